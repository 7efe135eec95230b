"""Situations with those who come from elsewhere: crossing, turning, oncoming, at roundabouts.

The ego's lane runs along x at y = 0 where the road is straight; the others are timed by when they meet the ego's path.
"""

from __future__ import annotations

import numpy as np

from common.geometry import Polyline
from common.messages import F64, Lane, Map, ObjectClass
from evaluation.hazards.along import FRONT, LANE, LINE, LONG_S, episode
from evaluation.hazards.episode import Episode, grid
from evaluation.hazards.script import Draw, actor, straight, travelled
from rig.sources import roads
from rig.world import EGO_SIZE

LIMIT = 13.9
"""Speed limit in town [m/s]."""


def crossing_pedestrian(draw: Draw) -> Episode:
    """h: a pedestrian walks from the pavement straight into the ego's way."""
    t, v = grid(LONG_S), draw("speed", 11.0, 7.0, 14.0)
    walk, side = draw("walk", 1.4, 1.0, 2.2), draw.side("side")
    meet, late = draw("meets_at", 6.0, 4.5, 7.5), draw("late", 0.0, -0.9, 0.9)
    angle = draw("angle", 0.0, -0.35, 0.35)
    x = FRONT + v * meet
    away = 12.0
    from_ = (x - away * np.sin(angle), -side * away * np.cos(angle))
    line = straight(*from_, 2 * x - from_[0], -from_[1])
    s = away + walk * (t - meet - late)
    person = actor(ObjectClass.PEDESTRIAN, (0.5, 0.5), line, s)
    return episode("crossing_pedestrian", draw, two_way(LIMIT), v, [person], None)


def perpendicular_conflict(draw: Draw) -> Episode:
    """h: a car crosses at a right angle and nobody gives way."""
    return _perpendicular("perpendicular_conflict", draw, draw("late", 0.1, -1.1, 1.1))


def perpendicular_clear(draw: Draw) -> Episode:
    """A car crosses, clearly before or after the ego."""
    return _perpendicular("perpendicular_clear", draw, draw("late", 2.3, 1.5, 3.5) * draw.side("order"))


def _perpendicular(name: str, draw: Draw, late: float) -> Episode:
    t, v, size = grid(LONG_S), draw("speed", 11.0, 7.0, 15.0), draw.car()
    u, side, meet = draw("other_speed", 10.0, 5.0, 14.0), draw.side("side"), draw("meets_at", 6.0, 4.5, 7.0)
    x = v * meet
    angle = draw("angle", 0.0, -0.3, 0.3)
    line = _crossing_line(x, side, angle)
    s = 200.0 + u * (t - meet - late)
    car = actor(ObjectClass.CAR, size, line, s, draw.wander(t))
    return episode(name, draw, _crossroads(line), v, [car], None)


def _crossing_line(x: float, side: int, angle: float) -> Polyline:
    """The line that meets the ego's at x after 200 m, from the right (side +1) or left."""
    d = np.array([np.sin(angle), side * np.cos(angle)])
    return Polyline.of([np.array([x, 0.0]) - 200.0 * d, np.array([x, 0.0]) + 200.0 * d])


def _crossroads(line: Polyline) -> Map:
    return Map(lanes=[*two_way(LIMIT).lanes, roads.lane(9, line.points, limit=LIMIT, left="virtual", right="virtual")])


def side_street_car_stops(draw: Draw) -> Episode:
    """A car comes from the side street, brakes and stops at its line."""
    t, v, size = grid(LONG_S), draw("speed", 12.0, 8.0, 15.0), draw.car()
    u, side, meet = draw("other_speed", 9.0, 6.0, 12.0), draw.side("side"), draw("meets_at", 6.0, 4.5, 7.0)
    brake = draw("braking", 3.0, 2.2, 3.8)
    stops = meet - draw("stops_before", 1.0, -0.5, 2.0)
    rest = EGO_SIZE[1] / 2 + draw("clearance", 1.8, 1.3, 3.0) + size[0] / 2  # from the ego's line
    line = _crossing_line(v * meet, side, draw("angle", 0.0, -0.2, 0.2))
    s = travelled(t, [(stops - u / brake, u), (stops, 0.0)])
    car = actor(ObjectClass.CAR, size, line, 200.0 - rest + s - s[-1], 0.0)
    return episode("side_street_car_stops", draw, _crossroads(line), v, [car], None)


def oncoming_left_turn(draw: Draw) -> Episode:
    """h: an oncoming car turns left across the ego's path."""
    return _left_turn("oncoming_left_turn", draw, draw("late", 0.0, -0.8, 0.8))


def oncoming_left_turn_clears(draw: Draw) -> Episode:
    """An oncoming car turns left and is through before the ego comes."""
    return _left_turn("oncoming_left_turn_clears", draw, -draw("early", 2.8, 1.8, 4.0))


