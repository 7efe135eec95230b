"""Each trap of planning on a risk volume has its rule; each rule its test."""

from __future__ import annotations

import numpy as np
import pytest

from common.codec import check
from common.messages import Map, Plan, Risk
from services.planner.bezier import Start
from services.planner.core import Planner
from services.planner.footprint import Footprint, PathRisk, path_risk
from services.planner.rollout import Field, Tier, roll_out
from services.planner.settings import PlannerSettings
from services.planner.speed import FAR, Cap, contact_distance
from services.planner.volume import Volume
from tests.planner.worlds import (
    WHEELBASE,
    Box,
    barrier,
    box,
    drive,
    ego_at,
    follow,
    lane,
    risk_of,
    stamped,
    straight_route,
)

SETTINGS = PlannerSettings()
EMPTY, ROUTE = Map(), straight_route()
STEP, POINTS = 1.0, 72
STARTS = np.arange(13) * 0.5


def once(
    boxes: list[Box],
    speed: float,
    *,
    y: float = 0.0,
    road: Map | None = None,
    planner: Planner | None = None,
    **more: object,
) -> Plan:
    """Plan once on a straight road."""
    ego = ego_at(0, y, 0, speed)
    plan = (planner or Planner(SETTINGS)).step(
        stamped(ego, 1.0),
        stamped(risk_of(ego, boxes, **more), 1.0),  # type: ignore[arg-type]
        stamped(road or EMPTY, 0.0),
        stamped(ROUTE, 0.0),
        1_010_000_000,
    )
    check(plan)
    return plan


def field(risk: np.ndarray, *, stays: np.ndarray | None = None, speed: float = 14.0) -> Field:
    """A field of one path from its risk [S, p]."""
    r = risk[None].astype(np.float32)
    put = np.zeros((1, POINTS), dtype=np.float32) if stays is None else stays[None].astype(np.float32)
    cap = Cap(np.full((1, POINTS), 100.0), np.zeros((1, POINTS), dtype=np.intp))
    volume = Volume(None, 0, STARTS)  # type: ignore[arg-type]
    return Field.of(PathRisk(r, put, np.array([1e3])), volume, cap, np.array([1e3]), np.array([speed]), STEP, SETTINGS)


def rolled(f: Field, speed: float, target: float, hold: float = np.inf, tier: int = 0):  # type: ignore[no-untyped-def]
    start = Start(0, 0, 0, 0, speed, 0.0)
    return roll_out(f, start, np.array([0]), np.array([target]), np.array([hold]), Tier.all(SETTINGS)[tier], SETTINGS)


def wall(at: float, slices: slice = slice(None)) -> np.ndarray:
    risk = np.zeros((13, POINTS))
    risk[slices, int(at) :] = 1.0
    return risk


# --- slices ---


def test_slices_are_cut_by_the_driven_profile_and_not_by_the_current_speed():
    crossing = np.zeros((13, POINTS))
    crossing[6:9, 40:44] = 1.0  # at 40 m from 3.0 s to 4.5 s
    f = field(crossing)
    # at the current 4 m/s the ego would be at 12…18 m then: nothing there. Accelerating to 14 it would meet it.
    assert rolled(f, 4.0, 4.0).passed[0]
    assert not rolled(f, 12.0, 14.0).passed[0]


def test_a_slice_reads_the_next_one_too():
    late = np.zeros((13, POINTS))
    late[5, 24:30] = 1.0  # only from 2.5 s on; at 10 m/s the ego passes 24…30 m from 2.4 to 3.0 s
    f = field(late)
    assert not rolled(f, 10.0, 10.0).passed[0]
    early = field(np.roll(late, 3, axis=0))  # from 4.0 s on: the ego is past it
    assert rolled(early, 10.0, 10.0).passed[0]


def test_an_object_that_is_predicted_to_leave_may_stay_put():
    gone = np.zeros((13, POINTS))
    gone[:3, 30:36] = 1.0  # stands at 30 m, predicted away from 1.5 s on
    stays = np.zeros(POINTS)
    assert rolled(field(gone, stays=stays), 10.0, 10.0).passed[0]
    stays[30:36] = 1.0
    assert not rolled(field(gone, stays=stays), 10.0, 10.0).passed[0]


