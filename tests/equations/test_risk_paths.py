# ruff: noqa: C408, SIM300
"""The kinetic term along curved paths, and the sources that a prediction becomes."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from common.risk import RiskParameters, dynamic_energy, local_closest, straight_energy
from common.risk_sources import StaticLine, dynamic_sources, line_energy, risk_at_points
from tests.riskfield.scenes import prediction

P = RiskParameters()
few = settings(max_examples=25, deadline=None)


def arc(radius: float, step: float, back: float = 20.0, ahead: float = 60.0) -> tuple[np.ndarray, float]:
    """A circular path through the origin along x, its vertices `step` apart; and the origin's arc length on it."""
    s = np.arange(-round(back / step), round(ahead / step) + 1) * step
    points = np.stack((radius * np.sin(s / radius), radius * (1 - np.cos(s / radius))), axis=-1)
    chords = np.hypot(*np.diff(points, axis=0).T)
    return points, float(chords[: round(back / step)].sum())


def field(px, py, path, s0, *, u=10.0, heading=0.0, x=0.0, y=0.0, length=4.5, width=1.8, M_v=700.0):
    return dynamic_energy(
        px, py, x=x, y=y, heading=heading, length=length, width=width, M_v=M_v, u=u, path=path, s0=s0, p=P
    )


def around(seed=0, n=4000):
    rng = np.random.default_rng(seed)
    return rng.uniform(-30, 45, n), rng.uniform(-15, 45, n)


@given(st.floats(0, 6.28), st.floats(-1e4, 1e4), st.floats(-1e4, 1e4), st.sampled_from([-12.0, 9.0]))
@few
def test_the_field_does_not_change_under_rigid_motion(angle, dx, dy, u):
    path, s0 = arc(15.0, 0.7)
    px, py = around(n=400)
    c, s = np.cos(angle), np.sin(angle)

    def moved(x, y):
        return dx + c * x - s * y, dy + s * x + c * y

    before = sum(field(px, py, path, s0, u=u))
    after = sum(
        field(*moved(px, py), np.stack(moved(*path.T), axis=-1), s0, u=u, heading=angle, x=dx, y=dy)
    )  # fmt: skip
    assert after == pytest.approx(before, abs=1e-9)


@given(st.integers(0, 1000), st.sampled_from([-10.0, 10.0]))
@few
def test_vertices_put_on_a_path_change_nothing(seed, u):
    rng = np.random.default_rng(seed)
    path, s0 = arc(12.0, 1.5)
    k = rng.choice(len(path) - 1, 20, replace=False)
    put = k + rng.uniform(0.3, 0.7, 20)
    extra = path[k] + (path[k + 1] - path[k]) * (put - k)[:, None]
    finer = np.concatenate((path, extra))[np.argsort(np.concatenate((np.arange(len(path)), put)), kind="stable")]
    px, py = around(seed, 1000)
    assert sum(field(px, py, finer, s0, u=u)) == pytest.approx(sum(field(px, py, path, s0, u=u)), abs=1e-6)


@pytest.mark.parametrize("radius", [5.0, 12.0, 80.0])
@pytest.mark.parametrize("u", [-3.0, 3.0])
def test_resampling_a_curved_path_changes_the_field_by_less_than_a_hundredth(radius, u):
    back = ahead = min(20.0, 2.5 * radius)  # longer than the lobe: where the path ends, its last chord goes on
    px, py = around()
    coarse, fine = (arc(radius, step, back, ahead) for step in (0.5, 0.125))
    difference = np.abs(sum(field(px, py, *coarse, u=u)) - sum(field(px, py, *fine, u=u)))
    assert difference.max() < 1e-2 * P.e_max


