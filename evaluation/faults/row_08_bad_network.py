"""Row 8: loss, duplicates, reordering, delay, on every link between vehicle and services at once."""

from __future__ import annotations

import itertools
import time
from collections import defaultdict
from dataclasses import dataclass

import numpy as np

from common import codec, topics
from common.bus import Raw
from common.codec import RefusedError
from common.messages import Header, StepInputs
from common.topics import Topic
from evaluation.faults.relay import NAME_OF, Harm, relay
from evaluation.faults.result import FaultError, Figure, Row, Say, Scale, Verdict
from evaluation.faults.stack import Stack, stack
from evaluation.faults.watch import _head
from rig.launcher import SERVICES

NUMBER = 8
TARGET = "seq never goes back; nothing stale used; safe stop exactly when age > 300 ms"
HARMS = {
    "loss 1 %": Harm(loss=0.01),
    "loss 10 %": Harm(loss=0.10),
    "loss 50 %": Harm(loss=0.50),
    "duplicates, reordering": Harm(duplicates=0.3, delay_s=(0.0, 0.06)),
    "delay 100 ± 80 ms": Harm(delay_s=(0.02, 0.18)),
}
OLD_RISK_S, OLD_EGO_S, OLD_S = 0.3, 0.2, 0.3
OUTPUTS = {"predictor": topics.PREDICTION, "riskfield": topics.RISK, "planner": topics.PLAN}


@dataclass(frozen=True)
class Sent:
    """One output of a service: when, resting on what."""

    header: Header
    step: StepInputs
    mode: str = ""
    reason: str = ""


def run(scale: Scale, seed: int, say: Say) -> Row:
    """Each harm for some seconds."""
    seconds = scale.seconds(6.0, 120.0, 2.0)
    verdict = Verdict()
    sent: dict[str, list[Sent]] = defaultdict(list)
    figures: dict[str, Figure] = {}
    with stack((), seed=seed, road=False, drive=False) as s, relay(s.endpoint, seed) as (between, buses):
        for service, topic in OUTPUTS.items():
            buses[NAME_OF[service]].tap(topic, _listener(sent[service]))
        tree = s.tree
        for service in SERVICES:
            s.tree = {**tree, "vehicle": NAME_OF[service]}
            s.start(service)
        for service in SERVICES:
            s.wait_up(service)
        s.vehicle.put_map()
        s.vehicle.put_route()
        s.wait_drive()
        for name, harm in HARMS.items():
            before, since = between.counts.copy(), time.monotonic_ns()
            between.harm = harm
            time.sleep(seconds)
            s.check()
            _proven(name, harm, between.counts - before)
            share = _driving(sent["planner"], since)
            figures[f"plans that drive, {name} [%]"] = 100.0 * share
            say(f"{name}: {dict(between.counts - before)}, drives {100 * share:.0f} %")
        between.harm = Harm()
        s.wait_drive()
        counts = between.counts
        back = sum(_backwards(sent[service]) for service in SERVICES)
        taken_back = _vehicle_backwards(s)
        stale, wrong, others, true_ms = _judged(s, sent)
    verdict.need(back == 0, f"{back} steps rest on an older message than the one before")
    verdict.need(taken_back == 0, f"{taken_back} plans taken by the vehicle went back")
    verdict.need(not stale, f"used though stale: {stale[:3]}")
    verdict.need(not wrong, f"{len(wrong)} plans stop or drive where the age says otherwise: {wrong[:2]}")
    figures |= {
        "outputs of services checked": sum(len(v) for v in sent.values()), "steps that went back": back,
        "plans that went back at the vehicle": taken_back, "stale inputs used": len(stale),
        "plans whose mode does not follow from the age": len(wrong), "stops for other reasons": others,
        "true age of what was driven on, worst [ms]": true_ms,
    }  # fmt: skip
    proof = ", ".join(f"{n} {what}" for what, n in sorted(counts.items()))
    fault = f"a seeded relay on every link: {'; '.join(HARMS)}, each {seconds:g} s"
    return verdict.row(NUMBER, fault, TARGET, figures, proof)


