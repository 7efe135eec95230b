"""Algorithm 1 of the paper (arXiv:2506.23999), under its own function names.

    for each path p of path_sampling():
        for each slice L_j of path_slicing(p, S):
            r_j = max_risk_searching(M_j, L_j)
        S_p = speed_calculating(max_j r_j)
    trajectory_generating(the path of the highest S_p, S_p)

Two rules are added, for as printed it cannot start again and jumps between equal paths: the slicing speed has a floor,
and of equally fast paths the reference line is taken first, then the one driven so far.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from services.planner.bezier import Paths, Target, build_paths
from services.planner.reference import ReferenceLine
from services.planner.speed import speed_law
from services.planner.trajectory import Motion

F32 = npt.NDArray[np.float32]
F64 = npt.NDArray[np.float64]

SLICING_SPEED_FLOOR = 3.0
"""Slices are cut at no less than this: at S = 0 they would all collapse onto the ego [m/s]."""
_TIE = 1e-3


def path_sampling(
    reference: ReferenceLine,
    s: F64,
    start: tuple[float, float, float, float],
    targets: Sequence[Target],
    lengths: F64,
    *,
    step: float,
    points: int,
    max_curvature: float,
) -> Paths:
    """Bezier paths from the ego's pose and curvature to the targets; see `bezier.build_paths`."""
    return build_paths(
        reference, s, start, list(targets), lengths, step=step, points=points, max_curvature=max_curvature
    )


def path_slicing(stations: F64, speed: float, starts: F64) -> npt.NDArray[np.intp]:
    """Cut a path by time: the slice in which each station [p] is reached at constant `speed`, slices starting at [S].

    Stations that are reached after the horizon stand in the last slice.
    """
    arrival = stations / max(speed, SLICING_SPEED_FLOOR)
    return np.clip(np.searchsorted(starts, arrival + 1e-9, side="right") - 1, 0, len(starts) - 1)


def max_risk_searching(risk: F32, cut: npt.NDArray[np.intp], horizon: npt.NDArray[np.bool_]) -> F64:
    """Highest risk of each path in each slice, [n, S].

    Args:
        risk: Footprint maximum of M_j along the paths [n, S, p].
        cut: Slice of each station [p].
        horizon: Stations that count [p]: those reached within the horizon.
    """
    out = np.zeros(risk.shape[:2])
    for j in range(risk.shape[1]):
        mine = (cut == j) & horizon
        if np.any(mine):
            out[:, j] = risk[:, j, mine].max(axis=1)
    return out


def speed_calculating(risk: F64, s_max: F64 | float, r0: float, r1: float) -> F64:
    """Desired speed S_p of each path from its highest risk [n]; see `speed.speed_law`."""
    return speed_law(risk, s_max, r0, r1)


def choose(desired: F64, reference: npt.NDArray[np.bool_], previous: npt.NDArray[np.bool_]) -> int:
    """Index of the fastest path; of equals the reference line, then the previous choice, then the first."""
    equal = desired >= desired.max() - _TIE
    for preferred in (reference, previous, np.ones_like(equal)):
        if np.any(equal & preferred):
            return int(np.argmax(equal & preferred))
    return int(np.argmax(desired))


def trajectory_generating(
    speed: float,
    acceleration: float,
    desired: float,
    cap: F64,
    step: float,
    *,
    accel: float,
    brake: float,
    jerk: float,
    tau: float,
    duration: float,
    dt: float = 0.1,
) -> Motion:
    """Motion that brings the ego to the desired speed with limited acceleration and jerk.

    Args:
        speed: Now [m/s].
        acceleration: Now [m/s²].
        desired: S_p [m/s].
        cap: Highest speed at the path's stations (curves, limits, ends) [p] [m/s].
        step: Their distance [m].
        accel: Largest acceleration [m/s²].
        brake: Largest deceleration [m/s²].
        jerk: Largest jerk, more to reach the brake in 0.3 s [m/s³].
        tau: Time constant [s].
        duration: Length of the motion [s].
        dt: Step [s].
    """
    t, s, v, a = [0.0], [0.0], [max(speed, 0.0)], [acceleration]
    stations = step * np.arange(len(cap))
    look = tau + 0.3
    while t[-1] < duration - 1e-9:
        wanted = min(desired, *(float(np.interp(s[-1] + ahead, stations, cap)) for ahead in (0.0, v[-1] * look)))
        a_wanted = float(np.clip((wanted - v[-1]) / tau, -brake, accel))
        a_new = a[-1] + float(np.clip(a_wanted - a[-1], -max(jerk, brake / 0.3) * dt, 3.0 * jerk * dt))
        v_new = v[-1] + 0.5 * (a[-1] + a_new) * dt
        if v_new <= 0.02 and wanted <= 0.4:
            v_new, a_new = 0.0, 0.0
        s.append(s[-1] + 0.5 * (v[-1] + max(v_new, 0.0)) * dt)
        v.append(max(v_new, 0.0))
        a.append(a_new)
        t.append(t[-1] + dt)
    return Motion(np.array(t), np.array(s), np.array(v), np.array(a))
