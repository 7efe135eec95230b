"""How far another driver got in the same time: the recorded human where one is known, otherwise the IDM."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from common.geometry import Polyline
from common.messages import FRAME_S
from evaluation.planning.recorder import Recorder
from rig.world import Scenario


@dataclass(frozen=True)
class Yardstick:
    """The other driver: distance [m] at a time [s], and when he was done."""

    who: str  # human, idm
    end_s: float
    distance: Callable[[float], float]


def yardstick(scenario: Scenario, idm: Callable[[], Recorder]) -> Yardstick:
    """The recorded human; else whoever reached the goal at a known time; else the IDM in the same traffic.

    `idm` drives it, if need be.
    """
    human = scenario.human
    if human is not None and human.last > 10:
        first = max(-human.frame0, 0)
        p = np.stack((human.x[first:], human.y[first:]), axis=-1)
        s = np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(p, axis=0).T))))
        times = np.arange(len(s)) * FRAME_S
        return Yardstick("human", float(times[-1]), lambda t: float(np.interp(t, times, s)))
    if scenario.human_goal_s is not None:
        line = Polyline.of(scenario.route.reference)
        at = line.project(
            np.array([(scenario.ego0.x, scenario.ego0.y), (scenario.route.goal.x, scenario.route.goal.y)])
        )[0]
        far, v, end = float(at[1] - at[0]), scenario.ego0.speed, scenario.human_goal_s
        # from the first speed, at a constant acceleration, so as to be at the goal in time
        return Yardstick("human", end, lambda t: v * t + (far - v * end) * (t / end) ** 2)
    record = idm()
    return Yardstick("idm", record.t[-1] if record.t else 0.0, record.distance)
