"""Row 9: predictor and riskfield on another host, a router on each; the cable is cut and healed, or made slow.

Across the cable go objects and ego one way and every risk volume the other: the most that a split can put on it.
"""

from __future__ import annotations

import time

import numpy as np

from evaluation.faults.network import Cable, second_host
from evaluation.faults.outage import AGAIN_S, NS_TO_MS, NS_TO_S, Back, judge, old_drives, plan_figures
from evaluation.faults.result import FaultError, Figure, Row, Say, Scale, Verdict
from evaluation.faults.stack import Stack, stack
from evaluation.faults.watch import Heard

NUMBER = 9
TARGET = "as row 1: 0 missed plans, gap p99.9 ≤ 75 ms, safe stop ≤ 370 ms after the last valid capture; back ≤ 2 s"
RATE = "1mbit"
RATE_S = 5.0
RATE_BYTES_S = 1e6 / 8


def run(scale: Scale, seed: int, say: Say) -> Row:
    """Cut it for 0.2, 1 and 10 s, then throttle it."""
    cuts = {0.2: scale.repetitions(5, 20), 1.0: scale.repetitions(5, 20), 10.0: scale.repetitions(1, 20, 0)}
    slow = scale.repetitions(2, 20)
    backs: list[Back] = []
    gaps, old, rates = [], [], []
    unstopped: dict[str, int] = {}
    with second_host() as cable, stack(names=("planner",), seed=seed, drive=False, upstream=cable.endpoint) as s:
        s.start("edge", "--listen", cable.endpoint, within=cable.within)
        for service in ("predictor", "riskfield"):
            s.start(service, within=cable.within, settings={"bus.connect": [cable.endpoint]})
        for seconds, n in cuts.items():
            for _ in range(n):
                s.settle()
                begin = time.monotonic_ns()
                back = cut(s, cable, seconds)
                backs.append(back)
                unstopped[back.service] = unstopped.get(back.service, 0) + (back.stop_ms == 0.0)
                gaps.append(s.watch.gaps_ms(begin))
                old += old_drives(s, begin)
            if n:
                say(f"cut {seconds:g} s {n}×: back after {max(b.again_s for b in backs[-n:]):.2f} s at worst")
        for _ in range(slow):
            s.settle()
            begin = time.monotonic_ns()
            back, rate = throttled(s, cable)
            backs.append(back)
            rates.append(rate)
            gaps.append(s.watch.gaps_ms(begin))
            old += old_drives(s, begin)
        say(f"1 Mbit/s {slow}×: back after {max(b.again_s for b in backs[-slow:]):.2f} s at worst")
    all_gaps = np.concatenate(gaps)
    worst = {b.service: max(c.again_s for c in backs if c.service == b.service) for b in backs}
    figures: dict[str, Figure] = {
        **plan_figures(all_gaps),
        "safe stop after the last valid capture, worst [ms]": max(b.stop_ms for b in backs),
        **{f"back after {name}, worst [s]": seconds for name, seconds in worst.items()},
        "0.2 s bridged without a stop": f"{unstopped.get('0.2 s', 0)} of {cuts[0.2]}",
        "plans to drive on objects older than 370 ms": len(old),
    }
    verdict = Verdict()
    judge(verdict, all_gaps, backs)
    verdict.need(max(worst.values()) <= AGAIN_S, f"back after {max(worst.values()):.1f} s")
    verdict.need(not old, f"{len(old)} plans to drive on old objects, worst {max(old, default=0):.0f} ms")
    proof = (
        f"{sum(cuts.values())} of {sum(cuts.values())} cuts left no route to the other host;"
        f" {slow} of {slow} throttled links carried ≤ {max(rates) * 8e-6:.2f} Mbit/s"
    )
    fault = (
        f"{', '.join(f'{n}× {seconds:g} s' for seconds, n in cuts.items() if n)} without a link between two hosts,"
        f" {slow}× {RATE_S:g} s at 1 Mbit/s"
    )
    return verdict.row(NUMBER, fault, TARGET, figures, proof)


def cut(s: Stack, cable: Cable, seconds: float) -> Back:
    """Cut the cable for so long; returns once the vehicle drives, and had none but fresh plans for 0.5 s."""
    begin = cable.cut()
    time.sleep(max(seconds - (time.monotonic_ns() - begin) * NS_TO_S, 0.0))
    healed = cable.heal()
    return _back(s, f"{seconds:g} s", begin, healed)


def throttled(s: Stack, cable: Cable) -> tuple[Back, float]:
    """Throttle the cable; returns the outage and what the cable carried meanwhile [bytes/s].

    Raises:
        FaultError: it carried more than it should.
    """
    begin = cable.throttle(RATE)
    time.sleep(1.0)  # what the kernel had queued before goes first
    before, at = cable.received_bytes(), time.monotonic()
    time.sleep(RATE_S - 1.0)
    rate = (cable.received_bytes() - before) / (time.monotonic() - at)
    if not rate <= 1.1 * RATE_BYTES_S:
        raise FaultError(f"the throttled cable carried {rate * 8e-6:.2f} Mbit/s")
    healed = cable.unthrottle()
    return _back(s, "1 Mbit/s", begin, healed), rate


def _back(s: Stack, name: str, begin_ns: int, healed_ns: int) -> Back:
    """Wait for plans on what was captured after the cable was healed."""

    def new(h: Heard) -> bool:
        if h.mode != "drive" or h.cause is None or h.cause.boot != s.bus.boot:
            return False
        return s.vehicle.captured_ns(h.cause.seq) >= healed_ns

    drive = s.watch.first("plan", healed_ns, 60.0, "a plan to drive on objects from after the link was healed", new)
    stops = [h for h in s.watch.heard("plan", begin_ns, drive.arrived_ns) if h.mode == "safe_stop"]
    stop_ms = 0.0
    if stops and stops[0].cause is not None:
        stop_ms = (stops[0].arrived_ns - s.vehicle.captured_ns(stops[0].cause.seq)) * NS_TO_MS
    return Back(name, stop_ms, (drive.arrived_ns - healed_ns) * NS_TO_S, (healed_ns - begin_ns) * NS_TO_S)
