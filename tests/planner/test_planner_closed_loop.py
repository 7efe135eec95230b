"""The planner in closed loop with an ego that follows its plan perfectly, among boxes with a potential field."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from common.messages import Goal, Map, Route
from services.planner.settings import PlannerSettings
from tests.planner.worlds import Drive, barrier, box, drive, ego_at, lane, straight_route

pytestmark = pytest.mark.long

FEW = PlannerSettings(offsets=(0.0, 0.6, -0.6, 1.4, -1.4, 2.4, -2.4), lengths=((9.0, 2.2), (24.0, 5.0)))
ROAD = Map(lanes=[lane(1, 0)])


def walls(px: np.ndarray, py: np.ndarray) -> np.ndarray:
    """Kerbs that leave no way around."""
    return barrier(1.9)(px, py) + barrier(-1.9, -1.0)(px, py)


def comfortable(d: Drive) -> None:
    assert set(d.modes) == {"drive"}
    assert d.acceleration.min() > -1.6
    assert d.acceleration.max() < 1.4
    assert np.abs(d.jerk()).max() < 1.8


def test_an_empty_road_is_driven_at_its_limit_on_its_line():
    d = drive([], straight_route(speed=9.0), ego_at(0, 0.5, 0.02, 6), seconds=7.0, settings=FEW, road=ROAD, ahead=80.0)
    comfortable(d)
    assert abs(d.speed[-1] - 9.0) < 0.4
    assert abs(d.y[-1]) < 0.15


@pytest.mark.parametrize("noise", [pytest.param(0.0, marks=pytest.mark.slow), 0.2])
def test_a_slower_lead_is_followed_with_gap_and_headway_and_without_hunting(noise: float):
    lead = box(32, 0, 7.0)
    d = drive(
        [lead],
        straight_route(),
        ego_at(0, 0, 0, 10),
        seconds=12.0,
        settings=FEW,
        road=ROAD,
        statics=walls,
        noise=noise,
        ahead=90.0,
    )
    assert set(d.modes) == {"drive"}
    assert d.acceleration.min() > -2.0
    assert d.sign_changes() <= (4 if noise else 2)
    gap = np.array(d.clearance)
    assert (gap / np.maximum(d.speed, 0.1)).min() >= 0.8
    assert abs(d.speed[-1] - 7.0) < 0.5


def test_a_standing_obstacle_that_blocks_the_road_is_stopped_at_with_a_gap_and_for_good():
    d = drive(
        [box(60, 0)],
        straight_route(),
        ego_at(0, 0, 0, 9),
        seconds=15.0,
        settings=FEW,
        road=ROAD,
        statics=walls,
        ahead=90.0,
    )
    comfortable(d)
    assert 2.0 <= d.clearance[-1] <= 5.5
    assert d.speed[-1] < 0.05
    assert d.sign_changes() <= 1
    assert d.plans[-1].decision is not None
    assert d.plans[-1].decision.source_id == 1


def test_a_slow_pedestrian_at_the_roadside_is_overtaken_without_a_stop():
    walker = box(40, -1.9, 1.2, length=0.5, width=0.5, cls=6)
    d = drive([walker], straight_route(speed=9.0), ego_at(0, 0, 0, 9), seconds=7.0, settings=FEW, road=ROAD, ahead=80.0)
    assert set(d.modes) == {"drive"}
    assert min(d.clearance) > 0.5
    assert d.speed.min() > 4.0
    assert d.x[-1] > 50.0


def test_a_car_that_stands_far_away_in_the_other_lane_changes_nothing():
    d = drive([box(40, 3.5)], straight_route(speed=9.0), ego_at(0, 0, 0, 9), seconds=3.0, settings=FEW, road=ROAD)
    assert d.speed.min() > 8.5
    assert np.abs(d.y).max() < 0.6


def test_equal_offsets_beside_a_truck_do_not_chatter():
    truck = box(0, 3.6, 9.0, length=12.0, width=2.5, cls=2)
    d = drive([truck], straight_route(speed=9.0), ego_at(0, 0, 0, 9), seconds=5.0, settings=FEW, road=ROAD, noise=0.2)
    chosen = [round(float(p.candidates.y[p.chosen, -1]), 1) for p in d.plans if p.candidates is not None]
    switches = sum(a != b for a, b in itertools.pairwise(chosen))
    assert switches <= 3
    assert set(d.modes) == {"drive"}


def test_a_lead_that_brakes_hard_is_not_hit():
    def pose(t: float) -> tuple[float, float, float]:
        brake = np.clip(t - 1.5, 0.0, 9.0 / 5.0)
        return 30 + 9.0 * min(t, 1.5) + 9.0 * brake - 2.5 * brake**2, 0.0, 0.0

    lead = box(0, 0)
    lead.pose = pose
    d = drive(
        [lead], straight_route(), ego_at(0, 0, 0, 9), seconds=8.0, settings=FEW, road=ROAD, statics=walls, ahead=80.0
    )
    assert set(d.modes) == {"drive"}
    assert min(d.clearance) > 1.5
    assert d.speed[-1] < 0.3


def turn(radius: float, angle: float) -> Route:
    """25 m straight, a left turn, 60 m straight."""
    a = np.linspace(0, angle, 40)
    arc = np.stack((25 + radius * np.sin(a), radius * (1 - np.cos(a))), axis=1)
    out = arc[-1] + np.linspace(1, 60, 60)[:, None] * np.array([np.cos(angle), np.sin(angle)])
    points = np.vstack(([[-10.0, 0.0], [0.0, 0.0], [24.0, 0.0]], arc, out))
    goal = out[40]
    return Route(reference=points, goal=Goal(x=float(goal[0]), y=float(goal[1]), radius=3.0), speed_limit=8.0)


@pytest.mark.parametrize(
    ("radius", "angle", "seconds"), [(9.0, np.pi / 2, 12.0), pytest.param(6.5, np.pi, 18.0, marks=pytest.mark.slow)]
)
def test_turns_are_driven_smoothly_near_their_line(radius: float, angle: float, seconds: float):
    route = turn(radius, angle)
    d = drive([], route, ego_at(0, 0, 0, 6), seconds=seconds, settings=FEW, ahead=60.0)
    assert set(d.modes) == {"drive"}
    lateral = np.array([e.yaw_rate * e.speed for e in d.ego])
    assert np.abs(lateral).max() < 1.25
    assert d.acceleration.min() > -1.6
    reference = route.reference
    dense = np.stack(
        [np.interp(np.linspace(0, len(reference) - 1, 4000), np.arange(len(reference)), c) for c in reference.T], axis=1
    )
    rear = np.array([(e.x - 1.35 * np.cos(e.heading), e.y - 1.35 * np.sin(e.heading)) for e in d.ego])
    off = np.array([np.hypot(*(dense - p).T).min() for p in rear])
    assert off.max() < 0.5
    assert abs(d.ego[-1].heading - angle) % (2 * np.pi) < 0.15
    assert d.speed[-1] > 3.0


def test_an_ego_that_starts_beside_and_askew_comes_back_to_its_line():
    d = drive([], straight_route(speed=9.0), ego_at(0, -1.2, 0.2, 5), seconds=5.0, settings=FEW, ahead=70.0)
    assert set(d.modes) == {"drive"}
    assert abs(d.y[-1]) < 0.4


@pytest.mark.slow
def test_an_oncoming_car_beyond_the_grid_is_no_surprise():
    d = drive(
        [box(220, 0.0, -9.0, heading=np.pi)],
        straight_route(),
        ego_at(0, 0, 0, 12),
        seconds=14.0,
        settings=FEW,
        road=ROAD,
        statics=walls,
        ahead=70.0,
    )
    assert d.speed.max() < 14.0
    hit = np.array(d.clearance) <= 0.0
    assert not (hit & (d.speed > 0.3)).any()
