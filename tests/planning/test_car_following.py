"""Treiber's models: what a driver wants, by the papers' own statements."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from evaluation.planning.car_following import Following, LaneChange, desired_gap, idm, improved_idm, mobil

P = Following()
speed = st.floats(0.0, 40.0)
gap = st.floats(0.1, 200.0)


def test_the_free_road_gives_full_acceleration_at_rest_and_none_at_the_desired_speed():
    assert idm(P, 0.0, 20.0) == pytest.approx(P.accel)
    assert idm(P, 20.0, 20.0) == pytest.approx(0.0)
    assert idm(P, 25.0, 20.0) < 0.0


@given(v=st.floats(0.5, 18.0))
def test_the_equilibrium_gap_of_the_model_is_kept(v: float):
    """s_e(v) = (s0 + v T) / √(1 − (v/v0)^δ): at this gap behind an equally fast leader nobody accelerates."""
    v0 = 20.0
    s = (P.gap + v * P.headway) / math.sqrt(1.0 - (v / v0) ** P.exponent)
    assert idm(P, v, v0, s, 0.0) == pytest.approx(0.0, abs=1e-9)


@given(v=speed, v0=st.floats(1.0, 40.0), s=gap, dv=st.floats(-20.0, 20.0))
@pytest.mark.parametrize("model", [idm, improved_idm])
def test_a_wider_gap_or_a_faster_leader_never_makes_it_brake_more(model, v: float, v0: float, s: float, dv: float):
    here = model(P, v, v0, s, dv)
    assert model(P, v, v0, 1.5 * s, dv) >= here - 1e-9
    assert model(P, v, v0, s, dv - 1.0) >= here - 1e-9


@given(v=speed, v0=st.floats(1.0, 40.0), s=gap, dv=st.floats(-20.0, 20.0))
def test_the_improved_model_is_continuous_where_its_cases_meet(v: float, v0: float, s: float, dv: float):
    near = desired_gap(P, v, dv)
    if 0.5 < near < 200.0:
        a, b = improved_idm(P, v, v0, near * (1 + 1e-9), dv), improved_idm(P, v, v0, near * (1 - 1e-9), dv)
        assert a == pytest.approx(b, abs=1e-5)


def test_the_improved_model_does_not_brake_for_a_leader_farther_than_its_wish():
    far = 2.0 * desired_gap(P, 15.0, 0.0)
    assert improved_idm(P, 15.0, 15.0, far) == pytest.approx(0.0)
    assert idm(P, 15.0, 15.0, far) < -0.1


def test_without_room_it_brakes_as_hard_as_anybody_can():
    assert idm(P, 5.0, 10.0, 0.0) < -100.0
    assert improved_idm(P, 5.0, 10.0, -1.0) < -100.0


def test_nobody_changes_lanes_for_nothing_nor_if_the_new_follower_must_brake_hard():
    rule = LaneChange()
    assert mobil(rule, (-1.0, 1.0))
    assert not mobil(rule, (0.5, 0.6))
    assert not mobil(rule, (-1.0, 1.0), new_follower=(0.0, -rule.safe_brake - 0.1))
    assert not mobil(rule, (0.0, 0.5), new_follower=(0.0, -2.0))
    assert mobil(LaneChange(politeness=0.0), (0.0, 0.5), new_follower=(0.0, -2.0))
