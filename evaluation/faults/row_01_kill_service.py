"""Row 1: SIGKILL predictor and riskfield under load; each is started again at once, as a supervisor does."""

from __future__ import annotations

import time

import numpy as np

from evaluation.faults.outage import NS_TO_S, Back, back_figures, judge, plan_figures, safe_stop_ms
from evaluation.faults.result import Row, Say, Scale, Verdict
from evaluation.faults.stack import Stack, stack

NUMBER = 1
TARGET = (
    "0 missed plans; plan gap p99.9 ≤ 75 ms; safe stop ≤ 370 ms after the last valid capture; drives again ≤ 2 s after"
    " the service is ready"
)
SERVICES = ("predictor", "riskfield")


def run(scale: Scale, seed: int, say: Say) -> Row:
    """Kill each in turn."""
    n = scale.repetitions(5, 100)
    backs, gone, gaps = [], 0, []
    with stack(seed=seed) as s:
        for i in range(n):
            for service in SERVICES:
                s.settle()
                begin = time.monotonic_ns()
                backs.append(killed(s, service))
                gone += 1
                gaps.append(s.watch.gaps_ms(begin - 1_000_000_000))
            say(f"{i + 1} of {n}: {', '.join(f'{b.service} stop {b.stop_ms:.0f} ms' for b in backs[-2:])}")
    all_gaps = np.concatenate(gaps)
    verdict = Verdict()
    judge(verdict, all_gaps, backs)
    figures = {**plan_figures(all_gaps), **back_figures(backs)}
    proof = f"{gone} of {n * len(SERVICES)} processes gone by SIGKILL, {len(backs)} new boots"
    fault = f"SIGKILL predictor, riskfield, {n}× each under load (32 road users)"
    return verdict.row(NUMBER, fault, TARGET, figures, proof)


def killed(s: Stack, service: str) -> Back:
    """Kill a service and start it again; returns once the vehicle drives."""
    begin = time.monotonic_ns()
    s.kill(service)
    s.start(service)
    _, stop_ms = safe_stop_ms(s, begin)
    up = s.wait_up(service)  # of another boot than before
    drive = s.wait_drive(up.arrived_ns)
    return Back(service, stop_ms, (drive.arrived_ns - up.arrived_ns) * NS_TO_S, (up.arrived_ns - begin) * NS_TO_S)
