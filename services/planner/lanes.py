"""What the map says along the route: speed limits, the own lane's edges, the neighbouring lanes.

Everything is an offset from the smooth reference line, d > 0 to the left, at stations every metre. Where the reference
line changes lanes, the lanes themselves go straight on: a `Track` is a lane with the ones that follow it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

from common.messages import Lane, Map, Route
from services.planner.projections import SPACING, Projections, Span
from services.planner.reference import ReferenceLine
from services.planner.work import Work, finished

F64 = npt.NDArray[np.float64]

_UNDER = 1.5  # m; a lane nearer to the reference line than this is the route's where the route names none
_OWN = 2.5  # m; and nobody's own lane is further away

Side = Literal["left", "right"]


@dataclass(frozen=True)
class Neighbour:
    """The lanes on one side; arrays over the stations."""

    exists: npt.NDArray[np.bool_]  # where there is one
    centre: F64  # offset of its centre line, going on beyond where it exists [m]
    slope: F64  # d centre / ds
    same_direction: npt.NDArray[np.bool_]


@dataclass(frozen=True)
class Track:
    """A lane of the route's direction and those that follow it; arrays over the stations."""

    first: int  # stations between which it lies along the reference line
    last: int
    centre: F64  # offset of its centre line, held beyond its ends [m]
    slope: F64  # d centre / ds
    bend: F64  # d² centre / ds² [1/m]
    leaves: int  # station from which it leads away from the reference line, or merges, until it ends; `last` if never


@dataclass(frozen=True)
class RouteLanes:
    """The road along the reference line; arrays over the stations."""

    limit: F64  # speed limit; inf where unknown [m/s]
    own_left: F64  # offset of the own lane's left edge [m]
    own_right: F64
    mapped: npt.NDArray[np.bool_]  # a lane of the map was found here
    left: Neighbour
    right: Neighbour
    tracks: tuple[Track, ...] = ()
    end: float = np.inf  # where the lanes under the reference line end, or run against it; inf: not before the line [m]

    @property
    def stations(self) -> F64:
        """Arc lengths of the stations [m]."""
        return np.asarray(SPACING * np.arange(len(self.limit)), dtype=np.float64)

    @staticmethod
    def of(reference: ReferenceLine, route: Route, road: Map) -> RouteLanes:
        """Collect them for the lanes of the route, or, if it names none, for those that lie under it."""
        return finished(RouteLanes.preparing(reference, route, road))

    @staticmethod
    def preparing(reference: ReferenceLine, route: Route, road: Map) -> Work[RouteLanes]:
        """The same, a little at a time."""
        lines = Projections(reference)
        n = len(lines.stations)
        by_id = {lane.id: lane for lane in road.lanes}
        lanes = [by_id[i] for i in route.lane_ids if i in by_id] or (yield from lines.along(road.lanes, _UNDER))
        limit, nearest = np.full(n, np.inf), np.full(n, _OWN)
        half = route.lane_width / 2 or 1.75
        own_left, own_right = np.full(n, half), np.full(n, -half)
        own = np.full(n, -1)  # index of the own lane among `lanes`
        found: list[tuple[Lane, npt.NDArray[np.intp]]] = []
        yield from lines.add(lane.centre for lane in lanes)
        for k, lane in enumerate(lanes):
            span = lines.span(lane.centre)
            if span is None:
                continue
            better = span.first + np.flatnonzero(np.abs(span.d) < nearest[span.here])
            if len(better):
                nearest[better] = np.abs(span.d[better - span.first])
                limit[better] = lane.speed_limit if lane.speed_limit > 0 else np.inf
                own[better] = k
                found.append((lane, better))
                yield 1
        yield from lines.add(line for lane, _ in found for line in (lane.left, lane.right))
        for lane, better in found:
            for edge, points in ((own_left, lane.left), (own_right, lane.right)):
                if (span := lines.span(points)) is not None:
                    there = better[(better >= span.first) & (better < span.first + len(span.d))]
                    edge[there] = span.d[there - span.first]
            yield 1
        return RouteLanes(
            limit,
            own_left,
            own_right,
            own >= 0,
            (yield from _neighbour(lines, lanes, own, by_id, "left")),
            (yield from _neighbour(lines, lanes, own, by_id, "right")),
            (yield from _tracks(lines, road.lanes)),
            (yield from _end(lines, own >= 0, road.lanes)),
        )

    def ends(self, station: int) -> bool:
        """Whether what is known up to a station ends before the reference line does."""
        return station < len(self.limit) - 1 - _ROAD_END

    def index(self, s: npt.ArrayLike) -> npt.NDArray[np.intp]:
        """Station at arc lengths `s`."""
        return np.asarray(
            np.minimum(np.maximum(np.rint(np.asarray(s) / SPACING).astype(np.intp), 0), len(self.limit) - 1)
        )


_ROAD_END = 10  # stations; what ends nearer than this to the reference line's end goes on as long as it does
_GAP = 5.0  # m; what lies nearer to the line's own end is no end of the road


