"""Any order of starting, a restart of any one service, and what is missing: it runs, or says what it waits for."""

from __future__ import annotations

import signal
from collections.abc import Iterator

import pytest

from tests.e2e.stack import SERVICES, Stack, Vehicle, stack
from tests.waiting import until

WARM_S = 60.0
"""Kernels may have to be compiled first."""


@pytest.fixture(scope="module")
def running() -> Iterator[tuple[Stack, Vehicle]]:
    with stack() as (services, vehicle):
        for service in SERVICES:
            services.start(service)
        vehicle.put_map()
        vehicle.put_route()
        until(vehicle.drives, within_s=WARM_S, what="a plan to drive")
        yield services, vehicle


@pytest.mark.parametrize(
    "order",
    [("planner", "riskfield", "map", "predictor", "route"), ("map", "route", "predictor", "planner", "riskfield")],
    ids=", ".join,
)
def test_services_and_road_may_come_in_any_order(order: tuple[str, ...]) -> None:
    with stack() as (services, vehicle):
        for i, step in enumerate(order):
            if step in SERVICES:
                services.start(step)
                until(lambda s=step: vehicle.status(s), within_s=WARM_S, what=f"{step} up")
            elif step == "map":
                vehicle.put_map()
            else:
                vehicle.put_route()
            if i < len(order) - 1 and "planner" in order[: i + 1]:
                plan = until(vehicle.plan, within_s=WARM_S, what="a plan whatever is missing")
                assert plan.mode in ("waiting", "safe_stop")
                assert plan.reason
        until(vehicle.drives, within_s=WARM_S, what="a plan to drive")


@pytest.mark.parametrize(("missing", "word"), [("map", "map"), ("route", "route"), ("objects", "risk")])
def test_what_is_missing_is_named_and_its_coming_is_enough(missing: str, word: str) -> None:
    with stack() as (services, vehicle):
        vehicle.objects_too = missing != "objects"
        if missing != "map":
            vehicle.put_map()
        if missing != "route":
            vehicle.put_route()
        for service in SERVICES:
            services.start(service)
        until(
            lambda: (s := vehicle.status("riskfield")) and s.state != "starting", within_s=WARM_S, what="riskfield up"
        )
        plan = until(
            lambda: (p := vehicle.plan()) and word in p.reason and p, within_s=WARM_S, what=f"{word!r} in the reason"
        )
        assert plan.mode in ("waiting", "safe_stop")
        if missing == "map":  # a field without barriers would look like a road without barriers
            until(
                lambda: (s := vehicle.status("riskfield")) and "map" in s.reason,
                within_s=WARM_S,
                what="the riskfield's",
            )
            assert vehicle.risk() is None
            vehicle.put_map()
        elif missing == "route":
            vehicle.put_route()
        vehicle.objects_too = True
        until(vehicle.drives, within_s=WARM_S, what="a plan to drive")


@pytest.mark.parametrize("service", ["predictor", "riskfield"])
def test_a_killed_service_means_a_stop_with_its_reason_and_its_return_means_driving(
    running: tuple[Stack, Vehicle], service: str
) -> None:
    services, vehicle = running
    until(vehicle.drives, within_s=WARM_S, what="a plan to drive")
    services.kill(service)
    plan = until(lambda: (p := vehicle.plan()) and p.mode == "safe_stop" and p, what="a safe stop")
    assert "risk" in plan.reason
    assert plan.tail is not None and plan.tail.speed[-1] == 0.0
    services.start(service)
    until(vehicle.drives, within_s=WARM_S, what="driving again")


def test_a_killed_planner_comes_back_and_its_former_life_is_not_heard(running: tuple[Stack, Vehicle]) -> None:
    services, vehicle = running
    until(vehicle.drives, within_s=WARM_S, what="a plan to drive")
    before = vehicle.newest("plan")
    services.kill("planner")
    until(lambda: vehicle.newest("plan") is None, what="silence")
    services.start("planner")
    until(vehicle.drives, within_s=WARM_S, what="driving again")
    after = vehicle.newest("plan")
    assert before is not None and after is not None
    assert before.boot != after.boot


def test_a_silent_predictor_is_bridged_for_300_ms_and_then_the_riskfield_stops_and_says_so(
    running: tuple[Stack, Vehicle],
) -> None:
    services, vehicle = running
    until(vehicle.drives, within_s=WARM_S, what="a plan to drive")
    services.processes["predictor"].send_signal(signal.SIGSTOP)
    try:
        offsets: list[float] = []
        causes = set()

        def silent() -> bool:
            stamped = vehicle.newest("risk")
            if stamped is not None and stamped.value.t_offset > 0:
                offsets.append(stamped.value.t_offset)
                causes.add(stamped.cause)
            return stamped is None

        until(silent, every_s=0.005, what="the end of the risk")
        assert offsets, "the last prediction's field was shifted in time"
        assert max(offsets) <= 0.3 + 0.05
        assert len(causes) == 1, "its cause stays that of the old objects"
        status = until(
            lambda: (s := vehicle.status("riskfield")) and s.state == "waiting" and s, what="the riskfield saying so"
        )
        assert "prediction" in status.reason
    finally:
        services.processes["predictor"].send_signal(signal.SIGCONT)
    until(vehicle.drives, within_s=WARM_S, what="driving again")


def test_a_silent_ego_is_a_safe_stop_that_is_heard_as_long_as_it_lasts(running: tuple[Stack, Vehicle]) -> None:
    _, vehicle = running
    until(vehicle.drives, within_s=WARM_S, what="a plan to drive")
    vehicle.ego_too = False
    try:
        first = until(lambda: (p := vehicle.plan()) and p.mode == "safe_stop" and vehicle.newest("plan"), what="a stop")

        def later() -> bool:
            stamped = vehicle.newest("plan")
            assert stamped is not None, "the planner is heard all the time"
            return stamped.value.mode == "safe_stop" and stamped.seq >= first.seq + 20

        until(later, what="a second of safe stops")
        assert not [c for c in vehicle.bus.counters if c == "plan:stale"]
    finally:
        vehicle.ego_too = True
    until(vehicle.drives, within_s=WARM_S, what="driving again")


def test_the_planner_process_hears_ego_map_route_and_risk_and_nothing_else(running: tuple[Stack, Vehicle]) -> None:
    _, vehicle = running
    status = until(lambda: vehicle.status("planner"), what="the planner's status")
    assert set(status.inputs) == {"ego", "map", "route", "risk"}
    assert all(i.received > 0 for i in status.inputs.values())


@pytest.mark.parametrize("service", SERVICES)
def test_sigterm_ends_a_working_service_within_three_seconds_with_code_0(
    running: tuple[Stack, Vehicle], service: str
) -> None:
    services, vehicle = running
    until(vehicle.drives, within_s=WARM_S, what="a plan to drive")
    process = services.processes.pop(service)
    process.terminate()
    try:
        assert process.wait(3.0) == 0
    finally:
        process.kill()
        services.start(service)
