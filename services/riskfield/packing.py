"""Sources as the kernels read them: rows of float32 in the grid's frame, cut to what can reach the grid."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from common.messages import F32, F64, Grid
from common.risk import COUPLED, RiskParameters
from common.risk_sources import Bools, DynamicSources, Indices
from services.riskfield.grid import into_grid
from services.riskfield.layout import FAR_STEP, OBJECT_FIELDS, SEGMENT_FIELDS

FAR = 1.0e4
"""How far a path's ends go on straight for the kernels [m]."""
NOWHERE = 1.0e9
"""A coordinate that no row of the grid has [m]."""
STRAIGHT = 1.0e-7
"""Neighbouring segments that turn by less are one [rad]."""
FAR_ERROR = 1.5e-4
"""What cubic interpolation between the nodes may miss of one object's potential [E_max]."""


@dataclass(frozen=True)
class PackedObjects:
    """n' of the sources' n objects: those that may reach the grid in some slice."""

    kept: Indices
    """Which of the sources, [n']."""
    objects: F32
    """[k, n', len(OBJECT_FIELDS)]."""
    segments: F32
    """[n', S, len(SEGMENT_FIELDS)]."""
    widths: F32
    """Largest width over the slices, [n']."""
    two_level: bool
    """Whether every potential is smooth enough outside `near` to be taken from the far nodes."""


def nodes_every(h: float) -> int:
    """Cells from one far node to the next; below 3 there is nothing to gain."""
    return max(1, int(FAR_STEP / h + 1e-6))


def pack_objects(
    sources: DynamicSources, counts: Bools, grid: Grid, p: RiskParameters, two_level: bool = True
) -> PackedObjects:
    """Write the sources that count ([n] bool) in the grid's frame; what cannot reach a cell is left out, exactly.

    With `two_level` the fields of the far nodes are written too, if they hold for these parameters.
    """
    extent = np.array([grid.rows * grid.h, grid.columns * grid.h])
    centre = into_grid(grid, np.stack((sources.x, sources.y), axis=-1))
    diagonal = 0.5 * np.hypot(sources.length, sources.width)
    reach = np.abs(sources.u) * p.t
    outside = np.maximum(np.maximum(-centre, centre - extent), 0.0)
    outside = np.hypot(outside[..., 0], outside[..., 1])
    # an arc is never shorter than its chord; the strip is one width wide on each side
    span = np.where(sources.u != 0.0, reach + 0.5 * sources.length + 2.0 * sources.width, 0.0)
    kept = np.flatnonzero(counts & ((outside < p.taper_radius + diagonal) | (outside < span)).any(0))

    def of(values: F64) -> F64:
        return values[:, kept]

    length, width, u, reach, span, outside, diagonal = map(
        of, (sources.length, sources.width, sources.u, reach, span, outside, diagonal)
    )
    radius = p.taper_radius + diagonal
    A = p.k * p.r_a * of(sources.M_v)
    near, fits = _near(A, grid.h, p)
    two_level = two_level and fits
    q0 = near**2
    f0 = A / (q0 + A / p.e_max)
    f1, f2 = -f0 / (q0 + A / p.e_max), f0 / (q0 + A / p.e_max) ** 2
    heading = of(sources.heading) - grid.heading
    c, s = np.cos(heading), np.sin(heading)
    half_length, half_width = 0.5 * length, 0.5 * width

    origin = sources.paths.frame_s[kept, 0]
    segments, end_s = _segments(sources, kept, grid)
    s0 = of(sources.s0) - origin
    ahead = u > 0.0
    # inside a bend the arc length that neighbouring segments share lies less than one width off a segment's own
    s_low = s0 - half_length - width - np.where(ahead, 0.0, reach)
    s_high = s0 + half_length + width + np.where(ahead, reach, 0.0)
    lobe = (u != 0.0) & (outside < span)
    x = of(centre[..., 0])
    values: dict[str, F64] = {
        "x": x,
        "y": of(centre[..., 1]),
        "cos": c,
        "sin": s,
        "inverse_cos": _inverse(c),
        "inverse_sin": _inverse(s),
        "half_length": half_length,
        "half_width": half_width,
        "A": A,
        "A_e": A / p.e_max,
        "radius": np.where(outside < radius, radius, 0.0),
        "near": near,
        "near_x": np.minimum(np.abs(c) * (half_length + near) + np.abs(s) * (half_width + near), diagonal + near),
        "q0": q0,
        "f0": f0,
        "f1": f1,
        "f2": f2,
        "f3": (2.0 * f2 * q0 - f1) / (3.0 * q0**2),  # the slope at the body is 0: no kink along its edges
        "M2": 0.5 * of(sources.M_v) * u**2 / p.K0,
        "inverse_L": 1.0 / (reach + p.d0),
        "reach": reach,
        "sign": np.sign(u),
        "s0": s0,
        "half": half_length,
        "inverse_l": 1.0 / length,
        "width": width,
        "inverse_w2": 1.0 / width**2,
        "low": np.where(lobe, x - span, NOWHERE),
        "high": np.where(lobe, x + span, -NOWHERE),
        "first": (end_s[None] < s_low[..., None]).sum(-1),
        "last": (end_s[None, :, :-1] <= s_high[..., None]).sum(-1),
    }
    objects = np.empty((len(x), len(kept), len(OBJECT_FIELDS)), dtype=np.float32)
    for k, name in enumerate(OBJECT_FIELDS):
        objects[..., k] = values[name]
    return PackedObjects(
        kept=kept, objects=objects, segments=segments, widths=width.max(0).astype(np.float32), two_level=two_level
    )


def _inverse(v: F64) -> F64:
    small = np.abs(v) < 1e-4
    return np.asarray(np.where(small, 0.0, 1.0 / np.where(small, 1.0, v)))