def _left_turn(name: str, draw: Draw, late: float) -> Episode:
    t, v, size = grid(LONG_S), draw("speed", 11.0, 8.0, 14.0), draw.car()
    u, radius, y = draw("turn_speed", 5.5, 4.5, 6.5), draw("radius", 12.0, 10.0, 14.0), draw("lane_y", 7.0, 6.0, 8.0)
    meet, fast = draw("meets_at", 6.5, 5.5, 7.5), draw("approach_speed", 9.0, 7.0, 12.0)
    into = 200.0
    points = roads.line_of([(into, 0.0, 0.0), *roads.turn(np.pi / 2, radius, 5.0), (120.0, 0.0, 0.0)], (0.0, y, np.pi))
    turn = Polyline.of(points)
    crosses = float(np.interp(-0.0, -points[:, 1], turn.s))  # arc length at which its centre is on the ego's line
    points = points + np.array([v * meet - turn.at(crosses)[0], 0.0])
    turn = Polyline.of(points)
    # it slows with 1.5 m/s² to the speed of the turn, which it has where the bend begins
    begin = meet + late - (crosses - into) / u
    s = travelled(t, [(begin - (fast - u) / 1.5, fast), (begin, u)])
    s = into + s - np.interp(begin, t, s)
    car = actor(ObjectClass.CAR, size, turn, s, 0.0)
    lanes = _turn_lanes(turn, into, into + np.pi / 2 * radius + 5.0, y)
    return episode(name, draw, Map(lanes=[*two_way(LIMIT).lanes, *lanes]), v, [car], begin)


def _turn_lanes(turn: Polyline, begin: float, end: float, y: float) -> list[Lane]:
    """Approach, bend, straight on and the road it turns into."""
    on = Polyline.of([turn.at(begin), turn.at(begin) - np.array([200.0, 0.0])])

    def lane(id: int, line: Polyline, successors: list[int]) -> Lane:
        return roads.lane(
            id, line.resampled(0.5).points, limit=LIMIT, left="virtual", right="virtual", successors=successors
        )

    return [
        lane(11, turn.cut(0.0, begin), [12, 13]),
        lane(12, turn.cut(begin, end), [14]),
        lane(13, on, []),
        lane(14, turn.cut(end, turn.length), []),
    ]


def u_turning_car(draw: Draw) -> Episode:
    """h: an oncoming car turns round in front of the ego."""
    t, v, size = grid(LONG_S), draw("speed", 11.0, 8.0, 14.0), draw.car()
    u, radius, y = draw("turn_speed", 3.6, 3.0, 4.2), draw("radius", 5.2, 4.8, 6.0), draw("lane_y", 8.0, 7.0, 9.0)
    meet, late = draw("meets_at", 6.5, 5.5, 7.5), draw("late", 0.0, -0.5, 0.5)
    into = 200.0
    points = roads.line_of([(into, 0.0, 0.0), *roads.turn(np.pi, radius, 2.5), (200.0, 0.0, 0.0)], (0.0, y, np.pi))
    line = Polyline.of(points)
    # where the car's middle comes within two metres of the ego's line
    reach = float(line.s[np.flatnonzero(points[:, 1] < 2.0)[0]])
    line = Polyline.of(points + np.array([v * meet + FRONT - line.at(reach)[0], 0.0]))
    begin = meet + late - (reach - into) / u
    fast = draw("approach_speed", 6.0, 4.5, 8.0)
    s = travelled(t, [(begin - (fast - u) / 1.5, fast), (begin, u), (begin + 5.0, u), (begin + 8.0, u + 5.0)])
    s = into + s - np.interp(begin, t, s)
    car = actor(ObjectClass.CAR, size, line, s)
    opposite = Polyline.of([line.at(0.0), line.at(into), line.at(into) - np.array([200.0, 0.0])])
    lanes = [*two_way(LIMIT).lanes[:1], roads.lane(21, opposite.resampled(2.0).points, limit=LIMIT)]
    return episode("u_turning_car", draw, Map(lanes=lanes), v, [car], begin)


