"""The lines of the map that lie near the reference line, in its Frenet coordinates, each projected once.

A map may be a whole city and a route cross it: what is too far away is dropped by boxes, before anything is projected,
so that the work grows with what lies along the route and not with the map.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from common.geometry import Polyline, wrap_angle
from common.messages import Lane
from services.planner.reference import ReferenceLine
from services.planner.work import Work

F64 = npt.NDArray[np.float64]

SPACING = 1.0
"""Distance between stations [m]."""
_REACH = 20.0  # m; a point further from the reference line than this does not lie along it
_STEP = 2.0  # m; between the points of a line that are projected
_BLOCK = 512  # lanes whose boxes are compared at once
_GROUP = 32  # lines that are projected at once
_SAME_WAY = 0.6  # rad


@dataclass(frozen=True)
class Span:
    """Where a line lies along the reference line: its offsets at consecutive stations."""

    first: int
    d: F64  # [k], k ≥ 1 [m]

    @property
    def here(self) -> slice:
        """Its stations."""
        return slice(self.first, self.first + len(self.d))


@dataclass(frozen=True)
class _Projected:
    points: F64  # as they came: what is kept alive keeps its id
    line: Polyline
    s: F64
    d: F64


class Projections:
    """Lines of the map beside one reference line; remembers what it has projected."""

    def __init__(self, reference: ReferenceLine) -> None:
        self.stations: F64 = SPACING * np.arange(int(np.ceil(reference.length / SPACING)) + 1, dtype=np.float64)
        self._reference = reference
        self._known: dict[int, _Projected | F64] = {}  # the points themselves: they are no line
        self._spans: dict[int, Span | None] = {}

    def add(self, lines: Iterable[F64]) -> Work[None]:
        """Project lines [n, 2], several together: that costs less than one at a time."""
        unknown = list({id(p): p for p in lines if id(p) not in self._known}.values())
        for k in range(0, len(unknown), _GROUP):
            self._project(unknown[k : k + _GROUP])
            yield len(unknown[k : k + _GROUP])

    def _project(self, lines: list[F64]) -> None:
        new: list[tuple[F64, Polyline]] = []
        for points in lines:
            try:
                new.append((points, Polyline.of(points).resampled(_STEP)))
            except ValueError:
                self._known[id(points)] = points
        found = self._reference.project_lines([line.points for _, line in new])
        for (points, line), (s, d) in zip(new, found, strict=True):
            self._known[id(points)] = _Projected(points, line, s, d)

    def span(self, points: F64) -> Span | None:
        """Offset at the stations of a line that was added; None where it does not lie along the reference line."""
        if id(points) not in self._spans:
            known = self._known[id(points)]
            self._spans[id(points)] = self._span(known) if isinstance(known, _Projected) else None
        return self._spans[id(points)]

    def along(self, lanes: list[Lane], reach: float) -> Work[list[Lane]]:
        """Lanes whose centre line runs within `reach` of the reference line [m], in its direction."""
        near = yield from self.near(lanes, reach)
        yield from self.add(lane.centre for lane in near)
        found = []
        for lane in near:
            known = self._known[id(lane.centre)]
            if isinstance(known, _Projected):
                inside = (known.s >= 0.0) & (known.s <= self._reference.length) & (np.abs(known.d) < reach)
                if inside.any():
                    found.append((lane, known.line.heading(known.line.s[inside]), known.s[inside]))
        if not found:
            return []
        ends = np.cumsum([len(s) for _, _, s in found])[:-1]
        ways = np.split(self._reference.at(np.concatenate([s for _, _, s in found])).heading, ends)
        kept = []
        for (lane, heading, _), way in zip(found, ways, strict=True):
            if float(np.median(np.abs(wrap_angle(heading - way)))) < _SAME_WAY:
                kept.append(lane)
            yield 1
        return kept

    def against(self, lanes: list[Lane], reach: float) -> Work[list[float]]:
        """Where lanes within `reach` of the reference line run against it: the first place of each [m]."""
        near = yield from self.near(lanes, reach)
        yield from self.add(lane.centre for lane in near)
        found = []
        for lane in near:
            known = self._known[id(lane.centre)]
            if isinstance(known, _Projected):
                inside = (known.s >= 0.0) & (known.s <= self._reference.length) & (np.abs(known.d) < reach)
                if inside.any():
                    way = self._reference.at(known.s[inside]).heading
                    turned = np.abs(wrap_angle(known.line.heading(known.line.s[inside]) - way))
                    if float(np.median(turned)) > np.pi - _SAME_WAY:
                        found.append(float(known.s[inside].min()))
            yield 1
        return found

    def near(self, lanes: list[Lane], reach: float) -> Work[list[Lane]]:
        """Lanes that boxes cannot tell to lie further than `reach` [m]; none that does is left out.

        An offset is measured across the line at its nearest point, and in a kink that is less than the distance: half
        of it where the line turns by 60° between two metres. So lanes are kept up to twice as far.
        """
        lanes = [lane for lane in lanes if len(lane.centre)]
        if not lanes:
            return []
        points = np.concatenate([lane.centre for lane in lanes])
        starts = np.cumsum([0, *(len(lane.centre) for lane in lanes[:-1])])
        x, y = np.ascontiguousarray(points[:, 0]), np.ascontiguousarray(points[:, 1])
        low = np.stack((np.minimum.reduceat(x, starts), np.minimum.reduceat(y, starts)), axis=1)
        high = np.stack((np.maximum.reduceat(x, starts), np.maximum.reduceat(y, starts)), axis=1)
        line = self._reference
        first = np.array([line.x.min(), line.y.min()]) - reach - 0.5
        last = np.array([line.x.max(), line.y.max()]) + reach + 0.5
        kept = np.flatnonzero(~((high < first) | (low > last)).any(axis=1))
        near: list[Lane] = []
        yield len(lanes) // 32
        for a in range(0, len(kept), _BLOCK):
            k = kept[a : a + _BLOCK]
            far = (line.pieces.gap(low[k], high[k]) > 2.0 * reach + 1.0).all(axis=1)
            near.extend(lanes[i] for i in k[~far])
            yield len(k) // 16
        return near

    def _span(self, known: _Projected) -> Span | None:
        s, d = known.s, known.d
        near = np.abs(d) < _REACH
        ahead = np.concatenate(([True], np.diff(s) > 0)) | np.concatenate((np.diff(s) > 0, [True]))
        s, d = s[near & ahead], d[near & ahead]
        if len(s) < 2:
            return None
        if s[-1] <= s[0]:  # it may run against the reference line: an oncoming lane's own direction
            s, d = s[::-1], d[::-1]
        order = np.argsort(s, kind="stable")
        s, d = s[order], d[order]
        first = int(np.searchsorted(self.stations, s[0] - 0.5 * SPACING, side="left"))
        last = int(np.searchsorted(self.stations, s[-1] + 0.5 * SPACING, side="right"))
        return Span(first, np.interp(self.stations[first:last], s, d)) if last > first else None
