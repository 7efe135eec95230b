"""Row 11: who listens must not matter: a consumer ten times too slow, a viewer that froze, no viewer.

Within one run, again and again: nobody else listens, the slow consumer does, the viewer is frozen (SIGSTOP, at the
beginning of the block). Latency end to end is from the vehicle's `objects` to the first plan that rests on them.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, field

import numpy as np

from evaluation.faults.outage import NS_TO_MS
from evaluation.faults.process import Sample, growth_mib, sample
from evaluation.faults.result import FaultError, Figure, Row, Say, Scale, Verdict
from evaluation.faults.stack import Stack, stack
from evaluation.faults.watch import until

NUMBER = 11
TARGET = "what a slow consumer gets is no older than one period; memory flat; others' p99 + ≤ 10 %"
CONSUMER = "evaluation.faults.consumer"
WORK_S = 1.0
"""Ten periods of `risk`."""
PERIOD_MS = 100.0
GRACE_MS = 20.0
"""By so much the riskfield waits for a prediction that is late: a period of `risk` is up to 120 ms."""
FLAT_MIB = 4.0
"""About one risk volume more or less [MiB]."""
ALLOWED = 1.10


@dataclass
class Condition:
    """What was measured while one kind of listener was there."""

    latency_ms: list[float] = field(default_factory=list)
    gaps_ms: list[float] = field(default_factory=list)

    def p99(self) -> float:
        """99 % of the frames were through in this time [ms]."""
        return float(np.percentile(self.latency_ms, 99))


def run(scale: Scale, seed: int, say: Say) -> Row:
    """Blocks of each condition, in turn."""
    rounds, seconds = scale.repetitions(4, 30, 1), scale.seconds(6.0, 20.0, 3.0)
    met = {name: Condition() for name in ("nobody", "slow consumer", "frozen viewer")}
    waited_ms: list[float] = []
    taken = frozen = 0
    memory: dict[str, list[list[Sample]]] = {"consumer": [], "router": []}
    with stack(seed=seed) as s:
        for i in range(rounds):
            s.settle()
            _block(s, met["nobody"], seconds)
            s.start(CONSUMER, str(WORK_S))
            until(lambda: len(_lines(s)) > 1, 30.0, "the slow consumer's second message")
            s.settle()
            samples = _block(s, met["slow consumer"], seconds, (CONSUMER, "router"))
            for name, key in (("consumer", CONSUMER), ("router", "router")):
                memory[name].append(samples[key])
            lines = _lines(s)
            taken += len(lines)
            waited_ms += [w * NS_TO_MS for _, w in lines]
            s.kill(CONSUMER)
            s.settle()
            s.start("viz", settings={"viz.serve": 0})
            s.wait_up("viz")
            s.settle()
            s.pause("viz")
            _block(s, met["frozen viewer"], seconds)
            s.resume("viz")  # proves that it stood still to the end
            s.kill("viz")
            frozen += 1
            say(f"{i + 1} of {rounds}: p99 {', '.join(f'{name} {c.p99():.0f} ms' for name, c in met.items())}")
    base = met["nobody"].p99()
    ratio = {name: c.p99() / base for name, c in met.items() if name != "nobody"}
    grown = {name: max(growth_mib(samples) for samples in blocks) for name, blocks in memory.items()}
    figures: dict[str, Figure] = {
        "waited for the slow consumer, worst [ms]": max(waited_ms),
        "messages it took": taken,
        **{f"{name} grew by, worst [MiB]": value for name, value in grown.items()},
        "end to end p99, nobody else listens [ms]": base,
        **{f"p99 with {name}": f"{100 * (r - 1):+.0f} %" for name, r in ratio.items()},
        "frames measured of each": min(len(c.latency_ms) for c in met.values()),
        "missed plans": int(sum((np.array(c.gaps_ms) > 150.0).sum() for c in met.values())),
    }
    verdict = Verdict()
    verdict.need(
        max(waited_ms) <= PERIOD_MS + GRACE_MS, f"the slow consumer got what had waited for {max(waited_ms):.0f} ms"
    )
    for name, value in grown.items():
        verdict.need(value <= FLAT_MIB, f"{name} grew by {value:.1f} MiB")
    for name, r in ratio.items():
        verdict.need(r <= ALLOWED, f"p99 {100 * (r - 1):+.0f} % with the {name}")
    total = rounds * seconds
    if taken > 1.5 * total / WORK_S + 4 * rounds:
        raise FaultError(f"the consumer took {taken} messages in {total:g} s: it was not slow")
    proof = (
        f"the consumer took {taken} volumes, one a second of ten; the viewer stood still (state T) in"
        f" {frozen} of {rounds} blocks from beginning to end"
    )
    fault = f"consumer 10× too slow for {total:g} s, viewer frozen for {total:g} s, absent for {total:g} s, interleaved"
    return verdict.row(NUMBER, fault, TARGET, figures, proof)


def _block(s: Stack, condition: Condition, seconds: float, watched: tuple[str, ...] = ()) -> dict[str, list[Sample]]:
    begin = time.monotonic_ns()
    samples: dict[str, list[Sample]] = {name: [] for name in watched}
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        for name in watched:
            samples[name].append(sample(s.lives[name].pid))
        time.sleep(0.25)
    now = time.monotonic_ns()
    condition.latency_ms += latencies_ms(s, begin, now)
    condition.gaps_ms += list(s.watch.gaps_ms(begin, now))
    s.check()
    return samples


def latencies_ms(s: Stack, since_ns: int, until_ns: int) -> list[float]:
    """From each `objects` to the first plan that rests on it [ms], of plans that arrived in a span of time."""
    found, last = [], -1
    for plan in s.watch.heard("plan", since_ns - 500_000_000, until_ns):
        if plan.cause is None or plan.cause.boot != s.bus.boot or plan.cause.seq <= last:
            continue
        last = plan.cause.seq
        if plan.arrived_ns >= since_ns:
            found.append((plan.arrived_ns - s.vehicle.captured_ns(last)) * NS_TO_MS)
    return found


def _lines(s: Stack) -> list[tuple[int, int]]:
    """What the consumer wrote: when it took each message, and how long that had waited [ns]."""
    text = s.lives[CONSUMER].child.tail(10_000)
    return [(int(t), int(waited)) for t, waited in (line.split() for line in text.splitlines() if line[:1].isdigit())]
