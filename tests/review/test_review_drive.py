"""What was in force when, where a drive is cut, and which slow-downs of two drives belong together."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

pytest.importorskip("rerun")

from evaluation.review.charts import thin
from evaluation.review.compare import matched
from evaluation.review.compare import settings as differing
from evaluation.review.drive import drive_of
from evaluation.review.recording import Recording, Spoken, States
from rig.interventions import Intervention, Reason
from viz.account import Said


def states(t: np.ndarray, x: np.ndarray, v: np.ndarray) -> States:
    zero = np.zeros(len(t))
    return States(t, x, zero, zero, v, zero, zero, zero)


def recording(ego: States, plans: list[Spoken]) -> Recording:
    none = np.zeros(0)
    return Recording(
        (Path("made.rrd"),), "made", {}, ego, (4.5, 1.8), [], [], plans, {}, {}, (none, none), 1.0, 1.5, (0.0, 0.0)
    )


def plan(t: float, received: float, mode: str = "drive", reason: str = "") -> Spoken:
    return Spoken(t, received, 1.0, 0.1, Said(mode=mode, reason=reason, planner="", desired_speed=1.0))


def steady(seconds: float = 10.0, v: float = 10.0) -> States:
    t = np.arange(round(seconds / 0.02) + 1) * 0.02
    return states(t, v * t, np.full(len(t), v))


def test_the_plan_in_force_is_the_newest_that_had_come_and_a_silent_planner_gives_none() -> None:
    plans = [plan(0.0, 0.05, reason="first"), plan(0.1, 0.55, reason="late"), plan(0.5, 0.52, reason="second")]
    drive = drive_of(recording(steady(2.0), sorted(plans, key=lambda p: p.received)))
    told = [None if p is None else p.said.reason for p in drive.in_force]
    said = dict(zip((round(float(t), 2) for t in drive.states.t), told, strict=True))
    assert said[0.04] is None and said[0.06] == "first" and said[0.3] == "first"
    assert said[0.32] is None  # older than a plan may be
    assert said[0.54] == "second" and said[0.56] is None  # what came last rests on an older ego and is too old
    assert drive.mode_seconds()["drive"] + drive.mode_seconds()["waiting"] == pytest.approx(2.0)


def test_runs_recorded_one_after_another_are_told_apart() -> None:
    one, pause = steady(5.0), 3.0
    again = states(one.t + 5.02, one.x, one.speed)  # back at the start at once: the same scenario in a loop
    third = states(one.t + 10.04 + pause, one.x + 100.0, one.speed)
    parts = (one, again, third)
    whole = States(*(np.concatenate([getattr(p, name) for p in parts]) for name in vars(one)))
    drive = drive_of(recording(whole, []))
    assert len(drive.legs) == 3
    assert drive.distance_m == pytest.approx(150.0, abs=0.5)
    assert drive.interventions == []


def slow(t: float, source: int | None = None) -> Intervention:
    return Intervention(t, t + 1.0, "slow", 10.0, 8.0, Reason("drive", "", source, "potential", 0.0), t)


times = st.lists(st.tuples(st.floats(0, 60), st.none() | st.integers(1, 4)), max_size=8)


@given(times, times)
@settings(max_examples=100, deadline=None)
def test_every_slow_down_stands_in_the_comparison_exactly_once(a, b) -> None:
    one, other = [slow(t, s) for t, s in a], [slow(t, s) for t, s in b]
    pairs = matched(one, other)
    assert sorted(map(id, one)) == sorted(id(i) for i, _ in pairs if i is not None)
    assert sorted(map(id, other)) == sorted(id(j) for _, j in pairs if j is not None)
    assert all(abs(i.t - j.t) <= 4.0 for i, j in pairs if i is not None and j is not None)


@given(times)
@settings(max_examples=50, deadline=None)
def test_a_drive_compared_with_itself_differs_in_nothing(a) -> None:
    one = [slow(t, s) for t, s in a]
    assert all(i is not None and j is not None and abs(i.t - j.t) < 1e-9 for i, j in matched(one, list(one)))


def test_a_common_source_goes_before_a_smaller_distance_in_time() -> None:
    pairs = matched([slow(10.0, 3)], [slow(9.0, 4), slow(11.5, 3)])
    assert [(i and i.t, j and j.t) for i, j in pairs] == [(None, 9.0), (10.0, 11.5)]


def test_only_settings_of_the_drive_differ() -> None:
    a = {"planner": {"name": "paper", "gap": 3.0}, "viz": {"record": "a.rrd"}, "rig": {"seed": 0}}
    b = {"planner": {"name": "default", "gap": 3.0}, "viz": {"record": "b.rrd"}}
    assert differing(a, b) == {"planner.name": {"a": "paper", "b": "default"}}


@given(st.integers(3000, 20_000), st.integers(0, 2**31))
@settings(max_examples=15, deadline=None)
def test_a_thinned_curve_keeps_its_peaks(n: int, seed: int) -> None:
    v = np.random.default_rng(seed).standard_normal(n)
    t, w = thin(np.arange(n) * 0.02, v)
    assert len(t) <= 2500 and np.all(np.diff(t) > 0)
    assert w.max() == v.max() and w.min() == v.min()
