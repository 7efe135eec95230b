"""Following lanes: curves, successors, branches, limits, lane changes, and where lanes end."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from common.geometry import Polyline, wrap_angle
from common.messages import Map, Method, ObjectClass
from services.predictor.lanes import LaneIndex
from tests.predictor.scenes import T, arc, circle, drive, lane, line, objects_of, predictor, stamped, straight

UTM = st.sampled_from([(0.0, 0.0), (691_000.0, 5_335_000.0), (-4e6, 9e6)])


def turned(points, angle, shift):
    c, s = np.cos(angle), np.sin(angle)
    return np.asarray(points) @ np.array([[c, s], [-s, c]]) + shift


def curve(radius, *, angle=1.4, shift=(0.0, 0.0), rotation=0.0, **fields):
    """60 m straight along x to the origin, a curve to the left, 60 m straight: three lanes."""
    bend = arc(0.0, 0.0, 0.0, radius, angle, 40)
    end = bend[-1] + 60.0 * np.array([np.cos(angle), np.sin(angle)])
    lines = [line(-60, 0, 0, 0), bend, line(*bend[-1], *end)]
    lanes = [
        lane(turned(p, rotation, shift), id=10 + i, successors=[11 + i] if i < 2 else [], **fields)
        for i, p in enumerate(lines)
    ]
    return Map(lanes=lanes), Polyline.of(turned(np.concatenate(lines), rotation, shift))


@given(
    radius=st.floats(12.0, 120.0),
    v=st.floats(2.0, 15.0),
    back=st.floats(0.0, 40.0),
    offset=st.floats(-0.8, 0.8),
    rotation=st.floats(-3.0, 3.0),
    shift=UTM,
)
@settings(max_examples=20, deadline=None)
def test_a_car_stays_on_its_lane_through_a_curve_and_across_successors(radius, v, back, offset, rotation, shift):
    map, centre = curve(radius, rotation=rotation, shift=shift)
    x, y = turned((-back, offset), rotation, shift)
    p = drive([straight(x, y, rotation, v)], map=map)
    assert p.method[0] == Method.MAP_BASED
    s, d = centre.project(np.stack((p.x[0], p.y[0]), axis=1))
    np.testing.assert_allclose(d, offset, atol=0.2)
    assert (np.diff(s) >= -1e-6).all()
    # the body turns with the lane, and speed is what the positions do
    along = s < centre.length - 5
    assert np.abs(wrap_angle(p.heading[0] - centre.heading(s)))[along].max() < 0.12
    moved = np.hypot(np.diff(p.x[0]), np.diff(p.y[0])) / 0.1
    np.testing.assert_allclose(moved, (p.speed[0, 1:] + p.speed[0, :-1]) / 2, rtol=0.04, atol=0.03)


@given(radius=st.floats(10.0, 60.0), v=st.floats(12.0, 25.0))
@settings(max_examples=30, deadline=None)
def test_cars_slow_down_for_a_curve_ahead_with_comfort(radius, v):
    map, centre = curve(radius)
    p = drive([straight(-55.0, 0.0, 0.0, v)], map=map)
    s, _ = centre.project(np.stack((p.x[0], p.y[0]), axis=1))
    deceleration = -np.diff(p.speed[0], prepend=v) / 0.1
    assert deceleration.max() <= 1.5 + 1e-3
    assert (np.diff(p.speed[0]) <= 1e-4).all() or (s < 60).all() or v**2 / radius <= 3.5
    inside = (s > 70) & (s < 60 + 1.4 * radius - 5)
    fastest = np.sqrt(3.0 * radius)
    braked = np.sqrt(max(v**2 - 2 * 1.5 * 55.0, 0.0))  # what comfort allows
    if inside.any():
        assert p.speed[0][inside].max() <= max(fastest, braked) * 1.1 + 0.5


@pytest.mark.parametrize("turn", [-1, 0, 1])
def test_at_a_branch_the_motion_decides(turn):
    lanes = [
        lane(line(-100, 0, 0, 0), id=1, successors=[2, 3, 4]),
        lane(arc(0, 0, 0, 15, -1.5), id=2),
        lane(line(0, 0, 100, 0), id=3),
        lane(arc(0, 0, 0, 15, 1.5), id=4),
    ]
    # the last second is already an arc to that side, still on the first lane
    path = circle(-4.0, 0.0, 0.12 * turn, 7.0, 0.25 * turn) if turn else straight(-4.0, 0.0, 0.0, 7.0)
    p = drive([path], map=Map(lanes=lanes))
    assert p.method[0] == Method.MAP_BASED
    y = p.y[0, 30]
    assert abs(y) < 0.5 if turn == 0 else y * turn > 3.0


@given(order=st.permutations([2, 3, 4]), v=st.floats(3.0, 15.0))
@settings(max_examples=15, deadline=None)
def test_without_a_sign_of_turning_the_straightest_successor_is_taken(order, v):
    lanes = {
        2: lane(arc(0, 0, 0, 20, -1.5), id=2),
        3: lane(arc(0, 0, 0, 400, 0.3), id=3),
        4: lane(arc(0, 0, 0, 30, 1.5), id=4),
    }
    first = lane(line(-100, 0, 0, 0), id=1, successors=list(order))
    p = drive([straight(-10.0, 0.0, 0.0, v)], map=Map(lanes=[lanes[i] for i in order] + [first]))
    _, d = Polyline.of(np.concatenate((line(-100, 0, -1, 0), arc(0, 0, 0, 400, 0.3)))).project(
        np.stack((p.x[0], p.y[0]), axis=1)
    )
    assert np.abs(d).max() < 0.3


def test_inside_a_junction_the_turn_tells_overlapping_lanes_apart():
    left, ahead = arc(0, 0, 0, 20, 1.5), line(0, 0, 60, 0)
    map = Map(lanes=[lane(ahead, id=1), lane(left, id=2)])
    # by place and direction alone, the straight lane fits a little better
    turning, not_turning = (
        drive([path], map=map) for path in (circle(2.0, -0.3, 0.02, 6.0, 0.3), straight(2.0, -0.3, 0.02, 6.0))
    )
    s, d = Polyline.of(left).project(np.stack((turning.x[0, :30], turning.y[0, :30]), axis=1))
    assert s[-1] > 15
    assert np.abs(d).max() < 1.2
    assert np.abs(not_turning.y[0]).max() < 0.8


@given(limit=st.floats(5.0, 40.0), v=st.floats(5.0, 40.0), a=st.floats(0.5, 3.0))
@settings(max_examples=12, deadline=None)
def test_nobody_is_accelerated_beyond_the_limit_and_nobody_above_it_is_slowed(limit, v, a):
    map = Map(lanes=[lane(line(-300, 0, 1000, 0, 50), id=1, speed_limit=limit)])
    p = drive([straight(0.0, 0.0, 0.0, v, a)], map=map)
    now = np.hypot(p.vx0[0], p.vy0[0])
    assert p.speed[0].max() <= max(limit, now) + 1e-3
    assert p.speed[0].min() >= now - 1e-3


def test_a_lower_limit_ahead_is_met_with_comfort():
    map = Map(
        lanes=[
            lane(line(-100, 0, 80, 0), id=1, successors=[2], speed_limit=20.0),
            lane(line(80, 0, 500, 0), id=2, speed_limit=14.0),
        ]
    )
    p = drive([straight(0.0, 0.0, 0.0, 20.0)], map=map)
    beyond = p.x[0] > 82
    assert beyond.any()
    assert p.speed[0][beyond].max() <= 14.5
    assert (-np.diff(p.speed[0], prepend=20.0) / 0.1).max() <= 1.5 + 1e-3


@given(v=st.floats(2.0, 30.0), heading=st.floats(-3.0, 3.0))
@settings(max_examples=10, deadline=None)
def test_where_the_lane_ends_the_path_goes_straight_on(v, heading):
    c, s = np.cos(heading), np.sin(heading)
    map = Map(lanes=[lane(line(-100 * c, -100 * s, 3 * c, 3 * s), id=1)])
    p = drive([straight(0.0, 0.0, heading, v)], map=map)
    assert p.method[0] == Method.MAP_BASED
    np.testing.assert_allclose(p.x[0], v * T * c, atol=1e-3)
    np.testing.assert_allclose(p.y[0], v * T * s, atol=1e-3)


def two_lanes():
    return Map(
        lanes=[
            lane(line(-200, 0, 400, 0, 60), id=1, left_neighbour=2),
            lane(line(-200, 3.5, 400, 3.5, 60), id=2, right_neighbour=1),
        ]
    )


def test_a_lane_change_in_progress_ends_in_the_next_lane():
    p = drive([straight(0.0, 0.8, 0.06, 20.0)], map=two_lanes())  # 1.2 m/s to the left
    assert p.method[0] == Method.MAP_BASED
    assert p.y[0, 4] - 0.8 == pytest.approx(1.2 * 0.5, abs=0.15)
    assert p.y[0, -1] == pytest.approx(3.5, abs=0.3)
    assert abs(p.heading[0, -1]) < 0.02


def test_a_lane_change_that_is_ending_settles_on_the_centre():
    p = drive([straight(0.0, 2.5, 0.04, 20.0)], map=two_lanes())  # in lane 2 already, still moving to its centre
    assert p.y[0, -1] == pytest.approx(3.5, abs=0.2)
    assert p.y[0].max() < 3.9


def test_wandering_within_the_lane_is_no_lane_change():
    p = drive([straight(0.0, 0.3, 0.01, 20.0)], map=two_lanes())
    assert np.abs(p.y[0]).max() < 0.8


@pytest.mark.parametrize(
    ("state", "cls"),
    [
        ((0.0, 9.0, 0.0, 8.0), ObjectClass.CAR),  # beside the road
        ((0.0, 0.0, np.pi, 8.0), ObjectClass.CAR),  # against the traffic
        ((0.0, 0.0, 1.5, 8.0), ObjectClass.CAR),  # across
        ((0.0, 0.0, 0.0, 1.4), ObjectClass.PEDESTRIAN),
        ((0.0, 0.0, 0.0, 5.0), ObjectClass.BICYCLE),
        ((0.0, 0.0, 0.0, 5.0), ObjectClass.UNKNOWN),
    ],
)
def test_who_is_not_driving_on_a_lane_is_predicted_kinematically(state, cls):
    assert drive([straight(*state)], map=two_lanes(), cls=cls).method[0] == Method.CONSTANT_VELOCITY


def test_a_car_standing_on_a_lane_stays_where_it_is():
    p = drive([straight(5.0, 0.4, 0.1, 0.0)], map=two_lanes())
    assert p.method[0] == Method.MAP_BASED
    np.testing.assert_allclose(p.x[0], 5.0, atol=1e-9)
    np.testing.assert_allclose(p.y[0], 0.4, atol=1e-9)
    np.testing.assert_allclose(p.heading[0], 0.1, atol=1e-6)


def test_the_prediction_begins_where_the_object_is():
    map, _ = curve(15.0)
    for x in np.linspace(-20, 12, 17):
        p = drive([straight(x, 0.3, 0.05, 4.0)], map=map, frames=8)
        assert np.hypot(p.x[0, 0] - x, p.y[0, 0] - 0.3) < 0.45


def test_a_successor_elsewhere_or_unknown_or_in_a_loop_does_no_harm():
    ring = arc(0, 0, 0, 10, 2 * np.pi, 60)
    lanes = [
        lane(line(-60, 50, 0, 50), id=1, successors=[99, 2]),  # 2 begins far away
        lane(line(300, 300, 400, 300), id=2),
        lane(ring, id=3, successors=[3]),
        lane(np.zeros((3, 2)) + 7.0, id=4, successors=[4], width=0.0),
    ]
    p = drive([straight(-5.0, 50.0, 0.0, 10.0), circle(0.0, 0.0, 0.0, 5.0, 0.5)], map=Map(lanes=lanes))
    np.testing.assert_allclose(p.x[0], -5.0 + 10.0 * T, atol=1e-3)
    assert p.method[1] == Method.MAP_BASED
    np.testing.assert_allclose(np.hypot(p.x[1], p.y[1] - 10.0), 10.0, atol=0.3)


def test_a_new_map_counts_from_the_next_step_and_no_map_means_off_lane():
    p = predictor()
    map = two_lanes()
    methods = []
    for i, m in enumerate([None, map, map, None]):
        methods.append(p.step(stamped(objects_of([(i * 1.0, 0.0, 0.0, 10.0)]), i * 0.1), None, m).method[0])
    assert methods == [Method.CONSTANT_VELOCITY, Method.MAP_BASED, Method.MAP_BASED, Method.CONSTANT_VELOCITY]


def test_matching_finds_the_nearest_of_thousands_of_lanes():
    lanes = [
        lane(line(200 * (i // 50), 4.0 * (i % 50), 200 * (i // 50) + 200, 4.0 * (i % 50)), id=i) for i in range(4000)
    ]
    map = Map(lanes=lanes)
    rng = np.random.default_rng(0)
    wanted = rng.integers(0, 4000, 128)
    where = [(200.0 * (i // 50) + rng.uniform(20, 150), 4.0 * (i % 50) + 0.5, 0.0, 10.0) for i in wanted]
    p = predictor()
    q = p.step(stamped(objects_of(where), 0.0), None, map)
    np.testing.assert_allclose(q.y[:, 0], q.y0, atol=0.1)
    assert (q.method == Method.MAP_BASED).all()


def test_a_map_without_lanes_or_with_degenerate_ones_is_taken():
    point = lane(np.zeros((2, 2)), id=1, width=0.0, successors=[1, 2])
    for map in (Map(), Map(lanes=[point]), Map(lanes=[point, lane(line(0, 0, 50, 0), id=2, successors=[1])])):
        LaneIndex.of(map)
        assert np.isfinite(drive([straight(10.0, 0.0, 0.0, 10.0)], map=map).x).all()
