"""Manoeuvres where roads meet: turns, lights, a roundabout, the way back."""

from __future__ import annotations

import numpy as np

from common.geometry import Polyline
from common.messages import F64, BoundaryType, Obstacle
from rig.sources import roads
from rig.sources.building import (
    BEHIND_M,
    REST_M,
    Draw,
    Road,
    along,
    connector,
    drive,
    joined,
    stop_line,
    travelled,
)
from rig.sources.on_road import CAR, LIGHT
from rig.world import Closure, Scenario

HALF = 14.0
"""Half the size of a junction [m]."""


def junction(draw: Draw, before: float, after: float, angle: float = 0.0, radius: float = 10.0) -> tuple[Road, float]:
    """Two roads of two lanes that cross; the ego's line turns by `angle` [rad], 0: goes straight on.

    Returns the road, with the lines of the others in `ways` (`oncoming`, `from_left`, `from_right`), and the arc length
    at which the ego's line leaves the junction. It enters at BEHIND_M + before. Frame: forward along the ego's lane,
    whose centre is left = 0; the junction's centre is at (mid, 1.75).
    """
    into = BEHIND_M + before
    mid, arm = into + HALF, after + REST_M
    far = mid + HALF + arm
    start = (0.0, 0.0, draw.heading)
    if angle:
        bend = roads.turn(angle, radius, 0.5 * radius)
        end = roads.line_of(bend)[-1]  # (forward, left) that the bend takes
        lead_in = HALF - float(end[0]) + np.sign(angle) * 1.75
        lead_out = HALF + (-float(end[1]) + 1.75 if angle > 0 else float(end[1]) - 1.75)
        length = lead_in + sum(p[0] for p in bend) + lead_out
        pieces = [(into + lead_in, 0.0, 0.0), *bend, (lead_out + arm, 0.0, 0.0)]
    else:
        length = 2 * HALF
        pieces = [(far, 0.0, 0.0)]
    line = Polyline.of(roads.line_of(pieces, start))
    leaves = into + length

    def turned(forward: float, a: float, b: float) -> F64:
        """A line across, at `forward`, from a to b to the left."""
        return Polyline.of(draw.places([(forward, a), (forward, b)])).resampled(1.0).points

    top, bottom = 1.75 + HALF, 1.75 - HALF
    ways = {
        "oncoming": Polyline.of(draw.line(far, 0.0, 3.5)),
        "from_left": Polyline.of(turned(mid - 1.75, top + arm, bottom - arm)),
        "from_right": Polyline.of(turned(mid + 1.75, bottom - arm, top + arm)),
    }
    own = {1.0: 5, -1.0: 8}.get(float(np.sign(angle)), 3)
    lanes = [
        *joined(roads.two_way(draw.line(0.0, into, 1.75), ids=(1, 2)), {1: [12, *([11] if angle else [])]}),
        *joined(roads.two_way(draw.line(mid + HALF, far, 1.75), ids=(3, 4)), {4: [13]}),
        *joined(roads.two_way(turned(mid, top, top + arm), ids=(5, 6)), {6: [14]}),
        *joined(roads.two_way(turned(mid, bottom - arm, bottom), ids=(7, 8)), {7: [15]}),
        connector(12, draw.line(into, mid + HALF), [3]),
        connector(13, draw.line(mid + HALF, into, 3.5), [2]),
        connector(14, turned(mid - 1.75, top, bottom), [8]),
        connector(15, turned(mid + 1.75, bottom, top), [5]),
    ]
    if angle:
        lanes.append(connector(11, line.cut(into, leaves).points, [own]))
    return Road(lanes, line, lane_ids=(1, 11, own) if angle else (1, 12, 3), ways=ways), leaves


def left_turn(draw: Draw) -> Scenario:
    """Left at a junction of two-lane roads, after one oncoming car has gone through."""
    before, after, duration = 40.0, 60.0, 28.0
    road, leaves = junction(draw, before, after, np.pi / 2)
    way = road.ways["oncoming"]
    far = way.length - (BEHIND_M + before + HALF)
    move = travelled(duration, [(0, draw.about(10.0, 1.0))])
    car = along(1, CAR, way, far - draw.about(22.0, 4.0) + move)
    goal = leaves - BEHIND_M + after / 2
    return drive("left_turn", "Left turn at a junction", road, duration, draw.about(9.0, 1.0), goal, [car])


