"""Surrounding risk: the reference's field at nine points, causal, the same in training and in service."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from common.messages import Objects
from common.risk import RiskParameters, straight_energy
from evaluation.trajectory_windows import Recorded, Recording, track_signals, windows
from services.predictor import signals
from services.predictor.history import Tracks, frames, observe
from services.predictor.leader import leader_signals
from services.predictor.learned import LearnedPredictor
from services.predictor.lstm import Architecture, Network
from services.predictor.settings import HistorySettings
from services.predictor.surrounding_risk import Scene, surrounding_risk
from services.predictor.weight_files import Loaded

sys.path.insert(0, str(Path(__file__).parent))
from made import traffic, turning

P = RiskParameters()


def scene_of(seed, n=8, spread=40.0):
    rng = np.random.default_rng(seed)
    heading = rng.uniform(-np.pi, np.pi, n)
    speed = np.where(rng.random(n) < 0.2, 0.0, rng.uniform(0, 25, n))
    course = heading + rng.normal(0, 0.1, n)
    return Scene(
        x=rng.uniform(-spread, spread, n), y=rng.uniform(-spread / 3, spread / 3, n), heading=heading,
        vx=speed * np.cos(course), vy=speed * np.sin(course), length=rng.uniform(0.5, 12, n),
        width=rng.uniform(0.5, 2.5, n), mass=np.where(rng.random(n) < 0.5, 0.0, 2000.0),
        cls=rng.integers(0, 7, n).astype(np.uint8),
    )  # fmt: skip


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10**6))
def test_the_nine_points_hold_the_reference_field_of_all_others(seed):
    s = scene_of(seed)
    speed = np.hypot(s.vx, s.vy)
    found = surrounding_risk(s, 3, P)
    for a in range(3):
        d = max(s.length[a], speed[a] * 1.0)
        others = np.arange(len(s.x)) != a
        k = 0
        for along in (-d, 0.0, d):
            for across in (-3.5, 0.0, 3.5):
                px = s.x[a] + along * np.cos(s.heading[a]) - across * np.sin(s.heading[a])
                py = s.y[a] + along * np.sin(s.heading[a]) + across * np.cos(s.heading[a])
                e = straight_energy(
                    px, py, x=s.x[others], y=s.y[others], heading=s.heading[others], vx=s.vx[others],
                    vy=s.vy[others], length=s.length[others], width=s.width[others], mass=s.mass[others],
                    cls=s.cls[others], to_vx=s.vx[a], to_vy=s.vy[a], p=P,
                )  # fmt: skip
                assert found[a, k] == pytest.approx(np.log1p(e.sum()), abs=1e-5)
                k += 1


def test_nobody_else_no_risk():
    s = scene_of(1, n=1)
    assert not surrounding_risk(s, 1, P).any() and not leader_signals(s, 1).any()


def test_a_slower_car_ahead_is_the_leader_and_one_in_the_next_lane_is_not():
    def pair(y, v):
        z = np.zeros(2)
        return Scene(np.array([0.0, 25.0]), np.array([0.0, y]), z, np.array([12.0, v]), z, z + 4.5, z + 1.8, z,
                     np.ones(2, np.uint8))  # fmt: skip

    near, crossing, _, slower, flow, *_ = leader_signals(pair(0.0, 7.0), 1)[0]
    assert near == pytest.approx(1 / (1 + 20.5 / 10)) and slower == pytest.approx(-1.0) == flow and crossing == 0
    assert leader_signals(pair(3.5, 7.0), 1)[0, 0] == 0


def service_signals(recording: Recording, last: int, shift_ns=0):
    """What the service samples when it hears the recording frame by frame."""
    loaded = Loaded("n", Network(Architecture(hidden=4)).eval(), (1.0, 1.0), frozenset())
    learned, tracks, history, ids = LearnedPredictor(loaded, P), Tracks.empty(), None, None
    for f in range(last + 1):
        here = [(i, t, f - t.frame0) for i, t in enumerate(recording.tracks) if 0 <= f - t.frame0 < len(t.x)]
        n = len(here)
        objects = Objects(
            id=np.array([i for i, _, _ in here], np.int64), cls=np.array([t.cls for _, t, _ in here], np.uint8),
            x=np.array([t.x[k] for _, t, k in here]), y=np.array([t.y[k] for _, t, k in here]),
            heading=np.array([t.heading[k] for _, t, k in here]), vx=np.zeros(n), vy=np.zeros(n),
            length=np.array([t.length for _, t, _ in here]), width=np.array([t.width for _, t, _ in here]),
            mass=np.zeros(n),
        )  # fmt: skip
        now = 10**9 + f * 10**8 + shift_ns
        tracks = observe(tracks, objects, now, HistorySettings())
        history = frames(tracks, objects.id)
        ids = objects.id
        learned.observe(objects, history, None, now)
    return ids, signals.history(learned._samples, ids)


def test_training_and_service_see_the_same_numbers():
    recording = Recording("r", "s", (*traffic(n=5, k=60).tracks, turning(45, 9.0, 0.0, y0=3.0, name="leaves early")))
    ids, served = service_signals(recording, 55)
    trained = track_signals(recording, P)
    for i, values in zip(ids, served, strict=True):
        np.testing.assert_allclose(values, trained[i][55:25:-1], atol=1e-6)
    assert len(ids) == 5 and np.abs(served).max() > 0.01


def test_what_comes_later_changes_nothing_that_is_seen_now():
    recording = traffic(n=4, k=110)
    before = windows([recording], P, stride=50)
    now = int(before.frame[0])
    bent = Recording("rec0", "made", tuple(
        Recorded(t.name, t.cls, t.length, t.width, t.frame0, np.where(np.arange(len(t.x)) > now, t.x + 5.0, t.x),
                np.where(np.arange(len(t.y)) > now, -t.y, t.y),
                np.where(np.arange(len(t.x)) > now, 1.0, t.heading)) for t in recording.tracks))  # fmt: skip
    after = windows([bent], P, stride=50)
    rows = before.frame == now
    assert rows.sum() == 4
    for name in ("x", "y", "heading", "signals"):
        np.testing.assert_array_equal(getattr(before, name)[rows], getattr(after, name)[rows])
    assert not np.array_equal(before.future[rows], after.future[rows])


def test_samples_start_anew_after_a_gap_and_ignore_what_is_old():
    def add(samples, t):
        return signals.observed(
            samples, int(t * 1e9), np.array([7]), np.full((1, signals.SIGNALS), t, np.float32), 10**9
        )

    s = add(add((), 10.0), 10.1)
    assert add(s, 10.05) == s
    assert len(add(s, 12.0)) == 1
    held = signals.history(s, np.array([7, 8]))
    assert held[0, 0, 0] == pytest.approx(10.1) and held[0, 1, 0] == pytest.approx(10.0)
    assert held[0, 29, 0] == pytest.approx(10.0) and not held[1].any()
