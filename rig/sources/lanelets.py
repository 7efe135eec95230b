"""CommonRoad's lanelets, signs, stop lines and lights as our map and closures.

A boundary is what its `lineMarking` says: painted lines are lane lines, kerbs are kerbs, `no_marking` is nothing.
Without a marking it is a lane line (never a barrier), except where nothing can be painted: inside a junction, where it
runs through another lanelet that is no neighbour. A stop line is closed while every light for its lane is red.
"""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import shapely

from common.geometry import Polyline, wrap_angle
from common.messages import F64, FRAME_S, BoundaryType, Lane, Map, Obstacle
from rig.world import Closure, ScenarioError

MARKINGS: dict[str, BoundaryType] = {
    "dashed": "dashed",
    "dashed_dashed": "dashed",
    "broad_dashed": "dashed",
    "solid": "solid",
    "solid_solid": "solid",
    "solid_dashed": "solid",
    "dashed_solid": "solid",
    "broad_solid": "solid",
    "curb": "kerb",
    "lowered_curb": "kerb",
    "no_marking": "virtual",
}
STOP_LINE_WIDTH = 0.3  # m
TURN = np.radians(30.0)  # a successor that bends by more is a turn


def read_map(network: Any, fallback_limit: float, warnings: list[str]) -> Map:
    """Convert a lanelet network; odd lanelets are left out with a warning."""
    lanes = []
    bodies = {k.lanelet_id: shapely.Polygon(np.vstack((k.left_vertices, k.right_vertices[::-1]))[:, :2]).buffer(-0.3)
              for k in network.lanelets}  # fmt: skip
    shapely.prepare(list(bodies.values()))
    for lanelet in sorted(network.lanelets, key=lambda k: k.lanelet_id):
        try:
            lines = [
                np.ascontiguousarray(Polyline.of(v[:, :2]).points)
                for v in (lanelet.center_vertices, lanelet.left_vertices, lanelet.right_vertices)
            ]
        except ValueError as e:
            warnings.append(f"lanelet {lanelet.lanelet_id} left out: {e}")
            continue
        lanes.append(
            Lane(
                id=lanelet.lanelet_id,
                centre=lines[0],
                left=lines[1],
                right=lines[2],
                left_type=_boundary(lanelet, "left", lines[1], bodies),
                right_type=_boundary(lanelet, "right", lines[2], bodies),
                speed_limit=_limit(network, lanelet) or fallback_limit,
                successors=sorted(lanelet.successor),
                left_neighbour=lanelet.adj_left,
                left_same_direction=bool(lanelet.adj_left_same_direction) if lanelet.adj_left is not None else True,
                right_neighbour=lanelet.adj_right,
                right_same_direction=bool(lanelet.adj_right_same_direction) if lanelet.adj_right is not None else True,
            )
        )
    if not lanes:
        raise ScenarioError("no usable lanelet")
    known = {k.id for k in lanes}
    for k in lanes:
        lost = [n for n in (*k.successors, k.left_neighbour, k.right_neighbour) if n is not None and n not in known]
        if lost:
            warnings.append(f"lanelet {k.id} refers to {', '.join(map(str, lost))}, which the map does not hold")
    return Map(lanes=lanes, obstacles=_stop_lines(network, known))


def stop_line_id(lanelet_id: int) -> int:
    """Id of the stop line at a lanelet's end; ids of lanelets are positive, so that the two never meet."""
    return -lanelet_id - 1


def _boundary(lanelet: Any, side: str, line: F64, bodies: dict[int, Any]) -> BoundaryType:
    marking = getattr(lanelet, f"line_marking_{side}_vertices")
    name = "unknown" if marking is None else str(marking.value)
    if name in MARKINGS:
        return MARKINGS[name]
    if any(str(getattr(t, "value", t)) == "intersection" for t in lanelet.lanelet_type or ()):
        return "virtual"
    neighbours = {lanelet.lanelet_id, lanelet.adj_left, lanelet.adj_right, *lanelet.successor, *lanelet.predecessor}
    shape = shapely.LineString(line)
    inside = sum(
        shape.intersection(body).length for i, body in bodies.items() if i not in neighbours and body.intersects(shape)
    )
    return "virtual" if inside > 0.2 * shape.length else "unknown"


def _limit(network: Any, lanelet: Any) -> float:
    """Lowest speed limit among the lanelet's signs [m/s]; 0 without one."""
    values = []
    for i in lanelet.traffic_signs:
        sign = network.find_traffic_sign_by_id(i)
        for element in sign.traffic_sign_elements if sign is not None else ():
            if element.traffic_sign_element_id.name == "MAX_SPEED" and element.additional_values:
                values.append(float(element.additional_values[0]))
    values = [v for v in values if 0.0 < v < 100.0]
    return min(values, default=0.0)


