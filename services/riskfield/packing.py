"""Sources as the kernels read them: rows of float32 in the grid's frame, cut to what can reach the grid."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from common.messages import F32, F64, Grid
from common.risk import COUPLED, RiskParameters
from common.risk_sources import Bools, DynamicSources, Indices
from services.riskfield.grid import into_grid
from services.riskfield.kernels import OBJECT_FIELDS, SEGMENT_FIELDS

FAR = 1.0e4
"""How far a path's ends go on straight for the kernels [m]."""
NOWHERE = 1.0e9
"""A coordinate that no row of the grid has [m]."""


@dataclass(frozen=True)
class PackedObjects:
    """n' of the sources' n objects: those that reach the grid in some slice."""

    kept: Indices
    """Which of the sources, [n']."""
    objects: F32
    """[k, n', len(OBJECT_FIELDS)]."""
    segments: F32
    """[n', S, len(SEGMENT_FIELDS)]."""


def pack_objects(sources: DynamicSources, counts: Bools, grid: Grid, p: RiskParameters) -> PackedObjects:
    """Write the sources that count ([n] bool) in the grid's frame; what cannot reach a cell is left out, exactly."""
    lines = sources.paths
    extent = np.array([grid.rows * grid.h, grid.columns * grid.h])
    centre = into_grid(grid, np.stack((sources.x, sources.y), axis=-1))
    heading = sources.heading - grid.heading
    half = np.stack((sources.length, sources.width), axis=-1) / 2
    radius = p.taper_radius + np.hypot(half[..., 0], half[..., 1])
    outside = np.maximum(np.maximum(-centre, centre - extent), 0.0)
    radius = np.where(np.hypot(outside[..., 0], outside[..., 1]) < radius, radius, 0.0)

    reach = np.abs(sources.u) * p.t
    ahead = sources.u > 0.0
    # inside a bend the arc length that neighbouring segments share lies less than one width off a segment's own
    s_low = sources.s0 - half[..., 0] - sources.width - np.where(ahead, 0.0, reach)
    s_high = sources.s0 + half[..., 0] + sources.width + np.where(ahead, reach, 0.0)
    inner = np.arange(lines.s.shape[1])[None] <= (lines.count - 2)[:, None]
    inner[:, 0] = False
    below = inner[None] & (lines.s[None] < s_low[..., None])
    upto = inner[None] & (lines.s[None] <= s_high[..., None])
    vertices = into_grid(grid, lines.vertices)
    ends = into_grid(grid, np.stack((lines.at(s_low), lines.at(s_high))))
    between = upto & ~below
    low, high = ends.min(0), ends.max(0)
    for axis in (0, 1):
        along = np.ascontiguousarray(vertices[..., axis])[None]
        low[..., axis] = np.minimum(low[..., axis], np.where(between, along, np.inf).min(-1)) - sources.width
        high[..., axis] = np.maximum(high[..., axis], np.where(between, along, -np.inf).max(-1)) + sources.width
    lobe = (sources.u != 0.0) & np.all((high > 0.0) & (low < extent), axis=-1)

    kept = np.flatnonzero(counts & ((radius > 0.0) | lobe).any(0))
    origin = lines.frame_s[:, 0]
    values: dict[str, F64] = {
        "x": centre[..., 0],
        "y": centre[..., 1],
        "cos": np.cos(heading),
        "sin": np.sin(heading),
        "half_length": half[..., 0],
        "half_width": half[..., 1],
        "A": p.k * p.r_a * sources.M_v,
        "radius": radius,
        "M2": 0.5 * sources.M_v * sources.u**2 / p.K0,
        "inverse_L": 1.0 / (reach + p.d0),
        "reach": reach,
        "sign": np.sign(sources.u),
        "s0": sources.s0 - origin,
        "length": sources.length,
        "width": sources.width,
        "kinetic_low": np.where(lobe, low[..., 0], NOWHERE),
        "kinetic_high": np.where(lobe, high[..., 0], -NOWHERE),
        "segment_first": below.sum(-1),
        "segment_last": upto.sum(-1),
    }
    objects = np.empty((*sources.x.shape, len(OBJECT_FIELDS)), dtype=np.float32)
    for k, name in enumerate(OBJECT_FIELDS):
        objects[..., k] = values[name]
    return PackedObjects(
        kept=kept,
        objects=np.ascontiguousarray(objects[:, kept]),
        segments=_segments(vertices[kept], lines.s[kept] - origin[kept, None], lines.count[kept]),
    )


def _segments(vertices: F64, s: F64, count: Indices) -> F32:
    n, most = s.shape
    step = np.diff(vertices, axis=1)
    length = np.hypot(step[..., 0], step[..., 1])
    tangent = step / np.where(length > 0.0, length, 1.0)[..., None]
    before = np.concatenate((np.zeros((n, 1, 2)), tangent[:, :-1]), axis=1)
    cross = np.abs(before[..., 0] * tangent[..., 1] - before[..., 1] * tangent[..., 0])
    dot = np.sum(before * tangent, axis=-1)
    out = np.zeros((n, most - 1, len(SEGMENT_FIELDS)), dtype=np.float32)
    anchor = vertices[:, :-1].copy()
    s_anchor = s[:, :-1].copy()
    low, high = np.zeros_like(length), length.copy()
    # the first segment has no beginning: it hangs on its end
    anchor[:, 0], s_anchor[:, 0], low[:, 0], high[:, 0] = vertices[:, 1], s[:, 1], -FAR, 0.0
    following = np.concatenate((tangent[:, 1:], np.zeros((n, 1, 2))), axis=1)
    coupled = dot >= COUPLED
    span = np.concatenate((np.zeros((n, 1)), length), axis=1)
    span[:, 1] = span[np.arange(n), count - 1] = FAR
    last = (np.arange(n), count - 2)
    far = high.copy()
    far[last] = FAR
    ends = anchor[..., 0] + low * tangent[..., 0], anchor[..., 0] + far * tangent[..., 0]
    values: dict[str, F64] = {
        "x": anchor[..., 0],
        "y": anchor[..., 1],
        "tx": tangent[..., 0],
        "ty": tangent[..., 1],
        "s": s_anchor,
        "low": low,
        "high": far,
        "before_x": before[..., 0],
        "before_y": before[..., 1],
        "turn": np.where(dot >= 0.0, cross, 1.0),
        "before_most": np.where(coupled, span[:, :-1], 0.0),
        "next_x": following[..., 0],
        "next_y": following[..., 1],
        "next_0": high * np.concatenate((dot[:, 1:], np.zeros((n, 1))), axis=1),
        "x_low": np.minimum(*ends),
        "x_high": np.maximum(*ends),
        "next_most": np.concatenate((np.where(coupled, span[:, 1:], 0.0)[:, 1:], np.zeros((n, 1))), axis=1),
    }
    for k, name in enumerate(SEGMENT_FIELDS):
        out[..., k] = values[name]
    out[:, 0, SEGMENT_FIELDS.index("turn")] = 0.0
    return out
