"""The kernels equal their NumPy reference: paths, what they meet, how motions roll out, what the search finds."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from common.messages import NO_SLOT, Grid, Risk, Slot
from services.planner.beside import beside_law
from services.planner.bezier import Start, Target, build_paths
from services.planner.contact import Contact
from services.planner.footprint import Footprint, path_risk, timed_risk
from services.planner.reference import ReferenceLine
from services.planner.rollout import Tier, judge, roll_out
from services.planner.search import highest
from services.planner.settings import PlannerSettings
from services.planner.speed import brake_before
from services.planner.volume import NOBODY, Volume
from tests.planner.test_planner_search import POINTS, STARTS, STEP, blobs, field_of
from tests.planner.worlds import ego_at

SETTINGS = PlannerSettings()

pytest.importorskip("warp", reason="the planner's kernels need warp; without it NumPy is used")


def volume_of(rng: np.random.Generator, dtype: type) -> Volume:
    rows, columns, slices = 60, 40, 7
    grid = Grid(x=-8.0, y=-9.0, heading=float(rng.uniform(-3, 3)), rows=rows, columns=columns, h=0.5)
    volume = (rng.random((slices, rows, columns)) ** 6 * 2.0).astype(dtype)
    slots = [Slot(1, "potential", 1), Slot(1, "kinetic", 1), Slot(2, "potential", 1), Slot(-1, "static", -1, "other")]
    dominant = rng.choice([0, 1, 2, 3, NO_SLOT], (slices, 15, 10)).astype(np.uint8)
    risk = Risk(
        grid=grid, slice_times=[0.5 * j for j in range(slices)], slots=slots, volume=volume, dominant=dominant
    )  # fmt: skip
    return Volume.of(risk, 0, round(rng.uniform(0, 1.2e9)))


@settings(max_examples=25)
@given(st.integers(0, 2**32 - 1), st.sampled_from([np.float16, np.float32]))
def test_looking_up_in_the_kernel_equals_numpy(seed: int, dtype: type) -> None:
    rng = np.random.default_rng(seed)
    volume, footprint = volume_of(rng, dtype), Footprint.of(ego_at(0.0, 0.0), 0.9, 0.15)
    x, y = rng.uniform(-15, 25, (4, 9)), rng.uniform(-15, 25, (4, 9))
    heading = rng.uniform(-7, 7, (4, 9))
    leaves = rng.random(4) < 0.5
    fast = path_risk(volume, footprint, x, y, heading, 1.0, leaves=leaves)
    slow = path_risk(volume, footprint, x, y, heading, 1.0, leaves=leaves, reference=True)
    for name in ("risk", "stays", "contact", "ahead", "sides"):
        np.testing.assert_allclose(getattr(fast, name), getattr(slow, name), atol=2e-6, err_msg=name)
    np.testing.assert_array_equal(fast.known, slow.known)
    assert fast.who is not None
    assert slow.who is not None
    assert np.mean(fast.who != slow.who) < 0.01  # of two samples as high as each other either may be named
    assert slow.ahead is not None
    t = rng.uniform(0, 5, 9)
    risk, _ = timed_risk(volume, footprint, x[0], y[0], heading[0], t)
    np.testing.assert_allclose(risk, slow.ahead[0, volume.slice_at(t), np.arange(9)], atol=2e-6)


@settings(max_examples=40)
@given(st.integers(0, 2**32 - 1), st.integers(0, 5), st.floats(0, 25), st.floats(-6, 1))
def test_rolling_out_in_the_kernel_equals_numpy(seed: int, tier: int, speed: float, acceleration: float) -> None:
    rng = np.random.default_rng(seed)
    field = field_of(blobs(rng, 5))
    start = Start(0.0, 0.0, 0.0, 0.0, speed, acceleration)
    path = rng.integers(0, 5, 60)
    target, hold = rng.uniform(0, 16, 60), rng.choice([0.0, 1.5, np.inf], 60)
    fast = roll_out(field, start, path, target, hold, Tier.all(SETTINGS)[tier], SETTINGS)
    slow = roll_out(field, start, path, target, hold, Tier.all(SETTINGS)[tier], SETTINGS, reference=True)
    for name in ("t", "distance", "speed", "acceleration"):
        np.testing.assert_allclose(getattr(fast, name), getattr(slow, name), atol=1e-9, err_msg=name)
    np.testing.assert_array_equal(fast.failure, slow.failure)
    failure, failed_at = judge(field, start, path, target, hold, Tier.all(SETTINGS)[tier], SETTINGS)
    np.testing.assert_array_equal(failure, slow.failure)
    np.testing.assert_array_equal(failed_at[failure > 0], slow.failed_at[failure > 0])
    np.testing.assert_array_equal(fast.failed_at[fast.failure > 0], slow.failed_at[slow.failure > 0])


@settings(max_examples=30)
@given(st.integers(0, 2**32 - 1), st.integers(0, 5), st.floats(0, 25), st.floats(-6, 1))
def test_the_search_in_the_kernel_finds_what_numpy_finds(
    seed: int, tier: int, speed: float, acceleration: float
) -> None:
    rng = np.random.default_rng(seed)
    field, start = field_of(blobs(rng, 12)), Start(0.0, 0.0, 0.0, 0.0, speed, acceleration)
    path = rng.permutation(12)[:9]
    go, stop = highest(field, start, path, Tier.all(SETTINGS)[tier], SETTINGS)
    slow_go, slow_stop = highest(field, start, path, Tier.all(SETTINGS)[tier], SETTINGS, reference=True)
    faster = slow_stop.passed & (~slow_go.passed | (slow_stop.desired > slow_go.desired))
    all_paths = np.ones(len(path), dtype=bool)
    for fast, slow, where in ((go, slow_go, all_paths), (stop, slow_stop, faster)):
        for name in ("passed", "failure", "failed_at"):
            np.testing.assert_array_equal(getattr(fast, name)[where], getattr(slow, name)[where], err_msg=name)
        for name in ("desired", "rest", "failed_distance", "hold"):
            np.testing.assert_allclose(getattr(fast, name)[where], getattr(slow, name)[where], atol=1e-9, err_msg=name)
    # where stopping could not be faster it may be told to fail, and is never told to be
    assert np.all(faster | ~stop.passed | (stop.desired <= np.where(go.passed, go.desired, np.inf)))


@settings(max_examples=25)
@given(st.integers(0, 2**32 - 1))
def test_contact_and_law_in_the_kernel_equal_numpy(seed: int) -> None:
    rng = np.random.default_rng(seed)
    risk = blobs(rng, 3).astype(np.float32) + rng.random((3, 13, POINTS)).astype(np.float32) * 0.3
    who = np.where(risk > 0.5, rng.integers(0, 3, (3, 13, 1)), NOBODY).astype(np.uint8)
    fast, slow = (Contact.of(risk, who, STARTS, 0.8, STEP, reference=r) for r in (False, True))
    for name in ("distance", "rate", "away"):
        np.testing.assert_allclose(getattr(fast, name), getattr(slow, name), rtol=1e-5, atol=1e-4, err_msg=name)
    sides, whose = np.stack((risk, risk[::-1])), np.stack((who, who[::-1]))
    args = (sides, whose, STARTS, STEP, 14.0, 0.2, 0.9, 0.9)
    for a, b in zip(beside_law(*args), beside_law(*args, reference=True), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-4)


@settings(max_examples=25)
@given(st.integers(0, 2**32 - 1), st.floats(0.4, 2.2))
def test_paths_of_the_kernel_equal_numpy(seed: int, step: float) -> None:
    rng = np.random.default_rng(seed)
    turns = np.cumsum(rng.normal(0.0, 0.06, 120))
    line = ReferenceLine.of(np.cumsum(np.stack((np.cos(turns), np.sin(turns)), axis=1), axis=0) * 1.3)
    s = rng.uniform(0, 40) + 0.5 * step * np.arange(216)
    wave = 2.0 * np.sin(s / 15.0)
    kinds = [
        Target("a", np.full_like(s, 1.6), np.zeros_like(s), np.zeros_like(s)),
        Target("b", wave, np.cos(s / 15.0) * 2.0 / 15.0, -wave / 225.0),
    ]
    targets, lengths = [kinds[i] for i in (0, 1, 0)], np.array([9.0, 24.0, 60.0])
    start = (float(s[0]), float(rng.normal(0, 1.5)), float(rng.normal(0, 0.2)), float(rng.normal(0, 0.03)))
    fast, slow = (
        build_paths(line, s, start, targets, lengths, step=step, points=72, max_curvature=0.24, reference_form=r)
        for r in (False, True)
    )
    assert fast.target == slow.target
    for name in ("x", "y", "heading", "curvature", "s", "d", "end"):
        np.testing.assert_allclose(getattr(fast, name), getattr(slow, name), atol=1e-8, err_msg=name)
    cap = rng.uniform(0, 20, (3, 72))
    np.testing.assert_allclose(brake_before(cap, step, 1.0), brake_before(cap, step, 1.0, reference=True), atol=1e-9)
