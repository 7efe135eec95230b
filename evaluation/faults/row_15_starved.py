"""Row 15: twice as many busy processes as cores: who is too slow says so, and no late plan is driven."""

from __future__ import annotations

import itertools
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np

from evaluation.faults.outage import NS_TO_MS, NS_TO_S, SAFE_STOP_MS
from evaluation.faults.process import cpu_s, cpu_times
from evaluation.faults.result import FaultError, Figure, Row, Say, Scale, Verdict
from evaluation.faults.stack import Stack, stack
from rig.launcher import SERVICES

NUMBER = 15
TARGET = "lag declared ≤ 1 s; safe stop rather than a late plan"
DECLARED_S = 1.0
LAG_MS = 100.0
"""Two periods without a plan: the vehicle can tell that something lags."""
BUSY = 0.98
"""So much of the cores must have been in use, or nobody starved."""


@dataclass(frozen=True)
class Starved:
    """One time of starvation."""

    lags: int
    """Gaps between plans of more than two periods."""
    declared_s: float
    """From the first of them to the first status or plan that says so [s]; infinite: nobody did."""
    late: list[float]
    """Ages at receipt of what accepted plans to drive rest on, beyond 370 ms [ms]."""
    stops: int
    gaps_ms: list[float]
    busy: float
    eaten_s: float
    late_said: int
    refused: int
    """Plans that the vehicle refused as `stale`."""
    unsent: int
    """Plans that the planner did not send because they were too late."""


def run(scale: Scale, seed: int, say: Say) -> Row:
    """Starve it, let it recover, again."""
    n, seconds = scale.repetitions(3, 30), scale.seconds(5.0, 20.0, 3.0)
    load = 2 * (os.cpu_count() or 1)
    times = []
    backs = []
    with stack(seed=seed) as s:
        for i in range(n):
            s.settle()
            times.append(starved(s, load, seconds))
            over = time.monotonic_ns()
            backs.append((s.wait_drive(over).arrived_ns - over) * NS_TO_S)
            say(f"{i + 1} of {n}: {times[-1].lags} lags, {times[-1].stops} plans to stop, back {backs[-1]:.2f} s")
    gaps = np.concatenate([t.gaps_ms for t in times])
    late = [age for t in times for age in t.late]
    lagged = [t for t in times if t.lags]
    declared = max((t.declared_s for t in lagged), default=0.0)
    figures: dict[str, Figure] = {
        "times with a lag": f"{len(lagged)} of {n}",
        "lag declared after, worst [s]": declared,
        "statuses that said so": sum(t.late_said for t in times),
        "plans to stop": sum(t.stops for t in times),
        "late plans accepted": len(late),
        "late plans refused by the vehicle": sum(t.refused for t in times),
        "not sent, too late": sum(t.unsent for t in times),
        "plan gap p50 [ms]": float(np.percentile(gaps, 50)),
        "plan gap max [ms]": float(gaps.max()),
        "drives again, worst [s]": max(backs),
    }
    verdict = Verdict()
    verdict.need(declared <= DECLARED_S, f"lag declared after {declared:.1f} s")
    verdict.need(not late, f"{len(late)} late plans accepted, on objects {max(late, default=0):.0f} ms old")
    proof = (
        f"{load} busy processes on {os.cpu_count()} cores took {min(t.eaten_s for t in times):.1f} CPU s or more each"
        f" time; cores {100 * min(t.busy for t in times):.0f} % busy or more"
    )
    return verdict.row(NUMBER, f"CPU starved by {load} busy processes, {n}× {seconds:g} s", TARGET, figures, proof)


def starved(s: Stack, load: int, seconds: float) -> Starved:
    """Starve it for so long.

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
    plans = s.watch.heard("plan", begin, now)
    lags = [b for a, b in itertools.pairwise(plans) if (b.arrived_ns - a.arrived_ns) * NS_TO_MS > LAG_MS]
    said = sorted(
        h.arrived_ns
        for name in SERVICES
        for h in s.watch.heard(f"status/{name}", begin, now + 1_000_000_000)
        if h.mode == "degraded"
    )
    stops = [p for p in plans if p.mode == "safe_stop"]
    first = min([*said, *(p.arrived_ns for p in stops)], default=None)
    declared = 0.0
    if lags:
        declared = float("inf") if first is None else max(first - lags[0].arrived_ns, 0) * NS_TO_S
    refused, unsent = (b - a for a, b in zip(before, _late(s), strict=True))
    return Starved(
        len(lags), declared, accepted_late(s, begin, now), len(stops), list(s.watch.gaps_ms(begin, now)), share, eaten,
        len(said), refused, unsent,
    )  # fmt: skip


def _late(s: Stack) -> tuple[int, int]:
    """Plans refused as stale by the vehicle, and not sent by the planner, so far."""
    heard = s.watch.status("planner")
    counters = heard.status.counters if heard is not None and heard.status is not None else {}
    return s.bus.counters.get("plan:stale", 0), counters.get("plan:not_sent_too_late", 0)


def accepted_late(s: Stack, since_ns: int, until_ns: int) -> list[float]:
    """Age at receipt of what each plan to drive that the vehicle accepted rests on, beyond 370 ms [ms]."""
    ages = [
        (p.received_ns - s.vehicle.captured_ns(p.cause.seq)) * NS_TO_MS
        for p in list(s.vehicle.accepted)
        if since_ns <= p.received_ns <= until_ns
        and p.mode == "drive"
        and p.cause is not None
        and p.cause.boot == s.bus.boot
    ]
    return [age for age in ages if not age <= SAFE_STOP_MS]


@contextmanager
def busy(n: int) -> Iterator[list[int]]:
    """So many processes that do nothing but turn; gone when the `with` ends."""
    running = [subprocess.Popen([sys.executable, "-S", "-c", "while True: pass"]) for _ in range(n)]
    try:
        yield [p.pid for p in running]
    finally:
        for process in running:
            process.kill()
            process.wait()
