"""The kernels equal their NumPy reference: what paths meet, and how motions roll out and where they fail."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from common.messages import NO_SLOT, Grid, Risk, Slot
from services.planner.bezier import Start
from services.planner.footprint import Footprint, path_risk, timed_risk
from services.planner.rollout import Tier, roll_out
from services.planner.settings import PlannerSettings
from services.planner.volume import Volume
from tests.planner.test_planner_search import blobs, field_of
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
    np.testing.assert_array_equal(fast.failed_at[fast.failure > 0], slow.failed_at[slow.failure > 0])
