"""Row 4: every start order, each service alone, the router restarted: no crash, and whatever is missing is named."""

from __future__ import annotations

import itertools
import random
import time

from evaluation.faults.outage import NS_TO_S, deviation
from evaluation.faults.result import FaultError, Figure, Row, Say, Scale, Verdict
from evaluation.faults.row_02_kill_planner import TRACKING
from evaluation.faults.stack import Stack, stack
from evaluation.faults.vehicle import Tick
from evaluation.faults.watch import Heard, until
from rig.launcher import SERVICES

NUMBER = 4
TARGET = "no crash; state named; ready ≤ 15 s warm"
READY_S = 15.0
BETWEEN_S = 0.3
"""Between two starts [s]: each is under way when the next begins."""
ALONE = {"predictor": ("ready",), "riskfield": ("waiting",), "planner": ("waiting",)}
"""State of each service when it runs alone."""
NAMES = {"riskfield": "prediction", "planner": "risk"}
"""What it must say is missing."""


def run(scale: Scale, seed: int, say: Say) -> Row:
    """Start in many orders, alone, and restart the router."""
    orders = list(itertools.permutations(("router", *SERVICES)))
    random.Random(seed).shuffle(orders)
    orders = orders[: scale.repetitions(len(orders), len(orders))]
    restarts = scale.repetitions(5, 50)
    crashes: list[str] = []
    nameless, tails, off = 0, 0, 0.0
    ready: dict[str, list[float]] = {"orders": [], "alone": [], "router": []}
    with stack(names=(), seed=seed, drive=False) as s:
        begin = time.monotonic_ns()
        for i, order in enumerate(orders):
            crashes += _stop_all(s)
            ready["orders"].append(in_order(s, order))
            say(f"order {i + 1} of {len(orders)}: {', '.join(order)}: drives after {ready['orders'][-1]:.1f} s")
        for i in range(restarts):
            s.settle()
            back, alone = router_restarted(s)
            ready["router"].append(back)
            tails += bool(alone) and all(t.part in ("tail", "over") for t in alone)
            off = max(off, deviation(alone))
            say(f"router {i + 1} of {restarts}: drives {back:.1f} s after it is back")
        for service in SERVICES:
            crashes += _stop_all(s)
            s.start("router")
            up = alone_up(s, service)
            ready["alone"].append(up)
            say(f"{service} alone: up after {up:.1f} s")
        crashes += _stop_all(s)
        nameless = len([h for h in _said(s, begin) if h.mode != "drive" and not h.reason])
    worst = {name: max(values) for name, values in ready.items()}
    figures: dict[str, Figure] = {
        "crashes": len(crashes),
        "states without a reason": nameless,
        "drives after the last start, worst [s]": worst["orders"],
        "up alone, worst [s]": worst["alone"],
        "drives after the router's return, worst [s]": worst["router"],
        "stored tail driven while the router was away": f"{tails} of {restarts}",
    }
    verdict = Verdict()
    verdict.need(not crashes, "; ".join(crashes))
    verdict.need(nameless == 0, f"{nameless} states without a reason")
    for name, seconds in worst.items():
        verdict.need(seconds <= READY_S, f"{name}: ready after {seconds:.1f} s")
    verdict.need(tails == restarts and off <= TRACKING, f"the tail was driven in {tails} of {restarts} restarts")
    proof = (
        f"{len(orders)} of 24 orders, every process new and the router gone before each; {restarts} routers killed,"
        " silence seen each time; each service alone said what it missed"
    )
    fault = f"start orders {len(orders)}×, each service alone, router restarted {restarts}×"
    return verdict.row(NUMBER, fault, TARGET, figures, proof)


def in_order(s: Stack, order: tuple[str, ...]) -> float:
    """Start in this order; returns how long after the last start the first plan to drive came [s]."""
    for i, name in enumerate(order):
        if i:
            time.sleep(BETWEEN_S)
        s.start(name)
    last = time.monotonic_ns()
    for name in SERVICES:
        s.wait_up(name)
    drive = s.wait_drive(last)
    s.check()
    return (drive.arrived_ns - last) * NS_TO_S


def router_restarted(s: Stack) -> tuple[float, list[Tick]]:
    """Kill the router and start it again; the time until a plan to drive is heard [s], and the ticks without any."""
    s.kill("router")
    gone = time.monotonic_ns()
    time.sleep(1.0)
    silent = time.monotonic_ns()
    if s.watch.heard("plan", gone + 300_000_000, silent):  # what was under way may still come
        raise FaultError("plans were heard without a router")
    s.start("router")
    plan = s.vehicle.body.plan
    assert plan is not None
    drive = s.wait_drive(silent)
    over = plan.capture_ns + round(plan.value.valid_for * 1e9)
    s.check()
    return (drive.arrived_ns - silent) * NS_TO_S, s.vehicle.since(over, silent)


def alone_up(s: Stack, service: str) -> float:
    """Start one service; returns how long until it says what it should, alone [s]."""
    life = s.start(service)

    def said() -> Heard | None:
        heard = s.watch.status(service)
        new = heard is not None and heard.arrived_ns > life.since_ns and heard.mode in ALONE[service]
        return heard if new and heard is not None and NAMES.get(service, "") in heard.reason else None

    what = f"{service} alone, {' or '.join(ALONE[service])}, naming {NAMES.get(service, 'nothing')!r}"
    heard = until(said, 60.0, what)
    s.check()
    return (heard.arrived_ns - life.since_ns) * NS_TO_S


def _stop_all(s: Stack) -> list[str]:
    """End everything; returns who had ended by itself."""
    crashes = []
    for name in [*SERVICES, "router"]:
        if name in s.lives:
            try:
                s.kill(name)
            except FaultError as e:
                crashes.append(str(e))
                del s.lives[name]
    return crashes


def _said(s: Stack, since_ns: int) -> list[Heard]:
    topics = ("plan", *(f"status/{service}" for service in SERVICES))
    return [h for topic in topics for h in s.watch.heard(topic, since_ns)]
