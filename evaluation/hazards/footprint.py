"""The risk that the ego's footprint meets along its own path, read off a volume M as it is published."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from common.messages import F64, Risk

SPACING = 0.45
"""Largest distance between the footprint's points [m]."""


def footprint(length: float, width: float) -> F64:
    """Points of a rectangle, edges included, relative to its centre and heading [p, 2] [m]."""
    along = np.linspace(-length / 2, length / 2, int(np.ceil(length / SPACING)) + 1)
    beside = np.linspace(-width / 2, width / 2, int(np.ceil(width / SPACING)) + 1)
    return np.stack(np.meshgrid(along, beside, indexing="ij"), axis=-1).reshape(-1, 2)


def points_at(x: F64, y: F64, heading: F64, body: F64) -> tuple[F64, F64]:
    """The footprint's points at poses [...], x and y [..., p] [m]."""
    c, s = np.cos(heading)[..., None], np.sin(heading)[..., None]
    return x[..., None] + c * body[:, 0] - s * body[:, 1], y[..., None] + s * body[:, 0] + c * body[:, 1]


def read(risk: Risk, j: npt.ArrayLike, x: F64, y: F64) -> F64:
    """M_j at points of the `map` frame, bilinear between cell centres; 0 beyond the grid. j, x and y broadcast."""
    g = risk.grid
    c, s = np.cos(g.heading), np.sin(g.heading)
    dx, dy = x - g.x, y - g.y
    fi, fj = (c * dx + s * dy) / g.h - 0.5, (c * dy - s * dx) / g.h - 0.5
    known = (fi >= -0.5) & (fi <= g.rows - 0.5) & (fj >= -0.5) & (fj <= g.columns - 0.5)
    fi, fj = np.clip(fi, 0.0, g.rows - 1.001), np.clip(fj, 0.0, g.columns - 1.001)
    i, k = fi.astype(np.intp), fj.astype(np.intp)
    wi, wk = fi - i, fj - k
    m = np.ascontiguousarray(risk.volume).ravel()
    at = (np.asarray(j, dtype=np.intp) * g.rows + i) * g.columns + k

    def cells(shift: int) -> F64:
        return np.asarray(np.take(m, at + shift), dtype=np.float64)

    low = (1 - wk) * cells(0) + wk * cells(1)
    high = (1 - wk) * cells(g.columns) + wk * cells(g.columns + 1)
    return np.asarray(np.where(known, (1 - wi) * low + wi * high, 0.0), dtype=np.float64)


def met(risk: Risk, j: npt.ArrayLike, x: F64, y: F64, heading: F64, body: F64) -> F64:
    """Largest M_j under the footprint at poses [...]; j is one slice, or one for each pose."""
    j = np.asarray(j)
    return np.asarray(read(risk, j[..., None] if j.ndim else j, *points_at(x, y, heading, body)).max(-1))