def oncoming_on_bend(draw: Draw) -> Episode:
    """On a bend an oncoming car keeps to its lane, though for a moment it points at the ego."""
    t, v, size = grid(LONG_S), draw("speed", 11.0, 8.0, 13.0), draw.car()
    radius, way = draw("radius", 50.0, 35.0, 90.0), draw.side("way")
    u, meet = draw("other_speed", 11.0, 8.0, 13.0), draw("meets_at", 4.5, 3.0, 6.0)
    before = 300.0 + v * meet * draw("bend_begins", 0.6, 0.3, 0.8)
    bend = roads.turn(way * draw("bend_angle", 1.3, 0.9, 1.6), radius, 12.0)
    middle = roads.line_of([(before, 0.0, 0.0), *bend, (300.0, 0.0, 0.0)], (-300.0, LANE / 2, 0.0), step=1.0)
    path = Polyline.of(roads.beside(middle, -LANE / 2))
    other = Polyline.of(roads.beside(middle, LANE / 2)[::-1])
    at = other.project(path.at(300.0 + v * meet))[0]
    car = actor(ObjectClass.CAR, size, other, at + u * (t - meet), draw.wander(t))
    return episode("oncoming_on_bend", draw, Map(lanes=roads.two_way(middle, LANE, LIMIT)), v, [car], None, path)


def roundabout_entry(draw: Draw) -> Episode:
    """h: the ego drives into a roundabout just when a circulating car comes by."""
    return _roundabout("roundabout_entry", draw, stays=True)


def roundabout_exit(draw: Draw) -> Episode:
    """The circulating car leaves the roundabout by the exit before the ego's entry."""
    return _roundabout("roundabout_exit", draw, stays=False)


def _roundabout(name: str, draw: Draw, *, stays: bool) -> Episode:
    """An arm from the west: the ego enters to the right onto a ring that runs counter-clockwise.

    The ring's lane is a circle; entry and exit leave and join it as tangents by arcs to the right.
    """
    t, v, size = grid(LONG_S), draw("speed", 7.0, 5.5, 8.0), draw.car()
    R, u = draw("radius", 18.0, 15.0, 22.0), draw("other_speed", 7.0, 5.5, 8.0)
    late, meet = draw("late", 0.3, -1.0, 1.0), draw("meets_at", 6.0, 5.0, 7.0)
    tilt, easing, r = 0.8, 4.0, 14.0  # the entry turns right by so much [rad], with clothoids, at this radius [m]
    arc = tilt * r + easing
    begin = 300.0 + v * meet - arc
    entry = [(begin, 0.0, 0.0), *roads.turn(-tilt, r, easing)]
    onto = roads.line_of(entry, (-300.0, 0.0, 0.0))
    heading = -tilt
    ring_start = onto[-1]  # M: the entry's end, a point of the ring
    after = [*entry, (1.4 * R, 1 / R, 1 / R), *roads.turn(-tilt, r, easing), (300.0, 0.0, 0.0)]
    path = Polyline.of(roads.line_of(after, (-300.0, 0.0, 0.0)))
    join = begin + arc
    centre = ring_start + R * np.array([-np.sin(heading), np.cos(heading)])
    angle_m = np.arctan2(*(ring_start - centre)[::-1])
    angle_e = angle_m - draw("exit_before", 1.25, 1.15, 1.4)  # E: where the exit leaves the ring, before M
    exit_start = centre + R * np.array([np.cos(angle_e), np.sin(angle_e)])
    leaves = angle_e + np.pi / 2  # its direction at E; it turns right until it runs against the ego's arm
    exit_pieces = [*roads.turn(-(leaves + np.pi), r, easing), (200.0, 0.0, 0.0)]
    exit_line = roads.line_of(exit_pieces, (float(exit_start[0]), float(exit_start[1]), leaves))

    def ring(a: float, b: float) -> F64:
        w = np.linspace(a, b, 60)
        return np.asarray(centre + R * np.stack((np.cos(w), np.sin(w)), axis=-1))

    upstream = ring(angle_e - 4.5, angle_e)
    way = ring(angle_e, angle_m + 3.5)[1:] if stays else exit_line[1:]
    line = Polyline.of(np.concatenate((upstream, way)))
    # the ego is on the ring `late` before the other would be at M; it need not stay so long
    s_m = 4.5 * R + (angle_m - angle_e) * R
    s = s_m + u * (t - (join - 300.0) / v - late)
    car = actor(ObjectClass.CAR, size, line, s, 0.0)

    def lane(id: int, points: F64, successors: list[int]) -> Lane:
        line = Polyline.of(points).resampled(0.5).points
        return roads.lane(id, line, limit=LIMIT, left="virtual", right="virtual", successors=successors)

    lanes = [
        lane(31, path.cut(begin - 100.0, join).points, [33]),
        lane(32, ring(angle_e, angle_m), [33]),
        lane(33, ring(angle_m, angle_e + 2 * np.pi), [32, 34]),
        lane(34, exit_line, []),
    ]
    return episode(name, draw, Map(lanes=lanes), v, [car], None, path)


def two_way(limit: float) -> Map:
    """The ego's lane and one lane against it."""
    return Map(lanes=roads.two_way(LINE.points + np.array([0.0, LANE / 2]), LANE, limit))
