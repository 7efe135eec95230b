"""A gap that is wide enough is crept through, however many stand around it; one that is not stays closed."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec.structs import replace

from common.geometry import distance_to_rectangle
from common.messages import BLOCK, NO_SLOT
from services.planner.nearest import nearest_alone
from services.planner.settings import PlannerSettings
from services.planner.volume import Volume
from tests.planner.worlds import WIDTH, Box, barrier, box, drive, ego_at, risk_of, straight_route

SETTINGS = PlannerSettings()
EGO = ego_at(0.0, 0.0, 0.0, 1.0)
NEAR = {"ahead": 20.0, "behind": 10.0, "width": 12.0, "h": 0.25}
CONTACT = SETTINGS.r_hit + SETTINGS.flank_margin  # E_max, beside


def street(clear: float) -> list[Box]:
    """Two rows of parked cars 3.5 m apart, and before one of them a box that leaves the ego `clear` on either side."""
    rows = [box(8.0 + 7.5 * k, side * 2.65, id=2 * k + (side > 0)) for k in (1, 2, 3) for side in (-1, 1)]
    edge = 1.75 - WIDTH - 2.0 * clear
    return [*rows, box(23.0, edge - 0.5, length=1.0, width=1.0, id=90)]


def volumes(boxes: list[Box], **more: object) -> tuple[Volume, Volume]:
    before = Volume.of(risk_of(EGO, boxes, **(NEAR | more)), 0, 0)  # type: ignore[arg-type]
    return before, nearest_alone(before, 0.0, 0.0, 0.0)


@pytest.mark.parametrize(("clear", "passes"), [(0.5, True), (0.12, False)])
def test_a_gap_is_crept_through_if_it_is_wide_enough(clear: float, passes: bool):
    boxes = street(clear)
    out = drive(boxes, straight_route(speed=8.4), ego_at(8.0, 0.0, 0.0, 3.0), seconds=12.0, **NEAR)
    assert (out.x[-1] > 22.0) == passes
    assert min(out.clearance) > 0.2
    beside = np.abs(out.x - 23.0) < 2.5
    assert np.all(out.speed[beside] <= 2.5)
    if passes:
        assert any("through a gap" in p.reason for p in out.plans)


@settings(max_examples=40, deadline=None)
@given(
    st.lists(st.tuples(st.floats(-4, 12), st.floats(-4, 4), st.floats(-0.3, 0.3)), min_size=1, max_size=4),
    st.lists(st.tuples(st.floats(-4, 12), st.floats(-4, 4)), min_size=40, max_size=40),
)
def test_risk_is_only_lowered_never_below_contact_ahead_nor_near_a_body(cars, points):
    boxes = [box(x, y, heading=turned, id=k) for k, (x, y, turned) in enumerate(cars)]
    before, after = volumes(boxes)
    x, y = np.array(points).T
    a, b = before.sample(x, y)[0][0], after.sample(x, y)[0][0]
    raw, now = before.risk.volume, after.risk.volume
    assert np.all(now <= raw + 1e-3)
    assert np.all(now >= np.minimum(raw, 0.74))
    near = np.min([distance_to_rectangle(x, y, *c.pose(0.0), c.length, c.width) for c in boxes], axis=0)
    assert np.all(b[near < 0.1] >= np.minimum(a[near < 0.1], CONTACT - 0.03))


@given(st.floats(2.1, 3.0), st.floats(-2.0, 2.0))
@settings(max_examples=20, deadline=None)
def test_who_is_alone_beside_counts_as_before(y: float, x: float):
    before, after = volumes([box(x, y)])
    assert np.allclose(before.risk.volume, after.risk.volume, atol=0.06)


@given(st.floats(0.5, 6.0))
@settings(max_examples=10, deadline=None)
def test_whoever_moves_counts_as_before(v: float):
    before, after = volumes([box(3.0, side * 1.5, v, id=k) for k, side in enumerate((-1, 1))])
    assert np.array_equal(before.risk.volume, after.risk.volume)


@given(st.floats(-3.0, 6.0), st.floats(0.15, 0.9), st.sampled_from([4, 5, 6]))
@settings(max_examples=20, deadline=None)
def test_nothing_is_lowered_near_people_on_foot_or_on_two_wheels(x: float, gap: float, cls: int):
    """A body right behind somebody hides how near he stands."""
    somebody = box(x, 1.75 - gap - 0.3, length=0.6, width=0.6, id=7, cls=cls)
    before, after = volumes([*street(0.5), box(x, 2.65, id=50), somebody])
    fx, fy = np.meshgrid(np.linspace(x - 1.0, x + 1.0, 15), np.linspace(0.0, 1.75, 15))
    assert np.array_equal(before.sample(fx, fy)[0][0], after.sample(fx, fy)[0][0])


@given(st.floats(1.2, 2.5), st.floats(0.0, 1.0))
@settings(max_examples=20, deadline=None)
def test_lines_count_as_before(y: float, away: float):
    risk = risk_of(EGO, [box(0.0, -3.2 - away)], statics=barrier(y), **NEAR)
    line = (np.arange(risk.grid.columns) + 0.5) * risk.grid.h - 6.0 > y - 0.6
    dominant = risk.dominant.copy()
    dominant[:, :, np.flatnonzero(line) // BLOCK] = NO_SLOT
    before = Volume.of(replace(risk, dominant=dominant), 0, 0)
    after = nearest_alone(before, 0.0, 0.0, 0.0)
    assert np.array_equal(before.risk.volume[:, :, line], after.risk.volume[:, :, line])


def test_what_is_driven_towards_counts_as_before():
    boxes = [box(9.0, 0.0), *(box(9.0, side * 2.4, id=k + 2) for k, side in enumerate((-1, 1)))]
    before, after = volumes(boxes)
    x = np.linspace(0.0, 6.7, 50)
    assert np.array_equal(before.sample(x, 0.0 * x)[0], after.sample(x, 0.0 * x)[0])


def test_a_coarse_grid_shows_no_shape_and_changes_nothing():
    before, after = volumes(street(0.5), h=0.5)
    assert after is before


@settings(max_examples=15, deadline=None)
@given(st.floats(-0.12, 0.12), st.floats(0.45, 0.6))
def test_contact_in_a_gap_begins_near_the_nearest_body(phase: float, clear: float):
    """Whatever the phase of the grid: not within 0.14 m of a body, and gone 0.43 m from it."""
    poses = [(b, *b.pose(0.0)[:2]) for b in street(clear)]
    boxes = [box(x - 16.0, y + phase, length=b.length, width=b.width, id=b.id) for b, x, y in poses]
    _, after = volumes(boxes)
    face = 1.75 - WIDTH - 2.0 * clear + phase
    gone = face + np.arange(0.43, 0.43 + clear, 0.05)
    assert np.all(after.sample(np.full_like(gone, 7.0), gone)[0][0] < CONTACT)
    touched = face + np.linspace(0.0, 0.13, 10)
    assert np.all(after.sample(np.full_like(touched, 7.0), touched)[0][0] >= CONTACT - 0.01)