def test_what_moves_on_does_not_count_as_staying_put():
    ego = ego_at(0, 0, 0, 8)
    x = np.arange(0, 60, 1.0)[None]
    at = (x, np.zeros_like(x), np.zeros_like(x))
    foot = Footprint.of(ego, 0.9)
    moving = path_risk(Volume.of(risk_of(ego, [box(25, 0, 8.0)]), 0, 0), foot, *at, 1.0)
    standing = path_risk(Volume.of(risk_of(ego, [box(25, 0)]), 0, 0), foot, *at, 1.0)
    assert moving.stays.max() < 0.2
    assert standing.stays.max() > 0.95


def test_slices_are_times_and_an_older_volume_is_shifted_by_its_age():
    ego = ego_at(0, 0, 0, 10)
    risk = risk_of(ego, [])
    fresh, old = Volume.of(risk, 0, 0), Volume.of(risk, 0, 700_000_000)
    assert fresh.first == 0
    assert old.first == 1  # 0.7 s later the slice of 0.5 s is in force
    assert np.isclose(old.starts[0], -0.2)
    assert fresh.slice_at(1.2) == 2
    assert old.slice_at(1.2) + old.first == 3
    assert old.slice_at(100.0) + old.first == 12  # the last one holds for good


# --- ties, hysteresis, replanning ---


def test_on_an_empty_road_the_reference_line_is_taken():
    plan = once([], 10.0, y=0.8)
    assert plan.mode == "drive"
    assert plan.profile is not None
    end = plan.profile.y[-1]
    assert abs(end) < 0.4
    assert plan.desired_speed > 10.0


def test_a_choice_once_made_is_kept_unless_another_is_clearly_better():
    sides = set()
    planner = Planner(SETTINGS)
    ego = ego_at(0, 0, 0, 8)
    for k in range(10):  # an obstacle in the middle whose position trembles: left and right are equal
        tremble = 0.05 * (-1) ** k
        risk = risk_of(ego, [box(45, tremble, length=2.0, width=1.0)])
        t = 1.0 + 0.05 * k
        plan = planner.step(stamped(ego, t), stamped(risk, t), stamped(EMPTY, 0), stamped(ROUTE, 0), round(t * 1e9))
        assert plan.candidates is not None
        sides.add(np.sign(round(float(plan.candidates.y[plan.chosen, 20]), 1)))
        ego = follow(plan, ego, 0.05)
    assert len(sides) == 1


def test_hysteresis_does_not_hold_against_the_reference_line():
    planner = Planner(SETTINGS)
    around = once([box(40, -0.8)], 10.0, planner=planner)
    assert around.candidates is not None
    assert abs(around.candidates.y[around.chosen, -1]) > 0.4
    free = once([], 10.0, planner=planner)  # the obstacle is gone
    assert free.candidates is not None
    assert abs(free.candidates.y[free.chosen, -1]) < 0.05


@pytest.mark.parametrize(("off", "slower", "follows"), [(0.1, 0.1, True), (0.6, 0.0, False), (0.0, 0.9, False)])
def test_planning_goes_on_from_the_previous_plan_only_if_the_ego_is_near_it(off: float, slower: float, follows: bool):
    planner = Planner(SETTINGS)
    ego = ego_at(0, 0, 0, 10)

    def plan(e, t):  # type: ignore[no-untyped-def]
        risk = stamped(risk_of(e, []), t)
        return planner.step(stamped(e, t), risk, stamped(EMPTY, 0), stamped(ROUTE, 0), round(t * 1e9))

    first = plan(ego, 1.0)
    planned = follow(first, ego, 0.1)
    actual = ego_at(planned.x, planned.y + off, planned.heading, planned.speed - slower)
    second = plan(actual, 1.1)
    assert second.profile is not None
    expected = planned if follows else actual
    assert abs(second.profile.y[0] - expected.y) < 0.01
    assert abs(second.profile.speed[0] - expected.speed) < 0.02
    if follows:
        assert abs(second.profile.acceleration[0] - planned.acceleration) < 0.05


