"""Built-in scenarios: small worlds by name, for a first look without any data and for tests with a known answer.

Seed 0 is the nominal case; any other seed draws speeds, gaps and moments around it and turns the whole world to
another heading, so that nothing rests on a lucky number or on a road that runs along x.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import msgspec
import numpy as np
import numpy.typing as npt

from common.geometry import Polyline
from common.messages import F64, FRAME_S, BoundaryType, Goal, Lane, Map, ObjectClass, Obstacle, Route
from rig.sources import roads
from rig.world import SIZES, Scenario, Track, ego_at

LIMIT = 13.9  # m/s, 50 km/h
BEHIND_M = 60.0  # road behind the ego at the start
REST_M = 120.0  # road beyond the goal


class Draw:
    """Parameters: nominal for seed 0, otherwise drawn around the nominal value."""

    def __init__(self, seed: int) -> None:
        self.nominal = seed == 0
        self._random = np.random.default_rng(seed)
        self.heading = 0.0 if self.nominal else float(self._random.uniform(-np.pi, np.pi))

    def about(self, value: float, spread: float) -> float:
        """`value`, or one within ± `spread` of it."""
        return value if self.nominal else float(value + self._random.uniform(-spread, spread))


@dataclass(frozen=True)
class Road:
    """What a scenario's maker needs: lanes and the ego's line, with arc length 0 at its start."""

    lanes: list[Lane]
    line: Polyline
    obstacles: tuple[Obstacle, ...] = ()


def along(
    id: int,
    cls: ObjectClass,
    line: Polyline,
    s: npt.ArrayLike,
    offset: float = 0.0,
    *,
    backwards: bool = False,
    size: tuple[float, float] | None = None,
) -> Track:
    """A track that moves along `line` at arc lengths `s` [m], one a frame, `offset` [m] to the left of the line."""
    s = np.asarray(s, dtype=np.float64)
    p, heading = line.at(s), line.heading(s)
    normal = np.stack((-np.sin(heading), np.cos(heading)), axis=-1)
    p = p + offset * normal
    v = (p[1] - p[0]) / FRAME_S
    length, width = size or SIZES[cls]
    return Track(
        id=id,
        cls=cls,
        length=length,
        width=width,
        frame0=0,
        x=p[:, 0].copy(),
        y=p[:, 1].copy(),
        heading=heading + (np.pi if backwards else 0.0),
        first_velocity=(float(v[0]), float(v[1])),
    )


def travelled(duration_s: float, speeds: Sequence[tuple[float, float]]) -> F64:
    """Distance driven [m] at each frame for a speed that is linear between points (t [s], v [m/s])."""
    t = np.arange(round(duration_s / FRAME_S) + 1) * FRAME_S
    v = np.interp(t, [p[0] for p in speeds], [p[1] for p in speeds])
    return np.concatenate(([0.0], np.cumsum((v[1:] + v[:-1]) / 2 * FRAME_S)))


def _drive(
    name: str,
    title: str,
    road: Road,
    duration_s: float,
    speed: float,
    goal_m: float,
    tracks: Sequence[Track] = (),
    *,
    start_m: float = BEHIND_M,
    limit: float = LIMIT,
    lane_ids: Sequence[int] = (),
    lane_width: float = 3.5,
    stop: bool = False,
) -> Scenario:
    x, y = road.line.at(start_m)
    gx, gy = road.line.at(start_m + goal_m)
    goal = Goal(x=float(gx), y=float(gy), radius=3.0, stop=stop)
    return Scenario(
        name=name,
        title=title,
        source="built-in",
        duration_s=duration_s,
        map=Map(lanes=road.lanes, obstacles=list(road.obstacles)),
        route=Route(
            reference=np.ascontiguousarray(road.line.points),
            goal=goal,
            lane_ids=list(lane_ids),
            speed_limit=limit,
            lane_width=lane_width,
        ),
        ego0=ego_at(float(x), float(y), float(road.line.heading(start_m)), speed),
        tracks=tuple(tracks),
    )


def _straight_line(draw: Draw, length: float) -> F64:
    return roads.line_of([(length, 0.0, 0.0)], (0.0, 0.0, draw.heading), step=1.0)


def _two_way(draw: Draw, length: float) -> Road:
    """Two lanes of 3.5 m; the ego's line is the right lane's centre, the oncoming lane's centre 3.5 m to its left."""
    line = _straight_line(draw, length)
    return Road(roads.two_way(line), Polyline.of(roads.beside(line, -1.75)))


