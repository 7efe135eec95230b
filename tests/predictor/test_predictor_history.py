"""Histories: frames by time, gaps, identity, causality."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from common.messages import ObjectClass
from services.predictor.history import Tracks, frames, observe
from services.predictor.settings import HistorySettings
from tests.predictor.scenes import objects_of

S = HistorySettings()


def feed(samples, tracks=None, **kinds):
    """Observe (t, x, y, speed) of object 7."""
    tracks = tracks or Tracks.empty()
    for t, x, y, v in samples:
        tracks = observe(tracks, objects_of([(x, y, 0.0, v)], ids=[7], **kinds), round(t * 1e9), S)
    return tracks


def history(tracks):
    return frames(tracks, np.array([7]))


@given(
    dt=st.floats(0.011, 0.4),
    jitter=st.lists(st.floats(-0.3, 0.3), min_size=120, max_size=120),
    v=st.floats(-40.0, 40.0),
)
@settings(max_examples=40, deadline=None)
def test_frames_count_by_time_at_any_message_rate(dt, jitter, v):
    times = np.cumsum(dt * (1.0 + np.asarray(jitter)))
    h = history(feed([(t, v * t, 0.0, v) for t in times]))
    k = np.arange(30)
    reached = times[-1] - 0.1 * k >= max(times[0], times[-1] - 2.9) - 1e-6
    assert (h.valid[0] <= reached).all()
    if dt * 0.7 * 119 > 3.2:
        assert h.valid[0].all()
    expected = v * (times[-1] - 0.1 * k)
    np.testing.assert_allclose(h.x[0][h.valid[0]], expected[h.valid[0]], atol=1e-5)


def test_a_steady_10_hz_history_is_the_samples():
    x = np.cumsum(np.random.default_rng(1).uniform(0.5, 1.0, 45))
    h = history(feed([(0.1 * i, x[i], -x[i], 7.0) for i in range(45)]))
    assert h.valid.all()
    assert h.seen.all()
    np.testing.assert_allclose(h.x[0], x[:-31:-1], atol=1e-5)
    np.testing.assert_allclose(h.y[0], -x[:-31:-1], atol=1e-5)


def test_a_short_gap_is_interpolated_and_marked():
    kept = [i for i in range(30) if i not in (20, 21, 22)]
    h = history(feed([(0.1 * i, 0.8 * i, 0.0, 8.0) for i in kept]))
    assert h.valid.all()
    np.testing.assert_allclose(h.x[0], 0.8 * (29 - np.arange(30)), atol=1e-6)
    assert list(np.flatnonzero(~h.seen[0])) == [7, 8, 9]


def test_after_a_long_gap_the_track_starts_anew():
    t = feed([(0.1 * i, 0.8 * i, 0.0, 8.0) for i in range(30)])
    others = objects_of([(500.0, 0.0, 0.0, 0.0)], ids=[1])
    for i in range(12):
        t = observe(t, others, round((3.0 + 0.1 * i) * 1e9), S)
    assert 7 not in t.id
    h = history(feed([(4.2, 0.8 * 42, 0.0, 8.0)], t))
    assert h.steps[0] == 0


def test_an_object_missing_from_few_messages_keeps_its_track():
    t = feed([(0.1 * i, 0.8 * i, 0.0, 8.0) for i in range(30)])
    nothing = objects_of([])
    for i in range(5):
        t = observe(t, nothing, round((3.0 + 0.1 * i) * 1e9), S)
    assert list(t.id) == [7]
    h = history(feed([(3.5, 0.8 * 35, 0.0, 8.0)], t))
    assert h.valid.all()
    assert not h.seen[0, 1:5].any()


@pytest.mark.parametrize(
    ("after", "same"),
    [
        ({"cls": ObjectClass.PEDESTRIAN}, False),
        ({"cls": ObjectClass.BICYCLE}, False),
        ({"cls": ObjectClass.TRUCK}, True),  # a classifier that wavers
        ({"cls": ObjectClass.UNKNOWN}, True),
        ({"length": 12.0}, False),
        ({"width": 4.0}, False),
        ({"length": 5.0, "width": 2.0}, True),
    ],
)
def test_another_kind_or_size_under_the_same_id_is_another_object(after, same):
    t = feed([(0.1 * i, 0.8 * i, 0.0, 8.0) for i in range(20)])
    t = feed([(2.0, 16.0, 0.0, 8.0)], t, **after)
    assert bool(history(t).steps[0] == 20) is same
    if not same:
        assert history(t).steps[0] == 0


@given(v=st.floats(0.0, 40.0), jump=st.floats(3.0, 1e6), angle=st.floats(0.0, 6.3), n=st.integers(2, 40))
@settings(max_examples=60, deadline=None)
def test_a_teleport_starts_a_new_track(v, jump, angle, n):
    t = feed([(0.1 * i, v * 0.1 * i, 0.0, v) for i in range(n)])
    x, y = v * 0.1 * n + jump * np.cos(angle), jump * np.sin(angle)
    assert history(feed([(0.1 * n, x, y, v)], t)).steps[0] == 0


@given(v=st.floats(0.0, 40.0), a=st.floats(-10.0, 6.0), noise=st.floats(0.0, 0.15), seed=st.integers(0, 99))
@settings(max_examples=40, deadline=None)
def test_hard_braking_and_noise_are_no_teleport(v, a, noise, seed):
    rng = np.random.default_rng(seed)
    speed = np.maximum(v + a * 0.1 * np.arange(40), 0.0)
    x = np.cumsum(speed) * 0.1 + rng.normal(0.0, noise, 40)
    t = feed([(0.1 * i, x[i], rng.normal(0.0, noise), speed[i]) for i in range(40)])
    assert history(t).valid.all()


def test_velocities_that_are_never_sent_do_not_break_tracks():
    t = feed([(0.1 * i, 3.0 * i, 0.0, 0.0) for i in range(40)])
    assert history(t).valid.all()


def test_older_captures_are_ignored_and_repeated_ones_change_nothing():
    samples = [(0.1 * i, 0.8 * i, 0.0, 8.0) for i in range(35)]
    t = feed(samples)
    assert feed([(3.3, 77.0, 5.0, 0.0)], t) is t
    again = feed([samples[-1]], t)
    for name in ("t_ns", "x", "y", "heading", "count", "id"):
        np.testing.assert_array_equal(getattr(again, name), getattr(t, name))


def test_a_clock_that_was_set_back_starts_everything_anew():
    t = feed([(100.0 + 0.1 * i, 0.8 * i, 0.0, 8.0) for i in range(35)])
    t = feed([(5.0 + 0.1 * i, 0.8 * i, 0.0, 8.0) for i in range(10)], t)
    assert history(t).steps[0] == 9


@pytest.mark.parametrize("end", [2**62, -(2**62)])
def test_any_capture_time_that_a_header_may_hold_is_taken(end):
    t = feed([(0.0, 1.0, 2.0, 3.0)])
    t = observe(t, objects_of([(1.0, 2.0, 0.0, 3.0)], ids=[7]), end, S)
    t = observe(t, objects_of([(1.0, 2.0, 0.0, 3.0)], ids=[7]), -end, S)
    assert history(t).steps[0] == 0


def test_tracks_not_seen_are_forgotten_however_many_there_were():
    t = Tracks.empty()
    for i in range(60):
        message = objects_of([(float(k), 0.0, 0.0, 0.0) for k in range(1000)], ids=range(1000 * i, 1000 * i + 1000))
        t = observe(t, message, round(0.01 * i * 1e9), S)
    assert len(t.id) <= 1000 + 2048
    t = observe(t, objects_of([]), round(5e9), S)
    assert len(t.id) == 0


def test_observing_leaves_the_old_state_as_it_was():
    t = feed([(0.1 * i, 0.8 * i, 0.0, 8.0) for i in range(20)])
    before = {name: np.copy(getattr(t, name)) for name in ("t_ns", "x", "y", "heading", "count", "id")}
    feed([(2.0, 16.0, 0.0, 8.0), (2.1, 16.8, 0.0, 8.0)], t)
    for name, value in before.items():
        np.testing.assert_array_equal(getattr(t, name), value)