def _end(lines: Projections, mapped: npt.NDArray[np.bool_], lanes: list[Lane]) -> Work[float]:
    """Where the road under the reference line ends [m]: beyond its last lane, or where lanes run against it.

    Without any lane there, the map is silent and the line is believed.
    """
    if mapped.any():
        last = float(lines.stations[np.flatnonzero(mapped)[-1]])
        return last if last < lines.stations[-1] - _GAP else np.inf
    against = yield from lines.against(lanes, _UNDER)
    return min(against, default=np.inf)


_BESIDE = 9.0  # m; tracks further away are of no use
_HALF = 5  # stations to each side over which offsets are smoothed
_LEAVING = 0.05  # a lane that ends at this slope to the reference line has left it, or has merged
_JOINT = 1.0  # m; a lane whose centre begins further from the end of another does not follow it


def _tracks(lines: Projections, lanes: list[Lane]) -> Work[tuple[Track, ...]]:
    """Every lane beside the reference line that runs its way, each with the ones before and after it."""
    n = len(lines.stations)
    along = yield from lines.along(lanes, _BESIDE)
    beside = ((lane.id, lines.span(lane.centre)) for lane in along)
    spans = {i: span for i, span in beside if span is not None and len(span.d) >= 2}
    after = {lane.id: [k for k in lane.successors if k in spans] for lane in lanes if lane.id in spans}
    before: dict[int, list[int]] = {i: [] for i in spans}
    for i, following in after.items():
        for k in following:
            before[k].append(i)
    tracks, used = [], set[int]()
    for i in sorted(spans, key=lambda k: spans[k].first):
        if i in used:
            continue
        chain = [i]
        while (later := _next(spans, chain[-1], after[chain[-1]], ahead=True)) is not None and later not in chain:
            chain.append(later)
        while (sooner := _next(spans, chain[0], before[chain[0]], ahead=False)) is not None and sooner not in chain:
            chain.insert(0, sooner)
        used.update(chain)
        merged = np.full(n, np.nan)
        for k in reversed(chain):
            merged[spans[k].here] = spans[k].d
        tracks.append(_track(merged))
        yield 2
    return tuple(tracks)


def _track(offsets: F64) -> Track:
    """A track from its offsets at the stations, NaN where it does not lie along the reference line."""
    n, known = len(offsets), np.flatnonzero(np.isfinite(offsets))
    first, last = int(known[0]), int(known[-1])
    # beyond its ends all is level: only so far has anything to be smoothed
    a, b = max(first - 4 * _HALF, 0), min(last + 4 * _HALF + 1, n)
    centre = _filled(_filled(offsets[a:b]))
    slope = np.gradient(centre, SPACING) if len(centre) > 1 else np.zeros(len(centre))
    bend = np.gradient(slope, SPACING) if len(centre) > 1 else np.zeros(len(centre))
    centre, slope, bend = (np.pad(q, (a, n - b), mode="edge") for q in (centre, slope, bend))
    beside = np.flatnonzero(np.abs(slope[first : last + 1]) <= _LEAVING)
    leaves = first + int(beside[-1]) if len(beside) else first
    return Track(first, last, centre, slope, bend, leaves)


def _next(spans: dict[int, Span], lane: int, others: list[int], *, ahead: bool) -> int | None:
    """Which of the lanes after (or before) one goes on from it most smoothly."""
    end = -1 if ahead else 0
    jumps = {k: abs(float(spans[k].d[-1 - end]) - float(spans[lane].d[end])) for k in others}
    best = min(jumps, key=lambda k: jumps[k], default=None)
    return best if best is not None and jumps[best] <= _JOINT else None


def _neighbour(
    lines: Projections, lanes: list[Lane], own: npt.NDArray[np.intp], by_id: dict[int, Lane], side: Side
) -> Work[Neighbour]:
    n = len(own)
    centre, same = np.full(n, np.nan), np.ones(n, dtype=bool)
    sign = 1.0 if side == "left" else -1.0
    found = [(int(k), by_id.get(_neighbour_id(lanes[k], side))) for k in np.unique(own[own >= 0])]
    yield from lines.add(other.centre for _, other in found if other is not None)
    for k, other in found:
        span = None if other is None else lines.span(other.centre)
        if span is None:
            continue
        along = lanes[k].left_same_direction if side == "left" else lanes[k].right_same_direction
        good = span.first + np.flatnonzero((own[span.here] == k) & (sign * span.d > 1.0))
        centre[good], same[good] = span.d[good - span.first], along
    filled = _filled(centre)
    slope = np.gradient(filled, SPACING) if n > 1 else np.zeros(n)
    return Neighbour(np.isfinite(centre), filled, slope, same)


def _neighbour_id(lane: Lane, side: Side) -> int:
    other = lane.left_neighbour if side == "left" else lane.right_neighbour
    return -(2**63) if other is None else other


def _filled(a: F64) -> F64:
    """NaN replaced by the nearest known value, then smoothed over a few metres."""
    known = np.flatnonzero(np.isfinite(a))
    if not len(known):
        return np.zeros_like(a)
    full = np.interp(np.arange(len(a)), known, a[known])
    k = np.hanning(2 * _HALF + 3)[1:-1]
    return np.convolve(np.pad(full, _HALF, mode="edge"), k / k.sum(), mode="valid")
