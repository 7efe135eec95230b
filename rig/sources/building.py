"""What built-in scenarios are made of: drawn parameters, actors on lines, roads, and a drive through them.

Roads are a few lines with lanes beside them (`roads`), in a frame of their own: forward along the ego's first lane,
left of it. Actors move along lines by arc length. A manoeuvre is a road, some actors and a goal, in about ten lines.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import msgspec
import numpy as np
import numpy.typing as npt

from common.geometry import Polyline, wrap_angle
from common.messages import F64, FRAME_S, Goal, Lane, Map, ObjectClass, Obstacle, Route
from rig.sources import roads
from rig.world import SIZES, Closure, Scenario, Track, ego_at

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

    def line(self, forward: float, to: float, left: float = 0.0, step: float = 1.0) -> F64:
        """A straight line at `left` from `forward` to `to` [m]; backwards if `to` is less; points every `step`."""
        n = max(2, round(abs(to - forward) / step) + 1)
        return self.places([(f, left) for f in np.linspace(forward, to, n)])

    def places(self, points: Sequence[tuple[float, float]]) -> F64:
        """Points (forward, left) in the `map` frame, [n, 2]."""
        c, s = np.cos(self.heading), np.sin(self.heading)
        return np.asarray(np.array(points, dtype=np.float64) @ np.array([[c, s], [-s, c]]))


@dataclass(frozen=True)
class Road:
    """What a drive needs: lanes and the ego's line, with arc length 0 at its start."""

    lanes: list[Lane]
    line: Polyline
    obstacles: tuple[Obstacle, ...] = ()
    lane_ids: tuple[int, ...] = (1,)
    ways: dict[str, Polyline] = field(default_factory=dict)
    """Lines of the others, by name."""


# --- actors ---


def along(
    id: int,
    cls: ObjectClass,
    line: Polyline,
    s: npt.ArrayLike,
    offset: npt.ArrayLike = 0.0,
    *,
    backwards: bool = False,
    size: tuple[float, float] | None = None,
) -> Track:
    """A track that moves along `line` at arc lengths `s` [m], one a frame, `offset` [m] to the left of the line."""
    s = np.asarray(s, dtype=np.float64)
    beside = np.broadcast_to(np.asarray(offset, dtype=np.float64), s.shape)
    p, heading = line.at(s), line.heading(s)
    normal = np.stack((-np.sin(heading), np.cos(heading)), axis=-1)
    p = p + beside[:, None] * normal
    if np.ndim(offset):
        drift = np.concatenate(([0.0], np.diff(beside)))
        heading = heading + np.arctan2(drift, np.maximum(np.concatenate(([1.0], np.diff(s))), 1e-3))
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
        heading=np.asarray(wrap_angle(heading + (np.pi if backwards else 0.0))),
        first_velocity=(float(v[0]), float(v[1])),
    )


def travelled(duration_s: float, speeds: Sequence[tuple[float, float]]) -> F64:
    """Distance driven [m] at each frame for a speed that is linear between points (t [s], v [m/s])."""
    t = np.arange(round(duration_s / FRAME_S) + 1) * FRAME_S
    v = np.interp(t, [p[0] for p in speeds], [p[1] for p in speeds])
    return np.concatenate(([0.0], np.cumsum((v[1:] + v[:-1]) / 2 * FRAME_S)))


def shifting(duration_s: float, begin_s: float, takes_s: float, start: float, end: float) -> F64:
    """An offset [m] at each frame that goes from `start` to `end` smoothly within `takes_s` [s]."""
    t = np.arange(round(duration_s / FRAME_S) + 1) * FRAME_S
    u = np.clip((t - begin_s) / takes_s, 0.0, 1.0)
    return np.asarray(start + (end - start) * u**3 * (10.0 - 15.0 * u + 6.0 * u * u))


