"""Row 3: SIGSTOP each service for 5 s: what hangs is worse than what is dead, it comes back with old news."""

from __future__ import annotations

import time

import numpy as np

from evaluation.faults.outage import (
    AGAIN_S,
    NS_TO_S,
    Back,
    back_figures,
    deviation,
    judge,
    old_drives,
    plan_figures,
    safe_stop_ms,
)  # fmt: skip
from evaluation.faults.result import Figure, Row, Say, Scale, Verdict
from evaluation.faults.row_02_kill_planner import TRACKING
from evaluation.faults.stack import Stack, stack
from evaluation.faults.vehicle import Tick

NUMBER = 3
TARGET = (
    "predictor, riskfield as row 1; planner: nothing but the tail is driven past `valid_for`; nothing old is driven"
)
PAUSE_S = 5.0


def run(scale: Scale, seed: int, say: Say) -> Row:
    """Pause each in turn."""
    n = scale.repetitions(5, 50)
    backs, gaps, old = [], [], []
    tails, off, again = 0, 0.0, 0.0
    with stack(seed=seed) as s:
        for i in range(n):
            for service in ("predictor", "riskfield"):
                s.settle(0.5)
                begin = time.monotonic_ns()
                backs.append(paused(s, service))
                gaps.append(s.watch.gaps_ms(begin))
                old += old_drives(s, begin)
            s.settle(0.5)
            begin = time.monotonic_ns()
            alone, back = planner_paused(s)
            off, again = max(off, deviation(alone)), max(again, back)
            tails += bool(alone) and all(t.part in ("tail", "over") for t in alone)
            old += old_drives(s, begin)
            say(f"{i + 1} of {n}: stops {backs[-2].stop_ms:.0f}, {backs[-1].stop_ms:.0f} ms; planner back {back:.2f} s")
    all_gaps = np.concatenate(gaps)
    figures: dict[str, Figure] = {
        **plan_figures(all_gaps), **back_figures(backs),
        "planner: tail alone driven": f"{tails} of {n}",
        "planner: speed off the tail's, worst [m/s]": off,
        "planner: drives again after SIGCONT, worst [s]": again,
        "plans to drive on objects older than 370 ms": len(old),
    }  # fmt: skip
    verdict = Verdict()
    judge(verdict, all_gaps, backs)
    verdict.need(tails == n and off <= TRACKING, f"the tail alone was driven in {tails} of {n}, off by {off:.2f} m/s")
    verdict.need(again <= AGAIN_S, f"planner drives {again:.1f} s after SIGCONT")
    verdict.need(not old, f"{len(old)} plans to drive on old objects, worst {max(old, default=0):.0f} ms")
    proof = f"{3 * n} of {3 * n} processes stood still (state T) from beginning to end of their {PAUSE_S:g} s"
    fault = f"SIGSTOP {PAUSE_S:g} s each service, {n}×"
    return verdict.row(NUMBER, fault, TARGET, figures, proof)


def paused(s: Stack, service: str, seconds: float = PAUSE_S) -> Back:
    """Pause a service upstream; returns once the vehicle drives. It is ready when it runs again: SIGCONT."""
    begin = time.monotonic_ns()
    s.pause(service)
    _, stop_ms = safe_stop_ms(s, begin)
    time.sleep(max(seconds - (time.monotonic_ns() - begin) * NS_TO_S, 0.0))
    s.resume(service)
    ready = time.monotonic_ns()
    drive = s.wait_drive(ready)
    return Back(service, stop_ms, (drive.arrived_ns - ready) * NS_TO_S, (ready - begin) * NS_TO_S)


def planner_paused(s: Stack, seconds: float = PAUSE_S) -> tuple[list[Tick], float]:
    """Pause the planner; returns the ticks past its last plan's `valid_for`, and the time to drive again [s]."""
    begin = time.monotonic_ns()
    s.pause("planner")
    stood = time.monotonic_ns()
    time.sleep(max(seconds - (stood - begin) * NS_TO_S, 0.0))
    plan = s.vehicle.body.plan
    assert plan is not None
    resumed = time.monotonic_ns()
    alone = s.vehicle.since(max(plan.capture_ns + round(plan.value.valid_for * 1e9), stood), resumed)
    s.resume("planner")
    drive = s.wait_drive(resumed)
    return alone, (drive.arrived_ns - resumed) * NS_TO_S
