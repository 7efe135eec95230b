# ruff: noqa: C408
"""Promises of the field held for the kernels in float32, exact and fast, each by the name of what could break it."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec.structs import replace

from common.messages import NO_SLOT, Closures, Map
from common.risk import RiskParameters
from services.riskfield.core import RiskField
from services.riskfield.grid import cell_centres, into_grid
from services.riskfield.settings import RiskfieldSettings
from tests.riskfield.scenes import ego, prediction, stamped
from tests.riskfield.test_field_kernels import reference

P = RiskParameters()
LAYOUT = dict(ahead=16.0, ahead_most=16.0, behind=8.0, width=16.0, h=0.25, slices=2, slice_s=1.3, dtype="float32")
FIELDS = {a: RiskField(RiskfieldSettings(accuracy=a, **LAYOUT), P, "cpu") for a in ("exact", "fast")}
MOST = {"exact": 1e-4, "fast": 2e-3}
HEADINGS = st.floats(-np.pi, np.pi)
few = settings(max_examples=3, deadline=None)


def volumes(scene, me, *, compare=True):
    """The field of both variants, each held against the reference."""
    found = {}
    for name, field in FIELDS.items():
        r = field.step(stamped(scene), stamped(me), Map(), None)
        assert np.all(np.isfinite(r.volume))
        if compare:
            ref = sum(reference((scene, me, Map()), r, Closures(), 0.0, P).values())
            assert np.all(np.abs(r.volume - ref) <= MOST[name] * (P.e_max + np.abs(ref))), name
        found[name] = r
    return found


def at(r, x, y, j=0):
    i, k = np.floor(into_grid(r.grid, np.array([x, y])) / r.grid.h).astype(int)
    return float(r.volume[j, i, k])


def around(me, x, y):
    """A place x ahead and y to the left of the ego."""
    c, s = np.cos(me.heading), np.sin(me.heading)
    return me.x + c * x - s * y, me.y + s * x + c * y


@given(st.floats(0.25, 0.5), st.sampled_from([-1.0, 1.0]))
@few
def test_the_field_of_a_turning_object_follows_its_curved_path(rate, side):
    row = dict(x=-5.0, y=-side * 4.0, speed=7.0, rate=side * rate)
    radius = 7.0 / rate
    turned = 9.0 / radius
    on_path = (-5.0 + radius * np.sin(turned), -side * 4.0 + side * radius * (1 - np.cos(turned)))
    for r in volumes(prediction([row]), ego(speed=0.0)).values():
        assert at(r, *on_path) > at(r, 4.0, -side * 4.0) + 0.05  # as far straight on


@given(HEADINGS, st.floats(2.0, 6.0))
@few
def test_the_lobe_of_a_reversing_object_lies_where_it_drives_to_not_where_it_looks(yaw, speed):
    me = ego(heading=yaw, speed=0.0)
    x, y = around(me, 4.0, 0.0)
    p = prediction([dict(x=x, y=y, heading=yaw, speed=speed)])
    p = replace(p, heading0=p.heading0 + np.pi, heading=p.heading + np.float32(np.pi))
    for r in volumes(p, me).values():
        assert at(r, *around(me, 9.0, 0.0)) > at(r, *around(me, -1.0, 0.0)) + 0.05


@given(HEADINGS, st.floats(3.0, 15.0))
@few
def test_a_standing_object_has_its_lobe_towards_the_ego_that_closes_in_and_none_seen_from_the_side(yaw, speed):
    me = ego(heading=yaw, speed=speed)
    x, y = around(me, 10.0, 0.0)
    for r in volumes(prediction([dict(x=x, y=y, heading=yaw)]), me).values():
        assert at(r, *around(me, 6.0, 0.0)) > at(r, *around(me, 14.0, 0.0)) + 0.05
    side_on = prediction([dict(x=x, y=y, heading=yaw + np.pi / 2)])
    still = volumes(side_on, ego(heading=yaw, speed=0.0), compare=False)
    for name, r in volumes(side_on, me).items():
        assert np.abs(r.volume - still[name].volume).max() <= 1e-5


@given(st.floats(2.0, 20.0), st.floats(1e-4, 0.05))
@few
def test_the_field_is_continuous_where_the_relative_speed_goes_through_zero(speed, du):
    me = ego(speed=speed)
    slower, same, faster = (
        volumes(prediction([dict(x=5.0, y=1.0, speed=speed + d)]), me, compare=d == 0.0) for d in (-du, 0.0, du)
    )
    for name in FIELDS:
        middle = same[name].volume[0]
        for other in (slower, faster):
            assert np.abs(other[name].volume[0] - middle).max() <= 2.0 * du**2 + 0.01 * du + 1e-5


@given(HEADINGS, st.integers(1, 5))
@few
def test_an_object_larger_than_the_grid_fills_it_with_e_max(yaw, cls):
    me = ego(heading=yaw, speed=0.0)
    big = prediction([dict(x=0.0, y=0.0, heading=yaw + 0.3, length=150.0, width=90.0, cls=cls)])
    for r in volumes(big, me).values():
        assert r.volume == pytest.approx(P.e_max, abs=1e-4)


@given(HEADINGS, st.floats(0.0, 12.0), st.integers(0, 6))
@few
def test_objects_on_top_of_each_other_add_up(yaw, speed, cls):
    me = ego(speed=6.0)
    row = dict(x=6.0, y=2.0, heading=yaw, speed=speed, cls=cls)
    one = volumes(prediction([row]), me, compare=False)
    both = volumes(prediction([row, dict(row, id=99)]), me)
    for name in FIELDS:
        assert both[name].volume == pytest.approx(2.0 * one[name].volume, abs=2e-5)


def test_without_objects_there_is_no_field_and_nobody_is_named():
    for r in volumes(prediction([]), ego()).values():
        assert np.all(r.volume == 0.0)
        assert np.all(r.dominant == NO_SLOT)


@given(HEADINGS, st.sampled_from([0.0, 5.3e6]))
@few
def test_turning_the_grid_and_all_that_is_in_it_changes_nothing(yaw, far):
    rows = [
        dict(x=8.0, y=2.0, heading=0.4, speed=9.0, rate=0.3),
        dict(x=-6.0, y=-5.0, heading=-2.0, speed=1.3, cls=6),
        dict(x=14.0, y=-3.0, heading=3.0, speed=11.0, cls=2),
    ]
    me = ego(speed=8.0)
    turned = ego(far, far, yaw, 8.0)
    moved = []
    for row in rows:
        x, y = around(turned, row["x"], row["y"])
        moved.append(dict(row, x=x, y=y, heading=row["heading"] + yaw))
    plain, other = volumes(prediction(rows), me, compare=False), volumes(prediction(moved), turned)
    for name in FIELDS:
        assert np.abs(plain[name].volume - other[name].volume).max() <= 1e-4


@pytest.mark.parametrize("accuracy", list(FIELDS))
def test_the_source_named_has_the_largest_share_at_each_blocks_highest_cell(accuracy):
    rng = np.random.default_rng(7)
    rows = [
        dict(id=k, x=rng.uniform(-7, 15), y=rng.uniform(-7, 7), heading=rng.uniform(-3, 3), speed=rng.uniform(0, 12),
             rate=rng.choice([0.0, 0.3]), cls=rng.integers(0, 7))
        for k in range(8)
    ]  # fmt: skip
    scene, me = prediction(rows), ego(speed=9.0)
    r = FIELDS[accuracy].step(stamped(scene), stamped(me), Map(), None)
    shares = reference((scene, me, Map()), r, Closures(), 0.0, P)
    kinetic = 0
    for j, bi, bj in np.ndindex(r.dominant.shape):
        cells = np.s_[j, 4 * bi : 4 * bi + 4, 4 * bj : 4 * bj + 4]
        top = np.unravel_index(r.volume[cells].argmax(), (4, 4))
        at_top = {(i, term): share[cells][top] for (i, term, _), share in shares.items()}
        if r.dominant[j, bi, bj] == NO_SLOT:
            assert max(at_top.values()) <= 1e-6
            continue
        slot = r.slots[r.dominant[j, bi, bj]]
        assert at_top[slot.id, slot.term] >= max(at_top.values()) - 1e-4
        kinetic += slot.term == "kinetic"
    assert kinetic > 50
    assert cell_centres(r.grid)[0].shape == r.volume.shape[1:]