def test_small_changes_of_the_target_speed_are_filtered_but_large_ones_are_not():
    planner = Planner(SETTINGS)
    before = once([box(40, 0, 8.0), box(40, 3.5, 8.0), box(40, -3.5, 8.0)], 9.0, planner=planner)
    near = once([box(39, 0, 8.0), box(39, 3.5, 8.0), box(39, -3.5, 8.0)], 9.0, planner=planner)
    assert near.candidates is not None
    wanted = near.candidates.desired_speed[near.chosen]
    assert min(before.desired_speed, wanted) <= near.desired_speed + 1e-9 <= max(before.desired_speed, wanted) + 1e-6
    sudden = once([box(14, 0), box(14, 3.5), box(14, -3.5)], 9.0, planner=planner)
    assert sudden.desired_speed < before.desired_speed - 1.5


# --- the footprint ---


def test_a_path_points_risk_is_the_footprints_maximum_with_its_front_corners():
    ego = ego_at(0, 0, 0, 5)
    foot = Footprint.of(ego, 0.9)
    front = ego.length / 2 + WHEELBASE / 2
    corners = {(front, 0.9), (front, -0.9), (front - 4.5, 0.9), (front - 4.5, -0.9)}
    for x, y in corners:
        assert np.hypot(foot.x - x, foot.y - y).min() < 1e-9
    small = box(10 + front + 0.2, 0.9, length=0.3, width=0.3)  # just before the front left corner at x = 10
    risk = path_risk(
        Volume.of(risk_of(ego, [small], h=0.25), 0, 0),
        foot,
        np.array([[10.0]]),
        np.array([[0.0]]),
        np.array([[0.0]]),
        1.0,
    )
    assert risk.risk.max() > 0.8


def test_a_barrier_cannot_be_straddled():
    ego = ego_at(0, 0, 0, 5)
    x = np.full((1, 41), 5.0)
    y = np.linspace(-1.5, 1.5, 41)[None]
    volume = Volume.of(risk_of(ego, [], statics=barrier(0.0), h=0.25), 0, 0)
    risk = path_risk(volume, Footprint.of(ego, 0.9), x, y, np.zeros_like(x), 1.0).risk[0, 0]
    touching = y[0] > -0.9
    assert risk[touching].min() > 0.8


def test_samples_of_the_outline_lie_close_enough_for_long_vehicles():
    foot = Footprint.of(ego_at(0, 0, 0, 5, length=12.0, width=2.55, wheelbase=6.0), 0.9)
    for k in range(len(foot.x)):
        others = np.hypot(foot.x - foot.x[k], foot.y - foot.y[k])
        assert np.sort(others)[1] <= 0.9 + 1e-9


def test_the_rear_axle_is_planned_and_not_the_centre():
    a = np.linspace(0, np.pi, 60)
    points = np.stack((10 * np.sin(a), 10 * (1 - np.cos(a))), axis=1)
    ego = ego_at(WHEELBASE / 2, 0, 0, 2.5)
    route = straight_route()
    route = type(route)(reference=np.vstack(([[-20.0, 0.0]], points)), goal=route.goal)
    planner = Planner(SETTINGS)
    d = None
    route_stamped = stamped(route, 0)
    for k in range(40):
        t = 0.1 * k
        plan = planner.step(
            stamped(ego, t), stamped(risk_of(ego, []), t), stamped(EMPTY, 0), route_stamped, round(t * 1e9)
        )
        ego = follow(plan, ego, 0.1)
        rear = ego.x - WHEELBASE / 2 * np.cos(ego.heading), ego.y - WHEELBASE / 2 * np.sin(ego.heading)
        d = 10 - np.hypot(rear[0], rear[1] - 10.0), 10 - np.hypot(ego.x, ego.y - 10.0)
    assert d is not None
    assert abs(d[0]) < 0.25  # the rear axle is on the line, though the curve began without warning,
    assert d[1] < d[0] - 0.04  # the centre outside of it


# --- contact, gap, stopping ---