@given(st.floats(0.5, 30.0), st.floats(3.0, 60.0), st.sampled_from([-1.0, 1.0]))
@few
def test_kinetic_stays_within_its_reach_along_and_one_width_beside_a_curved_path(speed, radius, sign):
    path, s0 = arc(radius, 0.5, min(20.0, radius), min(100.0, 2.0 * radius))
    px, py = around(n=2000)
    _, kE = field(px, py, path, s0, u=sign * speed)
    nearest = np.min([np.where(c, D, np.inf) for _, D, c in local_closest(px, py, path)], axis=0)
    assert np.all(kE[nearest >= 1.8] == 0.0)
    s_min = np.min([np.where(c & (D < 1.8), s, np.inf) for s, D, c in local_closest(px, py, path)], axis=0) - s0
    s_max = np.max([np.where(c & (D < 1.8), s, -np.inf) for s, D, c in local_closest(px, py, path)], axis=0) - s0
    beyond = (sign * np.where(sign > 0, s_min, s_max) > 2.25 + speed * P.t) | (
        sign * np.where(sign > 0, s_max, s_min) < -2.25
    )
    assert np.all(kE[beyond] == 0.0)


@pytest.mark.parametrize("radius", [4.0, 10.0, 1e5])
@pytest.mark.parametrize("u", [-8.0, 8.0])
def test_halving_the_step_halves_the_largest_jump(radius, u):
    """Along many straight cuts through the field of a coarse path (1 m between vertices)."""
    path, s0 = arc(radius, 1.0, min(20.0, 2 * radius), min(40.0, 2 * radius))
    rng = np.random.default_rng(3)
    centres = path[rng.integers(2, len(path) - 2, 60)] + rng.uniform(-1.5, 1.5, (60, 2))
    angles = rng.uniform(0, np.pi, 60)
    jumps = []
    for n in (400, 800, 1600):
        t = np.linspace(-3.0, 3.0, n + 1)
        px = centres[:, :1] + t * np.cos(angles)[:, None]
        py = centres[:, 1:] + t * np.sin(angles)[:, None]
        jumps.append(np.abs(np.diff(sum(field(px, py, path, s0, u=u)), axis=1)).max())
    assert jumps[1] < 0.6 * jumps[0]
    assert jumps[2] < 0.6 * jumps[1]


def test_a_u_turn_shows_the_way_back_not_the_way_through():
    """Local closest points: a path that comes back beside itself keeps both of its strips."""
    path, s0 = arc(6.0, 0.5, 10.0, 6.0 * np.pi)
    path = np.concatenate((path, path[-1] + np.arange(1, 40)[:, None] * np.array([-0.5, 0.0])))
    _, kE = field(np.array([-3.0]), np.array([12.0]), path, s0, u=14.0)
    assert kE[0] > 0.1


FAR = st.floats(-60, 60)


@given(st.floats(-3, 3), st.floats(0.4, 25.0), FAR, FAR, st.floats(-20, 20), st.integers(0, 6))
@few
def test_a_straight_prediction_gives_the_straight_field(heading, speed, px, py, to_vx, cls):
    row = dict(x=1e5, y=-2e5, heading=heading, speed=speed, cls=cls, length=4.0, width=1.5)
    sources = dynamic_sources(prediction([row]), [0.0], (to_vx, 3.0), P)
    M = risk_at_points(1e5 + px, -2e5 + py, sources, 0, (), P)
    by_hand = straight_energy(
        px, py, x=0.0, y=0.0, heading=heading, vx=speed * np.cos(heading), vy=speed * np.sin(heading), length=4.0,
        width=1.5, mass=0.0, cls=cls, to_vx=to_vx, to_vy=3.0, p=P,
    )  # fmt: skip
    assert M == pytest.approx(by_hand, abs=1e-6)


def test_slices_lie_between_frames_and_beyond_the_last_one():
    rows = [dict(x=0.0, speed=10.0, heading=0.0), dict(x=0.0, y=5.0, speed=0.0, heading=3.1)]
    sources = dynamic_sources(prediction(rows), [0.0, 0.25, 6.0, 7.5], (0.0, 0.0), P)
    assert sources.x[:, 0] == pytest.approx([0.0, 2.5, 60.0, 75.0], abs=1e-6)
    assert sources.x[:, 1] == pytest.approx(0.0, abs=1e-9)
    assert sources.s0[:, 0] - sources.s0[0, 0] == pytest.approx([0.0, 2.5, 60.0, 75.0], abs=1e-5)


