"""What is measured of one outage: the safe stop, the way back, and what the vehicle drove meanwhile."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from common.messages import F64
from evaluation.faults.result import FaultError, Figure, Verdict
from evaluation.faults.stack import Stack
from evaluation.faults.vehicle import Tick
from evaluation.faults.watch import MISSED_MS, Heard

SAFE_STOP_MS = 370.0
"""From the last valid capture to the first plan that stops [ms]: 300 of age, and a planner's period with its slack."""
GAP_MS = 75.0
"""99.9 % of the times between two plans are no longer [ms]."""
AGAIN_S = 2.0
"""From a service's being ready to the first plan that drives [s]."""
NS_TO_MS = 1e-6
NS_TO_S = 1e-9


@dataclass(frozen=True)
class Back:
    """One outage of a service upstream of the planner."""

    service: str
    stop_ms: float
    """From the last valid capture to the first safe stop, as heard by the vehicle [ms]."""
    again_s: float
    """From the service's being ready to the first plan that drives [s]."""
    out_s: float
    """From the fault to the service's being ready [s]."""


def safe_stop_ms(stack: Stack, since_ns: int, within_s: float = 5.0) -> tuple[Heard, float]:
    """The first safe stop after a fault, and how long after the last valid capture it came [ms].

    Raises:
        FaultError: there was none.
    """
    stop = stack.watch.mode("safe_stop", since_ns, within_s)
    if stop.cause is None or stop.cause.boot != stack.bus.boot:
        raise FaultError(f"the safe stop rests on nothing that the vehicle said: {stop.reason}")
    return stop, (stop.arrived_ns - stack.vehicle.captured_ns(stop.cause.seq)) * NS_TO_MS


def deviation(ticks: Sequence[Tick]) -> float:
    """How far the vehicle's speed was off what its plan asked for, at the worst tick [m/s]."""
    return max((abs(t.speed - t.wanted_speed) for t in ticks), default=0.0)


def old_drives(stack: Stack, since_ns: int, until_ns: int = 2**62) -> list[float]:
    """Age at receipt [ms] of what each plan to drive rests on, for those beyond what a safe stop is due at."""
    ages = []
    for plan in stack.watch.heard("plan", since_ns, until_ns):
        if plan.mode == "drive" and plan.cause is not None and plan.cause.boot == stack.bus.boot:
            age = (plan.arrived_ns - stack.vehicle.captured_ns(plan.cause.seq)) * NS_TO_MS
            if not age <= SAFE_STOP_MS:
                ages.append(age)
    return ages


def plan_figures(gaps_ms: F64) -> dict[str, Figure]:
    """The figures of the plans' rhythm."""
    return {
        "missed plans": int((gaps_ms > MISSED_MS).sum()),
        "plans": len(gaps_ms),
        "plan gap p50 [ms]": float(np.percentile(gaps_ms, 50)),
        "plan gap p99.9 [ms]": float(np.percentile(gaps_ms, 99.9)),
        "plan gap max [ms]": float(gaps_ms.max()),
    }


def back_figures(backs: Sequence[Back]) -> dict[str, Figure]:
    """The figures of some outages."""
    figures: dict[str, Figure] = {
        "safe stop after the last valid capture, worst [ms]": max(b.stop_ms for b in backs),
        "drives again after ready, worst [s]": max(b.again_s for b in backs),
    }
    for service in dict.fromkeys(b.service for b in backs):
        figures[f"{service} out for, worst [s]"] = max(b.out_s for b in backs if b.service == service)
    return figures


def judge(verdict: Verdict, gaps_ms: F64, backs: Sequence[Back], timer_note: str = "") -> None:
    """The target of rows 1, 3 and 9."""
    missed, p999 = int((gaps_ms > MISSED_MS).sum()), float(np.percentile(gaps_ms, 99.9))
    verdict.need(missed == 0, f"{missed} plans missed{timer_note}")
    verdict.need(p999 <= GAP_MS, f"plan gap p99.9 {p999:.0f} ms{timer_note}")
    stop, again = max(b.stop_ms for b in backs), max(b.again_s for b in backs)
    verdict.need(stop <= SAFE_STOP_MS, f"safe stop {stop:.0f} ms after the last valid capture{timer_note}")
    verdict.need(again <= AGAIN_S, f"drives {again:.1f} s after ready{timer_note}")
