"""Row 15: twice as many busy processes as cores: who is too slow says so, and no late plan is driven.

Each busy process is a session of its own: the kernel shares out the cores by sessions (autogroup), and many busy
processes in one session would starve nobody. The same once more with ten times as many as cores.
"""

from __future__ import annotations

import math
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np

from common.topics import PLAN
from evaluation.faults.outage import NS_TO_MS, NS_TO_S, SAFE_STOP_MS
from evaluation.faults.process import cpu_s, cpu_times
from evaluation.faults.result import FaultError, Figure, Row, Say, Scale, Verdict
from evaluation.faults.stack import Stack, stack
from rig.launcher import SERVICES

NUMBER = 15
TARGET = "lag declared ≤ 1 s; safe stop rather than a late plan"
DECLARED_S = 1.0
PERIOD_NS = 50_000_000
"""Of the planner: what takes longer from input to sending is slow by its own rule [ns]."""
PLAN_AGE_MS = 1e3 * (PLAN.max_age_s or 0.0) + 5.0
"""A plan is refused at 300 ms [ms]; 5 ms for what a receiver cannot see of a link's delay."""
BUSY = 0.98
"""So much of the cores must have been in use, or nobody starved."""
STATUS_HZ = 2.0
"""The default; other rows listen more often."""


@dataclass(frozen=True)
class Starved:
    """One time of starvation."""

    load: int
    """Busy processes."""
    slow: int
    """Plans for which the planner needed more than its period."""
    declared_s: float
    """From the sending of such a plan to the next status or safe stop that says so, worst [s]; infinite: none did."""
    statuses: int
    """Statuses that said so."""
    stops: int
    """Safe stops."""
    late: list[float]
    """Ages of plans to drive that were accepted too late [ms]."""
    refused: int
    """Plans that the vehicle refused as `stale`."""
    unsent: int
    """Plans that the planner did not send because they were too late."""
    gaps_ms: list[float]
    back_s: float
    """From its end to a plan to drive [s]."""
    busy: float
    """Share of the cores in use."""
    eaten_s: float
    """CPU time that the busy processes took [s]."""


def run(scale: Scale, seed: int, say: Say) -> Row:
    """Starve it, let it recover, again."""
    seconds = scale.seconds(4.0, 20.0, 3.0)
    cores = os.cpu_count() or 1
    rounds = {2 * cores: scale.repetitions(3, 30), 10 * cores: scale.repetitions(2, 30)}
    times: list[Starved] = []
    with stack(seed=seed, settings={"service.status_hz": STATUS_HZ}) as s:
        for load, n in rounds.items():
            for i in range(n):
                s.settle()
                times.append(starved(s, load, seconds))
                t = times[-1]
                say(f"{load} busy, {i + 1} of {n}: {t.slow} slow plans, {t.stops} stops, back {t.back_s:.2f} s")
    if not any(t.slow or t.stops for t in times):
        raise FaultError("nothing lagged, so nothing is known of how lag is declared")
    gaps = np.concatenate([t.gaps_ms for t in times])
    late = [age for t in times for age in t.late]
    declared = max(t.declared_s for t in times)
    figures: dict[str, Figure] = {
        **{f"plans slower than 50 ms, {load} busy": sum(t.slow for t in times if t.load == load) for load in rounds},
        **{f"safe stops, {load} busy": sum(t.stops for t in times if t.load == load) for load in rounds},
        "lag declared after, worst [s]": declared,
        "statuses that said so": sum(t.statuses for t in times),
        "late plans accepted": len(late),
        "late plans refused by the vehicle": sum(t.refused for t in times),
        "late plans not sent": sum(t.unsent for t in times),
        "plan gap p50 [ms]": float(np.percentile(gaps, 50)),
        "plan gap max [ms]": float(gaps.max()),
        "drives again, worst [s]": max(t.back_s for t in times),
    }
    verdict = Verdict()
    verdict.need(declared <= DECLARED_S, f"lag declared after {declared:.1f} s")
    verdict.need(not late, f"{len(late)} late plans accepted, the worst {max(late, default=0):.0f} ms old")
    proof = (
        f"cores {100 * min(t.busy for t in times):.0f} % busy or more; the busy processes took"
        f" {min(t.eaten_s for t in times):.1f} CPU s or more each time"
    )
    loads = ", ".join(f"{n}× {seconds:g} s by {load}" for load, n in rounds.items())
    fault = f"CPU starved: {loads} busy processes on {cores} cores"
    return verdict.row(NUMBER, fault, TARGET, figures, proof)


