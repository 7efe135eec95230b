"""Row 16: leave it running: memory, descriptors and threads of every process stay as they are, no plan is left out."""

from __future__ import annotations

import time

from evaluation.faults.outage import plan_figures
from evaluation.faults.process import Sample, drift, growth_mib, sample
from evaluation.faults.result import Figure, Row, Say, Scale, Verdict
from evaluation.faults.stack import Stack, stack
from rig.launcher import SERVICES

NUMBER = 16
TARGET = "memory slope ≈ 0 after warm-up; fds, threads flat; rate ≥ 99.9 %"
RATE = 0.999
PLANS_PER_S, RISKS_PER_S = 20.0, 10.0
GROWTH_MIB = 2.0
"""What "≈ 0" means, for the whole soak [MiB]: less than one risk volume."""


def run(scale: Scale, seed: int, say: Say) -> Row:
    """Drive, and look at every process once a second."""
    warm, seconds = scale.seconds(10.0, 120.0, 3.0), scale.seconds(60.0, 3600.0, 5.0)
    names = (*SERVICES, "router")
    samples: dict[str, list[Sample]] = {name: [] for name in names}
    with stack(seed=seed) as s:
        time.sleep(warm)
        before = {name: _sent(s, name) for name in SERVICES}
        begin = time.monotonic_ns()
        while (gone := (time.monotonic_ns() - begin) * 1e-9) < seconds:
            for name in names:
                samples[name].append(sample(s.lives[name].pid))
            s.check()
            if len(samples["router"]) % 300 == 0:
                say(f"{gone:.0f} of {seconds:.0f} s")
            time.sleep(max(min(begin * 1e-9 + len(samples["router"]) - time.monotonic(), 1.0), 0.0))
        now = time.monotonic_ns()
        objects = sum(begin <= at <= now for at in s.vehicle.objects_put_ns.values())
        after = {name: _sent(s, name) for name in SERVICES}
        plans = len(s.watch.heard("plan", begin, now))
        gaps = s.watch.gaps_ms(begin, now)
        laps, late_ms = s.vehicle.laps, s.vehicle.late_ns * 1e-6
    length = (now - begin) * 1e-9
    rate = plans / (PLANS_PER_S * length)
    grown = {name: growth_mib(found) for name, found in samples.items()}
    fds = {name: drift([x.fds for x in found]) for name, found in samples.items()}
    threads = {name: drift([x.threads for x in found]) for name, found in samples.items()}
    figures: dict[str, Figure] = {
        **{f"{name} grew by [MiB]": value for name, value in grown.items()},
        **{f"{name} [MiB]": found[-1].rss_mib for name, found in samples.items()},
        "fds more than at first, worst": max(fds.values()),
        "threads more than at first, worst": max(threads.values()),
        "rate of plans": f"{100 * rate:.2f} %",
        "risks per objects": f"{100 * (after['riskfield'] - before['riskfield']) / max(objects, 1):.1f} %",
        **plan_figures(gaps),
        "vehicle's latest tick [ms]": late_ms,
    }
    verdict = Verdict()
    for name, value in grown.items():
        verdict.need(value <= GROWTH_MIB, f"{name} grew by {value:.1f} MiB")
    for what, changes in (("fds", fds), ("threads", threads)):
        for name, change in changes.items():
            verdict.need(change <= 0, f"{change} more {what} of {name}")
    verdict.need(rate >= RATE, f"rate {100 * rate:.2f} %")
    proof = f"{plans} plans in {length:.0f} s after {warm:g} s of warm-up, {laps} laps of the road"
    return verdict.row(NUMBER, f"soak {length:.0f} s", TARGET, figures, proof)


def _sent(s: Stack, name: str) -> int:
    heard = s.watch.status(name)
    topic = {"predictor": "prediction", "riskfield": "risk", "planner": "plan"}[name]
    return 0 if heard is None or heard.status is None else heard.status.counters.get(f"{topic}:sent", 0)
