"""The speed law of what is beside: who goes along may be near.

S = S_max · clamp((r1 − r) / (r1 − r0), 0, 1) says how fast to pass what stands. Beside a road user who goes the same
way at u, passing happens at v − u: whatever r is, up to `along` · u may be driven, which lets him draw ahead. Without
this a car that drives a hand's breadth beside in dense traffic would stop the ego for as long as it keeps up.

u is read off the volume: the stretch of the path on which one source makes itself felt (r ≥ r0) moves from slice to
slice; the slower of its two ends counts, so that a stretch that only widens (somebody enters the road) moves nobody.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from services.planner.backend import kernels
from services.planner.speed import speed_law
from services.planner.volume import NOBODY

F32 = npt.NDArray[np.float32]
F64 = npt.NDArray[np.float64]
U8 = npt.NDArray[np.uint8]

_GOING = 2.0  # m/s; from here on a source goes along
_ANY = 1e18  # m/s; any speed

_SOURCES = 128  # so many are told apart …
_SLICES = 32  # … in so many slices
_OVER = 4  # slices over which a speed is read


def beside_law(
    sides: F32,
    who: U8 | None,
    starts: F64,
    step: float,
    s_max: float,
    r0: float,
    r1: float,
    along: float,
    *,
    reference: bool = False,
) -> tuple[F64, F64]:
    """Speeds allowed at the stations of n paths in each slice, and at its very start [n, S, p] [m/s].

    What goes along is where the volume says only when a slice starts; the rest is read in slices j and j + 1.

    Args:
        sides: Highest risk on the left and the right of the footprint's front half [2, n, S, p].
        who: Its source, or NOBODY; None: unknown.
        starts: Of the slices [S] [s].
        step: Distance between the stations [m].
        s_max: Highest wanted speed [m/s].
        r0: Up to this risk S_max is left.
        r1: From this on nothing is.
        along: Share of the speed of one beside that may be driven whatever the risk.
        reference: Keep to NumPy.
    """
    who = np.full(sides.shape, NOBODY, dtype=np.uint8) if who is None else who
    if kernels is not None and not reference:
        allowed: tuple[F64, F64] = kernels.law(sides, who, starts, step, s_max, r0, r1, along, _GOING)
        return allowed
    law = speed_law(sides, s_max, r0, r1)
    moves = np.zeros(law.shape, dtype=bool)
    for side in range(2):
        for n in range(sides.shape[1]):
            u = _speeds(sides[side, n], who[side, n], starts, step, r0)
            law[side, n] = np.maximum(law[side, n], along * u)
            moves[side, n] = u >= _GOING
    now = np.where(moves, law, _ANY).min(axis=0)
    law = np.where(moves, _ANY, law).min(axis=0)
    law[:, :-1] = np.minimum(law[:, :-1], law[:, 1:])
    return law, now


def _speeds(risk: F32, who: U8, starts: F64, step: float, r0: float) -> F64:
    """How fast the source of each station moves along one path [S, p]; −inf: not known."""
    out = np.full(risk.shape, -np.inf)
    slices = min(len(starts), _SLICES)
    for name in np.unique(who[who < _SOURCES]):
        ends = np.array([_ends(risk[j], who[j] == name, r0) for j in range(slices)])  # [S, 2]
        felt = np.isfinite(ends).any(axis=1)
        for j in np.flatnonzero(felt):
            b = j
            while b + 1 < slices and b < j + _OVER and felt[b + 1]:
                b += 1
            u = np.inf
            for a, b_ in ((j, b), (j - 1, j)):
                if b_ > a >= 0:
                    u = min((step * (ends[b_] - ends[a]) / (starts[b_] - starts[a])), key=_known)
                    if np.isfinite(u):
                        break
            out[j, who[j] == name] = u if np.isfinite(u) else -np.inf
    return out


def _known(u: float) -> float:
    return u if np.isfinite(u) else np.inf


def _ends(risk: F32, mine: npt.NDArray[np.bool_], r0: float) -> tuple[float, float]:
    """Back and front of the stretch of one slice, in stations, NaN where it goes on beyond the path."""
    at = np.flatnonzero(mine)
    if not len(at):
        return np.nan, np.nan
    i, k, r = int(at[0]), int(at[-1]), risk.astype(np.float64)
    back = front = np.nan
    if i > 0:
        back = i - 1 + ((r0 - r[i - 1]) / (r[i] - r[i - 1] + 1e-12) if r[i - 1] < r0 else 0.5)
    if k + 1 < len(r):
        front = k + ((r[k] - r0) / (r[k] - r[k + 1] + 1e-12) if r[k + 1] < r0 else 0.5)
    return back, front
