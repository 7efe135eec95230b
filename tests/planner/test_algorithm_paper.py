"""Algorithm 1, function by function, and its two traps."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from services.planner.algorithm import (
    SLICING_SPEED_FLOOR,
    choose,
    max_risk_searching,
    path_slicing,
    speed_calculating,
    trajectory_generating,
)
from services.planner.settings import PlannerSettings
from tests.planner.worlds import box, drive, ego_at, straight_route

STARTS = np.arange(13) * 0.5
STATIONS = np.arange(72) * 1.2


def test_a_path_is_sliced_by_the_time_at_which_its_points_are_reached():
    cut = path_slicing(STATIONS, 12.0, STARTS)
    assert cut[0] == 0
    assert cut[np.searchsorted(STATIONS, 12.0 * 2.0)] == 4  # 24 m at 12 m/s: 2 s, slice of 2.0 s
    assert np.all(np.diff(cut) >= 0)


def test_slices_do_not_collapse_at_standstill():
    assert np.array_equal(path_slicing(STATIONS, 0.0, STARTS), path_slicing(STATIONS, SLICING_SPEED_FLOOR, STARTS))
    assert len(np.unique(path_slicing(STATIONS, 0.0, STARTS))) == len(STARTS)


def test_the_highest_risk_of_a_slice_is_searched_in_that_slice_alone():
    risk = np.zeros((1, 13, 72), dtype=np.float32)
    cut = path_slicing(STATIONS, 12.0, STARTS)
    horizon = np.ones(72, dtype=bool)
    risk[0, 3, cut == 5] = 0.9  # there in slice 3, but the path comes by only in slice 5
    assert max_risk_searching(risk, cut, horizon).max() == 0.0
    risk[0, 5, np.flatnonzero(cut == 5)[0]] = 0.7
    found = max_risk_searching(risk, cut, horizon)[0]
    assert np.isclose(found[5], 0.7)
    assert np.isclose(found.sum(), 0.7)


@given(st.floats(0, 3), st.floats(0, 3), st.floats(0.1, 60))
def test_desired_speed_falls_with_risk_from_s_max_to_zero(a: float, b: float, s_max: float):
    low, high = min(a, b), max(a, b)
    fast, slow = speed_calculating(np.array([low, high]), s_max, 0.2, 0.9)
    assert 0.0 <= slow <= fast <= s_max
    assert speed_calculating(np.array([0.2]), s_max, 0.2, 0.9)[0] == s_max
    assert speed_calculating(np.array([0.9]), s_max, 0.2, 0.9)[0] == 0.0


def test_of_equally_fast_paths_the_reference_line_is_taken_then_the_previous_choice():
    reference, previous = np.array([False, False, True]), np.array([False, True, False])
    assert choose(np.array([5.0, 5.0, 5.0]), reference, previous) == 2
    assert choose(np.array([5.0, 5.0, 4.0]), reference, previous) == 1
    assert choose(np.array([6.0, 5.0, 4.0]), reference, previous) == 0


@settings(max_examples=15, deadline=None)
@given(st.floats(0, 30), st.floats(0, 30))
def test_a_generated_motion_keeps_its_limits_and_arrives(speed: float, desired: float):
    motion = trajectory_generating(
        speed,
        0.0,
        desired,
        np.full(400, 100.0),
        1.0,
        accel=1.0,
        brake=3.0,
        jerk=1.5,
        tau=1.0,
        duration=60.0,
    )
    assert np.all(motion.speed >= 0.0)
    assert np.all(motion.acceleration <= 1.0 + 1e-9)
    assert np.all(motion.acceleration >= -3.0 - 1e-9)
    assert abs(motion.speed[-1] - desired) < 0.45


def test_the_paper_planner_drives_and_says_its_name():
    d = drive([box(60, 3.0)], straight_route(), ego_at(0, 0, 0, 8), seconds=2.0, settings=PlannerSettings(name="paper"))
    assert set(d.modes) == {"drive"}
    assert all(p.planner == "paper" for p in d.plans)
    assert d.x[-1] > 12.0
