"""Comfort: no brake firmer than need be, no plan that runs ahead of the vehicle, no hunting behind a lead."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from common.messages import Map
from services.planner.bezier import Start
from services.planner.contact import Contact
from services.planner.core import Planner, _led
from services.planner.rollout import Tier
from services.planner.search import gentlest, search
from services.planner.settings import PlannerSettings
from tests.planner.test_planner_closed_loop import FEW, ROAD, walls
from tests.planner.test_planner_search import POINTS, STARTS, STEP, field_of
from tests.planner.worlds import Box, drive, ego_at, lane, risk_of, stamped, straight_route

SETTINGS = PlannerSettings()


def far_from_centre(rest: np.ndarray) -> np.ndarray:
    return np.zeros_like(rest)


def brake_for(ahead: float, speed: float, moves: float = 0.0) -> tuple[int, float]:
    """Tier and deceleration counted on before what begins so far ahead and moves on so fast."""
    risk = np.zeros((1, STARTS.size, POINTS))
    for j, t in enumerate(STARTS):
        risk[:, j, int((ahead + moves * t) / STEP) :] = 1.0
    field, start = field_of(risk), Start(0, 0, 0, 0, speed, 0)
    verdict = search(field, start, SETTINGS, np.zeros(1), far_from_centre)
    tier = gentlest(field, start, verdict, 0, SETTINGS, far_from_centre)
    assert verdict.passed[0]
    return tier.index, tier.brake


@pytest.mark.parametrize("speed", [7.0, 10.0, 13.0])
def test_who_needs_a_little_more_than_comfort_brakes_a_little_more(speed: float):
    comfort, firm, *_ = Tier.all(SETTINGS)
    far = speed**2 / (2.0 * comfort.brake) + 4.0 * speed
    found = []
    for wall in np.arange(far, speed**2 / (2.0 * firm.brake), -STEP):
        tier, brake = brake_for(float(wall), speed)
        if tier > firm.index:
            break
        found.append(brake)
    assert found[0] == comfort.brake
    assert max(found) > 0.5 * (comfort.brake + firm.brake)
    assert np.all(np.diff(found) >= -1e-9)  # the nearer the firmer
    first = next(b for b in found if b > comfort.brake)
    assert first <= comfort.brake + 0.4 * (firm.brake - comfort.brake)


def test_what_is_near_is_braked_for_firmly_at_once():
    """There is no time to brake harder later, should it do other than predicted."""
    comfort, firm, *_ = Tier.all(SETTINGS)
    tier, brake = brake_for(15.4, 12.0, 14.0)  # there in 1.3 s, though it draws ahead
    assert tier == firm.index
    assert brake > comfort.brake + 0.75 * (firm.brake - comfort.brake)


state = st.builds(
    Start,
    x=st.floats(-0.3, 0.3),
    y=st.floats(-0.3, 0.3),
    heading=st.floats(-0.15, 0.15),
    curvature=st.floats(-0.1, 0.1),
    speed=st.floats(2, 25),
    acceleration=st.floats(-3, 1.4),
)


@given(planned=state, own=state)
def test_a_plan_starts_near_what_the_vehicle_does_along_and_across(planned: Start, own: Start):
    led = _led(planned, own, SETTINGS)
    off_v, off_a = SETTINGS.lead_speed + 1e-9, SETTINGS.lead_accel + 1e-9
    assert abs(led.speed - own.speed) <= off_v
    assert abs(led.acceleration - own.acceleration) <= off_a
    assert own.speed * abs(led.heading - own.heading) <= off_v
    assert own.speed**2 * abs(led.curvature - own.curvature) <= off_a
    c, s = np.cos(own.heading), np.sin(own.heading)
    across, before = (c * (p.y - own.y) - s * (p.x - own.x) for p in (led, planned))
    assert abs(across) <= SETTINGS.lead_side + 1e-9
    along, planned_along = (c * (p.x - own.x) + s * (p.y - own.y) for p in (led, planned))
    assert np.isclose(along, planned_along)
    assert abs(across) <= abs(before) + 1e-9


def test_a_plan_that_the_vehicle_follows_is_gone_on_with():
    own = Start(1.0, 2.0, 0.3, 0.01, 9.0, -0.5)
    assert _led(own, own, SETTINGS) == own


@settings(max_examples=30)
@given(st.floats(3.0, 14.0), st.floats(0.0, 1.0))
def test_the_speed_of_a_contact_is_known_better_than_a_slice_tells(speed: float, offset: float):
    """Crossings are read at stations a metre apart, where the field rises too steeply to interpolate."""
    risk = np.zeros((1, 7, 80), dtype=np.float32)
    starts = 0.5 * np.arange(7)
    for j, t in enumerate(starts):
        first = int(np.ceil(10.0 + offset + speed * t))
        risk[0, j, first : first + 6] = 1.0
    who = np.full(risk.shape, 3, dtype=np.uint8)
    for reference in (False, True):
        c = Contact.of(risk, who, starts, 0.8, 1.0, reference=reference)
        away = c.away[0, 1:5, 0]
        assert np.abs(away - speed).max() <= 1.0 / 1.5 + 0.1
        assert np.abs(away - speed).max() <= np.abs(c.rate[0, :6, 0] - speed).max() + 1e-9


@pytest.mark.parametrize("speed", [6.0, 9.0, 13.0])
def test_behind_a_steady_lead_the_age_of_the_risk_changes_the_speed_little(speed: float):
    found = []
    for age in (0.0, 0.05, 0.1, 0.15, 0.2):
        ahead = Box(lambda t: (4.5 + 1.4 * speed + 3.0 + speed * (t - 1.0), 0.0, 0.0))
        seen = risk_of(ego_at(-speed * age, 0, 0, speed), [ahead], 1.0 - age, statics=walls, ahead=90.0)
        plan = Planner(FEW).step(
            stamped(ego_at(0, 0, 0, speed), 1.0),
            stamped(seen, 1.0 - age),
            stamped(Map(lanes=[lane(1, 0)]), 0),
            stamped(straight_route(), 0),
            round(1.01e9),
        )
        assert plan.candidates is not None
        found.append(float(plan.candidates.desired_speed[plan.chosen]))
    assert max(found) - min(found) <= 0.5


@pytest.mark.long
def test_a_steady_lead_is_followed_without_hunting():
    speed = 9.0
    lead = Box(lambda t: (14.0 + 1.2 * speed + speed * t, 0.0, 0.0))
    d = drive(
        [lead],
        straight_route(),
        ego_at(0, 0, 0, speed),
        seconds=12.0,
        settings=FEW,
        road=ROAD,
        statics=walls,
        ahead=90.0,
    )
    assert d.sign_changes(0.1) <= 1  # 5 a minute
    assert np.abs(d.acceleration).max() < 1.5


def test_a_comfort_brake_as_hard_as_the_firm_one_is_a_configuration_like_any_other():
    alike = PlannerSettings(tier_brake=(3.0, 3.0, 5.0, 8.0))
    firm = 0
    for ahead in np.arange(10.0, 45.0, 1.2):
        risk = np.zeros((1, STARTS.size, POINTS))
        risk[:, :, int(ahead / STEP) :] = 1.0
        field, start = field_of(risk), Start(0, 0, 0, 0, 10.0, 0)
        verdict = search(field, start, alike, np.zeros(1), far_from_centre)
        tier = gentlest(field, start, verdict, 0, alike, far_from_centre)
        firm += tier.index == 1
        assert tier.index != 1 or tier.brake == 3.0
    assert firm
