"""Polylines, Frenet coordinates, rectangles."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from common.geometry import (
    Polyline,
    distance_between_rectangles,
    distance_to_rectangle,
    rectangle_corners,
    wrap_angle,
)

number = st.floats(-50, 50, allow_nan=False)
angle = st.floats(-7, 7, allow_nan=False)
size = st.floats(0.3, 12)


@given(angle)
def test_wrapped_angles_lie_in_one_turn_and_point_the_same_way(a: float) -> None:
    w = float(wrap_angle(a))
    assert -np.pi <= w < np.pi
    assert np.isclose(np.cos(w), np.cos(a)) and np.isclose(np.sin(w), np.sin(a))


@given(st.floats(-5, 60), st.floats(-3, 3))
def test_frenet_coordinates_of_a_point_beside_a_gentle_curve_come_back(s: float, d: float) -> None:
    phi = np.linspace(0, 1.5, 200)
    line = Polyline.of(40 * np.column_stack((np.sin(phi), 1 - np.cos(phi))))
    s = min(s, line.length + 5)
    heading = line.heading(s)
    point = line.at(s) + d * np.array([-np.sin(heading), np.cos(heading)])
    found_s, found_d = line.project(point)
    assert abs(found_s - s) < 0.35 and abs(found_d - d) < 0.02


def test_beyond_its_ends_a_line_goes_on_straight() -> None:
    line = Polyline.of([[0, 0], [10, 0], [10, 10]])
    assert np.allclose(line.at([-2.0, 25.0]), [[-2, 0], [10, 15]])
    s, d = line.project([[-3, 1], [9, 14]])
    assert np.allclose(s, [-3, 24]) and np.allclose(d, [1, 1])


@pytest.mark.parametrize("points", [[[0, 0]], [[1, 1], [1, 1]], [[0, 0], [np.nan, 1]], [0, 1]])
def test_what_is_no_line_is_refused(points: list[list[float]]) -> None:
    with pytest.raises(ValueError, match="polyline"):
        Polyline.of(points)


@given(number, number, angle, size, size, number, number)
def test_distance_to_a_rectangle_equals_the_nearest_sampled_point(
    x: float, y: float, h: float, length: float, width: float, px: float, py: float
) -> None:
    u, v = np.meshgrid(np.linspace(-0.5, 0.5, 41) * length, np.linspace(-0.5, 0.5, 41) * width)
    qx, qy = x + np.cos(h) * u - np.sin(h) * v, y + np.sin(h) * u + np.cos(h) * v
    sampled = np.hypot(qx - px, qy - py).min()
    exact = float(distance_to_rectangle(px, py, x, y, h, length, width))
    assert exact <= sampled + 1e-9
    assert sampled - exact <= 0.5 * np.hypot(length / 40, width / 40) + 1e-9


@given(number, number, angle, size, size, angle, size, size)
def test_distance_between_rectangles_is_symmetric_and_zero_only_where_they_meet(
    x: float, y: float, h0: float, l0: float, w0: float, h1: float, l1: float, w1: float
) -> None:
    a, b = rectangle_corners(0.0, 0.0, h0, l0, w0), rectangle_corners(x, y, h1, l1, w1)
    gap = float(distance_between_rectangles(a, b))
    assert np.isclose(gap, float(distance_between_rectangles(b, a)))
    t = np.linspace(0, 1, 30)[:, None]
    outline = np.concatenate([b[i] + t * (b[(i + 1) % 4] - b[i]) for i in range(4)])
    inside = np.concatenate([outline, [[x, y]]])
    nearest = distance_to_rectangle(inside[:, 0], inside[:, 1], 0.0, 0.0, h0, l0, w0).min()
    assert gap <= nearest + 1e-9
    if gap > 0:
        assert nearest - gap <= max(l1, w1) / 29 + 1e-9
