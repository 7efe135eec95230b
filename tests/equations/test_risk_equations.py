# ruff: noqa: C408, SIM300
"""Equations 1, 2, 4 and 5 at points given by distances: the properties the design promises."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from common.config import section
from common.risk import (
    RiskParameters,
    kinetic_energy,
    masses,
    potential_energy,
    printed_kinetic_energy,
    static_energy,
    straight_energy,
    taper,
    virtual_mass,
)

P = RiskParameters()
CLASSES = st.integers(0, 6)
SPEEDS = st.floats(0.0, 60.0)
POSITIONS = st.floats(-80.0, 80.0)
few = settings(max_examples=60, deadline=None)


def energy(px, py, *, vx=0.0, vy=0.0, heading=0.0, cls=1, length=4.5, width=1.8, to_vx=0.0, p=P):
    return straight_energy(
        px, py, x=0.0, y=0.0, heading=heading, vx=vx, vy=vy, length=length, width=width, mass=0.0, cls=cls,
        to_vx=to_vx, p=p,
    )  # fmt: skip


def test_virtual_mass_grows_4_7_fold_to_120_kmh():
    ratio = virtual_mass(1500.0, 1, 120 / 3.6, P) / virtual_mass(1500.0, 1, 0.0, P)
    assert ratio == pytest.approx(4.7, abs=0.1)


def test_virtual_mass_takes_metres_per_second_and_uses_km_per_hour():
    by_hand = 1500.0 * (1.566e-14 * 90.0**6.687 + 0.3345)
    assert virtual_mass(1500.0, 1, 25.0, P) == pytest.approx(by_hand, rel=1e-12)
    # fed m/s into the power, the speed term would vanish
    assert virtual_mass(1500.0, 1, 25.0, P) > 1.5 * 1500.0 * 0.3345


def test_virtual_mass_is_capped_at_130_kmh_and_blind_to_sign():
    assert virtual_mass(0.0, 1, 130 / 3.6, P) == virtual_mass(0.0, 1, 100.0, P)
    assert virtual_mass(0.0, 1, -20.0, P) == virtual_mass(0.0, 1, 20.0, P)


def test_an_unknown_mass_becomes_the_class_default():
    assert masses([0.0, 0.0, 900.0], [1, 2, 1], P).tolist() == [1500.0, 12000.0, 900.0]


def test_every_parameter_can_be_set_and_an_unknown_one_is_refused():
    assert section({"risk": {"k": 1e-3, "K0": 400}}, "risk", RiskParameters).K0 == 400
    with pytest.raises(Exception, match="nonsense"):
        section({"risk": {"nonsense": 1}}, "risk", RiskParameters)


@given(CLASSES, SPEEDS, st.sampled_from([0.5, 1.0, 2.0, 3.0]))
@few
def test_potential_is_e_max_at_the_body_and_strictly_falls_to_zero_at_the_radius(cls, speed, k1):
    p = RiskParameters(k1=k1, e_max=1.0)
    D = np.concatenate(([0.0], np.geomspace(1e-2, 0.999 * p.taper_radius, 400)))
    pE = potential_energy(D, virtual_mass(0.0, cls, speed, p), p) * taper(D, p)
    assert pE[0] == pytest.approx(p.e_max)
    assert np.all(np.diff(pE) < 0)
    assert np.all(taper([p.taper_radius, p.taper_radius + 1], p) == 0.0)


def test_the_taper_leaves_the_near_field_and_has_no_kink():
    assert np.all(taper(np.linspace(0, 20.0, 50), P) == 1.0)
    D = np.linspace(15.0, 30.0, 3001)
    slope = np.gradient(taper(D, P), D)
    assert np.max(np.abs(np.diff(slope))) < 0.01


@given(POSITIONS, POSITIONS, st.floats(-40, 40), st.floats(-40, 40), st.floats(-40, 40), CLASSES)
@few
def test_the_field_of_an_object_is_finite_and_below_twice_e_max(px, py, vx, vy, to_vx, cls):
    E = energy(px, py, vx=vx, vy=vy, to_vx=to_vx, cls=cls)
    assert np.isfinite(E)
    assert 0.0 <= E < 2 * P.e_max


@given(st.floats(-40, 40), CLASSES, st.floats(1.0, 12.0), st.floats(0.4, 2.6))
@few
def test_kinetic_never_rises_away_from_the_bumper_nor_from_the_path(u, cls, length, width):
    M_v = virtual_mass(0.0, cls, abs(u), P)
    lo, la = np.linspace(0.0, abs(u) * P.t + 5, 60), np.linspace(0.0, 1.5 * width, 40)
    s = np.sign(u) * (lo + length / 2)
    kE = kinetic_energy(s[:, None], la[None], M_v, u, length, width, P)
    assert np.all(np.diff(kE, axis=0) <= 1e-12)
    assert np.all(np.diff(kE, axis=1) <= 1e-12)


@given(st.floats(0.5, 60.0), st.floats(-1.7, 1.7), st.floats(0.0, 30.0))
@few
def test_the_field_ahead_never_falls_with_the_objects_own_speed(ahead, beside, to_vx):
    speeds = np.linspace(0.31, 40.0, 120)
    E = energy(2.25 + ahead, beside, vx=speeds, to_vx=to_vx)
    assert np.all(np.diff(E) >= -1e-12)


@given(POSITIONS, st.floats(0.0, 3.0))
@few
def test_kinetic_is_zero_at_u_zero_and_continuous_through_it(s, beside):
    M_v = virtual_mass(0.0, 1, 30.0, P)
    u = np.linspace(-0.5, 0.5, 2001)
    kE = kinetic_energy(s, beside, M_v, u, 4.5, 1.8, P)
    assert kE[1000] == 0.0
    # no jump: halving the step halves the largest difference
    coarse, fine = np.abs(np.diff(kE[::2])).max(), np.abs(np.diff(kE)).max()
    assert fine <= 0.6 * coarse + 1e-12
    assert np.abs(kE[999:1002]).max() < 1e-3


@given(st.floats(0.1, 40.0), POSITIONS, st.floats(0.0, 3.0))
@few
def test_the_opposite_relative_speed_mirrors_the_lobe(u, s, beside):
    assert kinetic_energy(s, beside, 800.0, u, 4.5, 1.8, P) == kinetic_energy(-s, beside, 800.0, -u, 4.5, 1.8, P)


@given(POSITIONS, st.floats(0.0, 10.0), st.floats(0.0, 30.0), st.floats(0.0, 30.0))
@few
def test_the_two_sides_of_a_straight_path_are_equal(px, py, vx, to_vx):
    assert energy(px, py, vx=vx, to_vx=to_vx) == pytest.approx(energy(px, -py, vx=vx, to_vx=to_vx), abs=1e-12)


@given(POSITIONS, st.floats(-10, 10), st.floats(-40.0, 40.0))
@few
def test_kinetic_lives_within_u_t_beyond_the_body_and_one_width_beside(s, beside, u):
    kE = kinetic_energy(s, abs(beside), 800.0, u, 4.5, 1.8, P)
    outside = abs(beside) >= 1.8 or not -2.25 < np.sign(u) * s < 2.25 + abs(u) * P.t
    assert (kE == 0.0) if outside else (kE >= 0.0)


def test_a_faster_closing_and_a_heavier_object_weigh_more():
    kE = kinetic_energy(10.0, 0.0, [400.0, 800.0, 1600.0], 12.0, 4.5, 1.8, P)
    assert np.all(np.diff(kE) > 0)
    assert np.all(np.diff(kinetic_energy(10.0, 0.0, 500.0, np.array([5.0, 10.0, 20.0]), 4.5, 1.8, P)) > 0)


def test_a_standing_object_seen_from_the_side_has_no_kinetic_field():
    x = np.linspace(-30, 30, 121)
    crossing = dict(x=0.0, y=0.0, heading=0.0, vx=0.0, vy=0.0, length=4.5, width=1.8, mass=0.0, cls=1)
    D = np.maximum(np.abs(x) - 2.25, 0.0)
    alone = potential_energy(D, virtual_mass(0.0, 1, 0.0, P), P) * taper(D, P)
    assert straight_energy(x, 0.0, **crossing, to_vx=0.0, to_vy=15.0, p=P) == pytest.approx(alone, abs=1e-12)


@given(st.floats(0.1, 3.0), st.floats(0.01, 5.0))
@few
def test_static_is_bounded_peaks_on_the_line_and_is_smooth_at_its_edge(half, peak):
    dis = np.linspace(0.0, 2 * half, 2001)
    E = static_energy(dis, half, peak)
    assert E[0] == pytest.approx(peak)
    assert np.all((E >= 0) & (E <= peak * (1 + 1e-12)))
    assert np.all(E[dis >= half] == 0.0)
    slope = np.gradient(E, dis)
    edge = np.searchsorted(dis, half)
    assert np.abs(slope[edge - 2 : edge + 3]).max() < 0.01 * np.abs(slope).max()


def test_the_printed_kinetic_term_has_the_measured_values_and_is_masked_where_undefined():
    # v_r = 10 m/s, t = 3 s, w = 1.8 m: U-shaped ahead of the object
    values = printed_kinetic_energy(np.array([1.0, 15.0, 29.0]), 0.0, 10.0, 1.8, P)
    assert values == pytest.approx([0.103, 0.013, 0.103], abs=5e-4)
    x, y = np.meshgrid(np.linspace(-60, 60, 241), np.linspace(-6, 6, 61))
    field = printed_kinetic_energy(x, np.abs(y), 10.0, 1.8, P)
    assert np.all(np.isfinite(field))
    assert np.all((field >= 0.0) & (field <= P.e_max))
    assert np.all(field[np.abs(y) >= 1.8] == 0.0)