def starved(s: Stack, load: int, seconds: float) -> Starved:
    """Starve it for so long; returns once the vehicle drives again.

    Raises:
        FaultError: the cores were not busy all the time.
    """
    before = _late(s)
    with busy(load) as pids:
        begin, (worked, idle) = time.monotonic_ns(), cpu_times()
        eaten = sum(map(cpu_s, pids))
        time.sleep(seconds)
        now, (worked_now, idle_now) = time.monotonic_ns(), cpu_times()
        eaten = sum(map(cpu_s, pids)) - eaten
    share = (worked_now - worked) / max(worked_now - worked + idle_now - idle, 1e-9)
    if not share >= BUSY:
        raise FaultError(f"the cores were only {100 * share:.0f} % busy")
    back = s.wait_drive(now)
    time.sleep(max(DECLARED_S + 0.1 - (time.monotonic_ns() - now) * NS_TO_S, 0.0))  # what was slow last is told by then
    plans = s.watch.heard("plan", begin, now)
    said = [h.arrived_ns for name in SERVICES for h in s.watch.heard(f"status/{name}", begin) if h.mode == "degraded"]
    stops = [p.arrived_ns for p in plans if p.mode == "safe_stop"]
    slow = [p.sent_ns for p in plans if p.work_ns > PERIOD_NS]
    declared = [min((t for t in (*said, *stops) if t >= sent), default=None) for sent in slow]
    refused, unsent = (b - a for a, b in zip(before, _late(s), strict=True))
    return Starved(
        load=load,
        slow=len(slow),
        declared_s=max(
            (math.inf if at is None else (at - sent) * NS_TO_S for at, sent in zip(declared, slow, strict=True)),
            default=0.0,
        ),
        statuses=len(said),
        stops=len(stops),
        late=accepted_late(s, begin, now),
        refused=refused,
        unsent=unsent,
        gaps_ms=list(s.watch.gaps_ms(begin, now)),
        back_s=(back.arrived_ns - now) * NS_TO_S,
        busy=share,
        eaten_s=eaten,
    )


def _late(s: Stack) -> tuple[int, int]:
    """Plans refused as stale by the vehicle, and not sent by the planner, so far."""
    heard = s.watch.status("planner")
    counters = heard.status.counters if heard is not None and heard.status is not None else {}
    return s.bus.counters.get("plan:stale", 0), counters.get("plan:not_sent_too_late", 0)


def accepted_late(s: Stack, since_ns: int, until_ns: int) -> list[float]:
    """Ages [ms] of plans to drive that the vehicle accepted too late, on this machine's one clock.

    Beyond 370 ms of the objects that they rest on when they were sent, or beyond their topic's 300 ms when received.
    """
    heard = {(h.boot, h.seq): h for h in s.watch.heard("plan", since_ns - 1_000_000_000)}
    late = []
    for p in list(s.vehicle.accepted):
        if not since_ns <= p.received_ns <= until_ns or p.mode != "drive":
            continue
        h = heard.get((p.boot, p.seq))
        if h is None or h.cause is None or h.cause.boot != s.bus.boot:
            continue
        basis_ms = (h.sent_ns - s.vehicle.captured_ns(h.cause.seq)) * NS_TO_MS
        own_ms = (p.received_ns - h.capture_ns) * NS_TO_MS
        if not basis_ms <= SAFE_STOP_MS:
            late.append(basis_ms)
        elif not own_ms <= PLAN_AGE_MS:
            late.append(own_ms)
    return late


@contextmanager
def busy(n: int) -> Iterator[list[int]]:
    """So many processes that do nothing but turn; gone when the `with` ends."""
    running = [
        subprocess.Popen([sys.executable, "-S", "-c", "while True: pass"], start_new_session=True) for _ in range(n)
    ]
    try:
        yield [p.pid for p in running]
    finally:
        for process in running:
            process.kill()
            process.wait()
