"""Plane geometry in the `map` frame: polylines with arc length, Frenet coordinates, rectangles.

Positions [m], headings [rad] counter-clockwise from x, lateral offset d positive to the left.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

F64 = npt.NDArray[np.float64]


def wrap_angle(angle: F64 | float) -> F64:
    """Bring angles into [−π, π)."""
    return np.asarray((np.asarray(angle) + np.pi) % (2 * np.pi) - np.pi)


@dataclass(frozen=True)
class Polyline:
    """A line through points [n, 2] with n ≥ 2, straight beyond its ends.

    Build it with `Polyline.of`, which drops repeated points.
    """

    points: F64

    @staticmethod
    def of(points: npt.ArrayLike, *, tolerance: float = 1e-6) -> Polyline:
        """Drop points nearer than `tolerance` [m] to the one before.

        Raises:
            ValueError: fewer than two different points, or a non-finite one.
        """
        p = np.asarray(points, dtype=np.float64)
        if p.ndim != 2 or p.shape[1] != 2 or not np.all(np.isfinite(p)):
            raise ValueError(f"a polyline needs finite points [n, 2], got shape {p.shape}")
        keep = np.ones(len(p), dtype=bool)
        keep[1:] = np.hypot(*np.diff(p, axis=0).T) > tolerance
        p = p[keep]
        if len(p) < 2:
            raise ValueError("a polyline needs at least two different points")
        return Polyline(p)

    @cached_property
    def s(self) -> F64:
        """Arc length at each point, shape [n]."""
        return np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(self.points, axis=0).T))))

    @property
    def length(self) -> float:
        """Length of the line [m]."""
        return float(self.s[-1])

    @cached_property
    def tangents(self) -> F64:
        """Unit tangent of each segment, shape [n − 1, 2]."""
        d = np.diff(self.points, axis=0)
        return np.asarray(d / np.hypot(d[:, 0], d[:, 1])[:, None])

    def segment(self, s: npt.ArrayLike) -> npt.NDArray[np.intp]:
        """Index of the segment on which arc length `s` lies; beyond the ends, the end segment."""
        return np.clip(np.searchsorted(self.s, np.asarray(s), side="right") - 1, 0, len(self.points) - 2)

    def at(self, s: npt.ArrayLike) -> F64:
        """Points at arc lengths `s`, shape [..., 2]; straight beyond the ends."""
        s = np.asarray(s, dtype=np.float64)
        i = self.segment(s)
        return np.asarray(self.points[i] + self.tangents[i] * (s - self.s[i])[..., None])

    def heading(self, s: npt.ArrayLike) -> F64:
        """Direction of the segment at arc lengths `s` [rad]."""
        t = self.tangents[self.segment(s)]
        return np.asarray(np.arctan2(t[..., 1], t[..., 0]))

    def project(self, xy: npt.ArrayLike) -> tuple[F64, F64]:
        """Frenet coordinates (s, d) of points [..., 2]: the nearest point of the line, d > 0 to its left.

        Beyond the ends the line goes on straight: s < 0 before it, s > length behind it.
        """
        q = np.asarray(xy, dtype=np.float64)
        flat = q.reshape(-1, 2)
        a, t = self.points[:-1], self.tangents
        lengths = np.diff(self.s)
        rel = flat[:, None, :] - a[None]
        along = np.einsum("psk,sk->ps", rel, t)
        low = np.zeros(len(a))
        high = lengths.copy()
        low[0], high[-1] = -np.inf, np.inf
        u = np.clip(along, low, high)
        foot = a[None] + u[..., None] * t[None]
        distance = np.hypot(*np.moveaxis(flat[:, None, :] - foot, -1, 0))
        best = np.argmin(distance, axis=1)
        rows = np.arange(len(flat))
        r, tb = rel[rows, best], t[best]
        side = np.sign(tb[:, 0] * r[:, 1] - tb[:, 1] * r[:, 0])
        s = self.s[best] + u[rows, best]
        d = side * distance[rows, best]
        return s.reshape(q.shape[:-1]), d.reshape(q.shape[:-1])

    def resampled(self, step: float) -> Polyline:
        """The same line with points about every `step` [m], ends kept."""
        n = max(int(np.ceil(self.length / step)), 1) + 1
        return Polyline(self.at(np.linspace(0.0, self.length, n)))

    def cut(self, s0: float, s1: float) -> Polyline:
        """The part between arc lengths s0 < s1, straight beyond the ends."""
        inner = self.points[(self.s > s0 + 1e-9) & (self.s < s1 - 1e-9)]
        return Polyline(np.vstack((self.at([s0]), inner, self.at([s1]))))


def rectangle_corners(
    x: npt.ArrayLike, y: npt.ArrayLike, heading: npt.ArrayLike, length: npt.ArrayLike, width: npt.ArrayLike
) -> F64:
    """Corners of rectangles, shape [..., 4, 2]: front left, rear left, rear right, front right."""
    x, y, heading, length, width = np.broadcast_arrays(x, y, heading, length, width)
    c, s = np.cos(heading)[..., None], np.sin(heading)[..., None]
    lx = length[..., None] * np.array([0.5, -0.5, -0.5, 0.5])
    ly = width[..., None] * np.array([0.5, 0.5, -0.5, -0.5])
    return np.stack((x[..., None] + c * lx - s * ly, y[..., None] + s * lx + c * ly), axis=-1)


def distance_to_rectangle(
    px: npt.ArrayLike,
    py: npt.ArrayLike,
    x: npt.ArrayLike,
    y: npt.ArrayLike,
    heading: npt.ArrayLike,
    length: npt.ArrayLike,
    width: npt.ArrayLike,
) -> F64:
    """Distance [m] from points to rectangles, 0 inside; all arguments broadcast."""
    dx, dy = np.asarray(px) - x, np.asarray(py) - y
    c, s = np.cos(heading), np.sin(heading)
    outside_x = np.maximum(np.abs(c * dx + s * dy) - np.asarray(length) / 2, 0.0)
    outside_y = np.maximum(np.abs(-s * dx + c * dy) - np.asarray(width) / 2, 0.0)
    return np.asarray(np.hypot(outside_x, outside_y))


def distance_between_rectangles(a: F64, b: F64) -> F64:
    """Distance [m] between rectangles given by corners [..., 4, 2], broadcast; 0 where they overlap.

    Convex bodies that do not overlap are nearest at a corner of one and an edge of the other; overlap is found by
    separating axes.
    """
    a, b = np.broadcast_arrays(a, b)
    nearest = np.minimum(_corners_to_edges(a, b), _corners_to_edges(b, a))
    overlap = ~(_separated(a, b) | _separated(b, a))
    return np.asarray(np.where(overlap, 0.0, nearest))


def _corners_to_edges(a: F64, b: F64) -> F64:
    start = b[..., None, :, :]
    edge = np.roll(b, -1, axis=-2)[..., None, :, :] - start
    rel = a[..., :, None, :] - start
    u = np.clip(np.sum(rel * edge, -1) / np.maximum(np.sum(edge * edge, -1), 1e-12), 0.0, 1.0)
    return np.asarray(np.linalg.norm(rel - u[..., None] * edge, axis=-1).min(axis=(-2, -1)))


def _separated(a: F64, b: F64) -> npt.NDArray[np.bool_]:
    axes = np.roll(a, -1, axis=-2)[..., :2, :] - a[..., :2, :]
    pa, pb = np.einsum("...ik,...jk->...ij", axes, a), np.einsum("...ik,...jk->...ij", axes, b)
    return np.asarray(((pa.max(-1) < pb.min(-1)) | (pb.max(-1) < pa.min(-1))).any(-1))
