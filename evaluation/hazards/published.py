"""A published criticality measure: the worst-time-to-collision (WTTC).

W. Wachenfeld, P. Junietz, R. Wenzel, H. Winner, "The worst-time-to-collision metric for situation identification",
IEEE Intelligent Vehicles Symposium 2016: the earliest time at which two road users could meet if each used all the
acceleration it has, in any direction. With the offset p and the velocity v of the other relative to the ego, each body
within a circle of radius r_i around its centre, and a_i the acceleration of each,

    |p + v t| = r_1 + r_2 + ½ (a_1 + a_2) t²

whose smallest root t ≥ 0 is the WTTC. Solved here in our own code: commonroad-crime, which has it too, depends on
Polygon3, which is not free for commercial use.
"""

from __future__ import annotations

import numpy as np

from common.messages import Ego, Objects

A_MAX = 9.81
"""Acceleration of every road user: tyres on a dry road, friction 1 [m/s²]."""


def wttc(ego: Ego, objects: Objects) -> float:
    """Least worst-time-to-collision with anybody [s]; infinite: nobody is there."""
    best = float("inf")
    for i in range(len(objects.id)):
        p = np.array([objects.x[i] - ego.x, objects.y[i] - ego.y])
        v = np.array([objects.vx[i] - ego.vx, objects.vy[i] - ego.vy])
        radii = (np.hypot(ego.length, ego.width) + np.hypot(objects.length[i], objects.width[i])) / 2
        best = min(best, _first_root(float(p @ p), float(p @ v), float(v @ v), float(radii)))
    return best


def _first_root(pp: float, pv: float, vv: float, radii: float) -> float:
    """Smallest t ≥ 0 with |p + v t| = radii + a t², both circles growing by a t² / 2."""
    if pp <= radii * radii:
        return 0.0
    # both sides squared: a² t⁴ + (2 a R − v·v) t² − 2 p·v t + R² − p·p = 0; the right side is never negative
    roots = np.roots([A_MAX**2, 0.0, 2.0 * A_MAX * radii - vv, -2.0 * pv, radii * radii - pp])
    real = roots.real[(np.abs(roots.imag) < 1e-6 * np.maximum(1.0, np.abs(roots))) & (roots.real > 0.0)]
    return float(real.min())
