"""The footprint's maximum: a path point's risk is the highest on the outline of the ego's rectangle there.

Contact is told apart by where it is. What is before the bumper is run into: r_hit. What is beside keeps its distance
or does not, whatever the brake does: there only touching counts (a margin is taken off), and nobody brakes hard for
it. What is behind comes nearer when the ego brakes: it counts on paths that leave where the ego drives, so that nobody
pulls out before a faster car, and says nothing about how fast to go on.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
import numpy.typing as npt

from common.messages import BLOCK, Ego
from services.planner.backend import kernels
from services.planner.volume import NOBODY, Volume

F32 = npt.NDArray[np.float32]
F64 = npt.NDArray[np.float64]
U8 = npt.NDArray[np.uint8]
Bools = npt.NDArray[np.bool_]

_STAYS_S = 2.0  # s
CORNER = 0.3
"""Of the bumpers, the outer part belongs to the flanks [m]."""
_AHEAD = 1.0  # m; so much of the flanks, from the bumper on, meets what the ego drives into
_THIN = 0.2  # m; so thin is where a closed line alone is contact, on a grid of a quarter metre
_TAIL = 1.5  # m; largest distance between the samples behind
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
    rear: Bools  # which samples lie behind the middle
    sides: U8  # of which side of the front half each sample is: 1: left, 2: right, 3: both, 0: of the rear
    outline: (
        int  # so many are of the outline; the others lie behind it, where nobody may be whom the ego pulls out before
    )

    @cached_property
    def taken(self) -> F32:
        """Off each sample for contact, contact ahead, left, right and all, on paths that stay or leave [2, 5, k]."""
        sides = [np.where(self.sides & side, 0.0, _NEVER) for side in (1, 2)]
        stay = np.where(self.rear, _NEVER, self.margin)
        whole = np.where(np.arange(len(self.x)) < self.outline, 0.0, _NEVER)
        return np.array([[m, self.ahead, *sides, whole] for m in (stay, self.margin)], dtype=np.float32)

    @cached_property
    def packed(self) -> Any:
        """The same for the kernels."""
        return kernels.pack(self.x, self.y, self.taken, self.outline)

    @cached_property
    def packed_rear(self) -> Any:
        """The rear half of the outline alone, for the kernels; nothing is taken off."""
        rear = np.flatnonzero(self.rear[: self.outline])
        return kernels.pack(self.x[rear], self.y[rear], np.zeros((2, 5, len(rear)), np.float32), len(rear))

    @staticmethod
    def of(ego: Ego, spacing: float, flank_margin: float = 0.0, behind: float = 0.0, stride: float = 0.0) -> Footprint:
        """Points on the outline no further than `spacing` apart [m]; `flank_margin` is taken off beside and behind.

        `behind` [m] is the gap to who follows that a path which leaves must have; `stride` [m] is how far apart the
        poses are at which it is looked up: points behind the bumper see to it that no closed line lies between two.
        """
        if behind <= 0.0 and stride <= 0.0:
            return _outlined(ego.length, ego.width, ego.wheelbase, spacing, flank_margin)
        return Footprint._made(ego.length, ego.width, ego.wheelbase, spacing, flank_margin, behind, stride)

    @staticmethod
    def _made(
        length: float,
        width: float,
        wheelbase: float,
        spacing: float,
        flank_margin: float,
        behind: float,
        stride: float = 0.0,
    ) -> Footprint:
        columns = int(np.ceil(length / spacing)) + 1
        rows = int(np.ceil(width / spacing)) + 1
        lx = np.linspace(-length / 2, length / 2, columns) + wheelbase / 2
        ly = np.linspace(-width / 2, width / 2, rows)
        inner = ly[1:-1]
        tail = np.linspace(behind, 0.0, int(np.ceil(behind / _TAIL)), endpoint=False)
        trail = lx[-1] - np.linspace(0.0, stride, int(np.ceil(stride / _THIN)), endpoint=False)[1:]
        trail = trail[trail > wheelbase / 2]
        middle = np.zeros(len(trail) + len(tail))
        outline = 2 * (columns + len(inner)) + len(trail)
        x = np.concatenate((lx, lx, np.full(len(inner), lx[-1]), np.full(len(inner), lx[0]), trail, lx[0] - tail))
        y = np.concatenate((np.full(columns, ly[-1]), np.full(columns, ly[0]), inner, inner, middle))
        before = (x >= lx[-1] - max(stride, 1e-9)) & (np.abs(y) <= width / 2 - CORNER)
        margin = np.where(before | (np.arange(len(x)) >= outline), 0.0, flank_margin)
        ahead = np.where((x >= lx[-1] - _AHEAD) | before, margin, _NEVER)
        rear = x < wheelbase / 2 - 1e-9
        sides = np.where(rear, 0, (y > -1e-9) * 1 + (y < 1e-9) * 2).astype(np.uint8)
        return Footprint(x, y, float(lx[-1]), width / 2, margin, ahead, rear, sides, outline)

    def at(self, x: F64, y: F64, heading: F64) -> tuple[F64, F64]:
        """The samples with the rear axle at poses of shape [...], each [..., samples], `map` frame."""
        c, s = np.cos(heading)[..., None], np.sin(heading)[..., None]
        return x[..., None] + c * self.x - s * self.y, y[..., None] + s * self.x + c * self.y


@lru_cache(maxsize=16)
def _outlined(length: float, width: float, wheelbase: float, spacing: float, flank_margin: float) -> Footprint:
    """The outline alone, made once for each size."""
    return Footprint._made(length, width, wheelbase, spacing, flank_margin, 0.0)


@dataclass(frozen=True)
class PathRisk:
    """The footprint's maximum along n paths of p points in S slices."""

    risk: F32  # [n, S, p]; slice j alone
    stays: F32  # [n, p]; what is there now and in every slice of the next 2 s: it may as well stay put
    known: F64  # distance from the start up to which the whole footprint is on the grid [n] [m]
    contact: F32 | None = None  # the maximum with the footprint's margin taken off; None: as `risk`
    ahead: F32 | None = None  # the same with what is ahead alone; None: no difference
    sides: F32 | None = None  # the maximum of the front half, on its left and its right [2, n, S, p]; None: as `risk`
    who: U8 | None = None  # sources of contact, contact ahead and both sides, or NOBODY [4, n, S, p]; None: unknown


