"""Where contact begins along paths, slice by slice, and how it moves.

s_hit is the first place at or beyond a station where the footprint's risk reaches r_hit, its crossing interpolated
(the first sample instead makes a limit cycle). What one and the same source does in slice j and in slice j + 1 it does
steadily in between: its contact moves along the path from the one place to the other. Of contacts of different or
unknown sources (somebody crosses, appears, goes) the nearer one holds for the whole slice; who goes out of the way goes
on as fast as he came there, and who comes into it moves as he does once there.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from services.planner.backend import kernels
from services.planner.footprint import Footprint, path_risk
from services.planner.pushers import pushers, without
from services.planner.speed import FAR, contact_distance
from services.planner.volume import NOBODY, Volume

F32 = npt.NDArray[np.float32]
F64 = npt.NDArray[np.float64]
U8 = npt.NDArray[np.uint8]

_FASTEST = 60.0
"""No contact moves faster [m/s]."""
STEP = 1.0
"""Between the points of a motion that is looked up [m]."""
_BEYOND = 25.0  # m; so far ahead of a motion contact is looked for, to know whether it moves on


@dataclass(frozen=True)
class Contact:
    """Contact along n paths of p stations in S slices: at time t of slice j at distance + rate · (t − t_j)."""

    distance: F64  # s_hit at the slice's start, FAR if none [n, S, p] [m]
    rate: F64  # how fast it moves along the path, 0 where it is not known to move steadily [n, S, p] [m/s]
    away: F64  # u ≥ 0: how fast it moves away [n, S, p] [m/s]

    def closing(self, ahead_s: float) -> Contact:
        """The same, but who comes towards the ego when the volume ends is in its last slice so much further on."""
        if self.distance.shape[1] < 2 or ahead_s <= 0.0:
            return self
        distance, came = self.distance.copy(), np.minimum(self.rate[:, -2], 0.0)
        distance[:, -1] += ahead_s * came
        return Contact(distance, self.rate, self.away)

    @staticmethod
    def of(risk: F32, who: U8 | None, starts: F64, r_hit: float, step: float, *, reference: bool = False) -> Contact:
        """Find it in the risk of contact [n, S, p] of the sources `who`, slices starting at [S]; else NumPy alone."""
        who = np.full(risk.shape, NOBODY, dtype=np.uint8) if who is None else who
        if kernels is not None and not reference:
            return Contact(*kernels.crossings(risk, who, starts, r_hit, step, FAR, _OVER))
        own = contact_distance(risk, r_hit, step)
        name = _carried(risk, who, r_hit)
        distance, rate, away = own.copy(), np.zeros_like(own), np.zeros_like(own)
        if len(starts) > 1:
            a, b = own[:, :-1], own[:, 1:]
            same = (name[:, :-1] == name[:, 1:]) & (name[:, :-1] != NOBODY) & (a < FAR) & (b < FAR)
            speed = np.clip((b - a) / np.diff(starts)[None, :, None], -_FASTEST, _FASTEST)
            rate[:, :-1] = np.where(same, speed, 0.0)
            distance[:, :-1] = np.where(same, a, np.minimum(a, b))
            away = np.maximum(_smooth(rate, np.diff(starts)), 0.0)
            alone = (rate[:, 1:] == 0.0) & (own[:, 1:] < FAR)
            moved = away.copy()  # who is alone now went as he came; who arrives goes on as he does then
            away[:, 1:] = np.where(alone, moved[:, :-1], away[:, 1:])
            away[:, :-1] = np.where(~same & (b < a), moved[:, 1:], away[:, :-1])
        return Contact(distance, rate, away)


_OVER = 1  # slices before and after, over which a speed is read


def _smooth(rate: F64, span: F64) -> F64:
    """Rates [n, S, p] as means over as many slices before as after, up to `_OVER`, in which something moves steadily.

    Between stations a crossing is known to a decimetre or two, which over one slice is half a metre per second.
    """
    out = rate.copy()
    steady = rate != 0.0
    for k in range(1, _OVER + 1):
        j = np.arange(k, rate.shape[1] - 1 - k)
        if not len(j):
            break
        weight = np.array([span[i - k : i + k + 1].sum() for i in j])
        sums = sum(rate[:, j + i] * span[j + i][None, :, None] for i in range(-k, k + 1))
        steady[:, j] &= (rate[:, j - k] != 0.0) & (rate[:, j + k] != 0.0)
        inside = np.zeros_like(steady)
        inside[:, j] = steady[:, j]
        steady = inside
        out[:, j] = np.where(steady[:, j], sums / weight[None, :, None], out[:, j])
    return out


def _carried(risk: F32, who: U8, r_hit: float) -> U8:
    """The source of the first contact at or beyond each station [n, S, p]."""
    p = risk.shape[-1]
    at = np.where(risk >= r_hit, np.arange(p), p)
    first = np.minimum.accumulate(at[..., ::-1], axis=-1)[..., ::-1]
    found = np.take_along_axis(who, np.minimum(first, p - 1), axis=-1)
    return np.where(first < p, found, np.uint8(NOBODY))


def meets(
    volume: Volume, footprint: Footprint, x: F64, y: F64, heading: F64, t: F64, bound: float
) -> npt.NDArray[np.bool_]:
    """Where a motion has come to contact ahead with anybody who does not push [m].

    Args:
        volume: The volume on the plan's clock.
        footprint: The ego's.
        x: Rear axle at the motion's samples, `map` frame [m] [m].
        y: The same.
        heading: Of the body there [m] [rad].
        t: Plan times of the samples [m] [s].
        bound: Risk from which on it is contact [E_max].
    """
    s = np.concatenate(([0.0], np.cumsum(np.hypot(np.diff(x), np.diff(y)))))
    want: F64 = np.asarray(STEP * np.arange(int((s[-1] + _BEYOND) / STEP) + 2), dtype=np.float64)
    over = np.maximum(want - s[-1], 0.0)
    turned = np.unwrap(heading)
    at, first = np.unique(s, return_index=True)
    px = np.interp(want, at, x[first]) + over * np.cos(turned[-1])
    py = np.interp(want, at, y[first]) + over * np.sin(turned[-1])
    ph = np.interp(want, at, turned[first])
    stays = np.zeros(1, dtype=bool)
    risk = path_risk(volume, footprint, px[None], py[None], ph[None], STEP, leaves=stays, r_hit=bound)
    risk = without(risk, pushers(volume, footprint, x, y, heading, t, bound), ~stays)
    ahead = risk.risk if risk.ahead is None else risk.ahead
    contact = Contact.of(ahead, None if risk.who is None else risk.who[1], volume.starts, bound, STEP)
    j, cell = volume.slice_at(t), (s / STEP).astype(np.intp)
    into = np.maximum(t - volume.starts[j], 0.0)
    return np.asarray(~(s < contact.distance[0, j, cell] + contact.rate[0, j, cell] * into))