def test_contact_is_interpolated_between_samples():
    places = []
    for edge in np.linspace(20.0, 22.0, 21):
        risk = np.clip(1.0 - 0.4 * np.maximum(edge - np.arange(POINTS) * STEP, 0.0), 0.0, 1.0)
        places.append(contact_distance(risk, 0.8, STEP)[0])
    steps = np.diff(places)
    assert np.all(steps > 0.0)
    assert steps.max() < 0.2  # the edge moved by 0.1 each, the samples lie 1.0 apart


def test_no_contact_is_far_and_contact_behind_does_not_count():
    risk = np.zeros(POINTS)
    risk[5:8] = 1.0
    distance = contact_distance(risk, 0.8, STEP)
    assert distance[0] < 5.0
    assert np.all(distance[8:] == FAR)


def test_an_obstacle_does_not_fall_out_of_the_horizon_as_the_ego_slows():
    for speed in (0.0, 0.3, 1.0, 3.0, 10.0):
        gap = 2.2 + speed * 1.5 + speed**2 / 3.0
        plan = once([box(4.5 + gap, 0), box(4.5 + gap, 3.4), box(4.5 + gap, -3.4)], speed)
        assert plan.profile is not None
        assert plan.desired_speed <= max(speed, 0.4)
        motion = plan.profile
        assert np.all(motion.x < gap - 1.0)


def test_all_speeds_zero_is_an_explicit_stop_with_its_reason():
    plan = once([box(7.0, 0, id=14), box(6.0, 3.0, id=15), box(6.0, -3.0, id=16)], 0.0)
    assert plan.mode == "drive"
    assert plan.profile is not None
    assert plan.profile.speed.max() == 0.0
    assert plan.decision is not None
    assert plan.decision.source_id in {14, 15, 16}
    assert "standing still: car" in plan.reason


def test_release_of_a_hard_brake_is_fast():
    f = field(np.zeros((13, POINTS)))
    start = Start(0, 0, 0, 0, 10.0, -6.0)
    r = roll_out(f, start, np.array([0]), np.array([10.0]), np.array([np.inf]), Tier.all(SETTINGS)[0], SETTINGS)
    assert np.argmax(r.acceleration[0] > -1.5) * 0.1 <= 0.6


def test_the_published_profile_is_the_very_rollout_that_was_checked():
    plan = once([box(50, 0, 6.0), box(50, 3.3, 6.0), box(50, -3.3, 6.0)], 10.0)
    p = plan.profile
    assert p is not None
    assert plan.slice_risk is not None
    assert plan.slice_risk.risk.max() < SETTINGS.r_hit
    dv = np.diff(p.speed) / np.diff(p.t)
    mean = 0.5 * (p.acceleration[1:] + p.acceleration[:-1])
    assert np.allclose(dv, mean, atol=1e-6)


# --- what is not known ---


def test_points_beyond_the_grid_set_no_risk_but_the_plan_can_stop_before_them():
    near = once([], 12.0, ahead=30.0)
    assert near.tail is not None
    assert near.profile is not None
    stop = near.tail.x[-1] + 2.25
    assert stop <= 30.0 + 0.3
    assert near.profile.speed[-1] < 8.0
    far = once([], 12.0, ahead=130.0)
    assert far.profile is not None
    assert far.profile.speed[-1] > 12.0


def test_an_ego_outside_the_grid_does_not_drive_on():
    ego = ego_at(0, 0, 0, 6)
    away = risk_of(ego_at(500, 0), [])
    plan = Planner(SETTINGS).step(
        stamped(ego, 1.0), stamped(away, 1.0), stamped(EMPTY, 0), stamped(ROUTE, 0), 1_010_000_000
    )
    assert plan.tail is not None
    assert plan.profile is not None
    assert plan.profile.speed[-1] < 2.5


def test_the_end_of_the_route_is_not_overrun():
    ego = ego_at(380, 0, 0, 8)
    plan = Planner(SETTINGS).step(
        stamped(ego, 1.0),
        stamped(risk_of(ego, []), 1.0),
        stamped(EMPTY, 0),
        stamped(ROUTE, 0),
        1_010_000_000,
    )
    assert plan.profile is not None
    assert plan.tail is not None
    assert plan.tail.x[-1] <= 400.5
    assert plan.decision is not None
    assert plan.decision.term == "horizon"


