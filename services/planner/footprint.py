"""The footprint's maximum: a path point's risk is the highest on the outline of the ego's rectangle there."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from common.messages import Ego
from services.planner.volume import Volume

F32 = npt.NDArray[np.float32]
F64 = npt.NDArray[np.float64]

_STAYS_S = 2.0  # s


@dataclass(frozen=True)
class Footprint:
    """Sample points on the outline, frame of the rear axle: x ahead, y to the left, corners included."""

    x: F64  # [m]
    y: F64  # [m]
    front: float  # from the rear axle to the front bumper [m]
    half_width: float  # [m]

    @staticmethod
    def of(ego: Ego, spacing: float) -> Footprint:
        """Points on the outline no further than `spacing` apart [m]."""
        columns = int(np.ceil(ego.length / spacing)) + 1
        rows = int(np.ceil(ego.width / spacing)) + 1
        lx = np.linspace(-ego.length / 2, ego.length / 2, columns) + ego.wheelbase / 2
        ly = np.linspace(-ego.width / 2, ego.width / 2, rows)
        inner = ly[1:-1]
        x = np.concatenate((lx, lx, np.full(len(inner), lx[-1]), np.full(len(inner), lx[0])))
        y = np.concatenate((np.full(columns, ly[-1]), np.full(columns, ly[0]), inner, inner))
        return Footprint(x, y, float(lx[-1]), ego.width / 2)

    def at(self, x: F64, y: F64, heading: F64) -> tuple[F64, F64]:
        """The samples with the rear axle at poses of shape [...], each [..., samples], `map` frame."""
        c, s = np.cos(heading)[..., None], np.sin(heading)[..., None]
        return x[..., None] + c * self.x - s * self.y, y[..., None] + s * self.x + c * self.y


@dataclass(frozen=True)
class PathRisk:
    """The footprint's maximum along n paths of p points in S slices."""

    risk: F32  # [n, S, p]; slice j alone
    stays: F32  # [n, p]; what is there now and still partly there 2 s later: it may as well stay put
    known: F64  # distance from the start up to which the whole footprint is on the grid [n] [m]


def path_risk(volume: Volume, footprint: Footprint, x: F64, y: F64, heading: F64, step: float) -> PathRisk:
    """Evaluate paths [n, p] of the rear axle with points every `step` [m]."""
    fx, fy = footprint.at(x, y, heading)
    values, inside = volume.sample(fx, fy)  # [S, n, p, k]
    risk = np.moveaxis(values.max(axis=-1), 0, 1)
    later = int(volume.slice_at(_STAYS_S))
    stays = np.minimum(values[0], values[later]).max(axis=-1)
    whole = np.asarray(inside.all(axis=-1))
    last = np.where(np.all(whole, axis=1), x.shape[1], np.argmin(whole, axis=1)) - 1
    return PathRisk(np.ascontiguousarray(risk), stays, step * np.maximum(last, 0).astype(np.float64))
