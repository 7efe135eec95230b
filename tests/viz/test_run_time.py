"""Messages stand at the time at which their contents were true, whatever the order of their arrival."""

from __future__ import annotations

import pickle

from hypothesis import given, settings
from hypothesis import strategies as st

from common.messages import Cause, Stamped
from viz.run_time import RunTime, When

MS = 1_000_000
START = 10**12


def message(capture_ms: float, *, seq: int = 0, cause: int | None = None, delay_ms: float = 1.0) -> Stamped[None]:
    capture = START + round(capture_ms * MS)
    origin = None if cause is None else Cause("boot", cause)
    return Stamped(None, capture, capture + round(delay_ms * MS), origin, "rig", "boot", seq)


def test_before_anything_moves_all_stands_at_the_start():
    time = RunTime()
    assert time.at(START) == time.at(START - 10**12) == When(0, 0.0)
    assert not time.started


@settings(max_examples=40, deadline=None)
@given(st.lists(st.floats(-4.0, 4.0), min_size=2, max_size=40))
def test_each_objects_message_at_10_hz_is_one_frame_in_spite_of_jitter(jitter):
    time = RunTime()
    frames = [time.begin(message(100 * n + j, seq=n)).frame for n, j in enumerate(jitter)]
    assert frames == list(range(len(jitter)))


@settings(max_examples=40, deadline=None)
@given(st.floats(-20.0, 20.0), st.integers(0, 9))
def test_what_objects_caused_stands_exactly_where_they_do(noise_ms, seq):
    time = RunTime()
    places = [time.begin(message(100 * n, seq=n)) for n in range(10)]
    assert time.of(message(100 * seq + noise_ms, cause=seq)) == places[seq]


def test_a_plan_stands_where_its_ego_was_captured_not_where_its_risk_was():
    time = RunTime()
    for n in range(3):
        time.begin(message(100 * n, seq=n))
    when = time.at(START + 250 * MS)
    assert when.frame == 2
    assert abs(when.t - 0.25) < 1e-9


def test_frames_go_on_without_objects_and_objects_fall_into_them_again():
    time = RunTime()
    time.begin(message(0))
    assert time.at(START + 950 * MS).frame == 8
    assert time.begin(message(1000, seq=1)).frame == 9


@settings(max_examples=40, deadline=None)
@given(st.lists(st.floats(0.0, 3000.0), min_size=1, max_size=60))
def test_later_is_never_an_earlier_frame(captures):
    time = RunTime()
    for n, capture in enumerate(sorted(captures)):
        time.begin(message(capture, seq=n))
    places = [time.at(START + round(ms * MS)) for ms in sorted(captures)]
    assert [p.frame for p in places] == sorted(p.frame for p in places)
    assert [p.t for p in places] == sorted(p.t for p in places)
    assert min(p.t for p in places) >= 0.0


def test_end_to_end_counts_from_our_receipt_of_the_objects():
    time = RunTime()
    time.begin(message(0, seq=7, delay_ms=3.0))
    assert time.since_objects_ms(Cause("boot", 7), START + 45 * MS) == 42.0
    assert time.since_objects_ms(Cause("boot", 8), START + 45 * MS) is None
    assert time.since_objects_ms(None, START) is None


def test_what_is_remembered_is_bounded():
    time = RunTime()
    for n in range(2000):
        time.begin(message(100 * n, seq=n))
    assert time.since_objects_ms(Cause("boot", 0), START) is None
    assert time.since_objects_ms(Cause("boot", 1999), START + 10**12) is not None


def test_a_drive_of_any_length_costs_no_more_memory_and_its_frames_are_counted_on():
    time = RunTime()
    time.begin(message(0))
    before = size_of(time)
    for n in range(1, 3000):
        assert time.begin(message(100 * n, seq=n)).frame == n
        if n == 1000:
            before = size_of(time)
    assert size_of(time) <= before * 1.1
    last = time.at(START + 299_950 * MS)
    assert last.frame == 2999 and abs(last.t - 299.95) < 1e-6
    assert time.at(START + 290_050 * MS).frame == 2900  # late by more than any topic allows


@settings(max_examples=40, deadline=None)
@given(st.lists(st.integers(1, 3000), min_size=1, max_size=8), st.integers(1, 400))
def test_a_long_silence_is_as_many_frames_as_many_short_ones(gaps, step):
    once, often = RunTime(), RunTime()
    now = 0
    for seq, gap in enumerate(gaps):
        assert once.begin(message(100 * now, seq=seq)) == often.begin(message(100 * now, seq=seq))
        for short in range(now, now + gap, step):
            often.at(START + short * 100 * MS)
        now += gap
        at = START + (now * 100 - 30) * MS
        assert once.at(at) == often.at(at)


def test_a_silence_of_a_month_is_placed_at_once():
    time = RunTime()
    time.begin(message(0))
    month_s = 30 * 86400
    assert time.at(START + month_s * 1000 * MS).frame == month_s * 10 - 1
    assert size_of(time) < 100_000


def size_of(time: RunTime) -> int:
    """What it holds, written out [bytes]."""
    return len(pickle.dumps(vars(time)))