def standing(
    id: int,
    cls: ObjectClass,
    line: Polyline,
    s: float,
    duration_s: float,
    offset: float = 0.0,
    *,
    backwards: bool = False,
    size: tuple[float, float] | None = None,
) -> Track:
    """One who does not move."""
    rest = np.full(round(duration_s / FRAME_S) + 1, s)
    return along(id, cls, line, rest, offset, backwards=backwards, size=size)


def crossing(
    id: int,
    cls: ObjectClass,
    line: Polyline,
    at: float,
    right: float,
    left: float,
    walk: F64,
    *,
    to_right: bool = False,
) -> Track:
    """One who crosses `line` at arc length `at`, from `right` [m] beside it to `left` beyond it, or the other way."""
    foot, heading = line.at(at), float(line.heading(at))
    normal = np.array([-np.sin(heading), np.cos(heading)])
    ends = [foot - right * normal, foot + left * normal]
    way = Polyline.of(np.array(ends[::-1] if to_right else ends))
    return along(id, cls, way, np.minimum(walk, way.length - 1.0))


# --- the drive ---


def drive(
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
    lane_width: float = 3.5,
    stop: bool = False,
    closures: Sequence[Closure] = (),
) -> Scenario:
    """A drive along the road's line from `start_m` [m] at `speed` [m/s] to a goal `goal_m` farther on."""
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
            lane_ids=list(road.lane_ids),
            speed_limit=limit,
            lane_width=lane_width,
        ),
        ego0=ego_at(float(x), float(y), float(road.line.heading(start_m)), speed),
        tracks=tuple(tracks),
        closures=tuple(closures),
    )


# --- roads ---


def straight_line(draw: Draw, length: float) -> F64:
    """A straight line from the origin, [n, 2]."""
    return draw.line(0.0, length)


def two_way(draw: Draw, length: float) -> Road:
    """Two lanes of 3.5 m; the ego's line is the right lane's centre, the oncoming lane's centre 3.5 m to its left."""
    line = straight_line(draw, length)
    own = Polyline.of(roads.beside(line, -1.75))
    return Road(roads.two_way(line), own, ways={"oncoming": Polyline.of(own.points[::-1])})


def one_way(draw: Draw, length: float, lanes: int = 1, width: float = 3.5) -> Road:
    """Lanes that all run the ego's way; its own is the rightmost."""
    line = straight_line(draw, length)
    return Road(roads.one_way(line, lanes=lanes, width=width), Polyline.of(line))


def stop_line(id: int, road: Road, at: float, half_width: float = 1.75) -> Road:
    """The road with a stop line across the ego's lane at arc length `at`."""
    return _across(id, "stop_line", road, at, (-half_width, half_width), 0.3)


def barrier(id: int, road: Road, at: float, right: float, left: float) -> Road:
    """The road with a barrier across it at arc length `at`, from `right` to `left` of the ego's line [m]."""
    return _across(id, "barrier", road, at, (-right, left), 0.3)


def _across(id: int, kind: str, road: Road, at: float, span: tuple[float, float], width: float) -> Road:
    foot, heading = road.line.at(at), float(road.line.heading(at))
    normal = np.array([-np.sin(heading), np.cos(heading)])
    points = np.ascontiguousarray([foot + d * normal for d in span])
    obstacle = Obstacle(id=id, kind=kind, points=points, width=width)  # type: ignore[arg-type]
    return Road(road.lanes, road.line, (*road.obstacles, obstacle), road.lane_ids, road.ways)


def joined(lanes: list[Lane], successors: dict[int, list[int]]) -> list[Lane]:
    """The same lanes with these successors, by id; the others have none."""
    return [msgspec.structs.replace(k, successors=successors.get(k.id, [])) for k in lanes]


def connector(id: int, line: F64, successors: list[int]) -> Lane:
    """A lane through a junction: nothing is painted beside it."""
    return roads.lane(id, line, left="virtual", right="virtual", successors=successors, limit=LIMIT)