def test_a_goal_with_stop_is_come_to_rest_at():
    d = drive([], straight_route(x=30.0, y=0.0, stop=True), ego_at(0, 0, 0, 7), seconds=13.0, settings=FEW, ahead=60.0)
    assert d.speed[-1] < 0.05
    assert abs(d.x[-1] - 30.0) < 1.5


FEW = PlannerSettings(offsets=(0.0, 0.8, -0.8, 2.0, -2.0), lengths=((9.0, 2.2), (24.0, 5.0)))


def test_the_speed_limit_of_the_lane_ahead_is_reached_before_it():
    slow = lane(2, 0.0, limit=6.0)
    fast = lane(1, 0.0, limit=14.0)
    split = 40.0

    def cut(lane_, ahead):  # type: ignore[no-untyped-def]
        def part(points: np.ndarray) -> np.ndarray:
            keep = points[:, 0] >= split if ahead else points[:, 0] <= split
            edge = np.array([[split, points[0, 1]]])
            return np.vstack((edge, points[keep])) if ahead else np.vstack((points[keep], edge))

        return type(lane_)(
            id=lane_.id,
            centre=part(lane_.centre),
            left=part(lane_.left),
            right=part(lane_.right),
            speed_limit=lane_.speed_limit,
        )

    road = Map(lanes=[cut(fast, False), cut(slow, True)])
    d = drive([], straight_route(), ego_at(0, 0, 0, 10), seconds=8.0, road=road, settings=FEW)
    beyond = d.x > split + 3.0
    assert beyond.any()
    assert d.speed[beyond].max() < 6.8
    assert d.speed[d.x < 10].max() > 9.5


def test_the_decision_names_source_term_slice_cell_and_side():
    plan = once([box(35, 0.8, id=14, cls=2), box(35, -3.2, id=15), box(35, 4.0, id=16)], 8.0)
    decision = plan.decision
    assert decision is not None
    assert decision.source_id in {14, 15, 16}
    assert decision.term == "potential"
    assert decision.slice is not None
    assert decision.cell is not None
    assert decision.x is not None
    assert 29.0 < decision.x < 38.0
    assert "potential term, slice" in decision.sentence
    assert "truck 14" in decision.sentence or "car 1" in decision.sentence


def test_the_message_holds_all_candidates_with_few_points():
    plan = once([], 10.0)
    assert plan.candidates is not None
    assert plan.candidates.x.shape[0] >= 33
    assert plan.candidates.x.shape[1] <= 40
    assert 0 <= plan.chosen < plan.candidates.x.shape[0]


def test_a_neighbouring_lane_is_a_target_where_the_map_has_one_and_dear_if_oncoming():
    def chosen_y(against: bool) -> float:
        road = Map(
            lanes=[
                lane(1, 0.0, left_neighbour=2, left_same_direction=not against),
                lane(2, 3.5, against=against),
            ]
        )
        plan = once([box(40, 0, 6.0)], 12.0, road=road)
        assert plan.candidates is not None
        return float(plan.candidates.y[plan.chosen, -1])

    assert chosen_y(False) > 2.5
    assert chosen_y(True) < 1.0


def test_volume_reading_is_bilinear_and_zero_outside():
    ego = ego_at(0, 0, 0, 0)
    base = risk_of(ego, [])
    i = np.arange(base.volume.shape[1])[:, None]
    j = np.arange(base.volume.shape[2])[None]
    plane = (0.5 * i + 0.25 * j)[None].repeat(13, axis=0).astype(np.float32)
    risk = Risk(grid=base.grid, slice_times=base.slice_times, slots=[], volume=plane, dominant=base.dominant)
    volume = Volume.of(risk, 0, 0)
    x, y = np.array([3.3, 11.7, 500.0]), np.array([-2.2, 4.9, 0.0])
    fi, fj = volume.coordinates(x, y)
    values, known = volume.sample(x, y)
    assert np.allclose(values[0, :2], (0.5 * (fi - 0.5) + 0.25 * (fj - 0.5))[:2], atol=1e-3)
    assert values[0, 2] == 0.0
    assert known.tolist() == [True, True, False]