def path_risk(
    volume: Volume,
    footprint: Footprint,
    x: F64,
    y: F64,
    heading: F64,
    step: float,
    *,
    leaves: Bools | None = None,
    r_hit: float = 0.8,
    r0: float = 0.2,
    reference: bool = False,
) -> PathRisk:
    """Evaluate paths [n, p] of the rear axle with points every `step` [m]; `reference` keeps to NumPy.

    `leaves` says of each path whether it leaves where the ego drives [n]: there what is behind counts; by default on
    all. Sources are told of contact, r_hit, and of what is beside from r0 on.
    """
    later = int(volume.slice_at(_STAYS_S))
    leaves = np.ones(len(x), dtype=bool) if leaves is None else leaves
    look_up = _look_up if reference else _fastest(footprint)
    risk, stays, whole, four, who = look_up(volume, footprint, leaves, (r_hit, r0), x, y, heading, later)
    last = np.where(np.all(whole, axis=1), x.shape[1], np.argmin(whole, axis=1)) - 1
    return PathRisk(risk, stays, step * np.maximum(last, 0).astype(np.float64), four[0], four[1], four[2:], who)


def timed_risk(volume: Volume, footprint: Footprint, x: F64, y: F64, heading: F64, t: F64) -> tuple[F64, Bools]:
    """The maximum ahead at poses of the rear axle [..., m] at plan times t [m] [s], and whether all of it is known."""
    at = tuple(np.atleast_2d(q) for q in (x, y, heading))
    slices = volume.slice_at(t)
    if kernels is None or len(footprint.x) > kernels.MOST_SAMPLES:
        fx, fy = footprint.at(*at)
        values = np.stack([volume.sample_at(fx[k], fy[k], slices) for k in range(len(fx))])
        risk = np.maximum(values - footprint.ahead.astype(np.float32), np.float32(0.0)).max(axis=-1)
        whole = volume.known(fx, fy)[..., : footprint.outline].all(axis=-1)
    else:
        none = np.zeros(len(at[0]), dtype=np.uint8)
        _, _, whole, four, _ = kernels.look_up(volume, footprint.packed, (1e9, 1e9), none, *at, 0, slices)
        risk = four[1, :, 0]
    return risk.astype(np.float64).reshape(np.shape(x)), np.asarray(whole, dtype=bool).reshape(np.shape(x))