def test_headings_are_interpolated_the_short_way_round():
    sources = dynamic_sources(prediction([dict(heading=3.1, rate=0.8, speed=5.0)]), [0.0, 0.05, 0.15], (0, 0), P)
    wrapped = (np.array([3.1, 3.14, 3.22]) + np.pi) % (2 * np.pi) - np.pi
    assert sources.heading[:, 0] == pytest.approx(wrapped, abs=1e-5)


def test_a_standing_objects_jitter_makes_no_path():
    still = prediction([dict(heading=0.4, speed=0.0)])
    rng = np.random.default_rng(0)
    noise = rng.normal(0, 0.03, still.past_x.shape)
    jittered = type(still)(
        **{f: getattr(still, f) for f in still.__struct_fields__ if f not in ("past_x", "past_y")},
        past_x=still.past_x + noise,
        past_y=still.past_y - noise,
    )
    path = dynamic_sources(jittered, [0.0], (10.0, 0.0), P).path(0)
    tangents = np.diff(path, axis=0)
    assert np.arctan2(tangents[:, 1], tangents[:, 0]) == pytest.approx(0.4)


def test_relative_speed_is_taken_along_the_objects_path_with_its_sign():
    rows = [dict(heading=0.0, speed=5.0), dict(heading=np.pi, speed=5.0), dict(heading=np.pi / 2, speed=5.0)]
    sources = dynamic_sources(prediction(rows), [0.0], (12.0, 0.0), P)
    assert sources.u[0] == pytest.approx([-7.0, 17.0, 5.0], abs=1e-6)


def test_spread_grows_the_rectangle_on_every_side():
    sources = dynamic_sources(prediction([dict(speed=3.0)], sigma=0.4), [0.0, 1.0], (0.0, 0.0), P)
    assert sources.width[:, 0] == pytest.approx([1.8, 2.6], abs=1e-6)
    assert sources.length[:, 0] == pytest.approx([4.5, 5.3], abs=1e-6)


BENT = np.array([[-20.0, 0.0], [0.0, 0.0], [10.0, 3.0], [18.0, 9.0]])


def test_beyond_an_outer_edge_the_field_stays_at_its_peak():
    line = StaticLine(1, "barrier", "barrier", BENT, 0.6, 1.5, side=1, depth=np.full(3, 40.0))
    rng = np.random.default_rng(1)
    s = rng.uniform(0.02, 0.98, 300) * 3
    k = s.astype(int)
    t = np.diff(BENT, axis=0)[k]
    n = np.stack((-t[:, 1], t[:, 0]), axis=-1) / np.hypot(t[:, 0], t[:, 1])[:, None]
    on = BENT[k] + t * (s - k)[:, None]
    far = on + n * rng.uniform(0.0, 10.0, 300)[:, None]
    assert line_energy(*far.T, line) == pytest.approx(1.5)
    near = on - n * rng.uniform(0.61, 3.0, 300)[:, None]
    inside = np.array([q[1] < np.interp(q[0], BENT[:, 0], BENT[:, 1]) - 0.75 for q in near])
    assert inside.sum() > 100
    assert np.all(line_energy(*near[inside].T, line) == 0.0)


def test_the_wedge_outside_a_bend_of_an_outer_edge_has_no_gap():
    line = StaticLine(1, "barrier", "barrier", BENT[::-1].copy(), 0.6, 1.5, side=1, depth=np.full(3, 40.0))
    angle = np.linspace(0, 2 * np.pi, 721)
    for r in (2.0, 8.0):
        px, py = r * np.sin(angle), -r * np.abs(np.cos(angle))
        assert line_energy(px, py, line) == pytest.approx(1.5)


def test_a_line_with_two_sides_falls_on_both():
    line = StaticLine(1, "lane_line", "lane_line", BENT, 0.5, 0.1)
    assert line_energy(-10.0, np.array([-0.5, -0.25, 0.0, 0.25, 0.5]), line) == pytest.approx(
        [0.0, 0.025, 0.1, 0.025, 0.0]
    )
