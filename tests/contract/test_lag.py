"""A service that is too slow says so, within a second, and no longer than a second after it was."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from common.health import DEADLINE, Health
from common.lag import STOOD_NS, WINDOW_NS, Lag

S = 1_000_000_000
MS = 1_000_000


class Clock:
    def __init__(self) -> None:
        self.now = 5 * S

    def __call__(self) -> int:
        return self.now


@given(st.integers(0, 3 * WINDOW_NS), st.integers(1, S))
def test_what_was_late_is_told_for_a_second_and_not_longer(later: int, by: int) -> None:
    lag = Lag()
    lag.late(0, by)
    assert bool(lag.words(later)) == (later <= WINDOW_NS)


def test_the_words_count_what_was_late_in_the_last_second_and_name_the_worst() -> None:
    lag = Lag()
    for at, by in ((0, 900), (500, 80), (1200, 120)):
        lag.late(at * MS, by * MS)
    assert lag.words(1300 * MS) == "late: 2 results in the last second, by up to 120 ms"


@given(st.integers(0, 10 * S))
def test_a_loop_that_stands_is_told_and_one_that_never_turned_is_not(stood: int) -> None:
    lag = Lag()
    assert lag.words(stood) == ""
    lag.turned(0)
    assert bool(lag.words(stood)) == (stood > STOOD_NS)


def test_both_are_told_together() -> None:
    lag = Lag()
    lag.turned(0)
    lag.late(100 * MS, 60 * MS)
    assert lag.words(700 * MS) == (
        "late: 1 result in the last second, by up to 60 ms; the loop has not turned for 0.7 s"
    )


@pytest.mark.parametrize("state", ["waiting", "ready", "degraded"])
def test_a_service_that_lags_is_degraded_and_its_own_reason_stands_behind(state: str) -> None:
    clock = Clock()
    health = Health("planner", clock)
    health.say(state, "driving")  # type: ignore[arg-type]
    health.turned()
    assert health.status().state == state and health.status().reason == "driving"
    health.late(80 * MS)
    status = health.status()
    assert status.state == "degraded" and status.counters[DEADLINE] == 1
    assert status.reason == "late: 1 result in the last second, by up to 80 ms; driving"
    clock.now += WINDOW_NS + 1
    health.turned()
    assert health.status().state == state and health.status().reason == "driving"
    clock.now += 2 * S
    assert health.status().reason == "the loop has not turned for 2.0 s; driving"
    assert health.state == state, "what was said stays as it was said"


@pytest.mark.parametrize("state", ["starting", "stopping"])
def test_who_starts_or_ends_does_not_lag(state: str) -> None:
    clock = Clock()
    health = Health("planner", clock)
    health.turned()
    health.late(80 * MS)
    health.say(state, "compiling")  # type: ignore[arg-type]
    clock.now += 10 * S
    assert (health.status().state, health.status().reason) == (state, "compiling")
