"""Frames, latencies and periods read off headers."""

from __future__ import annotations

from collections import Counter

from hypothesis import given, settings
from hypothesis import strategies as st

from common.messages import Cause, Header
from common.topics import TOPICS
from rig.statuses import by_topic
from rig.tally import Tally, quantiles

MS = 1_000_000


def header(schema: str, seq: int, cause: int | None, work_ms: float = 0.0, boot: str = "rigsboot") -> Header:
    return Header(
        schema=schema,
        version=(1, 0),
        source="x",
        boot="otherboot",
        seq=seq,
        capture_ns=0,
        sent_ns=0,
        age_ns=0,
        work_ns=round(work_ms * MS),
        cause=None if cause is None else Cause(boot, cause),
    )


def started() -> Tally:
    tally = Tally("rigsboot")
    tally.begin()
    return tally


@given(st.lists(st.integers(1, 4), min_size=1, max_size=40), st.integers(1, 200))
@settings(max_examples=50)
def test_only_the_first_plan_on_a_cause_counts_for_latency_and_period(repeats, delay_ms):
    tally = started()
    for seq, times in enumerate(repeats):
        sent = seq * 1000 * MS
        tally.put(Cause("rigsboot", seq), sent)
        for i in range(times):
            tally.saw("plan", header("plan", 4 * seq + i, seq), sent + (delay_ms + 50 * i) * MS)
    assert tally.frames["plan"] == sum(repeats)
    assert tally.end_to_end_ms == [delay_ms] * len(repeats)
    expected = 1000.0 if len(repeats) > 1 else None
    assert tally.period_ms() == {"p50": expected, "p99": expected}


def test_plans_on_older_causes_foreign_causes_and_without_cause_have_no_latency():
    tally = started()
    for seq in (0, 1):
        tally.put(Cause("rigsboot", seq), 0)
    tally.saw("plan", header("plan", 0, 1), 30 * MS)
    tally.saw("plan", header("plan", 1, 0), 40 * MS)
    tally.saw("plan", header("plan", 2, None), 50 * MS)
    tally.saw("plan", header("plan", 3, 2, boot="anothers"), 60 * MS)
    assert tally.end_to_end_ms == [30.0]
    assert tally.frames["plan"] == 4


def test_what_was_sent_before_the_beginning_is_not_counted():
    tally = Tally("rigsboot")
    tally.put(Cause("rigsboot", 0), 0)
    tally.saw("risk", header("risk", 0, 0, work_ms=99), 10 * MS)
    tally.begin()
    tally.saw("plan", header("plan", 0, 0), 10 * MS)
    assert tally.frames == Counter({"plan": 1})
    assert tally.end_to_end_ms == []
    assert tally.latency_ms()["riskfield"]["p50"] is None


def test_a_stage_latency_is_its_work():
    tally = started()
    for i in range(101):
        tally.saw("prediction", header("prediction", i, None, work_ms=float(i)), i)
    assert tally.latency_ms()["predictor"] == {"p50": 50.0, "p95": 95.0, "p99": 99.0, "max": 100.0}


def test_quantiles_of_nothing_are_unknown_not_zero():
    assert quantiles([]) == {"p50": None, "p95": None, "p99": None, "max": None}


def test_counters_are_sorted_into_refused_and_skipped_of_all_receivers():
    counters = [
        Counter({"ego:overwritten": 3, "ego:stale": 1, "plan:sent": 9, "mode:drive": 4}),
        Counter({"ego:overwritten": 2, "status/viz:overwritten": 1, "step:ValueError": 2}),
    ]
    refused, skipped = by_topic(counters, TOPICS)
    assert refused == {"ego": {"stale": 1}}
    assert skipped == {"ego": {"overwritten": 5}, "status/viz": {"overwritten": 1}}
