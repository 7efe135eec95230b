"""How far another driver got in the same time: the recorded human where one is known, otherwise the IDM."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from common.geometry import Polyline
from common.messages import F64, FRAME_S
from evaluation.planning.loop import DriveResult
from evaluation.planning.recorder import Recorder
from rig.sources.motion import fair
from rig.world import Scenario

ACCEL, BRAKE, LATERAL = 1.5, 1.5, 1.2
"""What counts as comfortable [m/s²]."""
JERK = 1.5
"""The same of its rate [m/s³]."""


@dataclass(frozen=True)
class Yardstick:
    """The other driver: distance [m] at a time [s], and when he was done."""

    who: str  # human, idm
    end_s: float
    distance: Callable[[float], float]
    comfortable: Callable[[float], float] | None = None
    """The same path and wishes under our comfort limits; None: not known."""
    fair: bool = True
    """Nobody is measured by one who drove through somebody."""


def yardstick(scenario: Scenario, idm: Callable[[], tuple[DriveResult, Recorder]]) -> Yardstick:
    """The recorded human; else whoever reached the goal at a known time; else the IDM in the same traffic.

    `idm` drives it, if need be.
    """
    human = scenario.human
    if human is not None and human.last > 10:
        first = max(-human.frame0, 0)
        p = np.stack((human.x[first:], human.y[first:]), axis=-1)
        s = np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(p, axis=0).T))))
        times = np.arange(len(s)) * FRAME_S
        slower = comfortably(p, s)
        return Yardstick(
            "human",
            float(times[-1]),
            lambda t: float(np.interp(t, times, s)),
            lambda t: float(np.interp(t, slower[0], slower[1])),
        )
    if scenario.human_goal_s is not None:
        line = Polyline.of(scenario.route.reference)
        at = line.project(
            np.array([(scenario.ego0.x, scenario.ego0.y), (scenario.route.goal.x, scenario.route.goal.y)])
        )[0]
        far, v, end = float(at[1] - at[0]), scenario.ego0.speed, scenario.human_goal_s
        # from the first speed, at a constant acceleration, so as to be at the goal in time
        return Yardstick("human", end, lambda t: v * t + (far - v * end) * (t / end) ** 2)
    result, record = idm()
    crashed = bool(result.summary["ego"]["collision"])
    return Yardstick("idm", record.t[-1] if record.t else 0.0, record.distance, fair=not crashed)


def comfortably(p: F64, s: F64) -> tuple[F64, F64]:
    """Times [s] and distances [m] of one who drives the path `p` [n, 2], one row a frame, at arc lengths `s` [m].

    Never faster than recorded at any place, nor than `LATERAL` allows on the smoothed path; speeding up with at most
    `ACCEL`, slowing down with at most `BRAKE`; then averaged over so long a time that the jerk is at most `JERK` (by a
    window of width T it is at most 2 a / T). Where the record stands, it waits as long.
    """
    grid: F64 = np.arange(0.0, float(s[-1]), 0.5, dtype=np.float64)
    if len(grid) < 3:
        return np.arange(len(s), dtype=np.float64) * FRAME_S, s
    recorded = np.gradient(s) / FRAME_S
    moving = np.concatenate(([True], np.diff(s) > 1e-3))
    at = s[moving]
    v = np.maximum(np.interp(grid, at, recorded[moving]), 0.3)
    line = fair(p[moving]) if moving.sum() > 2 else p
    curve = Polyline.of(line)
    heading = np.unwrap(np.arctan2(*(curve.at(grid + 1.0) - curve.at(grid - 1.0)).T[::-1]))
    kappa = np.abs(np.gradient(heading, 0.5))
    v = np.minimum(v, np.sqrt(LATERAL / np.maximum(kappa, 1e-4)))
    for i in range(1, len(v)):
        v[i] = min(v[i], np.sqrt(v[i - 1] ** 2 + 2 * ACCEL * 0.5))
    for i in range(len(v) - 2, -1, -1):
        v[i] = min(v[i], np.sqrt(v[i + 1] ** 2 + 2 * BRAKE * 0.5))
    waits = np.interp(grid, at, np.cumsum(~moving)[moving] * FRAME_S)
    times = np.concatenate(([0.0], np.cumsum(0.5 / (0.5 * (v[1:] + v[:-1]))))) + waits
    t: F64 = np.arange(0.0, float(times[-1]), FRAME_S, dtype=np.float64)
    at_t = np.interp(t, times, grid)
    half = round((ACCEL + BRAKE) / JERK / 2 / FRAME_S)
    steps = np.arange(1, half + 1) * FRAME_S
    first, last = v[0] if waits[0] == 0.0 else 0.0, float(at_t[-1] - at_t[-2]) / FRAME_S
    padded = np.concatenate((at_t[0] - first * steps[::-1], at_t, at_t[-1] + last * steps))
    smooth = np.convolve(padded, np.full(2 * half + 1, 1.0 / (2 * half + 1)), mode="valid")
    return t, smooth - smooth[0]
