"""What the nearest body alone is felt of: far tails that add up close no gap that is wide enough to be crept through.

The volume is a sum. Between two rows of parked cars the tails of all of them lift the risk at the ego's flanks above
contact where no body is nearer than half a metre. How near the nearest one is shows in the *shape* of the field, to
which tails add next to nothing: pE = A / (D² + A) is hollow (curved upwards along its gradient) further away than
D = sqrt(A/3), which is 0.37 m for a car and more for whatever is heavier or more easily hurt, rounded nearer than that,
and flat inside the body. Levels of tails fall with D², their curvature with D⁴.

So near a standing body, where the field is hollow or nearly so, its level counts no more than says how near it is:
0.8 E_max (contact) 0.35 m from it, and not less than 0.75 further away; the speed law then has the gap crept through.
What the ego drives towards (there the field falls along its heading), lines (closed ones, kerbs, barriers) and whoever
moves keep what they have. So does everything near people on foot or on two wheels: a body behind them can hide their
shape.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from msgspec.structs import replace

from common.messages import BLOCK, ObjectClass
from services.planner.volume import Volume

F32 = npt.NDArray[np.float32]
F64 = npt.NDArray[np.float64]
Bools = npt.NDArray[np.bool_]

SLOW = 5.0
"""Who is faster does not look so closely [m/s]."""

_REACH = 16.0  # m; so far around the ego
_FINE = 0.3  # m; on coarser grids the shape is not seen
_LEAST = 0.75  # E_max; what is left at least
_ROUNDED, _AT_ROUNDED = -1.1, 0.95  # E_max/m², E_max: along the gradient 0.3 m from a car, and what counts there …
_HOLLOW, _AT_HOLLOW = -0.5, 0.8  # … and at 0.35 m
_LINE = 2.2  # E_max/m²; no body's field is so hollow
_STEEP = 0.6  # E_max/m; inside a body the field is flatter, but for what stands close behind its face …
_MOST = 1.3  # E_max; … and there it is higher
_EDGE = 1.1  # E_max; what is next to a place that is made clear counts no more, or it would spread into it
_EASILY_HURT = (ObjectClass.PEDESTRIAN, ObjectClass.BICYCLE, ObjectClass.MOTORCYCLE)
_APART = 2  # blocks; so near to one of them nothing is lowered
_STAYS_S = 2.0  # s; who changes a place by then does not stand there …
_SAME = 0.05  # E_max; … by more than this


def nearest_alone(volume: Volume, x: float, y: float, heading: float) -> Volume:
    """The volume with what standing bodies beside a pose [m] [m] [rad] add up to lowered to the nearest one's."""
    risk, g = volume.risk, volume.risk.grid
    if g.h > _FINE:
        return volume
    i, j = (int(q[0]) for q in volume.coordinates(np.array([x]), np.array([y])))
    reach = int(_REACH / g.h)
    rows = slice(max(i - reach, 0), max(min(i + reach, g.rows), 0))
    columns = slice(max(j - reach, 0), max(min(j + reach, g.columns), 0))
    now = risk.volume[volume.first, rows, columns].astype(np.float32)
    if min(now.shape) < 3 or not (now >= _LEAST).any():
        return volume
    lowered = now - _nearest(now, _bodies(volume, rows, columns), heading - g.heading, g.h)
    soon = risk.volume[volume.first + int(volume.slice_at(_STAYS_S)), rows, columns]
    i_at, j_at = np.nonzero((lowered > 0.0) & (np.abs(soon - now) <= _SAME))
    if not len(i_at):
        return volume
    changed = risk.volume.copy()
    part = changed[volume.first :, rows, columns]
    later = part[:, i_at, j_at].astype(np.float32)  # [S, cells]
    stands = np.abs(later - now[i_at, j_at]) <= _SAME
    part[:, i_at, j_at] = later - np.where(stands, lowered[i_at, j_at], np.float32(0.0))
    return Volume(replace(risk, volume=changed), volume.first, volume.starts)


def _bodies(volume: Volume, rows: slice, columns: slice) -> Bools:
    """Where a body has the largest share and nobody easily hurt is near, cell by cell of a window of the first slice.

    Who is easily hurt and has the largest share nowhere may be anywhere: then there is no such place.
    """
    slots = volume.risk.slots
    is_body, is_soft = np.zeros(256, dtype=bool), np.zeros(256, dtype=bool)
    is_soft[: len(slots)] = [slot.cls in _EASILY_HURT for slot in slots]
    is_body[: len(slots)] = [slot.cls >= 0 for slot in slots]
    dominant = volume.risk.dominant[volume.first]
    blocks = (is_body & ~is_soft)[dominant]
    if not np.isin(np.flatnonzero(is_soft), dominant).all():
        blocks = np.zeros_like(blocks)
    for at in np.argwhere(is_soft[dominant]):
        low, high = np.maximum(at - _APART, 0), at + _APART + 1
        blocks[low[0] : high[0], low[1] : high[1]] = False
    i, j = np.arange(rows.start, rows.stop) // BLOCK, np.arange(columns.start, columns.stop) // BLOCK
    return np.asarray(blocks[i[:, None], j])


def _nearest(m: F32, body: Bools, turned: float, h: float) -> F32:
    """The level that counts in each cell of `m`, beside somebody who stands `turned` in the grid [rad]."""
    p = np.pad(m, 1, mode="edge")
    a, b, c, d = p[2:, 1:-1], p[:-2, 1:-1], p[1:-1, 2:], p[1:-1, :-2]
    gi, gj = (a - b) / (2.0 * h), (c - d) / (2.0 * h)
    ii, jj = (a - 2.0 * m + b) / h**2, (c - 2.0 * m + d) / h**2
    ij = (p[2:, 2:] - p[2:, :-2] - p[:-2, 2:] + p[:-2, :-2]) / (4.0 * h**2)
    steep = gi**2 + gj**2
    bent = (gi**2 * ii + 2.0 * gi * gj * ij + gj**2 * jj) / np.maximum(steep, 1e-9)  # along the gradient
    slope = (_AT_ROUNDED - _AT_HOLLOW) / (_HOLLOW - _ROUNDED)
    level = np.maximum(_AT_ROUNDED - slope * (bent - _ROUNDED), _LEAST)
    along, across = gi * np.cos(turned) + gj * np.sin(turned), gj * np.cos(turned) - gi * np.sin(turned)
    clear = body & (np.abs(across) >= np.abs(along))
    clear &= (steep >= _STEEP**2) & (m <= _MOST) & (bent >= _ROUNDED) & (bent <= _LINE) & (m > level)
    beside = np.pad(clear, 1)
    beside = beside[2:, 1:-1] | beside[:-2, 1:-1] | beside[1:-1, 2:] | beside[1:-1, :-2]
    beside &= body & ~clear
    return np.where(clear, level, np.where(beside, np.minimum(m, _EDGE), m)).astype(np.float32)
