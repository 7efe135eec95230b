"""What is beside or behind: it is told apart from what is ahead, and nobody brakes hard for it."""

from __future__ import annotations

import numpy as np
import pytest

from common.codec import check
from common.messages import Map, Plan
from services.planner.bezier import Start
from services.planner.core import Planner
from services.planner.footprint import Footprint, PathRisk, path_risk
from services.planner.rollout import Field, Tier, roll_out
from services.planner.settings import PlannerSettings
from services.planner.speed import Cap
from services.planner.volume import Volume
from tests.planner.worlds import Box, box, ego_at, risk_of, stamped, straight_route

SETTINGS = PlannerSettings()
POINTS, STEP = 72, 1.0
STARTS = np.arange(13) * 0.5
SQUEEZED, SWEPT, EMERGENCY = 2, 3, 5


def met(boxes: list[Box], at: float = 0.0) -> PathRisk:
    """What the footprint meets with the rear axle at x = `at`."""
    ego = ego_at(0, 0, 0, 8)
    foot = Footprint.of(ego, SETTINGS.footprint_spacing, SETTINGS.flank_margin)
    volume = Volume.of(risk_of(ego, boxes, h=0.25), 0, 0)
    pose = (np.array([[at - 1.35]]), np.zeros((1, 1)), np.zeros((1, 1)))
    return path_risk(volume, foot, *pose, 1.0)


def field(risk: np.ndarray, ahead: np.ndarray) -> Field:
    r, a = (q[None].astype(np.float32) for q in (risk, ahead))
    none = np.zeros((1, POINTS), dtype=np.float32)
    cap = Cap(np.full((1, POINTS), 100.0), np.zeros((1, POINTS), dtype=np.intp))
    far = np.array([1e3])
    volume = Volume(None, 0, STARTS)  # type: ignore[arg-type]
    return Field.of(PathRisk(r, none, far, r, a), volume, cap, far, np.array([14.0]), STEP, SETTINGS)


def passes(f: Field, speed: float, target: float, tier: int) -> bool:
    start = Start(0, 0, 0, 0, speed, 0.0)
    how = Tier.all(SETTINGS)[tier]
    return bool(roll_out(f, start, np.array([0]), np.array([target]), np.array([np.inf]), how, SETTINGS).passed[0])


def once(boxes: list[Box], speed: float) -> Plan:
    ego = ego_at(0, 0, 0, speed)
    risk = risk_of(ego, boxes)
    plan = Planner(SETTINGS).step(
        stamped(ego, 1.0), stamped(risk, 1.0), stamped(Map(), 0.0), stamped(straight_route(), 0.0), 1_010_000_000
    )
    check(plan)
    return plan


def test_a_car_a_hand_beside_is_near_but_no_contact_and_one_before_the_bumper_is():
    beside = met([box(0, 1.8 + 0.25)])
    assert beside.risk.max() > SETTINGS.r_hit
    assert beside.contact is not None
    assert beside.contact.max() < SETTINGS.r_hit
    before = met([box(4.5 + 0.15, 0)])
    assert before.contact is not None
    assert before.ahead is not None
    assert min(before.contact.max(), before.ahead.max()) >= SETTINGS.r_hit


@pytest.mark.parametrize(("x", "y"), [(-4.55, 0.0), (-3.0, 1.85), (-3.0, -1.85)])
def test_what_touches_the_rear_is_not_ahead(x: float, y: float):
    touching = met([box(x, y)])
    assert touching.contact is not None
    assert touching.ahead is not None
    assert touching.contact.max() >= SETTINGS.r_hit
    assert touching.ahead.max() < SETTINGS.r_hit


def test_contact_beside_fails_the_gentle_tiers_and_is_no_reason_to_brake_hard():
    beside = np.zeros((13, POINTS))
    beside[2:8] = 1.0  # somebody is beside wherever the ego is
    f = field(beside, np.zeros_like(beside))
    assert not passes(f, 10.0, 10.0, 0)
    assert not passes(f, 10.0, 10.0, 1)
    assert passes(f, 10.0, 9.0, SQUEEZED)
    ahead = field(beside, beside)
    assert not passes(ahead, 10.0, 9.0, SQUEEZED)


def test_what_comes_over_a_standing_ego_is_let_be_but_not_what_the_ego_drives_into_before():
    over = np.zeros((13, POINTS))
    over[4:8, :20] = 1.0  # at 2 s somebody drives over where the ego is now
    assert not passes(field(over, over), 4.0, 3.0, SQUEEZED)
    assert passes(field(over, over), 4.0, 3.0, SWEPT)
    wall = over.copy()
    wall[:, 5:] = 1.0  # and there is a wall that it reaches sooner
    assert not passes(field(wall, wall), 8.0, 6.4, SWEPT)
    there = over.copy()
    there[:, 0] = 1.0  # contact that is there already is nothing that comes
    assert not passes(field(there, there), 4.0, 3.0, SWEPT)


def test_neighbours_that_drive_along_a_hand_beside_are_not_braked_hard_for():
    plan = once([box(-3.0, 2.2, 9.0), box(-2.0, -2.2, 9.0)], 9.0)
    assert plan.mode == "drive"
    assert plan.profile is not None
    assert plan.profile.acceleration.min() >= -SETTINGS.tier_brake[1] - 1e-6


def test_a_wall_ahead_is_still_braked_for_with_all_there_is():
    plan = once([box(10.5, 0.0, length=1.0, width=30.0)], 9.0)
    assert plan.profile is not None
    assert plan.profile.acceleration.min() <= -0.9 * SETTINGS.tier_brake[2]


def test_a_queue_that_moves_does_not_stay_put_though_each_place_is_taken_again():
    ego = ego_at(0, 0, 0, 9)
    x = np.arange(0, 60, 1.0)[None]
    at = (x, np.zeros_like(x), np.zeros_like(x))
    foot = Footprint.of(ego, 0.9)
    queue = [box(15.0 + 18.0 * k, 0, 9.0) for k in range(4)]  # after 2 s each stands where the next one stood
    assert path_risk(Volume.of(risk_of(ego, queue), 0, 0), foot, *at, 1.0).stays.max() < 0.2


def test_the_decision_tells_how_far_beside_the_path_the_source_is():
    plan = once([box(14.0, 2.6), box(14.0, -2.6)], 9.0)
    assert plan.decision is not None
    assert "of the path" in plan.decision.sentence
    assert "0.9 m left" not in plan.decision.sentence
    lead = once([box(14.0, 0.0, width=12.0)], 9.0)
    assert lead.decision is not None
    assert "on the path" in lead.decision.sentence