def right_turn(draw: Draw) -> Scenario:
    """Right at a junction of two-lane roads; a car comes along the road that is turned into."""
    before, after, duration = 40.0, 60.0, 28.0
    road, leaves = junction(draw, before, after, -np.pi / 2, radius=8.0)
    way = road.ways["from_left"]
    move = travelled(duration, [(0, draw.about(9.0, 1.0))])
    car = along(1, CAR, way, way.length / 2 - draw.about(2.0, 6.0) + move)
    goal = leaves - BEHIND_M + after / 2
    return drive("right_turn", "Right turn at a junction", road, duration, draw.about(8.0, 1.0), goal, [car])


def unprotected_left(draw: Draw) -> Scenario:
    """Left across a stream of oncoming cars: a gap too small, then one that is wide enough."""
    before, after, duration = 40.0, 60.0, 38.0
    road, leaves = junction(draw, before, after, np.pi / 2)
    way, speed = road.ways["oncoming"], draw.about(9.0, 0.8)
    middle = way.length - (BEHIND_M + before + HALF)
    when = draw.about(4.0, 0.7)  # s, when the first is in the middle of the junction
    cars = []
    for k, gap in enumerate((0.0, 2.3, 3.0, 2.3, draw.about(11.0, 1.0))):
        when += gap
        cars.append(along(k + 1, CAR, way, middle - speed * when + travelled(duration, [(0, speed)])))
    goal = leaves - BEHIND_M + after / 2
    title = "Unprotected left across oncoming traffic"
    return drive("unprotected_left", title, road, duration, draw.about(8.5, 0.8), goal, cars)


def red_light(draw: Draw) -> Scenario:
    """A red light at a junction while others cross; then green."""
    before, after, duration = 55.0, 60.0, 36.0
    road, leaves = junction(draw, before, after)
    road = stop_line(LIGHT, road, BEHIND_M + before - 1.0)
    green = draw.about(13.0, 2.0)
    speed = draw.about(9.0, 1.0)
    cars = []
    for k, (name, when) in enumerate((("from_left", 4.0), ("from_right", 6.5), ("from_left", 9.0))):
        way = road.ways[name]
        move = way.length / 2 - speed * draw.about(when, 0.6) + travelled(duration, [(0, speed)])
        cars.append(along(k + 1, CAR, way, move))
    goal = leaves - BEHIND_M + after / 2
    closed = [Closure(LIGHT, 0.0, green)]
    return drive("red_light", "Red, then green", road, duration, draw.about(10.0, 1.0), goal, cars, closures=closed)


