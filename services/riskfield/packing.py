"""Sources as the kernels read them: rows of float32 in the grid's frame, cut to what can reach the grid."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from common.messages import F32, F64, Grid
from common.risk import RiskParameters
from common.risk_sources import Bools, DynamicSources, Indices
from services.riskfield.grid import into_grid
from services.riskfield.layout import FAR_STEP, OBJECT_FIELDS

NOWHERE = 1.0e9
"""A coordinate that no row of the grid has [m]."""
FAR_ERROR = 1.5e-4
"""What cubic interpolation between the nodes may miss of one object's potential [E_max]."""


@dataclass(frozen=True)
class PackedObjects:
    """n' of the sources' n objects: those that may reach the grid in some slice."""

    kept: Indices
    """Which of the sources, [n']."""
    objects: F32
    """[k, n', len(OBJECT_FIELDS)]; `first` and `last` are the kernels' to write."""
    vertices: F64
    """Of the paths, `map` frame, [n', P, 2] [m]."""
    arcs: F64
    """Arc length of each vertex, [n', P] [m]."""
    vertex_counts: Indices
    """[n']."""
    origins: F64
    """Arc length of the current state, from which the kernels count, [n'] [m]."""
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

    lines = sources.paths
    origin = lines.frame_s[kept, 0]
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
        "s0": of(sources.s0) - origin,
        "half": half_length,
        "inverse_l": 1.0 / length,
        "width": width,
        "inverse_w2": 1.0 / width**2,
        "low": np.where(lobe, x - span, NOWHERE),
        "high": np.where(lobe, x + span, -NOWHERE),
    }
    objects = np.zeros((len(x), len(kept), len(OBJECT_FIELDS)), dtype=np.float32)
    for name, value in values.items():
        objects[..., OBJECT_FIELDS.index(name)] = value
    return PackedObjects(
        kept=kept,
        objects=objects,
        vertices=lines.vertices[kept],
        arcs=lines.s[kept],
        vertex_counts=lines.count[kept],
        origins=origin,
        two_level=two_level,
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
