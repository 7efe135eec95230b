"""Constant velocity and CTRA: exact where they should be, calm where nothing moves, blind to the future."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from common.geometry import wrap_angle
from common.messages import Method, ObjectClass
from services.predictor.kinematic import speeds_ahead
from services.predictor.settings import KinematicSettings
from tests.predictor.scenes import T, circle, drive, objects_of, predictor, stamped, straight

ANGLE = st.floats(-3.1, 3.1)
UTM = st.sampled_from([(0.0, 0.0), (691_000.0, 5_335_000.0), (-4e6, 9e6)])


@given(v=st.floats(0.5, 45.0), heading=ANGLE, origin=UTM, cls=st.sampled_from([1, 2, 5, 6, 0]))
@settings(max_examples=40, deadline=None)
def test_constant_velocity_is_predicted_exactly(v, heading, origin, cls):
    assume(cls != ObjectClass.PEDESTRIAN or v < 10)
    assume(cls != ObjectClass.BICYCLE or v < 20)
    p = drive([straight(*origin, heading, v)], cls=cls)
    np.testing.assert_allclose(p.x[0], origin[0] + v * T * np.cos(heading), atol=1e-5)
    np.testing.assert_allclose(p.y[0], origin[1] + v * T * np.sin(heading), atol=1e-5)
    np.testing.assert_allclose(p.speed[0], v, rtol=1e-4)
    np.testing.assert_allclose(wrap_angle(p.heading[0] - heading), 0.0, atol=1e-4)
    assert p.method[0] == Method.CONSTANT_VELOCITY
    np.testing.assert_allclose([p.vx0[0], p.vy0[0]], [v * np.cos(heading), v * np.sin(heading)], atol=1e-5)


@pytest.mark.parametrize(
    ("cls", "steps"),
    [(ObjectClass.CAR, 3), (ObjectClass.BICYCLE, 5), (ObjectClass.MOTORCYCLE, 5), (ObjectClass.PEDESTRIAN, 5),
     (ObjectClass.UNKNOWN, 5)],
)  # fmt: skip
def test_who_is_in_no_data_that_could_choose_moves_as_the_yardstick_says(cls, steps):
    """Position noise in the last half second: the velocity is the mean of five steps, of vehicles three."""
    noise = {0: 0.05, 1: -0.03, 2: 0.04, 3: -0.06, 4: 0.01, 5: -0.04}

    def path(t):
        return 3.0 * t + noise.get(round(-t / 0.1), 0.0), 0.0, 0.0, 3.0

    p = drive([path], cls=cls)
    v = 3.0 + (noise[0] - noise[steps]) / (0.1 * steps)
    assert p.method[0] == Method.CONSTANT_VELOCITY
    np.testing.assert_allclose(p.x[0], noise[0] + v * T, atol=1e-5)


@given(v=st.floats(2.5, 25.0), radius=st.floats(6.0, 200.0), left=st.booleans(), heading=ANGLE, origin=UTM)
@settings(max_examples=40, deadline=None)
def test_a_circle_is_predicted_exactly_while_the_turn_rate_is_held(v, radius, left, heading, origin):
    omega = v / radius
    assume(0.12 < omega < 0.9 and v * omega < 5.5)
    omega = omega if left else -omega
    p = predictor(policy="kinematic", kinematic=KinematicSettings(turn_decay_s=1e9))
    q = drive([circle(*origin, heading, v, omega)], with_=p)
    x, y, h, _ = np.array([circle(*origin, heading, v, omega)(t) for t in T]).T
    assert q.method[0] == Method.CTRA
    np.testing.assert_allclose(q.x[0], x, atol=1e-3)
    np.testing.assert_allclose(q.y[0], y, atol=1e-3)
    np.testing.assert_allclose(q.speed[0], v, rtol=1e-4)
    np.testing.assert_allclose(wrap_angle(q.heading[0] - h), 0.0, atol=1e-3)


@given(v=st.floats(3.0, 20.0), radius=st.floats(8.0, 100.0), heading=ANGLE)
@settings(max_examples=30, deadline=None)
def test_a_fading_turn_lies_between_the_circle_and_the_tangent(v, radius, heading):
    omega = v / radius
    assume(0.12 < omega < 0.9 and v * omega < 5.5)
    q = drive([circle(0.0, 0.0, heading, v, omega)])
    turned = np.diff(np.unwrap(q.heading[0].astype(float)), prepend=heading + 0.0)
    assert (wrap_angle(turned) >= -1e-5).all()
    assert (wrap_angle(turned) <= omega * 0.1 + 1e-4).all()


@given(v=st.floats(1.0, 40.0), a=st.floats(-9.0, 5.0), heading=ANGLE, frames=st.integers(1, 30))
@settings(max_examples=60, deadline=None)
def test_nothing_reverses_and_what_brakes_comes_to_rest(v, a, heading, frames):
    assume(v + a * 0.5 > 0)
    p = drive([straight(0.0, 0.0, heading, v, a)], frames=frames)
    along = p.x[0] * np.cos(heading) + p.y[0] * np.sin(heading)
    assert (np.diff(along, prepend=0.0) >= -1e-6).all()
    assert (p.speed[0] >= 0).all()
    if a <= -3.5 and frames == 30:
        assert p.speed[0, -1] == 0.0 or v + a * 6.0 > 0
        assert p.method[0] == Method.CTRA


@given(v=st.floats(8.0, 30.0), a=st.floats(-8.0, -3.2))
@settings(max_examples=30, deadline=None)
def test_hard_braking_goes_on_as_measured_until_rest(v, a):
    p = drive([straight(0.0, 0.0, 0.0, v, a)])
    expected = np.array([straight(0.0, 0.0, 0.0, v, a)(t)[0] for t in T])
    np.testing.assert_allclose(p.x[0], expected, atol=0.1)
    np.testing.assert_allclose(p.speed[0], np.maximum(v + a * T, 0.0), atol=1e-3)


@given(v=st.floats(0.0, 150.0), a=st.floats(-50.0, 50.0))
@settings(max_examples=50, deadline=None)
def test_speeds_are_monotone_and_bounded(v, a):
    s = speeds_ahead(np.array([v]), np.array([a]), KinematicSettings())[0]
    assert (s >= 0).all()
    assert (s <= 150).all()
    steps = np.diff(s, prepend=v)
    assert (steps >= -1e-12).all() if a >= 0 else (steps <= 1e-12).all()


@given(
    heading=ANGLE,
    cls=st.sampled_from([1, 2, 4, 5, 6, 0]),
    noise=st.floats(0.0, 0.03),
    seed=st.integers(0, 1000),
    origin=UTM,
)
@settings(max_examples=40, deadline=None)
def test_what_stands_stays_put_and_keeps_its_heading(heading, cls, noise, seed, origin):
    rng = np.random.default_rng(seed)

    def path(t):
        dx, dy = rng.normal(0.0, noise, 2)
        return origin[0] + dx, origin[1] + dy, heading, 0.0

    p = drive([path], cls=cls, frames=35)
    assert np.hypot(p.x - p.x0[:, None], p.y - p.y0[:, None]).max() < 0.05
    np.testing.assert_allclose(wrap_angle(p.heading[0] - p.heading0[0]), 0.0, atol=1e-5)
    assert p.speed.max() < 0.02


@given(
    paths=st.lists(
        st.tuples(st.floats(-80, 80), st.floats(-80, 80), ANGLE, st.floats(0.0, 30.0), st.floats(-6.0, 3.0)),
        min_size=1,
        max_size=5,
    ),
    angle=ANGLE,
    shift=UTM,
)
@settings(max_examples=30, deadline=None)
def test_moving_and_turning_the_scene_moves_and_turns_the_prediction(paths, angle, shift):
    c, s = np.cos(angle), np.sin(angle)
    a = drive([straight(*p) for p in paths])
    b = drive(
        [straight(shift[0] + c * x - s * y, shift[1] + s * x + c * y, h + angle, v, acc) for x, y, h, v, acc in paths]
    )
    np.testing.assert_allclose(b.x, shift[0] + c * a.x - s * a.y, atol=1e-4)
    np.testing.assert_allclose(b.y, shift[1] + s * a.x + c * a.y, atol=1e-4)
    np.testing.assert_allclose(b.speed, a.speed, atol=1e-4)
    np.testing.assert_allclose(wrap_angle(b.heading - a.heading - angle), 0.0, atol=1e-4)


@given(seed=st.integers(0, 1000), now=st.integers(0, 40))
@settings(max_examples=15, deadline=None)
def test_the_future_changes_nothing(seed, now):
    rng = np.random.default_rng(seed)
    walk = np.cumsum(rng.normal(0.5, 0.2, (60, 2)), axis=0)
    other = walk.copy()
    other[now + 1 :] += rng.normal(0.0, 5.0, (59 - now, 2))

    def predictions(points):
        p = predictor()
        return [p.step(stamped(objects_of([(*points[i], 0.3, 5.0)]), 0.1 * i), None, None) for i in range(60)]

    for a, b in zip(predictions(walk)[: now + 1], predictions(other)[: now + 1], strict=True):
        for name in ("x", "y", "heading", "speed", "vx0", "vy0", "past_x", "past_y"):
            np.testing.assert_array_equal(getattr(a, name), getattr(b, name))


def test_with_a_short_history_the_velocity_is_the_messages():
    p = predictor()
    for i in range(3):
        q = p.step(stamped(objects_of([(5.0 * i, 0.0, 0.0, 12.0)]), 0.1 * i), None, None)
        assert q.vx0[0] == 12.0
    q = p.step(stamped(objects_of([(15.0, 0.0, 0.0, 12.0)]), 0.3), None, None)
    assert q.vx0[0] == pytest.approx(50.0)


def test_one_noisy_step_makes_no_acceleration_and_no_turn():
    rng = np.random.default_rng(0)
    methods = []
    for _ in range(30):
        jump = rng.normal(0.0, 0.3, 2)
        paths = [lambda t, j=jump: (12.0 * t + (j[0] if abs(t) < 0.01 else 0.0), j[1] * (abs(t) < 0.01), 0.0, 12.0)]
        methods.append(drive(paths).method[0])
    assert set(methods) == {Method.CONSTANT_VELOCITY}


def test_a_body_that_slides_keeps_its_yaw():
    def path(t):  # moves along x, looks along 0.3 rad
        return 10.0 * t, 0.0, 0.3, 0.0

    p = drive([path])
    np.testing.assert_allclose(p.heading[0], 0.3, atol=1e-5)
    np.testing.assert_allclose(p.x[0], 10.0 * T, atol=1e-6)


def test_a_reversing_car_goes_on_backwards_without_turning_round():
    p = drive([straight(0.0, 0.0, 0.5, -3.0)])
    np.testing.assert_allclose(p.heading[0], 0.5, atol=1e-5)
    np.testing.assert_allclose(p.x[0], -3.0 * T * np.cos(0.5), atol=1e-5)
    np.testing.assert_allclose(p.speed[0], 3.0, rtol=1e-5)