def straight(draw: Draw) -> Scenario:
    """An empty road of two lanes."""
    goal = 200.0
    speed = draw.about(10.0, 3.0)
    return _drive(
        "straight", "Empty straight road", _two_way(draw, BEHIND_M + goal + REST_M), 22.0, speed, goal, lane_ids=[1]
    )


def following(draw: Draw) -> Scenario:
    """A car ahead in a one-lane street slows down, speeds up again; there is no way past it."""
    goal, duration = 150.0, 30.0
    line = _straight_line(draw, BEHIND_M + goal + 3 * REST_M)
    road = Road(roads.one_way(line, lanes=1), Polyline.of(line))
    slow = draw.about(4.0, 1.0)
    lead = travelled(duration, [(0, 9), (6, 9), (9, slow), (14, slow), (19, 10), (30, 10)])
    gap = draw.about(28.0, 5.0)
    car = along(1, ObjectClass.CAR, road.line, BEHIND_M + gap + lead)
    title = "Following a car that slows down and speeds up"
    return _drive("following", title, road, duration, draw.about(11.0, 1.0), goal, [car], lane_ids=[1])


def slow_pedestrian(draw: Draw) -> Scenario:
    """A pedestrian walks in the lane along its right edge; the ego has room to pass on the left."""
    goal, duration = 130.0, 25.0
    road = _two_way(draw, BEHIND_M + goal + REST_M)
    walk = travelled(duration, [(0, draw.about(1.2, 0.3))])
    walker = along(
        1, ObjectClass.PEDESTRIAN, road.line, BEHIND_M + draw.about(45.0, 8.0) + walk, draw.about(-1.3, 0.15)
    )
    title = "Overtaking a slow pedestrian at the roadside"
    return _drive("slow_pedestrian", title, road, duration, draw.about(8.3, 1.0), goal, [walker], lane_ids=[1])


def truck_adjacent(draw: Draw, cls: ObjectClass = ObjectClass.TRUCK) -> Scenario:
    """At 50 km/h past a slower truck in the next lane; both centred in lanes of 3.5 m."""
    goal, duration = 300.0, 28.0
    line = _straight_line(draw, BEHIND_M + goal + 2 * REST_M)
    road = Road(roads.one_way(line, lanes=2), Polyline.of(line))
    speed = draw.about(10.0, 0.8)
    truck = along(1, cls, road.line, BEHIND_M + draw.about(35.0, 6.0) + travelled(duration, [(0, speed)]), 3.5)
    name = "truck_adjacent"
    return _drive(
        name, "Past a truck in the adjacent lane at 50 km/h", road, duration, LIMIT, goal, [truck], lane_ids=[1]
    )


def crossing_pedestrian(draw: Draw) -> Scenario:
    """A pedestrian steps off the pavement and crosses in front of the ego."""
    goal, duration = 120.0, 25.0
    road = _two_way(draw, BEHIND_M + goal + REST_M)
    at = BEHIND_M + draw.about(50.0, 4.0)
    walk = travelled(duration, [(0, draw.about(1.3, 0.2))])
    foot, heading = road.line.at(at), float(road.line.heading(at))
    left = np.array([-np.sin(heading), np.cos(heading)])
    crossing = Polyline.of(np.array([foot - 6.5 * left, foot + 12.0 * left]))
    walker = along(1, ObjectClass.PEDESTRIAN, crossing, np.minimum(walk, crossing.length - 1.0))
    title = "A pedestrian crosses the road"
    return _drive("crossing_pedestrian", title, road, duration, draw.about(10.0, 1.0), goal, [walker], lane_ids=[1])


