"""The reference line made smooth, and paths beside it."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from services.planner.bezier import Start, Target, build_paths, frenet_start
from services.planner.reference import ReferenceLine


def circle(radius: float, angle: float, straight: float = 30.0, step: float = 1.0) -> np.ndarray:
    """Straight, a left curve, straight on."""
    n = max(int(radius * angle / step), 4)
    a = np.linspace(0, angle, n)
    arc = np.stack((radius * np.sin(a), radius * (1 - np.cos(a))), axis=1)
    head = np.stack((np.arange(-straight, 0, step), np.zeros(int(straight / step))), axis=1)
    out = arc[-1] + np.arange(step, straight, step)[:, None] * np.array([np.cos(angle), np.sin(angle)])
    return np.vstack((head, arc, out))


def test_a_kink_of_a_motorway_lane_does_not_read_as_a_tight_curve():
    line = ReferenceLine.of(np.array([[0, 0], [100, 0], [200, 5.0], [300, 10.0]]))
    assert np.abs(line.curvature).max() < 0.006


def test_noise_of_a_recorded_track_does_not_read_as_curves():
    rng = np.random.default_rng(1)
    points = np.stack((np.arange(0, 200, 0.8), 0.05 * rng.standard_normal(250)), axis=1)
    line = ReferenceLine.of(points)
    assert np.abs(line.curvature).max() < 0.01
    assert np.abs(line.y).max() < 0.1


def test_a_recorder_that_stood_still_leaves_no_loops():
    rng = np.random.default_rng(2)
    jitter = np.array([[20.0, 0.0]]) + 0.03 * rng.standard_normal((50, 2))
    line = ReferenceLine.of(np.vstack(([[0.0, 0.0], [10.0, 0.0]], jitter, [[40.0, 0.0], [60.0, 0.0]])))
    assert np.abs(line.heading).max() < 0.1
    assert abs(line.length - 60.0) < 0.5


@pytest.mark.parametrize("radius", [6.0, 8.0, 12.0, 40.0])
def test_tight_turns_stay_where_they_are(radius: float):
    points = circle(radius, np.pi if radius < 7 else np.pi / 2)
    line = ReferenceLine.of(points)
    apart = [np.hypot(line.x - x, line.y - y).min() for x, y in points]
    assert max(apart) < 0.35
    assert np.abs(line.curvature).max() < 1.15 / radius


def test_the_ends_stay_the_ends():
    line = ReferenceLine.of(np.array([[0.0, 0.0], [40.0, 0.0]]))
    assert np.allclose([line.x[0], line.y[0], line.x[-1], line.y[-1]], [0, 0, 40, 0], atol=0.05)
    beyond = line.at(50.0)
    assert np.allclose([beyond.x, beyond.y], [50.0, 0.0], atol=0.05)


@settings(max_examples=40, deadline=None)
@given(st.floats(5, 60), st.floats(-2.5, 2.5))
def test_projection_inverts_position(s: float, d: float):
    line = ReferenceLine.of(circle(12.0, np.pi / 2))
    p = line.at(s)
    x, y = float(p.x - d * np.sin(p.heading)), float(p.y + d * np.cos(p.heading))
    found_s, found_d = line.project(x, y, float(p.heading))
    assert abs(found_s - s) < 0.02
    assert abs(found_d - d) < 0.02


def test_a_u_turn_does_not_swallow_the_way_back():
    line = ReferenceLine.of(circle(6.0, np.pi, straight=60.0))
    s_out, _ = line.project(-20.0, 2.0, 0.0)
    s_back, _ = line.project(-20.0, 10.0, np.pi)
    assert s_out < 50.0 < s_back
    near, _ = line.project(-20.0, 6.2, 0.0, near=s_out)  # in the middle between the legs: it stays on its own
    assert near < 50.0


@settings(max_examples=40, deadline=None)
@given(
    st.floats(-1.0, 1.0),
    st.floats(-0.4, 0.4),
    st.floats(-0.1, 0.1),
    st.floats(-3.0, 3.0),
    st.sampled_from([12.0, 25.0, 200.0]),
)
def test_a_path_meets_position_direction_and_steering_of_the_rear_axle(
    d: float, turn: float, curvature: float, offset: float, radius: float
):
    line = ReferenceLine.of(circle(radius, np.pi / 2))
    p = line.at(25.0)
    start = Start(
        float(p.x - d * np.sin(p.heading)),
        float(p.y + d * np.cos(p.heading)),
        float(p.heading) + turn,
        curvature,
        8.0,
        0.0,
    )
    frenet = frenet_start(line, start, None)
    s = frenet[0] + 0.25 * np.arange(300)
    target = Target("t", np.full_like(s, offset), np.zeros_like(s), np.zeros_like(s))
    paths = build_paths(line, s, frenet, [target], np.array([25.0]), step=0.5, points=80, max_curvature=0.3)
    assert np.hypot(paths.x[0, 0] - start.x, paths.y[0, 0] - start.y) < 0.02
    assert abs(paths.heading[0, 0] - start.heading) < 0.02
    assert abs(paths.curvature[0, 0] - curvature) < 0.02
    assert abs(paths.d[0, 60] - offset) < 0.05  # arrived
    good = int(paths.end[0] / 0.5)
    ds = np.hypot(np.diff(paths.x[0]), np.diff(paths.y[0]))[: max(good - 1, 1)]
    assert np.allclose(ds, 0.5, atol=0.03)
    turned = np.diff(np.unwrap(paths.heading[0]))[: max(good - 1, 1)]
    mean = 0.5 * (paths.curvature[0, 1:] + paths.curvature[0, :-1])[: max(good - 1, 1)]
    assert np.allclose(turned, 0.5 * mean, atol=0.02)


def test_what_is_too_tight_ends_the_path():
    line = ReferenceLine.of(circle(6.0, np.pi))
    s = 10.0 + 0.25 * np.arange(400)
    inner = Target("t", np.full_like(s, 3.5), np.zeros_like(s), np.zeros_like(s))
    outer = Target("t", np.full_like(s, -1.0), np.zeros_like(s), np.zeros_like(s))
    start = frenet_start(line, Start(-20.0, 0.0, 0.0, 0.0, 5.0, 0.0), None)
    paths = build_paths(line, s, start, [inner, outer], np.full(2, 15.0), step=0.5, points=100, max_curvature=0.24)
    assert paths.end[0] < 25.0
    assert paths.end[1] > 45.0
