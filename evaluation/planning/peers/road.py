"""The world as CommonRoad's drivability checker wants it: the road's boundary, walls, and others as predicted.

Runs on the peer's Python.
"""

from __future__ import annotations

import itertools
import math
from typing import Any

import commonroad_dc.pycrcc as pycrcc
import numpy as np
from commonroad.scenario.lanelet import Lanelet, LaneletNetwork
from commonroad.scenario.scenario import Scenario
from commonroad_dc.boundary.boundary import create_road_boundary_obstacle
from serving import Line


def scenario(start: Line) -> Scenario:
    """A scenario of the lanes alone."""
    found = Scenario(0.1)
    lanes = start["lanes"]
    ids = {k["id"] for k in lanes}
    lanelets = [
        Lanelet(
            *_alike(k["left"], k["centre"], k["right"]), k["id"], successor=[i for i in k["successors"] if i in ids]
        )
        for k in lanes
    ]
    found.add_objects(LaneletNetwork.create_from_lanelet_list(lanelets, cleanup_ids=True))
    return found


def _alike(*lines: list[list[float]]) -> list[np.ndarray]:
    """The lines with as many points each, at equal shares of their lengths."""
    n = max(len(k) for k in lines)
    return [_resampled(np.array(k), n) for k in lines]


def _resampled(p: np.ndarray, n: int) -> np.ndarray:
    if len(p) == n:
        return p
    s = np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(p, axis=0).T))))
    at = np.linspace(0.0, s[-1], n)
    return np.column_stack([np.interp(at, s, p[:, i]) for i in (0, 1)])


def boundary(start: Line, lanes: Scenario) -> list[Any]:
    """What stands: the road's boundary as the checker makes it by default, and the map's barriers and kerbs."""
    group = create_road_boundary_obstacle(lanes, return_scenario_obstacle=False)
    walls = [wall(points, start["wall_width"]) for points in start["walls"]]
    return [group, *walls]


def wall(points: list[list[float]], width: float) -> Any:
    """A polyline as thin rectangles."""
    group = pycrcc.ShapeGroup()
    for (x0, y0), (x1, y1) in itertools.pairwise(points):
        length = math.hypot(x1 - x0, y1 - y0)
        if length > 1e-6:
            heading = math.atan2(y1 - y0, x1 - x0)
            group.add_shape(pycrcc.RectOBB(length / 2, width / 2, heading, (x0 + x1) / 2, (y0 + y1) / 2))
    return group


def checker(standing: list[Any], asked: Line, margin: tuple[float, float] = (0.0, 0.0)) -> Any:
    """A checker of one cycle; time step k is 0.1 k s from now. `margin` [m]: added to others' length and width."""
    found = pycrcc.CollisionChecker()
    for k in standing:
        found.add_collision_object(k)
    for points in asked["closed"]:
        found.add_collision_object(wall(points, 0.3))
    for o in asked["others"]:
        moving = pycrcc.TimeVariantCollisionObject(0)
        size = ((o["length"] + margin[0]) / 2, (o["width"] + margin[1]) / 2)
        for x, y, heading in zip(o["x"], o["y"], o["heading"], strict=True):
            moving.append_obstacle(pycrcc.RectOBB(*size, heading, x, y))
        found.add_collision_object(moving)
    return found
