"""What the map says along the route: speed limits, the own lane's edges, the neighbouring lanes.

Everything is an offset from the smooth reference line, d > 0 to the left, at stations every metre. Where the reference
line changes lanes, the lanes themselves go straight on: a `Track` is a lane with the ones that follow it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

from common.geometry import Polyline, wrap_angle
from common.messages import Lane, Map, Route
from services.planner.reference import ReferenceLine

F64 = npt.NDArray[np.float64]

SPACING = 1.0
"""Distance between stations [m]."""
_REACH = 20.0  # m; a lane further from the reference line than this does not lie along it

Side = Literal["left", "right"]


@dataclass(frozen=True)
class Neighbour:
    """The lanes on one side; arrays over the stations."""

    exists: npt.NDArray[np.bool_]  # where there is one
    centre: F64  # offset of its centre line, going on beyond where it exists [m]
    slope: F64  # d centre / ds
    outer: F64  # offset of its far edge, NaN where there is none [m]
    same_direction: npt.NDArray[np.bool_]


@dataclass(frozen=True)
class Track:
    """A lane of the route's direction and those that follow it; arrays over the stations."""

    first: int  # stations between which it lies along the reference line
    last: int
    centre: F64  # offset of its centre line, held beyond its ends [m]
    slope: F64  # d centre / ds
    bend: F64  # d² centre / ds² [1/m]


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

    @staticmethod
    def of(reference: ReferenceLine, route: Route, road: Map) -> RouteLanes:
        """Collect them for the lanes of the route, or, if it names none, for those that lie under it."""
        n = int(np.ceil(reference.length / SPACING)) + 1
        stations: F64 = np.asarray(SPACING * np.arange(n), dtype=np.float64)
        by_id = {lane.id: lane for lane in road.lanes}
        lanes = [by_id[i] for i in route.lane_ids if i in by_id] or _under(reference, road.lanes)
        limit, nearest = np.full(n, np.inf), np.full(n, 2.5)
        own_left, own_right = np.full(n, route.lane_width / 2 or 1.75), np.full(n, -(route.lane_width / 2 or 1.75))
        own: list[Lane | None] = [None] * n
        for lane in lanes:
            centre = _offsets(reference, lane.centre, stations)
            better = np.abs(centre) < nearest
            if not np.any(better):
                continue
            nearest[better] = np.abs(centre[better])
            left, right = _offsets(reference, lane.left, stations), _offsets(reference, lane.right, stations)
            own_left[better] = np.where(np.isfinite(left[better]), left[better], own_left[better])
            own_right[better] = np.where(np.isfinite(right[better]), right[better], own_right[better])
            limit[better] = lane.speed_limit if lane.speed_limit > 0 else np.inf
            for i in np.flatnonzero(better):
                own[i] = lane
        return RouteLanes(
            limit,
            own_left,
            own_right,
            np.array([lane is not None for lane in own]),
            _neighbour(reference, stations, own, by_id, "left"),
            _neighbour(reference, stations, own, by_id, "right"),
            _tracks(reference, stations, road.lanes),
        )

    def index(self, s: npt.ArrayLike) -> npt.NDArray[np.intp]:
        """Station at arc lengths `s`."""
        return np.clip(np.rint(np.asarray(s) / SPACING).astype(np.intp), 0, len(self.limit) - 1)


_BESIDE = 9.0  # m; tracks further away are of no use
_JOINT = 1.0  # m; a lane whose centre begins further from the end of another does not follow it


def _tracks(reference: ReferenceLine, stations: F64, lanes: list[Lane]) -> tuple[Track, ...]:
    """Every lane beside the reference line that runs its way, each with the ones before and after it."""
    offsets = {lane.id: _offsets(reference, lane.centre, stations) for lane in _along(reference, lanes, _BESIDE)}
    offsets = {i: d for i, d in offsets.items() if np.isfinite(d).sum() >= 2}
    after = {lane.id: [k for k in lane.successors if k in offsets] for lane in lanes if lane.id in offsets}
    before: dict[int, list[int]] = {i: [] for i in offsets}
    for i, following in after.items():
        for k in following:
            before[k].append(i)
    tracks, used = [], set[int]()
    for i in sorted(offsets, key=lambda k: int(np.flatnonzero(np.isfinite(offsets[k]))[0])):
        if i in used:
            continue
        chain = [i]
        while (later := _next(offsets, chain[-1], after[chain[-1]], ahead=True)) is not None and later not in chain:
            chain.append(later)
        while (sooner := _next(offsets, chain[0], before[chain[0]], ahead=False)) is not None and sooner not in chain:
            chain.insert(0, sooner)
        used.update(chain)
        merged = np.full(len(stations), np.nan)
        for k in reversed(chain):
            merged = np.where(np.isfinite(offsets[k]), offsets[k], merged)
        known = np.flatnonzero(np.isfinite(merged))
        centre = _filled(_filled(merged))
        slope = np.gradient(centre, SPACING) if len(stations) > 1 else np.zeros(len(stations))
        bend = np.gradient(slope, SPACING) if len(stations) > 1 else np.zeros(len(stations))
        tracks.append(Track(int(known[0]), int(known[-1]), centre, slope, bend))
    return tuple(tracks)