def left_turn(draw: Draw) -> Scenario:
    """Left at a junction of two-lane roads, after one oncoming car has gone through."""
    before, after, duration = 40.0, 60.0, 28.0
    half = 14.0  # the junction's half size [m]
    into = BEHIND_M + before
    # the ego's line: straight into the junction, a left turn of 90°, straight on
    radius, easing = 10.0, 5.0
    bend = roads.turn(np.pi / 2, radius, easing)
    end = roads.line_of(bend)[-1]  # (forward, left) that the bend takes
    lead_in = half - float(end[0]) + 1.75
    lead_out = half - float(end[1]) + 1.75
    start = (0.0, 0.0, draw.heading)
    pieces = [(into + lead_in, 0.0, 0.0), *bend, (lead_out + after + REST_M, 0.0, 0.0)]
    whole = Polyline.of(roads.line_of(pieces, start))
    bend_length = sum(p[0] for p in bend)
    s_in, s_out = into, into + lead_in + bend_length + lead_out
    c, s = np.cos(draw.heading), np.sin(draw.heading)
    turned = np.array([[c, s], [-s, c]])  # rows: forward, left

    def place(forward: float, left: float) -> F64:
        return np.asarray(np.array([forward, left]) @ turned)

    def straight_line(a: tuple[float, float], b: tuple[float, float]) -> F64:
        return Polyline.of(np.array([place(*a), place(*b)])).resampled(1.0).points

    # frame: forward along the ego's lane, whose centre is left = 0; the junction's centre is at (mid, 1.75)
    mid = into + half
    far = mid + half + after + REST_M
    road_in = straight_line((0.0, 1.75), (into, 1.75))
    road_on = straight_line((mid + half, 1.75), (far, 1.75))
    road_left = straight_line((mid, 1.75 + half), (mid, 1.75 + half + after + REST_M))
    road_right = straight_line((mid, 1.75 - half - 80.0), (mid, 1.75 - half))
    lanes = [
        *_joined(roads.two_way(road_in, ids=(1, 2)), {1: [11, 12]}),
        *_joined(roads.two_way(road_on, ids=(3, 4)), {4: [13]}),
        *_joined(roads.two_way(road_left, ids=(5, 6)), {6: [14]}),
        *_joined(roads.two_way(road_right, ids=(7, 8)), {7: [15]}),
        _connector(11, whole.cut(s_in, s_out).points, [5]),
        _connector(12, straight_line((into, 0.0), (mid + half, 0.0)), [3]),
        _connector(13, straight_line((mid + half, 3.5), (into, 3.5)), [2]),
        _connector(14, straight_line((mid - 1.75, 1.75 + half), (mid - 1.75, 1.75 - half)), [8]),
        _connector(15, straight_line((mid + 1.75, 1.75 - half), (mid + 1.75, 1.75 + half)), [5]),
    ]
    oncoming_line = Polyline.of(straight_line((far, 3.5), (0.0, 3.5)))
    car = along(
        1,
        ObjectClass.CAR,
        oncoming_line,
        far - mid - draw.about(22.0, 4.0) + travelled(duration, [(0, draw.about(10.0, 1.0))]),
    )
    road = Road(lanes, whole)
    goal = s_out - BEHIND_M + after / 2
    title = "Left turn at a junction"
    return _drive("left_turn", title, road, duration, draw.about(9.0, 1.0), goal, [car], lane_ids=[1, 11, 5])


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
    axis = Polyline.of(roads.line_of([(total, 0.0, 0.0)], (0.0, 0.0, draw.heading), step=1.0))
    cuts = [0.0, begin - 6.0, begin - 6.0 + opening, total]
    lanes = []
    for k in range(3):
        part = axis.cut(cuts[k], cuts[k + 1]).resampled(1.0).points
        inner: BoundaryType = "virtual" if k == 1 else "solid"
        here, back = 10 * (k + 1), 10 * (k + 1) + 5
        nxt = [] if k == 2 else [here + 10]
        prv = [] if k == 0 else [back - 10]
        lanes += [
            roads.lane(
                here, part, 0.0, left=inner, right="dashed", right_lane=here + 1, successors=[*nxt, *([40] * (k == 0))]
            ),
            roads.lane(here + 1, part, -3.5, right="road_edge", left_lane=here, successors=[n + 1 for n in nxt]),
            roads.lane(
                back, part, across, reverse=True, left=inner, right="dashed", right_lane=back + 1, successors=prv
            ),
            roads.lane(
                back + 1,
                part,
                across + 3.5,
                reverse=True,
                right="road_edge",
                left_lane=back,
                successors=[n + 1 for n in prv],
            ),
        ]
    arc = sum(p[0] for p in bend)
    lanes.append(_connector(40, whole.cut(cuts[1], begin + arc + 6.0).points, [15]))
    goal = before + arc + after
    road = Road(lanes, whole)
    title = "U-turn on a wide road"
    return _drive("u_turn", title, road, duration, draw.about(7.0, 1.0), goal, lane_ids=[10, 40, 15])


