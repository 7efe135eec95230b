"""How a drive felt: speed on one grid of time, acceleration and jerk as difference quotients over 0.2 s.

Longitudinal acceleration is the driven speed's difference quotient over 0.2 s, jerk that of the acceleration over
another 0.2 s (support 0.4 s, so that the integration step does not show); lateral acceleration is speed · yaw rate,
averaged over 0.2 s.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from common.messages import F64

GRID_S = 0.05
"""The grid on which speeds are compared [s]."""
_SPAN = 4
"""Steps of the grid that a difference quotient spans."""


@dataclass(frozen=True)
class Motion:
    """A drive on the grid of time: n points; quotients lie at the middle of their spans."""

    t: F64  # [n] [s]
    speed: F64  # [n] [m/s]
    acceleration: F64  # [n - 4] [m/s²]
    jerk: F64  # [n - 8] [m/s³]
    lateral: F64  # [n - 4] [m/s²]

    @property
    def t_acceleration(self) -> F64:
        """Times of `acceleration` and `lateral` [s]."""
        return self.t[_SPAN // 2 : len(self.t) - _SPAN // 2] if len(self.acceleration) else np.zeros(0)

    @property
    def t_jerk(self) -> F64:
        """Times of `jerk` [s]."""
        return self.t[_SPAN : len(self.t) - _SPAN] if len(self.jerk) else np.zeros(0)

    def peaks(self) -> dict[str, float]:
        """The largest of each, by the names of a run's report."""
        p95 = round(float(np.percentile(np.abs(self.jerk), 95)), 3) if len(self.jerk) else 0.0
        return {
            "max_abs_accel_lon": _peak(self.acceleration),
            "max_abs_accel_lat": _peak(self.lateral),
            "max_abs_jerk": _peak(self.jerk),
            "p95_abs_jerk": p95,
        }


def motion(times: npt.ArrayLike, speeds: npt.ArrayLike, yaw_rates: npt.ArrayLike) -> Motion:
    """Put a drive on the grid.

    Args:
        times: increasing [s].
        speeds: along the heading [m/s].
        yaw_rates: [rad/s].
    """
    at = np.asarray(times, dtype=np.float64)
    if len(at) < 2:
        none = np.zeros(0)
        return Motion(none, none, none, none, none)
    v_raw = np.asarray(speeds, dtype=np.float64)
    t = np.arange(at[0], at[-1] + 1e-9, GRID_S)
    v = np.interp(t, at, v_raw)
    across = np.interp(t, at, v_raw * np.asarray(yaw_rates, dtype=np.float64))
    n = _SPAN + 1
    lateral = np.convolve(across, np.ones(n) / n, mode="valid") if len(across) >= n else across[:0]
    a = _quotient(v)
    return Motion(t, v, a, _quotient(a), lateral)


def _quotient(values: F64) -> F64:
    return (values[_SPAN:] - values[:-_SPAN]) / (_SPAN * GRID_S) if len(values) > _SPAN else np.zeros(0)


def _peak(values: Any) -> float:
    return round(float(np.max(np.abs(values))), 3) if len(values) else 0.0