def _next(offsets: dict[int, F64], lane: int, others: list[int], *, ahead: bool) -> int | None:
    """Which of the lanes after (or before) one goes on from it most smoothly."""
    end = -1 if ahead else 0
    at = offsets[lane][np.isfinite(offsets[lane])][end]
    jumps = {k: abs(float(offsets[k][np.isfinite(offsets[k])][-1 - end]) - float(at)) for k in others}
    best = min(jumps, key=lambda k: jumps[k], default=None)
    return best if best is not None and jumps[best] <= _JOINT else None


def _offsets(reference: ReferenceLine, points: F64, stations: F64) -> F64:
    """Offset of a line at the stations, NaN where it does not lie along the reference line."""
    out = np.full(len(stations), np.nan)
    try:
        line = Polyline.of(points).resampled(2.0)
    except ValueError:
        return out
    s, d = reference.project_line(line.points)
    near = np.abs(d) < _REACH
    ahead = np.concatenate(([True], np.diff(s) > 0)) | np.concatenate((np.diff(s) > 0, [True]))
    s, d = s[near & ahead], d[near & ahead]
    if len(s) < 2 or s[-1] <= s[0]:
        # it may run against the reference line: an oncoming lane's own direction
        if len(s) < 2:
            return out
        s, d = s[::-1], d[::-1]
    order = np.argsort(s, kind="stable")
    s, d = s[order], d[order]
    inside = (stations >= s[0] - 0.5 * SPACING) & (stations <= s[-1] + 0.5 * SPACING)
    out[inside] = np.interp(stations[inside], s, d)
    return out


def _neighbour(
    reference: ReferenceLine, stations: F64, own: list[Lane | None], by_id: dict[int, Lane], side: Side
) -> Neighbour:
    n = len(stations)
    centre, outer, same = np.full(n, np.nan), np.full(n, np.nan), np.ones(n, dtype=bool)
    sign = 1.0 if side == "left" else -1.0
    for lane in {lane.id: lane for lane in own if lane is not None}.values():
        other = by_id.get(_neighbour_id(lane, side))
        if other is None:
            continue
        along = lane.left_same_direction if side == "left" else lane.right_same_direction
        here = np.array([o is lane for o in own])
        middle = _offsets(reference, other.centre, stations)
        a, b = _offsets(reference, other.left, stations), _offsets(reference, other.right, stations)
        edge = np.fmax(a, b) if side == "left" else np.fmin(a, b)
        good = here & np.isfinite(middle) & (sign * middle > 1.0)
        centre[good], same[good] = middle[good], along
        outer[good] = np.where(np.isfinite(edge[good]), edge[good], middle[good] + sign * 1.75)
    filled = _filled(centre)
    slope = np.gradient(filled, SPACING) if n > 1 else np.zeros(n)
    return Neighbour(np.isfinite(centre), filled, slope, outer, same)


def _neighbour_id(lane: Lane, side: Side) -> int:
    other = lane.left_neighbour if side == "left" else lane.right_neighbour
    return -(2**63) if other is None else other


def _filled(a: F64) -> F64:
    """NaN replaced by the nearest known value, then smoothed over a few metres."""
    known = np.flatnonzero(np.isfinite(a))
    if not len(known):
        return np.zeros_like(a)
    full = np.interp(np.arange(len(a)), known, a[known])
    k = np.hanning(13)[1:-1]
    return np.convolve(np.pad(full, 5, mode="edge"), k / k.sum(), mode="valid")


def _under(reference: ReferenceLine, lanes: list[Lane]) -> list[Lane]:
    """Lanes whose centre line runs within 1.5 m of the reference line, in its direction."""
    return _along(reference, lanes, 1.5)


def _along(reference: ReferenceLine, lanes: list[Lane], reach: float) -> list[Lane]:
    """Lanes whose centre line runs within `reach` of the reference line [m], in its direction."""
    low = np.array([reference.x.min(), reference.y.min()]) - reach - 0.5
    high = np.array([reference.x.max(), reference.y.max()]) + reach + 0.5
    out = []
    for lane in lanes:
        c = lane.centre
        if np.any(c.max(axis=0) < low) or np.any(c.min(axis=0) > high):
            continue
        try:
            line = Polyline.of(c).resampled(2.0)
        except ValueError:
            continue
        s, d = reference.project_line(line.points)
        inside = (s >= 0.0) & (s <= reference.length) & (np.abs(d) < reach)
        if not np.any(inside):
            continue
        middle = line.s[inside]
        turn = wrap_angle(line.heading(middle) - reference.at(s[inside]).heading)
        if float(np.median(np.abs(turn))) < 0.6:
            out.append(lane)
    return out
