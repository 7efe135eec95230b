"""Treiber's car-following models and lane-change rule, as pure functions.

Sources: Treiber, Hennecke, Helbing, Phys. Rev. E 62 (2000) 1805 (IDM); Treiber, Kesting, *Traffic Flow Dynamics*
(2013), section 11.3.7 (the improved IDM, which does not brake for a leader farther away than its own wish);
Kesting, Treiber, Helbing, Transp. Res. Rec. 1999 (2007) 86 (MOBIL).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

NEVER = -1e9
"""Acceleration of one who has no room at all [m/s²]; callers limit it to what brakes can do."""


@dataclass(frozen=True)
class Following:
    """Parameters of a driver."""

    headway: float = 1.2
    """Desired time gap T [s]."""
    gap: float = 2.0
    """Gap at standstill s0 [m]."""
    accel: float = 1.5
    """Maximum acceleration a [m/s²]."""
    brake: float = 2.0
    """Comfortable deceleration b [m/s²]."""
    exponent: float = 4.0
    """Of the free acceleration, δ."""


@dataclass(frozen=True)
class LaneChange:
    """Parameters of MOBIL."""

    politeness: float = 0.3
    """How much the others' loss counts, p."""
    threshold: float = 0.2
    """Advantage below which nobody changes, Δa_th [m/s²]."""
    safe_brake: float = 3.0
    """The new follower may be made to brake as hard as this, b_safe [m/s²]."""


def desired_gap(p: Following, v: float, closing: float) -> float:
    """s* = s0 + max(0, v T + v Δv / (2 √(a b))) [m]; Δv = v − v_leader."""
    return p.gap + max(0.0, v * p.headway + v * closing / (2.0 * math.sqrt(p.accel * p.brake)))


def free_acceleration(p: Following, v: float, v0: float) -> float:
    """a (1 − (v/v0)^δ), and above v0 −b (1 − (v0/v)^(aδ/b)) [m/s²]."""
    if v0 <= 1e-6:
        return -p.brake if v > 0.0 else 0.0
    if v <= v0:
        return float(p.accel * (1.0 - (v / v0) ** p.exponent))
    return float(-p.brake * (1.0 - (v0 / v) ** (p.accel * p.exponent / p.brake)))


def idm(p: Following, v: float, v0: float, gap: float = math.inf, closing: float = 0.0) -> float:
    """Acceleration a (1 − (v/v0)^δ − (s*/s)²) [m/s²]; an infinite gap is a free road."""
    free = p.accel * (1.0 - (v / v0) ** p.exponent) if v0 > 1e-6 else (-p.brake if v > 0.0 else 0.0)
    if math.isinf(gap):
        return free
    if gap <= 0.0:
        return NEVER
    return free - p.accel * (desired_gap(p, v, closing) / gap) ** 2


def improved_idm(p: Following, v: float, v0: float, gap: float = math.inf, closing: float = 0.0) -> float:
    """The improved IDM [m/s²]: at the desired speed it brakes only for a leader nearer than s*."""
    free = free_acceleration(p, v, v0)
    if math.isinf(gap):
        return free
    if gap <= 0.0:
        return NEVER
    z = desired_gap(p, v, closing) / gap
    if v <= v0:
        if z >= 1.0:
            return p.accel * (1.0 - z * z)
        return free * (1.0 - z ** (2.0 * p.accel / free)) if free > 1e-6 else 0.0
    return free + p.accel * (1.0 - z * z) if z >= 1.0 else free


def mobil(
    p: LaneChange,
    own: tuple[float, float],
    new_follower: tuple[float, float] = (0.0, 0.0),
    old_follower: tuple[float, float] = (0.0, 0.0),
) -> bool:
    """Whether a lane change is safe and worth it; each pair is the acceleration before and after the change [m/s²].

    Safe: ã_n ≥ −b_safe. Worth it: ã_c − a_c + p (ã_n − a_n + ã_o − a_o) > Δa_th.
    """
    if not (new_follower[1] >= -p.safe_brake and own[1] >= -p.safe_brake):
        return False
    others = new_follower[1] - new_follower[0] + old_follower[1] - old_follower[0]
    return own[1] - own[0] + p.politeness * others > p.threshold
