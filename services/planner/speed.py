"""How risk, curves and distance limit speed.

- Speed law (algorithm 1): S = S_max · clamp((r1 − r) / (r1 − r0), 0, 1).
- Contact: s_hit is the first place at or beyond s where the footprint's risk reaches r_hit, its crossing interpolated
  (the first sample instead makes a limit cycle).
- Stop speed (held by the rollouts): the ego may be as fast as lets it react for the headway and stop with b_stop short
  of the gap: v·headway + v²/(2 b) ≤ s_hit − gap − s + u²/(2 b), where u is the speed at which the contact itself moves
  away. With u = 0 this is V_stop; behind a lead of the same speed it leaves gap + headway.
- Cap: curve speed sqrt(a_lat / |κ|), lane limits, the goal, the end of the line and the first unknown point, each with
  the way to brake before it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from services.planner.backend import kernels

F32 = npt.NDArray[np.float32]
F64 = npt.NDArray[np.float64]

FAR = 1e6
"""Stands for no contact [m]."""


def speed_law(risk: npt.ArrayLike, s_max: F64 | float, r0: float, r1: float) -> F64:
    """Speed that a risk allows [m/s]."""
    return np.asarray(s_max * np.clip((r1 - np.asarray(risk)) / max(r1 - r0, 1e-9), 0.0, 1.0))


def contact_distance(risk: npt.NDArray[np.floating], r_hit: float, step: float) -> F64:
    """s_hit at each station: the first crossing of r_hit at or beyond it; risk [..., p], distances [m], FAR if none."""
    p = risk.shape[-1]
    hit = risk >= r_hit
    at = np.full(risk.shape, FAR)
    stations = step * np.arange(p)
    at[hit] = np.broadcast_to(stations, risk.shape)[hit]
    # between a station below and the next one above, the crossing lies in between and counts from the one below
    a, b = risk[..., :-1].astype(np.float64), risk[..., 1:].astype(np.float64)
    rising = ~hit[..., :-1] & hit[..., 1:]
    w = np.clip((r_hit - a) / np.maximum(b - a, 1e-9), 0.0, 1.0)
    at[..., :-1] = np.where(rising, stations[:-1] + w * step, at[..., :-1])
    return np.asarray(np.minimum.accumulate(at[..., ::-1], axis=-1)[..., ::-1])


def curve_speed(curvature: F64, step: float, lateral_accel: float, max_rate: float) -> F64:
    """Speed that lateral acceleration and steering rate allow, shape of `curvature` [..., p]."""
    rate = np.abs(np.gradient(curvature, step, axis=-1))
    return np.asarray(
        np.minimum(
            np.sqrt(lateral_accel / np.maximum(np.abs(curvature), 1e-6)), 0.7 * max_rate / np.maximum(rate, 1e-6)
        )
    )


def brake_before(cap: F64, step: float, brake: float, *, reference: bool = False) -> F64:
    """Lower a cap [n, p] so that every lower speed ahead can be reached with `brake` [m/s²]; else NumPy alone."""
    if kernels is not None and not reference:
        lowered: F64 = kernels.brake_before(cap, step, brake)
        return lowered
    squared = cap**2
    for i in range(cap.shape[1] - 2, -1, -1):
        np.minimum(squared[:, i], squared[:, i + 1] + 2.0 * brake * step, out=squared[:, i])
    return np.asarray(np.sqrt(squared))


def stop_at(distance: F64, stations: F64, brake: float) -> F64:
    """Cap [n, p] that comes to rest at distances [n] [m]."""
    return np.asarray(np.sqrt(2.0 * brake * np.maximum(distance[:, None] - stations[None], 0.0)))


CAUSES = ("limit", "curve", "goal", "horizon")
"""What may cap the speed; `horizon`: the end of the line, the first unknown point, or a curve too tight to drive."""


@dataclass(frozen=True)
class Cap:
    """Highest speed along n paths [n, p], and which of CAUSES set it."""

    speed: F64
    cause: npt.NDArray[np.intp]

    @staticmethod
    def of(parts: list[F64]) -> Cap:
        """The lowest of the parts, which stand in the order of CAUSES."""
        stack = np.stack(parts)
        cause = np.argmin(stack, axis=0)
        return Cap(np.take_along_axis(stack, cause[None], axis=0)[0], cause)
