"""Who comes from behind: no reason to brake, but one not to pull out before him."""

from __future__ import annotations

import numpy as np
import pytest

from common.codec import check
from common.messages import Map, Plan, Risk
from services.planner.core import Planner
from services.planner.footprint import Footprint, PathRisk, path_risk
from services.planner.pushers import pushers, without
from services.planner.settings import PlannerSettings
from services.planner.volume import NOBODY, Volume
from tests.planner.worlds import Box, box, drive, ego_at, lane, risk_of, stamped, straight_route

SETTINGS = PlannerSettings()
T = 0.1 * np.arange(61)


def found(boxes: list[Box], speed: float) -> set[int]:
    """Ids of the pushers of an ego that goes on straight."""
    ego = ego_at(0, 0, 0, speed)
    volume = Volume.of(risk_of(ego, boxes, h=0.25), 0, 0)
    x = speed * T - 1.35
    numbers = pushers(volume, Footprint.of(ego, 0.9, 0.15), x, np.zeros_like(x), np.zeros_like(x), T, SETTINGS.r_hit)
    names = {int(volume.who[i]): slot.id for i, slot in enumerate(volume.risk.slots)}
    return {names[k] for k in numbers}


def once(boxes: list[Box], speed: float, road: Map | None = None) -> Plan:
    ego = ego_at(0, 0, 0, speed)
    plan = Planner(SETTINGS).step(
        stamped(ego, 1.0),
        stamped(risk_of(ego, boxes), 1.0),
        stamped(road or Map(), 0.0),
        stamped(straight_route(), 0.0),
        1_010_000_000,
    )
    check(plan)
    return plan


@pytest.mark.parametrize("speed", [3.0, 8.0, 12.0])
def test_a_faster_car_behind_pushes_and_nobody_ahead_or_beside_does(speed: float):
    assert found([box(-9.0, 0.3, speed + 4.0, id=7)], speed) == {7}
    for other in (
        box(20.0, 0.0, 0.0, id=7),
        box(20.0, 0.0, speed - 3.0, id=7),
        box(15.0, 0.0, -5.0, heading=np.pi, id=7),
        box(25.0, -1.0, 0.5, length=0.5, width=0.5, id=7),
        box(3.0 + 2.0 * speed, -8.0, 0.0, 4.0, heading=np.pi / 2, id=7),
        box(-4.0, 3.5, speed + 4.0, id=7),
        box(2.0, 4.0, 0.7 * speed, -1.2, id=7),  # who cuts in
        box(-1.0, 4.0, speed, -1.2, id=7),
    ):
        assert found([other], speed) == set()


def test_nobody_brakes_for_who_would_run_into_him_from_behind():
    lone, pushed = once([], 8.0), once([box(-8.0, 0.4, 12.0)], 8.0)
    assert pushed.mode == "drive"
    assert pushed.profile is not None
    assert pushed.profile.acceleration.min() >= -0.3
    assert pushed.desired_speed >= 0.8 * lone.desired_speed


def test_the_lead_under_a_pusher_is_still_braked_for():
    lead = box(26.0, 0.0, 2.0, id=2, width=6.0)
    plan = once([lead, box(-8.0, 0.4, 13.0)], 10.0)
    assert plan.profile is not None
    assert plan.profile.acceleration.min() < -1.0
    alone = once([lead], 10.0)
    assert plan.desired_speed <= alone.desired_speed + 0.5


@pytest.mark.parametrize("gap", [14.0, 18.0, 22.0])
def test_who_passes_over_a_place_that_the_ego_has_left_excuses_no_contact(gap: float):
    wall = box(24.0, 0.0, id=2, width=30.0)  # can just be stopped for

    def merges(now: float, ahead: float) -> tuple[float, float, float]:
        return -gap + 15.0 * ahead, max(3.5 - 3.0 * ahead, 0.0), 0.0

    alone, followed = once([wall], 15.0), once([wall, Box(lambda t: (-gap, 3.5, 0.0), id=3, predict=merges)], 15.0)
    for plan in (alone, followed):
        assert plan.profile is not None
        assert plan.profile.acceleration.min() <= -7.0
        assert plan.profile.x.max() + 2.25 < 24.0


def test_without_leaves_what_is_met_of_others_and_what_is_there_now():
    shape = (2, 3, 4)
    contact = np.full(shape, 0.9, dtype=np.float32)
    contact[:, 0] = 0.4
    who = np.full((4, *shape), NOBODY, dtype=np.uint8)
    who[:, :, 1] = 5  # in slice 1 somebody pushes
    none = np.zeros((2, 4), dtype=np.float32)
    risk = PathRisk(contact, none, np.full(2, 1e3), contact, contact, np.stack((contact, contact)), who)
    out = without(risk, frozenset({5}), np.array([True, False]))
    assert out.contact is not None and out.who is not None
    assert np.allclose(out.contact[0, 1], 0.4) and np.allclose(out.contact[0, 2], 0.9)
    assert np.allclose(out.contact[1], contact[1])
    assert np.all(out.who[:, 0] == NOBODY)


def test_a_path_that_leaves_keeps_its_distance_to_who_follows_and_one_that_stays_does_not_see_him():
    ego = ego_at(0, 0, 0, 8)
    foot = Footprint.of(ego, 0.9, 0.15, behind=3.0)
    volume = Volume.of(risk_of(ego, [box(-6.0, 0.0)], h=0.25), 0, 0)  # 1.5 m behind the bumper
    pose = (np.full((2, 1), -1.35), np.zeros((2, 1)), np.zeros((2, 1)))
    risk = path_risk(volume, foot, *pose, 1.0, leaves=np.array([False, True]))
    assert risk.contact is not None
    assert risk.contact[0].max() < SETTINGS.r_hit <= risk.contact[1].max()
    assert risk.risk.max() < SETTINGS.r_hit  # the footprint itself touches nobody


def test_nobody_pulls_out_before_a_faster_car_in_the_other_lane():
    road = Map(
        lanes=[
            lane(1, 0.0, left_neighbour=2, left_same_direction=True),
            lane(2, 3.5, right_neighbour=1, right_same_direction=True),
        ]
    )
    slow, fast = box(35.0, 0.0, 4.0), box(-14.0, 3.5, 13.0, id=2)
    d = drive([slow, fast], straight_route(), ego_at(0, 0, 0, 9.0), seconds=4.0, road=road, ahead=90.0)
    assert min(d.clearance) > 0.6
    assert max(d.y[:30]) < 1.2  # while he comes past
    assert d.acceleration.min() > -3.2


def test_unknown_sources_push_nobody():
    ego = ego_at(0, 0, 0, 6)
    base = risk_of(ego, [box(-8.0, 0.0, 11.0)], h=0.25)
    nameless = Risk(
        grid=base.grid,
        slice_times=base.slice_times,
        slots=[],
        volume=base.volume,
        dominant=np.full_like(base.dominant, NOBODY),
    )
    x = 6.0 * T - 1.35
    foot = Footprint.of(ego, 0.9, 0.15)
    assert pushers(Volume.of(nameless, 0, 0), foot, x, 0 * x, 0 * x, T, 0.8) == frozenset()
