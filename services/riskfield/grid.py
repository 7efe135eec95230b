"""Where the grid lies: along the ego's heading, longer ahead the faster it goes."""

from __future__ import annotations

import math

import numpy as np

from common.messages import BLOCK, F64, Ego, Grid
from services.riskfield.settings import RiskfieldSettings

LENGTH_STEP = 20.0
"""The grid grows in steps of this length, so that its shape seldom changes [m]."""


def needed_ahead(speed: float) -> float:
    """1.5 v + v²/3 + 6.5 m: reaction, braking with 1.5 m/s² and a gap, from the ego's centre [m]."""
    v = max(speed, 0.0)
    return 1.5 * v + v * v / 3.0 + 6.5


def grid_around(ego: Ego, settings: RiskfieldSettings) -> Grid:
    """The grid of this frame: `behind` + what is needed ahead, in whole blocks, `width` across."""
    ahead = settings.ahead
    needed = needed_ahead(math.hypot(ego.vx, ego.vy))
    if needed > ahead:
        ahead += math.ceil((needed - ahead) / LENGTH_STEP) * LENGTH_STEP
    ahead = min(ahead, max(settings.ahead_most, settings.ahead))
    rows = min(_whole_blocks((settings.behind + ahead) / settings.h), 8192)
    columns = min(_whole_blocks(settings.width / settings.h), 8192)
    c, s = math.cos(ego.heading), math.sin(ego.heading)
    right = columns * settings.h / 2
    return Grid(
        x=ego.x - c * settings.behind + s * right,
        y=ego.y - s * settings.behind - c * right,
        heading=math.remainder(ego.heading, 2 * math.pi),
        rows=rows,
        columns=columns,
        h=settings.h,
    )


def cell_centres(grid: Grid) -> tuple[F64, F64]:
    """Centres of all cells in the `map` frame, x and y [rows, columns] [m]."""
    i = (np.arange(grid.rows) + 0.5)[:, None] * grid.h
    j = (np.arange(grid.columns) + 0.5)[None, :] * grid.h
    c, s = math.cos(grid.heading), math.sin(grid.heading)
    return grid.x + c * i - s * j, grid.y + s * i + c * j


def into_grid(grid: Grid, xy: F64) -> F64:
    """Points [..., 2] of the `map` frame in the grid's frame [m]; subtracts first, so that far maps lose nothing."""
    d = xy - np.array([grid.x, grid.y])
    c, s = math.cos(grid.heading), math.sin(grid.heading)
    return np.stack((c * d[..., 0] + s * d[..., 1], c * d[..., 1] - s * d[..., 0]), axis=-1)


def _whole_blocks(cells: float) -> int:
    return max(BLOCK, math.ceil(cells / BLOCK - 1e-9) * BLOCK)
