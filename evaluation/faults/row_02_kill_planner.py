"""Row 2: SIGKILL the planner: the vehicle has the tail of its last plan, and nothing of a former life counts."""

from __future__ import annotations

import time
from collections import deque
from dataclasses import dataclass

from common.bus import BusSettings, Raw, open_bus
from common.topics import PLAN
from evaluation.faults.outage import NS_TO_S, deviation
from evaluation.faults.result import FaultError, Figure, Row, Say, Scale, Verdict
from evaluation.faults.stack import VEHICLE, Stack, stack
from evaluation.faults.watch import until

NUMBER = 2
TARGET = (
    "the vehicle drives the stored tail each time; new plan ≤ 2 s with a warm cache; nothing of the old boot accepted"
)
TRACKING = 0.5
"""So far may the vehicle's speed be off the tail's, by its actuators' delay [m/s]."""
REPLAYED = 10


@dataclass(frozen=True)
class Life:
    """One death of the planner."""

    plan_s: float
    """From the start of the new process to its first plan [s]."""
    drive_s: float
    """… to its first plan that drives [s]."""
    tail_s: float
    """How long the tail was driven [s]."""
    off: float
    """Worst difference of the vehicle's speed from the tail's [m/s]."""
    others: int
    """Ticks in which anything but that plan's tail was in force after `valid_for`."""
    refused: int
    """Replayed messages of the old boot that were refused as `old_boot`."""
    taken: int
    """Those that were accepted."""


def run(scale: Scale, seed: int, say: Say) -> Row:
    """Kill it, again and again."""
    n = scale.repetitions(5, 100)
    lives = []
    kept: deque[Raw] = deque(maxlen=REPLAYED)
    with stack(seed=seed) as s:
        s.watch.keep_raw = kept.append
        for i in range(n):
            s.settle()
            kept.clear()
            until(lambda: len(kept) == REPLAYED, 10.0, "plans to be said again later")
            lives.append(killed(s, kept))
            say(f"{i + 1} of {n}: new plan after {lives[-1].plan_s:.2f} s, tail driven for {lives[-1].tail_s:.2f} s")
    tails = sum(1 for life in lives if life.tail_s > 0 and not life.others and life.off <= TRACKING)
    plan, drive = max(life.plan_s for life in lives), max(life.drive_s for life in lives)
    taken, refused = sum(life.taken for life in lives), sum(life.refused for life in lives)
    figures: dict[str, Figure] = {
        "stored tail driven": f"{tails} of {n}",
        "speed off the tail's, worst [m/s]": max(life.off for life in lives),
        "new plan, worst [s]": plan,
        "drives again, worst [s]": drive,
        "of the old boot, accepted": taken,
        "of the old boot, refused": refused,
    }
    verdict = Verdict()
    verdict.need(tails == n, f"the tail was driven in {tails} of {n} cases")
    verdict.need(plan <= 2.0, f"new plan after {plan:.1f} s")
    verdict.need(taken == 0, f"{taken} messages of an old boot accepted")
    verdict.need(refused > 0, "no message of an old boot reached the vehicle")
    proof = (
        f"{n} of {n} processes gone by SIGKILL, {n} new boots; {refused} messages of former lives were delivered again"
    )
    return verdict.row(NUMBER, f"SIGKILL planner {n}×", TARGET, figures, proof)


def killed(s: Stack, kept: deque[Raw]) -> Life:
    """Kill the planner, start it again, let its former life speak once more."""
    begin = time.monotonic_ns()
    old = s.watch.last("plan")
    s.kill("planner")
    again = list(kept)
    life = s.start("planner")
    if old is None:
        raise FaultError("the planner had not planned")
    first = s.watch.first("plan", begin, 60.0, "a plan of the new planner", lambda h: h.boot != old.boot)
    in_force = until(lambda: next((p for p in reversed(s.vehicle.accepted) if p.boot == old.boot), None), 1.0, "a plan")
    over = in_force.capture_ns + round(in_force.valid_for * 1e9)
    until(
        lambda: s.vehicle.body.plan is not None and s.vehicle.body.plan.boot == first.boot, 5.0, "the new plan in force"
    )
    ticks = [t for t in s.vehicle.since(over) if t.boot == old.boot]
    alone = s.vehicle.since(over, first.arrived_ns)
    drive = s.wait_drive(first.arrived_ns)
    before = s.bus.counters.get("plan:old_boot", 0)
    taken = _replay(s, again, first.boot)
    return Life(
        plan_s=(first.arrived_ns - life.since_ns) * NS_TO_S,
        drive_s=(drive.arrived_ns - life.since_ns) * NS_TO_S,
        tail_s=0.02 * sum(t.part in ("tail", "over") for t in ticks),
        off=deviation(ticks),
        # the vehicle may hear the new plan a moment before the listener does
        others=sum(
            t.boot != old.boot or t.seq != in_force.seq or t.part not in ("tail", "over")
            for t in alone
            if t.boot != first.boot
        ),
        refused=s.bus.counters.get("plan:old_boot", 0) - before,
        taken=taken,
    )


def _replay(s: Stack, messages: list[Raw], boot: str) -> int:
    """Send old messages once more; returns how many plans of another boot than the new one were accepted meanwhile."""
    begin = time.monotonic_ns()
    settings = BusSettings(connect=(s.endpoint,))
    with open_bus(settings, VEHICLE, "echo", wait_s=10.0) as bus:
        publisher = bus.publisher(PLAN)
        for raw in messages:
            time.sleep(0.03)
            publisher.put_raw(raw.attachment, raw.payload, raw.encoding)
        time.sleep(0.2)
    return sum(p.boot != boot for p in s.vehicle.accepted if p.received_ns > begin)
