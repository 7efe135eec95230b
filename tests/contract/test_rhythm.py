"""When a loop steps next, whatever the times: never later than it may, never just before its trigger."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from common.rhythm import Rhythm, sooner_ns
from common.service import Service
from common.topics import MAP, OBJECTS, PREDICTION

MS = 1_000_000
times = st.integers(0, 10**15)


def of(period: int, interval: int | None, grace: int) -> Rhythm:
    return Rhythm(period * MS, None if interval is None else interval * MS, grace * MS)


@given(times, st.integers(1, 500), st.one_of(st.none(), st.integers(1, 500)), st.integers(0, 100), st.booleans())
def test_the_next_step_is_due_a_period_later_or_at_most_two_graces_after_that(
    now: int, period: int, interval: int | None, grace: int, triggered: bool
) -> None:
    rhythm = of(period, interval, grace)
    rhythm.due_ns(now - 37 * MS, True)
    due = rhythm.due_ns(now, triggered) - now
    assert period * MS <= due <= (period + 2 * grace) * MS


@given(times, st.integers(20, 200), st.integers(1, 9))
def test_no_step_falls_between_a_grace_before_and_a_grace_after_the_trigger_that_is_expected(
    start: int, interval: int, grace: int
) -> None:
    rhythm = of(interval // 2, interval, grace)
    second = rhythm.due_ns(start, True)
    assert second == start + interval // 2 * MS, "far from the next trigger nothing waits"
    third = rhythm.due_ns(second, False)
    assert third == start + (interval + grace) * MS


@given(times, st.integers(1, 500), st.integers(0, 100))
def test_without_a_trigger_the_rhythm_is_the_period(now: int, period: int, grace: int) -> None:
    assert of(period, 100, grace).due_ns(now, False) == now + period * MS
    assert of(period, None, grace).due_ns(now, True) == now + period * MS


def test_a_trigger_that_fails_to_come_is_waited_for_once() -> None:
    rhythm = of(50, 100, 10)
    now, steps = rhythm.due_ns(0, True), []
    for _ in range(5):
        steps.append(now // MS)
        now = rhythm.due_ns(now, False)
    assert steps == [50, 110, 160, 210, 260]


@given(times, times, st.one_of(st.none(), times))
def test_a_step_asked_for_again_is_due_then_unless_it_is_due_before_or_that_is_over(
    now: int, later: int, again: int | None
) -> None:
    due = now + later
    found = sooner_ns(due, again, now)
    assert found == (due if again is None or not now < again < due else again)


def test_triggers_are_expected_at_the_middle_of_their_topics_rates() -> None:
    def service(trigger):
        return Service("s", (), PREDICTION, trigger, 0.1, lambda tree, health: lambda inputs: None, grace_s=0.02)

    assert service(OBJECTS).rhythm().due_ns(0, True) == 120 * MS
    assert service(MAP).rhythm().due_ns(0, True) == 100 * MS
