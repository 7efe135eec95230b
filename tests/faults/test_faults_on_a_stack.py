"""Quick forms of the fault rows that need real processes: the fault happens, and what does not hang on speed is kept.

One stack for all of them. The figures are `make faults`' business: nothing here is timed.
"""

from __future__ import annotations

import itertools
import os
import time
from collections import deque
from collections.abc import Iterator

import pytest

from common.bus import Raw
from evaluation.faults import row_02_kill_planner, row_11_slow_listener
from evaluation.faults.outage import safe_stop_ms
from evaluation.faults.process import sample
from evaluation.faults.row_01_kill_service import killed
from evaluation.faults.row_03_pause import paused, planner_paused
from evaluation.faults.row_04_start import router_restarted
from evaluation.faults.row_13_sigterm import mapped
from evaluation.faults.row_15_starved import starved
from evaluation.faults.stack import Stack, stack
from evaluation.faults.watch import until
from rig.launcher import SERVICES

PAUSE_S = 1.5
OLD_S = 1.0
"""What rests on objects older than this must not be driven [s], however slow the machine is; the limit is 0.3."""


@pytest.fixture(scope="module")
def running() -> Iterator[Stack]:
    with stack(road_users=12, steady_s=0.3) as s:
        yield s


def accepted_old(s: Stack, since_ns: int) -> int:
    """Plans to drive that the vehicle took although they rest on old objects."""
    return sum(
        p.received_ns >= since_ns
        and p.mode == "drive"
        and p.cause is not None
        and p.cause.boot == s.bus.boot
        and (p.received_ns - s.vehicle.captured_ns(p.cause.seq)) * 1e-9 > OLD_S
        for p in list(s.vehicle.accepted)
    )


@pytest.mark.parametrize("service", ["predictor", "riskfield"])
def test_row_1_a_killed_service_is_a_safe_stop_and_its_next_life_drives_again(running: Stack, service: str) -> None:
    begin = time.monotonic_ns()
    boot = running.watch.status(service)
    back = killed(running, service)
    after = running.watch.status(service)
    assert boot is not None and after is not None and boot.boot != after.boot
    assert back.stop_ms > 0 and back.again_s >= 0
    assert [h for h in running.watch.heard("plan", begin) if h.mode == "safe_stop" and "risk" in h.reason]
    assert not accepted_old(running, begin)


def test_row_2_without_a_planner_the_stored_tail_is_driven_and_its_former_life_is_not_heard(running: Stack) -> None:
    kept: deque[Raw] = deque(maxlen=5)
    running.watch.keep_raw = kept.append
    until(lambda: len(kept) == 5, 30.0, "plans")
    life = row_02_kill_planner.killed(running, kept)
    running.watch.keep_raw = None
    assert life.tail_s > 0 and life.others == 0
    assert life.refused > 0 and life.taken == 0


@pytest.mark.parametrize("service", ["predictor", "riskfield"])
def test_row_3_a_service_that_hangs_is_a_safe_stop_and_nothing_old_is_driven_when_it_goes_on(
    running: Stack, service: str
) -> None:
    begin = time.monotonic_ns()
    back = paused(running, service, PAUSE_S)
    assert back.out_s >= PAUSE_S and back.stop_ms > 0
    assert not accepted_old(running, begin)


def test_row_3_while_the_planner_hangs_nothing_but_its_tail_is_driven(running: Stack) -> None:
    begin = time.monotonic_ns()
    alone, _ = planner_paused(running, PAUSE_S)
    assert alone and all(t.part in ("tail", "over") for t in alone)
    assert not accepted_old(running, begin)


def test_row_4_a_router_that_comes_back_is_found_again_and_the_tail_was_driven_meanwhile(running: Stack) -> None:
    running.settle(0.3, 120.0)
    _, alone = router_restarted(running)
    assert alone and all(t.part in ("tail", "over") for t in alone)
    assert set(running.lives) == {*SERVICES, "router"}
    running.check()


def test_row_11_a_slow_consumer_gets_the_newest_and_skips_the_rest(running: Stack) -> None:
    begin = time.monotonic_ns()
    running.start(row_11_slow_listener.CONSUMER, "0.7")
    try:
        lines = until(
            lambda: found if len(found := row_11_slow_listener._lines(running)) > 2 else None, 60.0, "volumes"
        )
    finally:
        running.kill(row_11_slow_listener.CONSUMER)
    risks = running.watch.status("riskfield")
    assert risks is not None and risks.arrived_ns > begin, "the riskfield goes on"
    times = [at for at, _ in lines]
    assert all(b - a >= 0.7e9 for a, b in itertools.pairwise(times)), "it is slow"
    assert row_11_slow_listener.latencies_ms(running, begin, time.monotonic_ns()), "frames come through meanwhile"


def test_row_13_a_planner_that_is_asked_to_end_under_load_ends_with_code_0_and_uses_no_shared_memory(
    running: Stack,
) -> None:
    assert not mapped(running)
    seconds, code = running.terminate("planner", 20.0)
    assert code == 0 and seconds < 20.0
    running.start("planner")
    running.wait_up("planner")
    running.wait_drive()


def test_row_15_a_starved_machine_is_told_and_no_late_plan_is_driven(running: Stack) -> None:
    begin = time.monotonic_ns()
    times = starved(running, 2 * (os.cpu_count() or 1), 2.0)
    assert times.busy >= 0.98 and times.eaten_s > 0
    assert not accepted_old(running, begin)
    running.wait_drive()


def test_row_16_every_process_can_be_looked_at(running: Stack) -> None:
    for name in (*SERVICES, "router"):
        seen = sample(running.lives[name].pid)
        assert seen.rss_mib > 10 and seen.fds > 3 and seen.threads > 1


def test_a_safe_stop_comes_when_the_vehicle_falls_silent(running: Stack) -> None:
    begin = time.monotonic_ns()
    running.vehicle.objects_too = False
    try:
        stop, ms = safe_stop_ms(running, begin, within_s=30.0)
    finally:
        running.vehicle.objects_too = True
    assert ms > 0 and stop.reason
    running.wait_drive(time.monotonic_ns())