def rear_risk(volume: Volume, footprint: Footprint, x: F64, y: F64, heading: F64, t: F64) -> F32:
    """The maximum on the rear half of the outline at poses of the rear axle [m] at plan times t [m] [s]; [m]."""
    slices = volume.slice_at(t)
    if kernels is None or footprint.outline > kernels.MOST_SAMPLES:
        rear = footprint.rear[: footprint.outline]
        fx, fy = footprint.at(x, y, heading)
        values = volume.sample_at(fx[:, : footprint.outline][:, rear], fy[:, : footprint.outline][:, rear], slices)
        return np.asarray(values.max(axis=1))
    none = np.zeros(1, dtype=np.uint8)
    poses = (x[None], y[None], heading[None])
    found = kernels.look_up(volume, footprint.packed_rear, (1e9, 1e9), none, *poses, 0, slices)
    return np.asarray(found[0][0, 0])


def _fastest(footprint: Footprint) -> Callable[..., _Looked]:
    return _look_up if kernels is None or len(footprint.x) > kernels.MOST_SAMPLES else _kernel_look_up


_Looked = tuple[F32, F32, Bools, F32, U8]


def _kernel_look_up(
    volume: Volume,
    footprint: Footprint,
    leaves: Bools,
    named: tuple[float, float],
    x: F64,
    y: F64,
    heading: F64,
    later: int,
) -> _Looked:
    found: _Looked = kernels.look_up(volume, footprint.packed, named, leaves.astype(np.uint8), x, y, heading, later)
    return found


def _look_up(
    volume: Volume,
    footprint: Footprint,
    leaves: Bools,
    named: tuple[float, float],
    x: F64,
    y: F64,
    heading: F64,
    later: int,
) -> _Looked:
    fx, fy = footprint.at(x, y, heading)
    values, inside = volume.sample(fx, fy)  # [S, n, p, k]
    four, who = [], []
    taken = footprint.taken[leaves.astype(np.intp)]  # [n, 4, k]
    g = volume.risk.grid
    fi, fj = volume.coordinates(fx, fy)
    block = (
        np.clip(fi, 0, g.rows - 1).astype(np.intp) // BLOCK,
        np.clip(fj, 0, g.columns - 1).astype(np.intp) // BLOCK,
    )
    j = volume.first + np.arange(volume.slices)[:, None, None]
    for w, least in enumerate((named[0], named[0], named[1], named[1])):
        part = np.maximum(values - taken[None, :, w, None], np.float32(0.0))
        most = part.argmax(axis=-1)[..., None]  # [S, n, p, 1]
        value = np.take_along_axis(part, most, axis=-1)[..., 0]
        at = (np.take_along_axis(b[None], most, axis=-1)[..., 0] for b in block)
        name = volume.who[volume.risk.dominant[j, next(at), next(at)]]
        four.append(np.moveaxis(value, 0, 1))
        who.append(np.moveaxis(np.where(value >= np.float32(least), name, np.uint8(NOBODY)), 0, 1))
    stays = np.maximum(values[: later + 1].min(axis=0) - taken[:, 0, None], np.float32(0.0)).max(axis=-1)
    return (
        np.ascontiguousarray(np.moveaxis(values[..., : footprint.outline].max(axis=-1), 0, 1)),
        stays,
        np.asarray(inside[..., : footprint.outline].all(axis=-1)),
        np.stack(four),
        np.stack(who),
    )