def _listener(into: list[Sent]):  # type: ignore[no-untyped-def]
    def hear(raw: Raw) -> None:
        try:
            header = codec.decode_header(raw.topic, raw.attachment)
        except RefusedError:
            return
        said = _head(raw.payload, ("mode", "reason")) if raw.topic is topics.PLAN else {}
        if header.step is not None:
            into.append(Sent(header, header.step, said.get("mode", ""), said.get("reason", "")))

    return hear


def _proven(name: str, harm: Harm, counts: dict[str, int]) -> None:
    for wanted, what in ((harm.loss, "lost"), (harm.duplicates, "duplicated"), (harm.delay_s[1], "overtaken")):
        if wanted and not counts.get(what):
            raise FaultError(f"{name}: nothing was {what}")


def _driving(plans: list[Sent], since_ns: int) -> float:
    modes = [p.mode == "drive" for p in plans if p.step.now_ns >= since_ns]
    return float(np.mean(modes)) if modes else 0.0


def _backwards(outputs: list[Sent]) -> int:
    """Steps of one service that rest on an older message, or on a boot that was replaced."""
    last: dict[str, tuple[str, int]] = {}
    gone: set[tuple[str, str]] = set()
    found = 0
    for out in sorted(outputs, key=lambda o: o.header.seq):
        for used in out.step.used:
            boot, seq = last.get(used.topic, (used.boot, -1))
            if used.boot != boot:
                gone.add((used.topic, boot))
            found += (used.topic, used.boot) in gone or (used.boot == boot and used.seq < seq)
            last[used.topic] = used.boot, used.seq
    return found


def _vehicle_backwards(s: Stack) -> int:
    ticks = [t for t in list(s.vehicle.ticks) if t.boot]
    return sum(b.boot == a.boot and b.seq < a.seq for a, b in itertools.pairwise(ticks))


def _age_s(out: Sent, topic: Topic) -> float:
    return max((out.step.now_ns - u.capture_ns) * 1e-9 for u in out.step.used if u.topic == topic.suffix)


def _judged(s: Stack, sent: dict[str, list[Sent]]) -> tuple[list[str], list[str], int, float]:
    """What was used though stale; plans whose mode does not follow from the ages; other stops; the worst true age."""
    stale, wrong, others, true_ms = [], [], 0, 0.0
    for out in sent["predictor"]:
        if _age_s(out, topics.OBJECTS) > OLD_S:
            stale.append(f"objects {_age_s(out, topics.OBJECTS) * 1e3:.0f} ms")
    for out in sent["riskfield"]:
        if _age_s(out, topics.PREDICTION) > OLD_S:
            stale.append(f"prediction {_age_s(out, topics.PREDICTION) * 1e3:.0f} ms")
    for plan in sent["planner"]:
        known = {u.topic for u in plan.step.used}
        if not {"ego", "risk", "map", "route"} <= known:
            continue
        risk, ego = _age_s(plan, topics.RISK), _age_s(plan, topics.EGO)
        old = risk > OLD_RISK_S or ego > OLD_EGO_S
        says_old = plan.mode == "safe_stop" and "ms old" in plan.reason
        if old != says_old:
            wrong.append(f"risk {risk * 1e3:.1f} ms, ego {ego * 1e3:.1f} ms: {plan.mode} {plan.reason[:60]}")
        others += plan.mode != "drive" and not says_old
        cause = plan.header.cause
        if plan.mode == "drive" and cause is not None and cause.seq in s.vehicle.objects_put_ns:
            true_ms = max(true_ms, (plan.step.now_ns - s.vehicle.objects_put_ns[cause.seq]) * 1e-6)
    return stale, wrong, others, true_ms