def demo(draw: Draw) -> Scenario:
    """Half a minute of town: a roadside pedestrian, oncoming traffic, people crossing, a cyclist; on a gentle bend."""
    goal, duration = 230.0, 36.0
    bend = [(BEHIND_M + 70.0, 0.0, 0.0), *roads.turn(0.6, 150.0, 20.0), (goal + REST_M, 0.0, 0.0)]
    line = roads.line_of(bend, (0.0, 0.0, draw.heading))
    ego_line = Polyline.of(roads.beside(line, -1.75)).resampled(0.5)
    road = Road(roads.two_way(line), ego_line)
    walk = travelled(duration, [(0, 1.1)])
    walker = along(1, ObjectClass.PEDESTRIAN, ego_line, BEHIND_M + draw.about(40.0, 5.0) + walk, -1.35)
    oncoming = Polyline.of(ego_line.points[::-1])
    tracks = [walker]
    for k, (cls, away, speed) in enumerate(
        [(ObjectClass.CAR, 150.0, 10.0), (ObjectClass.TRUCK, 230.0, 9.0), (ObjectClass.CAR, 300.0, 10.0)]
    ):
        s = oncoming.length - BEHIND_M - draw.about(away, 8.0) + travelled(duration, [(0, draw.about(speed, 1.0))])
        tracks.append(along(2 + k, cls, oncoming, s, -3.5))
    at = BEHIND_M + 150.0
    foot, heading = ego_line.at(at), float(ego_line.heading(at))
    left = np.array([-np.sin(heading), np.cos(heading)])
    for k, wait in enumerate((9.0, 10.5, 12.0)):
        crossing = Polyline.of(np.array([foot - 4.0 * left, foot + 9.0 * left]))
        begin = draw.about(wait, 0.5)
        steps = travelled(duration, [(0, 0), (begin, 0), (begin + 0.4, 1.35)])
        walk_s = np.minimum(steps, crossing.length - 1.0) - 0.8 * k
        tracks.append(along(5 + k, ObjectClass.PEDESTRIAN, crossing, walk_s, 0.7 * (k - 1)))
    ride = travelled(duration, [(0, draw.about(3.8, 0.3))])
    tracks.append(along(8, ObjectClass.BICYCLE, ego_line, BEHIND_M + 175.0 + ride, -1.3))
    title = "Half a minute of town traffic"
    return _drive("demo", title, road, duration, draw.about(9.0, 0.5), goal, tracks, lane_ids=[1])


def _joined(lanes: list[Lane], successors: dict[int, list[int]]) -> list[Lane]:
    return [msgspec.structs.replace(k, successors=successors.get(k.id, [])) for k in lanes]


def _connector(id: int, line: F64, successors: list[int]) -> Lane:
    """A lane through a junction: nothing is painted beside it."""
    return roads.lane(id, line, left="virtual", right="virtual", successors=successors, limit=LIMIT)


REPLAYED: tuple[str, ...] = ()
"""Scenarios whose others never react."""

SCENARIOS: dict[str, Callable[[Draw], Scenario]] = {
    "demo": demo,
    "straight": straight,
    "following": following,
    "slow_pedestrian": slow_pedestrian,
    "truck_adjacent": truck_adjacent,
    "crossing_pedestrian": crossing_pedestrian,
    "left_turn": left_turn,
    "u_turn": u_turn,
}
"""Every built-in scenario by name."""


def generate(name: str, seed: int = 0) -> Scenario:
    """Build a built-in scenario; KeyError for an unknown name."""
    return SCENARIOS[name](Draw(seed))