def _near(A: F64, h: float, p: RiskParameters) -> tuple[F64, bool]:
    """How far from the body [m] values are exact in two levels, and whether two levels hold at all.

    Cubic interpolation between nodes H apart misses 3/128 H⁴ f⁗ along each axis, and f⁗ < 120 A / D⁶ for f = A / D².
    At the ends of the taper the second derivative jumps, which costs H² / 30 of the jump.
    """
    ratio = nodes_every(h)
    H = ratio * h
    near = (2.0 * 3.0 / 128.0 * 120.0 * A * H**4 / (FAR_ERROR * p.e_max)) ** (1.0 / 6.0)
    top, R = float(A.max(initial=0.0)), p.taper_radius
    free = p.taper_start * R
    kink = 6.0 / ((1.0 - p.taper_start) * R) ** 2 * top / max(free, 1e-3) ** 2 * H**2 / 30.0
    fits = ratio >= 3 and p.k1 == 2.0 and float(near.max(initial=0.0)) < free and kink < FAR_ERROR * p.e_max
    return np.maximum(near, 1.0), fits


def _segments(sources: DynamicSources, kept: Indices, grid: Grid) -> tuple[F32, F64]:
    """Rows of the paths' segments, and the arc length of each one's end, [n', S] (padding: infinite)."""
    lines = sources.paths
    vertices = into_grid(grid, lines.vertices[kept])
    count = lines.count[kept]
    s = lines.s[kept] - lines.frame_s[kept, :1]
    n, most = s.shape
    if n == 0:
        return np.zeros((0, 1, len(SEGMENT_FIELDS)), dtype=np.float32), np.zeros((0, 1))
    step = np.diff(vertices, axis=1)
    length = np.hypot(step[..., 0], step[..., 1])
    tangent = step / np.where(length > 0.0, length, 1.0)[..., None]
    # of the vertex at each segment's beginning: the turn there, and whether the segments on both sides are coupled
    before, after = tangent[:, :-1], tangent[:, 1:]
    cross = np.zeros((n, most))
    dot = np.ones((n, most))
    cross[:, 1:-1] = np.abs(before[..., 0] * after[..., 1] - before[..., 1] * after[..., 0])
    dot[:, 1:-1] = np.sum(before * after, axis=-1)
    vertex = np.arange(most)[None]
    end = count[:, None] - 1
    inner = (vertex > 0) & (vertex < end)
    turns = inner & ((cross > STRAIGHT) | (dot < 0.0))
    reach = length.copy()
    reach[:, 0] = FAR
    reach[np.arange(n), count - 2] = FAR

    # straight runs become one segment, but for the pieces next to a turn: the arc length that they share with the other
    # side of it ends with them. The first segment has no beginning, so one inner vertex always stays
    stays = turns | (vertex == 0) | (vertex == 1) | (vertex == end)
    stays[:, 1:] |= turns[:, :-1]
    stays[:, :-1] |= turns[:, 1:]
    stays &= vertex <= end
    order = np.argsort(~stays, axis=1, kind="stable")
    left = np.count_nonzero(stays, axis=1)
    size = int(left.max()) - 1
    real = np.arange(size)[None] < left[:, None] - 1
    rows = np.arange(n)[:, None]
    a = order[:, :size]
    b = np.where(real, order[:, 1 : size + 1], a)  # vertices at the beginning and the end
    last = np.maximum(b - 1, a)  # the last of the segments that became one
    first = a == 0
    t = tangent[rows, np.minimum(a, most - 2)]
    anchor = np.where(first, b, a)
    s_a, s_b = s[rows, a], s[rows, b]
    ends = b == end
    high = np.where(first, 0.0, np.where(ends, FAR, s_b - s_a))
    low = np.where(first, -FAR, 0.0)
    at = vertices[rows, anchor]
    turn_a, turn_b = turns[rows, a], turns[rows, b]
    earlier, later = np.maximum(a - 1, 0), np.minimum(b, most - 2)
    coupled = turns & (dot >= COUPLED)
    before_t = np.where(turn_a[..., None], tangent[rows, earlier], 0.0)
    next_t = np.where(turn_b[..., None], tangent[rows, later], 0.0)
    x_ends = at[..., 0] + low * t[..., 0], at[..., 0] + high * t[..., 0]
    values: dict[str, F64] = {
        "x": at[..., 0],
        "y": at[..., 1],
        "tx": t[..., 0],
        "ty": t[..., 1],
        "inverse_tx": _inverse(t[..., 0]),
        "inverse_ty": _inverse(t[..., 1]),
        "s": s[rows, anchor],
        "low": low,
        "high": high,
        "before_x": before_t[..., 0],
        "before_y": before_t[..., 1],
        "turn": np.where(turn_a, np.where(dot[rows, a] >= 0.0, cross[rows, a], 1.0), 0.0),
        "before_most": np.where(coupled[rows, a], reach[rows, earlier], 0.0),
        "next_x": next_t[..., 0],
        "next_y": next_t[..., 1],
        "next_0": high * np.sum(tangent[rows, np.minimum(last, most - 2)] * next_t, axis=-1),
        "next_most": np.where(coupled[rows, b], reach[rows, later], 0.0),
        "x_low": np.where(real, np.minimum(*x_ends), NOWHERE),
        "x_high": np.where(real, np.maximum(*x_ends), -NOWHERE),
        "bent": (turn_a | turn_b).astype(np.float64),
    }
    out = np.empty((n, size, len(SEGMENT_FIELDS)), dtype=np.float32)
    for k, name in enumerate(SEGMENT_FIELDS):
        out[..., k] = values[name]
    return out, np.where(real & ~ends, s_b, np.inf)
