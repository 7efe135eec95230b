"""The route's reference line, made smooth: position, heading and curvature by arc length, and Frenet coordinates.

Recorded tracks and lanelet centre lines are noisy polylines with kinks, and a kink of 0.05 rad reads as a tight
curve. The line is resampled and smoothed by a Gaussian whose shrinkage is compensated (2 G − G²), wide where that
moves it by less than a hand's breadth, narrow in tight turns.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from common.geometry import Polyline

F64 = npt.NDArray[np.float64]

SPACING = 0.25
"""Distance between the stored points [m]."""
LONGEST_M = 50_000.0
"""A longer line is refused: every metre of it takes memory, and one wild point would take all there is [m]."""
_DECIMATE = 0.5  # m; nearer points are jitter of a standing recorder
_SIGMAS = (1.5, 3.0, 7.0)  # m
_TIGHT = 0.17  # 1/m; sharper than this, the middle width is used whatever it moves
_MOVED = (0.15, 0.30)  # m; full trust in a wider smoothing up to the first, none beyond the second


@dataclass(frozen=True)
class Frenet:
    """Points of the reference line at given arc lengths; all arrays of one shape."""

    x: F64  # [m]
    y: F64  # [m]
    heading: F64  # unwrapped [rad]
    curvature: F64  # [1/m]
    curvature_rate: F64  # dκ/ds [1/m²]


@dataclass(frozen=True)
class ReferenceLine:
    """A smooth line sampled every `spacing`, straight beyond its ends."""

    spacing: float
    x: F64
    y: F64
    heading: F64
    curvature: F64
    curvature_rate: F64

    @staticmethod
    def of(points: npt.ArrayLike) -> ReferenceLine:
        """Smooth a polyline [n, 2].

        Raises:
            ValueError: shorter than half a metre, longer than `LONGEST_M`, or a non-finite point.
        """
        line = Polyline.of(points)
        if not line.length <= LONGEST_M:
            long, most = line.length / 1e3, LONGEST_M / 1e3
            raise ValueError(f"the reference line is {long:.4g} km long, at most {most:.0f}: send the next part of it")
        line = _decimated(line)
        n = max(int(np.ceil(line.length / SPACING)), 2) + 1
        spacing = line.length / (n - 1)
        raw = line.at(np.linspace(0.0, line.length, n))
        fine, middle, wide = (_smoothed(raw, sigma / spacing) for sigma in _SIGMAS)
        tight = np.abs(_derivatives(fine, spacing)[1]) > _TIGHT
        p = _blend(fine, middle, np.maximum(_trust(raw, middle, spacing), _spread(tight, spacing)), spacing)
        p = _blend(p, wide, _trust(raw, wide, spacing), spacing)
        # the blend bends the line a little where its weights change: a last narrow pass
        p = _smoothed(p, 1.0 / spacing)
        heading, curvature = _derivatives(p, spacing)
        return ReferenceLine(spacing, p[:, 0], p[:, 1], heading, curvature, np.gradient(curvature, spacing))

    @property
    def length(self) -> float:
        """Length [m]."""
        return self.spacing * (len(self.x) - 1)

    def at(self, s: npt.ArrayLike) -> Frenet:
        """The line at arc lengths `s`, any shape; straight beyond the ends."""
        s = np.asarray(s, dtype=np.float64)
        inside = np.minimum(np.maximum(s, 0.0), self.length)
        over = s - inside
        f = inside / self.spacing
        i = np.minimum(f.astype(np.intp), len(self.x) - 2)
        w = f - i

        def value(a: F64) -> F64:
            return np.asarray(a[i] + w * (a[i + 1] - a[i]))

        heading = value(self.heading)
        beyond = over != 0.0
        return Frenet(
            value(self.x) + over * np.cos(heading),
            value(self.y) + over * np.sin(heading),
            heading,
            np.where(beyond, 0.0, value(self.curvature)),
            np.where(beyond, 0.0, value(self.curvature_rate)),
        )

    def project(self, x: float, y: float, heading: float, near: float | None = None) -> tuple[float, float]:
        """Frenet coordinates (s, d) of a pose; `near` is where it was last, so that it does not jump between legs.

        s < 0 before the line and s > length behind it; d > 0 to its left [m].
        """
        s0 = self.spacing * self._nearest(x, y, heading, near)
        d = 0.0
        for _ in range(6):
            px, py, way, curvature, _ = self.point(s0)
            dx, dy = x - px, y - py
            c, sn = math.cos(way), math.sin(way)
            d = -sn * dx + c * dy
            move = (c * dx + sn * dy) / max(1.0 - curvature * d, 0.2)
            s0 += min(max(move, -2.0), 2.0) if 0.0 <= s0 <= self.length else c * dx + sn * dy
            if abs(move) < 1e-6:
                break
        return s0, d

    def _nearest(self, x: float, y: float, heading: float, near: float | None) -> int:
        """Index of the vertex from which a projection starts."""
        if near is not None:
            first = min(max(math.floor((near - 10.0) / self.spacing) + 1, 0), len(self.x))
            last = min(max(math.ceil((near + 30.0) / self.spacing), 0), len(self.x))
            if first < last:
                cost = (self.x[first:last] - x) ** 2 + (self.y[first:last] - y) ** 2
                i = int(np.argmin(cost))
                if cost[i] < 100.0:
                    return first + i
        cost = (self.x - x) ** 2 + (self.y - y) ** 2
        if near is None:  # of two legs of the line the one that runs the ego's way, unless it is 6 m further
            cost = np.sqrt(cost) + 3.0 * (1.0 - np.cos(self.heading - heading))
        return int(np.argmin(cost))

    def point(self, s: float) -> tuple[float, float, float, float, float]:
        """x, y, heading, curvature and its rate at one arc length, as `at` has them."""
        inside = min(max(s, 0.0), self.length)
        over = s - inside
        f = inside / self.spacing
        i = min(int(f), len(self.x) - 2)
        w = f - i

        def value(a: F64) -> float:
            low, high = a.item(i), a.item(i + 1)
            return float(low + w * (high - low))

        heading = value(self.heading)
        x, y = value(self.x) + over * math.cos(heading), value(self.y) + over * math.sin(heading)
        if over != 0.0:
            return x, y, heading, 0.0, 0.0
        return x, y, heading, value(self.curvature), value(self.curvature_rate)

    def project_lines(self, lines: Sequence[F64]) -> list[tuple[F64, F64]]:
        """Frenet coordinates (s, d) of the points [n, 2] of lines that run along this one, each [n].

        The nearest vertex of this line is looked for only in the pieces of it that can hold it.
        """
        if not lines:
            return []
        pieces, points = self.pieces, np.concatenate(lines)
        ends = np.cumsum([len(line) for line in lines])
        a = np.concatenate([np.arange(end - len(line), end, _RUN) for end, line in zip(ends, lines, strict=True)])
        b = np.minimum(np.append(a[1:], len(points)), a + _RUN)
        low, high = np.minimum.reduceat(points, a), np.maximum.reduceat(points, a)
        nearest = np.empty(len(points), dtype=np.intp)
        for k in range(0, len(a), _BLOCK):
            block = slice(k, k + _BLOCK)
            for first, last, near in zip(a[block], b[block], pieces.near(low[block], high[block]), strict=True):
                i, part = pieces.vertices(near), points[first:last]
                cost = (part[:, None, 0] - pieces.x[i]) ** 2 + (part[:, None, 1] - pieces.y[i]) ** 2
                nearest[first:last] = i[np.argmin(cost, axis=1)]
        h = self.heading[:: pieces.stride][nearest]
        dx, dy = points[:, 0] - pieces.x[nearest], points[:, 1] - pieces.y[nearest]
        s = self.spacing * pieces.stride * nearest + np.cos(h) * dx + np.sin(h) * dy
        d = -np.sin(h) * dx + np.cos(h) * dy
        return list(zip(np.split(s, ends[:-1]), np.split(d, ends[:-1]), strict=True))

    @cached_property
    def pieces(self) -> Pieces:
        """This line in pieces of about 32 m."""
        stride = max(round(1.0 / self.spacing), 1)
        return Pieces.of(self.x[::stride], self.y[::stride], stride)


_PIECE = 32  # vertices about a metre apart
_RUN = 32  # points that are projected together
_BLOCK = 512  # such runs whose boxes are compared at once


@dataclass(frozen=True)
class Pieces:
    """Vertices of a line about a metre apart, and the boxes of runs of them."""

    stride: int  # points of the line from one vertex to the next
    x: F64  # [m]
    y: F64
    low: F64  # corners of the boxes [k, 2]
    high: F64
    middle: F64  # a vertex of each run [k, 2]

    @staticmethod
    def of(x: F64, y: F64, stride: int) -> Pieces:
        """Cut them."""
        starts = np.arange(0, len(x), _PIECE)
        p = np.stack((x, y), axis=1)
        low, high = np.minimum.reduceat(p, starts), np.maximum.reduceat(p, starts)
        return Pieces(stride, x, y, low, high, p[np.minimum(starts + _PIECE // 2, len(x) - 1)])

    def gap(self, low: F64, high: F64) -> F64:
        """Distance of boxes, corners [n, 2], from those of the pieces, [n, k] [m]."""
        dx, dy = (
            np.maximum(np.maximum(self.low[:, c] - high[:, None, c], low[:, None, c] - self.high[:, c]), 0.0)
            for c in (0, 1)
        )
        return np.asarray(np.hypot(dx, dy))

    def near(self, low: F64, high: F64) -> npt.NDArray[np.bool_]:
        """Which pieces may hold the nearest vertex to a point within boxes, corners [n, 2]; [n, k]."""
        centre = 0.5 * (low + high)
        least = np.hypot(centre[:, None, 0] - self.middle[:, 0], centre[:, None, 1] - self.middle[:, 1]).min(axis=1)
        most = least + 0.5 * np.hypot(*(high - low).T)
        return np.asarray(self.gap(low, high) <= most[:, None] + 1e-3)

    def vertices(self, near: npt.NDArray[np.bool_]) -> npt.NDArray[np.intp]:
        """Indices of the vertices of some pieces, in order."""
        i = (_PIECE * np.flatnonzero(near)[:, None] + np.arange(_PIECE)).ravel()
        return i[i < len(self.x)]


def _decimated(line: Polyline) -> Polyline:
    keep, steps = [0], np.hypot(*np.diff(line.points, axis=0).T).tolist()
    for i in range(1, len(line.points)):
        last = keep[-1]
        apart = steps[last] if last == i - 1 else np.hypot(*(line.points[i] - line.points[last]))
        if apart >= _DECIMATE:
            keep.append(i)
    if len(keep) < 2:
        raise ValueError(f"the reference line is shorter than {_DECIMATE} m")
    points = line.points[keep]
    if keep[-1] != len(line.points) - 1 and len(keep) > 2:
        points = np.vstack((points[:-1], line.points[-1:]))  # the end stays the end
    return Polyline.of(points)


def _smoothed(p: F64, sigma: float) -> F64:
    """2 G − G² of points [n, 2]; point-symmetric beyond the ends, which therefore stay. `sigma` in samples."""
    half = int(np.ceil(3.5 * sigma))
    k = np.exp(-0.5 * (np.arange(-half, half + 1) / sigma) ** 2)
    k /= k.sum()
    kernel = -np.convolve(k, k)
    middle = len(kernel) // 2
    kernel[middle - half : middle + half + 1] += 2.0 * k
    pad = middle
    head, tail = _extension(p[::-1], pad)[::-1], _extension(p, pad)
    padded = np.vstack((head, p, tail))
    return np.stack([np.convolve(padded[:, c], kernel, mode="valid") for c in range(2)], axis=1)


def _extension(p: F64, n: int) -> F64:
    """Go on n points straight from the end of p, in the mean direction of its last metres."""
    back = min(len(p) - 1, 12)
    step = (p[-1] - p[-1 - back]) / back
    return np.asarray(p[-1] + step * np.arange(1, n + 1)[:, None])


def _derivatives(p: F64, spacing: float) -> tuple[F64, F64]:
    dx, dy = np.gradient(p[:, 0], spacing), np.gradient(p[:, 1], spacing)
    heading = np.unwrap(np.arctan2(dy, dx))
    speed = np.maximum(np.hypot(dx, dy), 0.2)
    return heading, np.gradient(heading, spacing) / speed


def _trust(raw: F64, smooth: F64, spacing: float) -> F64:
    moved = np.hypot(*(smooth - raw).T)
    reach = max(int(4.0 / spacing), 1)
    padded = np.pad(moved, reach, mode="edge")
    worst = np.lib.stride_tricks.sliding_window_view(padded, 2 * reach + 1).max(axis=1)
    return np.asarray(np.clip((_MOVED[1] - worst) / (_MOVED[1] - _MOVED[0]), 0.0, 1.0))


def _spread(mask: npt.NDArray[np.bool_], spacing: float) -> F64:
    reach = max(int(4.0 / spacing), 1)
    padded = np.pad(mask.astype(np.float64), reach)
    return np.asarray(np.lib.stride_tricks.sliding_window_view(padded, 2 * reach + 1).max(axis=1))


def _blend(a: F64, b: F64, weight: F64, spacing: float) -> F64:
    reach = max(int(4.0 / spacing), 1)
    k = np.hanning(2 * reach + 3)[1:-1]
    w = np.convolve(np.pad(weight, reach, mode="edge"), k / k.sum(), mode="valid")[:, None]
    return np.asarray(a + w * (b - a))
