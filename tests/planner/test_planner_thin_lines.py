"""A closed line is contact only where the bumper is nearly on it: none may lie between two poses that are looked at."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from common.messages import Plan, Trajectory
from services.planner.bezier import Start
from services.planner.footprint import Footprint, path_risk
from services.planner.safe_stop import safe_stop
from services.planner.settings import PlannerSettings
from services.planner.trajectory import brake_motion
from services.planner.validator import validate
from services.planner.volume import Volume
from tests.planner.worlds import LENGTH, box, ego_at, risk_of

SETTINGS = PlannerSettings()
EGO = ego_at(0.0, 0.0, 0.0, 8.0)
SMALL = {"ahead": 40.0, "behind": 10.0, "width": 8.0}
FRONT = EGO.wheelbase / 2 + EGO.length / 2  # m, before the rear axle


def met(line: float, step: float) -> tuple[np.ndarray, np.ndarray, float]:
    """Contact at poses `step` apart with a closed line across the way at `line`, where the front is [m], and r_hit."""

    def across(px: np.ndarray, py: np.ndarray) -> np.ndarray:
        return 1.5 / 0.36 * (0.6 - np.minimum(0.6, np.abs(px - line))) ** 2

    volume = Volume.of(risk_of(EGO, [], h=0.25, statics=across, **SMALL), 0, 0)
    x = step * np.arange(16)[None] - EGO.wheelbase / 2
    foot = Footprint.of(EGO, SETTINGS.footprint_spacing, SETTINGS.flank_margin, 1.0, step)
    found = path_risk(volume, foot, x, np.zeros_like(x), np.zeros_like(x), step)
    assert found.contact is not None
    assert found.ahead is not None
    return np.minimum(found.contact[0, 0], found.ahead[0, 0]), x[0] + FRONT, SETTINGS.r_hit


@settings(max_examples=40)
@given(st.floats(6.0, 11.0), st.floats(SETTINGS.step_min, SETTINGS.step_max))
def test_no_closed_line_lies_between_two_poses(line: float, step: float):
    contact, front, r_hit = met(line, step)
    hit = np.flatnonzero(contact >= r_hit)
    assert len(hit)
    assert abs(front[hit[0]] - line) <= step + 0.2


def test_points_behind_the_bumper_change_nothing_about_bodies():
    volume = Volume.of(risk_of(EGO, [box(18.0, 0.3), box(12.0, 2.4), box(30.0, -1.9, 3.0)], h=0.25, **SMALL), 0, 0)
    x = 1.1 * np.arange(26)[None] - EGO.wheelbase / 2
    zero = np.zeros_like(x)
    before, after = (
        path_risk(volume, Footprint.of(EGO, 0.9, SETTINGS.flank_margin, 1.0, stride), x, zero, zero, 1.1)
        for stride in (0.0, 1.1)
    )
    first = [int(np.argmax(r.contact[0, 0] >= SETTINGS.r_hit)) for r in (before, after)]  # type: ignore[index]
    assert first[0] == first[1] > 0
    assert np.array_equal(before.contact[0, :, : first[0]], after.contact[0, :, : first[0]])  # type: ignore[index]


def thin(line: float) -> Volume:
    """A closed line across the way whose contact is 0.2 m wide, where the front is [m]."""

    def across(px: np.ndarray, py: np.ndarray) -> np.ndarray:
        return 1.5 / 0.36 * (0.6 - np.minimum(0.6, np.abs(px - line))) ** 2

    return Volume.of(risk_of(FAST, [], h=0.25, statics=across, ahead=120.0, behind=10.0, width=8.0), 0, 0)


FAST = ego_at(0.0, 0.0, 0.0, 22.0)
POSE_S, APART = 0.1, 2.2  # s, m; at which a profile is looked at


@given(st.floats(6.0, 6.0 + APART))
@settings(max_examples=12, deadline=None)
def test_the_validator_refuses_a_line_between_two_of_its_poses(line: float):
    s = np.arange(0.0, 2.05, POSE_S) * FAST.speed
    profile = straight(s, np.full(len(s), FAST.speed))
    rest = brake_motion(0.3, 0.3 * FAST.speed, FAST.speed, 0.0, 4.0, 12.0)
    tail = straight(rest.distance, rest.speed, rest.t, rest.acceleration)
    plan = Plan(mode="drive", reason="", planner="default", valid_for=0.3, profile=profile, tail=tail)
    assert validate(plan, FAST, thin(200.0), SETTINGS) == ""
    assert "meets risk" in validate(plan, FAST, thin(LENGTH / 2 + line), SETTINGS)


def straight(s: np.ndarray, v: np.ndarray, t: np.ndarray | None = None, a: np.ndarray | None = None) -> Trajectory:
    zero = np.zeros(len(s))
    t = POSE_S * np.arange(len(s)) if t is None else t
    return Trajectory(t=t, x=s, y=zero, heading=zero, curvature=zero, speed=v, acceleration=zero if a is None else a)


@given(st.floats(60.0, 60.0 + APART))
@settings(max_examples=12, deadline=None)
def test_a_safe_stop_brakes_hard_before_a_line_between_two_of_its_poses(line: float):
    start = Start(-EGO.wheelbase / 2, 0.0, 0.0, 0.0, FAST.speed, 0.0)
    for at, hard in ((line, True), (112.0, False)):
        plan, _ = safe_stop("a test", start, None, 0.0, FAST, thin(at), SETTINGS)
        assert plan.tail is not None
        assert (plan.tail.acceleration.min() < -1.5 * SETTINGS.safe_stop_brake) == hard
