"""A published criticality measure from commonroad-crime, where that is installed: the worst-time-to-collision.

W. Wachenfeld et al., "The worst-time-to-collision metric for situation identification", IEEE IV 2016: the earliest time
at which two road users could meet if both used all the acceleration they have. The equation is solved by the library.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from common.messages import F64, Ego, Objects

A_MAX = 11.5
"""Acceleration of the library's default vehicle (BMW 320i) [m/s²]."""


@dataclass(frozen=True)
class _Body:
    """What the library's solver asks of a vehicle, at one moment."""

    position: F64
    velocity: float  # [m/s] along x
    velocity_y: float
    length: float
    width: float
    obstacle_type: Any

    @property
    def obstacle_shape(self) -> _Body:
        return self

    def state_at_time(self, _: int) -> _Body:
        return self


class WorstTtc:
    """The library's solver; `WorstTtc.here()` is None where it is not installed."""

    def __init__(self, solve: Any, car: Any) -> None:
        self._solve, self._car = solve, car

    @staticmethod
    def here() -> WorstTtc | None:
        """The solver, or None."""
        try:
            from commonroad.scenario.obstacle import ObstacleType
            from commonroad_crime.utility.solver import solver_wttc
        except ImportError:
            return None
        return WorstTtc(solver_wttc, ObstacleType.CAR)

    def __call__(self, ego: Ego, objects: Objects) -> float:
        """Least worst-time-to-collision with anybody [s]; infinite: nobody is there."""
        origin = np.zeros(2)
        me = _Body(origin, ego.vx, ego.vy, ego.length, ego.width, self._car)
        best = float("inf")
        for i in range(len(objects.id)):
            at = np.array([objects.x[i] - ego.x, objects.y[i] - ego.y])
            it = _Body(
                at,
                float(objects.vx[i]),
                float(objects.vy[i]),
                float(objects.length[i]),
                float(objects.width[i]),
                self._car,
            )
            roots = self._solve(me, it, 0, A_MAX)
            real = [float(r.real) for r in roots if abs(r.imag) < 1e-9 and r.real > 0.0]
            best = min(best, min(real, default=0.0))  # no positive root: their circles overlap already
        return best
