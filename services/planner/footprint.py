"""The footprint's maximum: a path point's risk is the highest on the outline of the ego's rectangle there.

Contact is told apart by where it is. What is before the bumper is run into: r_hit. What is beside or behind keeps its
distance or does not, whatever the brake does: there only touching counts (a margin is taken off), and nobody brakes
hard for it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from common.messages import Ego
from services.planner.backend import kernels
from services.planner.volume import Volume

F32 = npt.NDArray[np.float32]
F64 = npt.NDArray[np.float64]

_STAYS_S = 2.0  # s
_CORNER = 0.3  # m; of the bumper, the outer part belongs to the flanks
_AHEAD = 1.0  # m; so much of the flanks, from the bumper on, meets what the ego drives into
_NEVER = 1e3  # E_max


@dataclass(frozen=True)
class Footprint:
    """Sample points on the outline, frame of the rear axle: x ahead, y to the left, corners included."""

    x: F64  # [m]
    y: F64  # [m]
    front: float  # from the rear axle to the front bumper [m]
    half_width: float  # [m]
    margin: F64  # taken off the risk where contact is judged: 0 before the bumper [E_max]
    ahead: F64  # the same where contact with what the ego drives into is judged: beside and behind none [E_max]

    @staticmethod
    def of(ego: Ego, spacing: float, flank_margin: float = 0.0) -> Footprint:
        """Points on the outline no further than `spacing` apart [m]; `flank_margin` is taken off beside and behind."""
        columns = int(np.ceil(ego.length / spacing)) + 1
        rows = int(np.ceil(ego.width / spacing)) + 1
        lx = np.linspace(-ego.length / 2, ego.length / 2, columns) + ego.wheelbase / 2
        ly = np.linspace(-ego.width / 2, ego.width / 2, rows)
        inner = ly[1:-1]
        x = np.concatenate((lx, lx, np.full(len(inner), lx[-1]), np.full(len(inner), lx[0])))
        y = np.concatenate((np.full(columns, ly[-1]), np.full(columns, ly[0]), inner, inner))
        before = (x >= lx[-1] - 1e-9) & (np.abs(y) <= ego.width / 2 - _CORNER)
        margin = np.where(before, 0.0, flank_margin)
        ahead = np.where(x >= lx[-1] - _AHEAD, margin, _NEVER)
        return Footprint(x, y, float(lx[-1]), ego.width / 2, margin, ahead)

    def at(self, x: F64, y: F64, heading: F64) -> tuple[F64, F64]:
        """The samples with the rear axle at poses of shape [...], each [..., samples], `map` frame."""
        c, s = np.cos(heading)[..., None], np.sin(heading)[..., None]
        return x[..., None] + c * self.x - s * self.y, y[..., None] + s * self.x + c * self.y


@dataclass(frozen=True)
class PathRisk:
    """The footprint's maximum along n paths of p points in S slices."""

    risk: F32  # [n, S, p]; slice j alone
    stays: F32  # [n, p]; what is there now and in every slice of the next 2 s: it may as well stay put
    known: F64  # distance from the start up to which the whole footprint is on the grid [n] [m]
    contact: F32 | None = None  # the same as `risk` with the footprint's margin taken off; None: no margin
    ahead: F32 | None = None  # the same with what is ahead alone; None: no difference


def path_risk(
    volume: Volume, footprint: Footprint, x: F64, y: F64, heading: F64, step: float, *, reference: bool = False
) -> PathRisk:
    """Evaluate paths [n, p] of the rear axle with points every `step` [m]; `reference` keeps to NumPy."""
    later = int(volume.slice_at(_STAYS_S))
    look_up = _look_up if kernels is None or reference else _kernel_look_up
    risk, stays, whole, contact, ahead = look_up(volume, footprint, x, y, heading, later)
    last = np.where(np.all(whole, axis=1), x.shape[1], np.argmin(whole, axis=1)) - 1
    return PathRisk(risk, stays, step * np.maximum(last, 0).astype(np.float64), contact, ahead)


def timed_risk(
    volume: Volume, footprint: Footprint, x: F64, y: F64, heading: F64, t: F64
) -> tuple[F64, npt.NDArray[np.bool_]]:
    """The maximum ahead at poses of the rear axle [m] at plan times t [m] [s], and whether all of it is known."""
    look_up = _look_up if kernels is None else _kernel_look_up
    _, _, whole, _, ahead = look_up(volume, footprint, x[None], y[None], heading[None], 0)
    return ahead[0, volume.slice_at(t), np.arange(len(x))].astype(np.float64), whole[0]


def _kernel_look_up(
    volume: Volume, footprint: Footprint, x: F64, y: F64, heading: F64, later: int
) -> tuple[F32, F32, npt.NDArray[np.bool_], F32, F32]:
    found: tuple[F32, F32, npt.NDArray[np.bool_], F32, F32] = kernels.look_up(
        volume, (footprint.x, footprint.y, footprint.margin, footprint.ahead), x, y, heading, later
    )
    return found


def _look_up(
    volume: Volume, footprint: Footprint, x: F64, y: F64, heading: F64, later: int
) -> tuple[F32, F32, npt.NDArray[np.bool_], F32, F32]:
    fx, fy = footprint.at(x, y, heading)
    values, inside = volume.sample(fx, fy)  # [S, n, p, k]
    risk = np.moveaxis(values.max(axis=-1), 0, 1)
    less = np.maximum(values - footprint.margin.astype(np.float32), np.float32(0.0))
    stays = less[: later + 1].min(axis=0).max(axis=-1)
    contact = np.moveaxis(less.max(axis=-1), 0, 1)
    ahead = np.moveaxis(np.maximum(values - footprint.ahead.astype(np.float32), np.float32(0.0)).max(axis=-1), 0, 1)
    whole = np.asarray(inside.all(axis=-1))
    return np.ascontiguousarray(risk), stays, whole, np.ascontiguousarray(contact), np.ascontiguousarray(ahead)
