"""The lane says where, the network how fast."""

from __future__ import annotations

import numpy as np
import pytest

from services.predictor.blend import lane_path_network_speed
from services.predictor.kinematic import Motion, State

T = 0.1 * np.arange(1, 61)


def state(x=0.0, y=0.0):
    zero = np.zeros(1)
    return State(zero + x, zero + y, zero, zero + 10.0, zero, zero + 10.0, zero, zero, zero)


def straight(speed, heading=0.0):
    s = speed * T[None]
    return Motion(s * np.cos(heading), s * np.sin(heading), np.full((1, 60), heading), np.full((1, 60), float(speed)))


def arc(speed, radius):
    a = speed * T[None] / radius
    return Motion(radius * np.sin(a), radius * (1 - np.cos(a)), a, np.full((1, 60), float(speed)))


@pytest.mark.parametrize("speed", [3.0, 10.0, 20.0])
def test_the_object_follows_the_lane_as_far_as_the_network_says(speed):
    m = lane_path_network_speed(state(), arc(10.0, 40.0), straight(speed))
    driven = np.minimum(speed * T, 10.0 * 6.0)
    np.testing.assert_allclose(np.hypot(m.x[0], m.y[0] - 40.0)[driven < 60.0], 40.0, atol=0.02)
    np.testing.assert_allclose(m.heading[0][driven < 60.0], (driven / 40.0)[driven < 60.0], atol=0.02)
    np.testing.assert_allclose(m.speed, speed, rtol=1e-6)


def test_beyond_the_lanes_path_it_goes_straight_on():
    m = lane_path_network_speed(state(), straight(5.0), straight(10.0, heading=0.3))
    np.testing.assert_allclose(m.x[0], 10.0 * T, atol=1e-6)
    np.testing.assert_allclose(m.y[0], 0.0, atol=1e-9)


def test_a_path_too_short_to_give_a_direction_leaves_the_networks_positions():
    learned = straight(0.3, heading=1.0)
    m = lane_path_network_speed(state(), straight(0.1), learned)
    np.testing.assert_array_equal(m.x, learned.x)
    np.testing.assert_array_equal(m.y, learned.y)


def test_who_stands_by_the_network_stands_on_the_lane():
    m = lane_path_network_speed(state(2.0, 1.0), Motion(2.0 + straight(8.0).x, np.ones((1, 60)), np.zeros((1, 60)),
                                np.full((1, 60), 8.0)), Motion(np.full((1, 60), 2.0), np.ones((1, 60)),
                                np.zeros((1, 60)), np.zeros((1, 60))))  # fmt: skip
    np.testing.assert_allclose(m.x, 2.0)
    np.testing.assert_allclose(m.y, 1.0)
