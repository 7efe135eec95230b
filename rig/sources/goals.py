"""CommonRoad's planning problem as a route: which lanes lead to its goal, a reference line along them, a goal on it."""

from __future__ import annotations

from typing import Any

import numpy as np

from common.geometry import Polyline
from common.messages import F64, Ego, Goal, Map, Route
from rig.sources import routing

GOAL_RADIUS_M = 3.0  # m, at least: recorded goals are as small as the place where one driver happened to be
OTHER_START_M = 1.5  # m of cost: lanes that hold the start nearly as well as the best one (junctions) may be chosen
TIMED_GOAL_PACE = 0.8  # of the initial speed: where a goal that is only a time is put


def route_to(map: Map, problem: Any, ego: Ego, time_s: float, warnings: list[str]) -> Route:
    """Where a planning problem wants the ego to go: lanes, a line along them, a goal; `time_s` until its end [s]."""
    roads = routing.Roads.of(map)
    starts = roads.at(ego.x, ego.y, ego.heading)
    starts = [k for k in starts if k[0] < starts[0][0] + OTHER_START_M]
    goal_state = problem.goal.state_list[0]
    if len(problem.goal.state_list) > 1:
        warnings.append(f"{len(problem.goal.state_list)} goal states; the first is driven to")
    listed = (problem.goal.lanelets_of_goal_position or {}).get(0, [])
    place = getattr(goal_state, "position", None)
    if listed:
        goals, centre = set(listed), None
    elif place is not None:
        centre = _centre(place)
        goals = _goal_lanes(roads, centre, getattr(goal_state, "orientation", None))
    else:
        goals, centre = set(), None
    path = _path(roads, starts, goals, ego.speed * time_s, warnings)
    if path:
        reference = np.ascontiguousarray(routing.reference(roads, path, ego.x, ego.y, ego.speed))
    else:
        ahead = np.array([np.cos(ego.heading), np.sin(ego.heading)])
        reference = np.array([ego.x, ego.y]) + np.linspace(-5.0, routing.BEYOND_M, 106)[:, None] * ahead
    line = Polyline.of(reference)
    here = float(line.project(np.array([ego.x, ego.y]))[0])
    if centre is not None:
        goal = _goal_at(centre, place, line, warnings)
    elif listed:
        goal = _goal_in_lane(roads, line, [i for i in path if i in goals], here)
    else:
        way = TIMED_GOAL_PACE * ego.speed * time_s
        x, y = line.at(min(here + max(way, 10.0), line.length))
        goal = Goal(x=float(x), y=float(y), radius=GOAL_RADIUS_M)
        warnings.append(f"the goal is only a time ({time_s:.1f} s): a point {way:.0f} m ahead stands for it")
    rest = line.length - float(line.project(np.array([goal.x, goal.y]))[0])
    if rest < routing.BEYOND_M:
        warnings.append(f"the map ends {max(rest, 0.0):.0f} m beyond the goal: the route goes straight on from there")
        more = line.at(line.length + np.arange(1.0, routing.BEYOND_M - rest + 1.0))
        reference = np.ascontiguousarray(np.vstack((reference, more)))
    driven = path or list(roads.lanes)
    limits = [roads.lanes[i].speed_limit for i in driven]
    width = float(np.median([roads.width(i) for i in driven]))
    return Route(
        reference=reference,
        goal=goal,
        lane_ids=path,
        speed_limit=max(limits),
        lane_width=float(np.clip(width, 2.0, 6.0)),
    )


def _path(
    roads: routing.Roads, starts: list[tuple[float, int]], goals: set[int], reach: float, warnings: list[str]
) -> list[int]:
    """Lanes to the goal and at least 100 m beyond it; empty: the ego starts on no lane that runs its way."""
    if not starts:
        warnings.append("the ego does not start on a lane that runs its way: the route is straight ahead")
        return []
    path = routing.lane_sequence(roads, starts, goals) if goals else None
    if path is None:
        if goals:
            warnings.append("no lanes connect the start with the goal: the route follows the lane")
        path = [starts[0][1]]
    return path + routing.following(roads, path[-1], max(routing.BEYOND_M, reach))[1:]


def _centre(place: Any) -> F64:
    return np.array(place.shapely_object.centroid.coords[0][:2], dtype=np.float64)


def _goal_lanes(roads: routing.Roads, centre: F64, orientation: Any) -> set[int]:
    """Lanes at the goal: the nearest, and others as near (lanes overlap in junctions)."""
    heading = None
    if orientation is not None and hasattr(orientation, "start"):
        heading = (float(orientation.start) + float(orientation.end)) / 2
    found = roads.at(float(centre[0]), float(centre[1]), heading) or roads.at(float(centre[0]), float(centre[1]), None)
    return {i for cost, i in found if cost < found[0][0] + 1.5}


def _goal_at(centre: F64, place: Any, line: Polyline, warnings: list[str]) -> Goal:
    shape = place.shapely_object
    reach = max(float(np.hypot(x - centre[0], y - centre[1])) for x, y in shape.exterior.coords)
    radius = float(np.clip(reach, GOAL_RADIUS_M, 20.0))
    off = abs(float(line.project(centre)[1]))
    if off > radius:
        warnings.append(f"the goal lies {off:.1f} m beside the route")
    return Goal(x=float(centre[0]), y=float(centre[1]), radius=radius)


def _goal_in_lane(roads: routing.Roads, line: Polyline, lanes: list[int], here: float) -> Goal:
    """A goal that is a lane: a point within its first 10 m (on the ego's own lane: 10 m ahead)."""
    lane = roads.lines[lanes[0]]
    enter, leave = (float(line.project(lane.points[k])[0]) for k in (0, -1))
    half = float(np.clip((leave - enter) / 2, GOAL_RADIUS_M, 10.0))
    x, y = line.at(max(enter + half, here + half))
    return Goal(x=float(x), y=float(y), radius=half)