def roundabout(draw: Draw) -> Scenario:
    """Straight on through a roundabout, giving way to who is in it."""
    before, after, duration = 45.0, 60.0, 38.0
    radius, angle, bend_in = 15.0, 0.85, 12.0
    enter = roads.turn(-angle, bend_in, 4.0)
    around = [(2 * angle * radius, 1 / radius, 1 / radius)]
    pieces = [(BEHIND_M + before, 0.0, 0.0), *enter, *around, *enter, (after + REST_M, 0.0, 0.0)]
    local = roads.line_of(pieces)
    s_in = BEHIND_M + before
    bend_length = sum(p[0] for p in enter)
    s_ring, s_leave = s_in + bend_length, s_in + bend_length + 2 * angle * radius
    s_out = s_leave + bend_length
    own = Polyline.of(local)
    at, heading = own.at(s_ring), -angle
    centre = at + radius * np.array([-np.sin(heading), np.cos(heading)])

    def placed(points: F64) -> F64:
        return draw.places([(float(p[0]), float(p[1])) for p in points])

    turned = np.array([[0.0, -1.0], [1.0, 0.0]])  # the way from the left arm: the own one, a quarter turn clockwise
    rings = [np.arange(k, k + 19) * np.pi / 36 for k in range(0, 72, 18)]
    circle = [centre + radius * np.stack((np.cos(a), np.sin(a)), axis=-1) for a in rings]
    left_way = (local - centre) @ turned + centre
    line, other = Polyline.of(placed(local)), Polyline.of(placed(left_way))
    lanes = [
        roads.lane(1, line.cut(0.0, s_in).points, left="solid", successors=[11]),
        connector(11, line.cut(s_in, s_out).points, [2]),
        roads.lane(2, line.cut(s_out, line.length).points, left="solid"),
        roads.lane(3, other.cut(0.0, s_in).points, left="solid", successors=[12]),
        connector(12, other.cut(s_in, s_out).points, [4]),
        roads.lane(4, other.cut(s_out, other.length).points, left="solid"),
        *[connector(20 + k, placed(c), [20 + (k + 1) % 4]) for k, c in enumerate(circle)],
    ]
    t = np.linspace(0.0, 2 * np.pi, 49)
    island = placed(centre + (radius - 3.0) * np.stack((np.cos(t), np.sin(t)), axis=-1))
    kerb = Obstacle(id=92, kind="kerb", points=np.ascontiguousarray(island), width=0.3)
    road = Road(lanes, line, (kerb,), (1, 11, 2))
    cars = []
    when, speed = draw.about(5.5, 0.8), draw.about(6.5, 0.5)
    for k, gap in enumerate((0.0, 2.6, draw.about(9.0, 1.0))):
        when += gap  # s, when he passes in front of the entry
        meets = 0.5 * (s_ring + s_leave)
        cars.append(along(k + 1, CAR, other, meets - speed * when + travelled(duration, [(0, speed)])))
    goal = s_out - BEHIND_M + after / 2
    return drive("roundabout", "Through a roundabout", road, duration, draw.about(8.0, 0.8), goal, cars)


def u_turn(draw: Draw) -> Scenario:
    """Round on a wide road with a painted median: from the inner lane into the inner lane of the other direction."""
    before, after, duration = 35.0, 35.0, 34.0
    bend = roads.turn(np.pi, 6.0, 5.0)
    across = float(roads.line_of(bend)[-1][1])  # distance between the two inner lanes' centres
    begin = BEHIND_M + before
    whole = Polyline.of(
        roads.line_of([(begin, 0.0, 0.0), *bend, (begin + after + REST_M, 0.0, 0.0)], (0.0, 0.0, draw.heading))
    )
    opening = 24.0  # the gap in the median [m], from 6 m before the bend begins
    total = begin + opening + 100.0
    axis = Polyline.of(draw.line(0.0, total))
    cuts = [0.0, begin - 6.0, begin - 6.0 + opening, total]
    lanes = []
    for k in range(3):
        part = axis.cut(cuts[k], cuts[k + 1]).resampled(1.0).points
        inner: BoundaryType = "virtual" if k == 1 else "solid"
        here, back = 10 * (k + 1), 10 * (k + 1) + 5
        ahead = [] if k == 2 else [here + 10]
        behind = [] if k == 0 else [back - 10]
        sides = [
            (here, 0.0, False, [*ahead, *([40] * (k == 0))], ahead),
            (back, across, True, behind, behind),
        ]
        for id, at, reverse, after_inner, after_outer in sides:
            outer = at + (3.5 if reverse else -3.5)
            lanes += [
                roads.lane(
                    id, part, at, reverse=reverse, left=inner, right="dashed", right_lane=id + 1, successors=after_inner
                ),
                roads.lane(id + 1, part, outer, reverse=reverse, left_lane=id, successors=[n + 1 for n in after_outer]),
            ]
    arc = sum(p[0] for p in bend)
    lanes.append(connector(40, whole.cut(cuts[1], begin + arc + 6.0).points, [15]))
    road = Road(lanes, whole, lane_ids=(10, 40, 15))
    return drive("u_turn", "U-turn on a wide road", road, duration, draw.about(7.0, 1.0), before + arc + after)
