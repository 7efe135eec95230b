"""Nothing twice, nothing backwards, nothing of a replaced process; ages without wall clocks."""

from __future__ import annotations

import itertools

import pytest
from hypothesis import given
from hypothesis import strategies as st

from common.age import WINDOW_NS, TransitClock
from common.codec import RefusedError
from common.messages import Header
from common.order import Order

MS = 1_000_000


def header(boot: str, seq: int) -> Header:
    return Header(schema="ego", version=(1, 0), source="v", boot=boot * 8, seq=seq, capture_ns=0, sent_ns=0, age_ns=0)


def take(order: Order, boot: str, seq: int) -> str:
    try:
        order.check(header(boot, seq))
    except RefusedError as e:
        return e.reason
    order.accept(header(boot, seq))
    return "used"


def test_repeated_reordered_and_replaced_senders_are_told_apart() -> None:
    order = Order()
    got = [
        take(order, b, s) for b, s in [("a", 0), ("a", 2), ("a", 2), ("a", 1), ("b", 0), ("a", 3), ("b", 1), ("a", 9)]
    ]
    assert got == ["used", "used", "duplicate", "reordered", "used", "old_boot", "used", "old_boot"]


def test_a_header_whose_body_was_refused_replaces_nobody() -> None:
    order = Order()
    assert take(order, "a", 0) == "used"
    order.check(header("z", 5))  # good header, but never accepted
    assert take(order, "a", 1) == "used"


@given(st.lists(st.tuples(st.sampled_from("abc"), st.integers(0, 5)), max_size=40))
def test_used_sequence_numbers_never_go_back_and_boots_never_return(messages: list[tuple[str, int]]) -> None:
    order, used = Order(), []
    for boot, seq in messages:
        if take(order, boot, seq) == "used":
            used.append((boot, seq))
    for (b0, s0), (b1, s1) in itertools.pairwise(used):
        assert b1 != b0 or s1 > s0
    boots = [b for i, (b, _) in enumerate(used) if i == 0 or used[i - 1][0] != b]
    assert len(boots) == len(set(boots))


def test_time_in_a_queue_is_added_and_the_offset_of_two_clocks_is_not() -> None:
    clock, offset = TransitClock(), 123_456_789_000
    assert clock.excess_ns("v", "b", 0, offset + 2 * MS) == 0
    assert clock.excess_ns("v", "b", 100 * MS, offset + 152 * MS) == 50 * MS
    assert clock.excess_ns("v", "b", 200 * MS, offset + 201 * MS) == 0
    assert clock.excess_ns("v", "b", 300 * MS, offset + 302 * MS) == 1 * MS


def test_the_minimum_is_forgotten_after_thirty_seconds_so_drifting_clocks_stay_usable() -> None:
    clock = TransitClock()
    assert clock.excess_ns("v", "b", 0, 0) == 0
    assert clock.excess_ns("v", "b", WINDOW_NS // 2, WINDOW_NS // 2 + 5 * MS) == 5 * MS
    assert clock.excess_ns("v", "b", WINDOW_NS + 1, WINDOW_NS + 1 + 5 * MS) == 0


@given(st.lists(st.integers(0, 10**9), min_size=1, max_size=60), st.integers(-(10**15), 10**15))
def test_excess_is_never_negative_and_does_not_depend_on_the_offset(delays: list[int], offset: int) -> None:
    a, b = TransitClock(), TransitClock()
    for i, delay in enumerate(delays):
        sent = i * 100 * MS
        one, two = a.excess_ns("v", "b", sent, sent + delay), b.excess_ns("v", "b", sent, sent + delay + offset)
        assert one == two >= 0


@pytest.mark.parametrize("senders", [10_000])
def test_many_senders_do_not_grow_memory(senders: int) -> None:
    clock = TransitClock()
    for i in range(senders):
        clock.excess_ns("v", str(i), 0, 0)
    assert len(clock._seen) <= 256