def _stop_lines(network: Any, known: set[int]) -> list[Obstacle]:
    found = []
    for lanelet in network.lanelets:
        line = lanelet.stop_line
        if (line is None and not lanelet.traffic_lights) or lanelet.lanelet_id not in known:
            continue
        start, end = (None, None) if line is None else (line.start, line.end)
        if start is None or end is None:
            start, end = lanelet.left_vertices[-1], lanelet.right_vertices[-1]
        points = np.array([start[:2], end[:2]], dtype=np.float64)
        if np.hypot(*(points[1] - points[0])) > 0.1:
            found.append(
                Obstacle(id=stop_line_id(lanelet.lanelet_id), kind="stop_line", points=points, width=STOP_LINE_WIDTH)
            )
    return sorted(found, key=lambda k: -k.id)


# --- lights ---


def read_lights(network: Any, map: Map, dt: float, duration_s: float, route: list[int]) -> list[Closure]:
    """When each stop line is closed: all lights for the movements from its lane (on the route: for that one) are red.

    Yellow does not close. Where a lane has lights but no stop line, it is closed at its end.
    """
    lines = {k.id for k in map.obstacles if k.kind == "stop_line"}
    lanes = {k.id: k for k in map.lanes}
    closures: list[Closure] = []
    for lanelet in network.lanelets:
        lights = [network.find_traffic_light_by_id(i) for i in lanelet.traffic_lights]
        if lanelet.stop_line is not None:
            lights += [network.find_traffic_light_by_id(i) for i in lanelet.stop_line.traffic_light_ref or ()]
        lights = list({k.traffic_light_id: k for k in lights if k is not None}.values())
        if not lights or stop_line_id(lanelet.lanelet_id) not in lines:
            continue
        nexts = [n for n in lanelet.successor if n in lanes]
        on_route = [n for n in nexts if n in route and lanelet.lanelet_id in route]
        ways = {_way(lanes[lanelet.lanelet_id], lanes[n]) for n in on_route or nexts}
        concerned = [k for k in lights if _concerns(k, ways)] or lights
        for start, end in _red(concerned, dt, duration_s):
            closures.append(Closure(stop_line_id(lanelet.lanelet_id), start, end))
    return closures


def _way(lane: Lane, after: Lane) -> str:
    begin, end = Polyline.of(lane.centre), Polyline.of(after.centre)
    turn = float(wrap_angle(end.heading(end.length) - begin.heading(begin.length)))
    return "left" if turn > TURN else "right" if turn < -TURN else "straight"


def _concerns(light: Any, ways: set[str]) -> bool:
    direction = str(light.direction.value).lower()
    return direction == "all" or any(way in direction for way in ways)


def _red(lights: list[Any], dt: float, duration_s: float) -> list[tuple[float, float]]:
    """Spans [s] in which every one of the lights is red; a light that is off or has no cycle is never red."""
    steps = int(np.ceil(duration_s / dt)) + 1

    def red(light: Any, step: int) -> bool:
        cycle = light.traffic_light_cycle
        if cycle is None or not light.active or not cycle.cycle_elements:
            return False
        return str(cycle.get_state_at_time_step(step).value) in ("red", "redYellow")

    spans, step = [], 0
    for closed, group in itertools.groupby(all(red(k, i) for k in lights) for i in range(steps)):
        n = len(list(group))
        if closed:
            last = step + n >= steps
            spans.append((step * dt, 1e9 if last else (step + n) * dt))
        step += n
    return spans


def contradicted(closures: list[Closure], map: Map, tracks: Any) -> dict[int, str]:
    """Stop lines at which recorded vehicles drive through red: their lights do not belong to this record."""
    lines = {k.id: k.points for k in map.obstacles}
    lanes = {stop_line_id(k.id): Polyline.of(k.centre) for k in map.lanes}
    found: dict[int, str] = {}
    for closure in closures:
        a, b = lines[closure.id]
        along = float(lanes[closure.id].heading(lanes[closure.id].length))
        for track in tracks:
            t = (track.frame0 + np.arange(len(track.x))) * FRAME_S
            shut = (t[1:] >= closure.start_s + 1.0) & (t[1:] < closure.end_s)
            p = np.stack((track.x, track.y), axis=-1)
            crosses = shut & _crosses(p[:-1], p[1:], a, b) & (np.cos(track.heading[1:] - along) > 0.7)
            if track.cls in (1, 2, 3) and crosses.any():
                when = float(t[1:][crosses][0])
                found.setdefault(closure.id, f"{track.label or track.id} drives over it at {when:.1f} s")
    return found


def _crosses(p: F64, q: F64, a: F64, b: F64) -> Any:
    """Which of the segments p-q [n, 2] cross the segment a-b."""

    def side(u: F64, v: F64, w: F64) -> Any:
        return (v[..., 0] - u[..., 0]) * (w[..., 1] - u[..., 1]) - (v[..., 1] - u[..., 1]) * (w[..., 0] - u[..., 0])

    return ((side(a, b, p) <= 0) != (side(a, b, q) <= 0)) & (side(p, q, a) * side(p, q, b) < 0)
