"""What a drive is held against: the comfort that the planner was set to keep, and where contact begins."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from common import config
from common.config import ConfigError
from common.messages import ObjectClass
from common.risk import RiskParameters, virtual_mass
from services.planner.settings import PlannerSettings


@dataclass(frozen=True)
class Bounds:
    """All positive; SI units."""

    accel: float
    """Of the comfort tier, speeding up [m/s²]."""
    brake: float
    """Of the comfort tier [m/s²]."""
    lateral: float
    """Of the curve speed [m/s²]."""
    jerk: float
    """In normal driving [m/s³]."""
    clearance: float
    """Where a standing car's potential reaches the contact threshold [m]."""
    gap: float
    """Kept to what stands ahead [m]."""
    contact: float
    """Risk from which the planner takes it for contact [E_max]."""


def bounds(configuration: dict[str, Any]) -> Bounds:
    """The bounds that the recorded configuration set; where it cannot be read, today's defaults."""
    planner = _section(configuration, "planner", PlannerSettings)
    risk = _section(configuration, "risk", RiskParameters)
    A = risk.k * risk.r_a * float(virtual_mass(0.0, int(ObjectClass.CAR), 0.0, risk))
    near = max(A / planner.r_hit - A / risk.e_max, 0.0) ** (1.0 / risk.k1)  # pE(D) = r_hit
    return Bounds(
        accel=planner.accel,
        brake=planner.tier_brake[0],
        lateral=planner.lateral_accel,
        jerk=planner.jerk,
        clearance=near,
        gap=planner.gap,
        contact=planner.r_hit,
    )


def _section(tree: dict[str, Any], name: str, kind: type[Any]) -> Any:
    try:
        return config.section(tree, name, kind)
    except ConfigError:
        return kind()
