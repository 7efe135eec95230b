"""Health as its views show it: fails closed, counts once, says what was said, and knows when the loop stands still."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest

from common import topics
from common.health import DEADLINE, RATE_WINDOW, STALL_S, WORK_BUCKETS_S, WORK_WINDOW, Health, InputMonitor
from common.messages import InputHealth

S = 1_000_000_000
MS = 1_000_000


class Clock:
    def __init__(self) -> None:
        self.now = 5 * S

    def __call__(self) -> int:
        return self.now


def rated(low: float, high: float, max_age_s: float | None = 0.3) -> InputMonitor:
    return InputMonitor(replace(topics.OBJECTS, rate_hz=(low, high), max_age_s=max_age_s))


def test_a_new_input_fails_closed() -> None:
    assert InputMonitor(topics.EGO).view(7 * S) == InputHealth(
        alive=False, rate_ok=False, valid=False, age_s=None, rate_hz=0.0, received=0, used=0
    )
    assert InputMonitor(topics.MAP).view(7 * S) == InputHealth(
        alive=False, rate_ok=True, valid=False, age_s=None, rate_hz=0.0, received=0, used=0
    )


def test_a_latched_input_lives_from_its_first_message_on_and_tells_its_age() -> None:
    monitor = InputMonitor(topics.MAP)
    monitor.arrived(1 * S)
    assert monitor.view(2 * S) == InputHealth(alive=True, rate_ok=True, valid=False, received=1, used=0)
    monitor.accepted(1 * S)
    monitor.arrived(3 * S)
    assert monitor.view(4 * S) == InputHealth(alive=True, rate_ok=True, valid=True, age_s=3.0, received=2, used=1)
    monitor.refused()
    assert monitor.view(4 * S) == InputHealth(alive=True, rate_ok=True, valid=False, age_s=3.0, received=2, used=1)


def test_what_gave_way_to_a_newer_message_was_not_used() -> None:
    monitor = InputMonitor(topics.MAP)
    for i in range(3):
        monitor.arrived(i * S)
        monitor.accepted(i * S)
    monitor.superseded()
    view = monitor.view(4 * S)
    assert (view.received, view.used, view.valid) == (3, 2, True)


def test_a_rated_input_tells_rate_age_and_counts() -> None:
    monitor = rated(8.0, 12.0)
    for i in range(3):
        monitor.arrived(i * S // 10)
        monitor.accepted(i * S // 10)
    assert monitor.view(3 * S // 10) == InputHealth(
        alive=True, rate_ok=True, valid=True, age_s=0.1, rate_hz=10.0, received=3, used=3
    )


def test_one_arrival_is_a_sign_of_life_but_no_rate() -> None:
    monitor = rated(8.0, 12.0)
    monitor.arrived(1 * S)
    view = monitor.view(1 * S)
    assert view.alive and not view.rate_ok and view.rate_hz == 0.0
    monitor.arrived(1 * S)  # two at once: no time between them
    assert monitor.view(1 * S).rate_hz == 0.0


def test_only_the_newest_arrivals_make_the_rate() -> None:
    monitor = rated(8.0, 12.0)
    for i in range(100):
        monitor.arrived(i * S)
    for i in range(RATE_WINDOW):
        monitor.arrived(1000 * S + i * S // 10)
    view = monitor.view(1000 * S + 2 * S)
    assert view.rate_hz == pytest.approx(10.0) and view.received == 100 + RATE_WINDOW


@pytest.mark.parametrize(
    ("low", "max_age_s", "silent_ms", "alive"),
    [
        (8.0, 0.3, 375, True), (8.0, 0.3, 376, False),  # three periods of the lowest rate …
        (12.0, 0.25, 250, True), (12.0, 0.25, 251, False),
        (1.0, 2.0, 3000, True), (1.0, 2.0, 3001, False),
        (100.0, 0.25, 250, True), (100.0, 0.25, 251, False),  # … or the largest age, whichever is longer
        (6.0, None, 500, True), (6.0, None, 501, False),
    ],
)  # fmt: skip
def test_an_input_is_alive_for_three_periods_or_its_largest_age(
    low: float, max_age_s: float | None, silent_ms: int, alive: bool
) -> None:
    monitor = rated(low, 1000.0, max_age_s)
    monitor.arrived(0)
    assert monitor.view(silent_ms * MS).alive is alive


@pytest.mark.parametrize(
    ("period_ms", "ok"), [(100, True), (155, True), (157, False), (67, True), (66, False), (1, False)]
)
def test_the_rate_may_be_a_fifth_below_and_a_quarter_above_its_limits(period_ms: int, ok: bool) -> None:
    monitor = rated(8.0, 12.0, max_age_s=10.0)
    for i in range(5):
        monitor.arrived(i * period_ms * MS)
    assert monitor.view(4 * period_ms * MS).rate_ok is ok


def test_a_rate_at_the_limits_themselves_is_allowed_and_a_dead_input_has_none() -> None:
    for period in (S // 4, S // 20):
        monitor = rated(5.0, 16.0, max_age_s=1.0)
        monitor.arrived(0)
        monitor.arrived(period)
        assert monitor.view(period).rate_ok
        assert not monitor.view(period + 2 * S).rate_ok


def test_the_same_topic_has_one_monitor() -> None:
    health = Health("planner", Clock())
    assert health.input(topics.RISK) is health.input(topics.RISK)
    assert health.input(topics.RISK) is not health.input(topics.EGO)


def test_the_status_is_what_was_said_counted_and_measured() -> None:
    clock = Clock()
    health = Health("planner", clock)
    assert (health.service, health.state, health.reason) == ("planner", "starting", "starting")
    fresh = health.status()
    assert (fresh.service, fresh.state, fresh.reason, fresh.uptime_s) == ("planner", "starting", "starting", 0.0)
    assert fresh.work_ms == {"p50": 0.0, "p95": 0.0, "p99": 0.0, "max": 0.0}
    assert (fresh.inputs, fresh.counters, fresh.detail) == ({}, {}, {})
    health.input(topics.MAP).arrived(clock.now)
    health.input(topics.MAP).accepted(clock.now)
    health.count("risk:stale")
    health.count("risk:stale", 4)
    health.count("risk:range")
    health.detail["planner"] = "default"
    for ms in range(1, 102):
        health.worked(ms * MS)
    health.say("ready", "r" * 1200)
    clock.now += 3 * S
    status = health.status()
    assert (status.state, status.uptime_s) == ("ready", 3.0)
    assert status.reason == "r" * 1000 and health.reason == "r" * 1200 and health.state == "ready"
    assert status.counters == {"risk:stale": 5, "risk:range": 1} and status.detail == {"planner": "default"}
    assert status.inputs == {"map": InputHealth(alive=True, rate_ok=True, valid=True, age_s=3.0, received=1, used=1)}
    assert status.work_ms == pytest.approx({"p50": 51.0, "p95": 96.0, "p99": 100.0, "max": 101.0})


def test_what_was_told_stays_as_it_was_told() -> None:
    health = Health("planner", Clock())
    health.detail["a"] = "b"
    status = health.status()
    health.detail["a"] = "c"
    health.count("x")
    assert status.detail == {"a": "b"} and status.counters == {}


def lagging(state: str = "ready") -> Health:
    clock = Clock()
    health = Health("planner", clock)
    for _ in range(20):
        health.turned()
        health.late(80 * MS)
        clock.now += 100 * MS
    health.say(state, "running")  # type: ignore[arg-type]
    return health


@pytest.mark.parametrize(("state", "told"), [("waiting", "degraded"), ("ready", "degraded"), ("degraded", "degraded"),
                                             ("starting", "starting"), ("stopping", "stopping")])  # fmt: skip
def test_what_lags_is_degraded_and_says_so_unless_it_starts_or_stops(state: str, told: str) -> None:
    health = lagging(state)
    status = health.status()
    assert (status.state, health.state, health.reason) == (told, state, "running")
    assert status.counters == {DEADLINE: 20}
    if told == "degraded":
        assert status.reason.endswith("; running") and "80 ms" in status.reason
    else:
        assert status.reason == "running"


def test_what_lags_no_more_says_so_no_more() -> None:
    health = lagging()
    health._clock.now += 60 * S  # type: ignore[attr-defined]
    health.turned()
    health._clock.now += 60 * S  # type: ignore[attr-defined]
    health.turned()
    assert (health.status().state, health.status().reason) == ("ready", "running")


def test_only_news_is_news() -> None:
    health = Health("planner", Clock())
    assert not health.say("starting", "starting")
    assert health.say("starting", "compiling")
    assert health.say("ready", "compiling")
    assert not health.say("ready", "compiling")


def test_work_is_a_window_and_its_histogram_is_of_all() -> None:
    health = Health("planner", Clock())
    for _ in range(10):
        health.worked(S)
    for _ in range(WORK_WINDOW):
        health.worked(2 * MS)
    assert health.status().work_ms == pytest.approx({"p50": 2.0, "p95": 2.0, "p99": 2.0, "max": 2.0})
    buckets, total = health.work_histogram()
    assert [end for end, _ in buckets] == [*map(str, WORK_BUCKETS_S), "+Inf"]
    assert dict(buckets)["0.001"] == 0.0 and dict(buckets)["0.002"] == dict(buckets)["0.5"] == WORK_WINDOW
    assert dict(buckets)["1.0"] == dict(buckets)["+Inf"] == WORK_WINDOW + 10
    assert math.isclose(total, 10.0 + 0.002 * WORK_WINDOW)
    health.worked(2 * S)
    buckets, total = health.work_histogram()
    assert dict(buckets)["1.0"] == WORK_WINDOW + 10 and dict(buckets)["+Inf"] == WORK_WINDOW + 11
    assert math.isclose(total, 12.0 + 0.002 * WORK_WINDOW)
    assert all(isinstance(n, float) for _, n in buckets)


def test_a_loop_that_stands_still_has_no_heartbeat_unless_it_is_still_starting() -> None:
    clock = Clock()
    health = Health("planner", clock)
    clock.now += 100 * S
    assert health.turning  # compiling kernels may take long
    health.say("ready", "running")
    assert not health.turning
    health.turned()
    assert health.turning
    clock.now += round(STALL_S * S) - 1
    assert health.turning
    clock.now += 1
    assert not health.turning
