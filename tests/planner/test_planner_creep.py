"""Who is near already may stay so near; but what the ego drifts into is not let be, plan after plan."""

from __future__ import annotations

import numpy as np

from common.messages import Map
from services.planner.core import Planner
from services.planner.settings import PlannerSettings
from services.planner.trajectory import Memory
from tests.planner.worlds import box, ego_at, risk_of, stamped, straight_route

SETTINGS = PlannerSettings()
PERIOD, SPEED = 0.05, 8.0
MAP, ROUTE = stamped(Map(), 0.0), stamped(straight_route(speed=SPEED), 0.0)
NEAR = 0.05  # m; beside, nearer than contact begins
A_PLAN = 0.011  # E_max


def margins(gaps: list[float]) -> np.ndarray:
    """What each plan lets the flanks have, as the car beside is so far away [m]."""
    planner, found = Planner(SETTINGS), []
    for k, gap in enumerate(gaps):
        t = 1.0 + PERIOD * k
        ego = ego_at(SPEED * PERIOD * k, 0.0, 0.0, SPEED)
        beside = box(ego.x - SPEED * t, 1.8 + gap, SPEED)
        risk = stamped(risk_of(ego, [beside], t, h=0.25), t)
        plan = planner.step(stamped(ego, t), risk, MAP, ROUTE, round(t * 1e9) + 10_000_000)
        assert plan.mode == "drive"
        memory = planner._memory
        assert isinstance(memory, Memory)
        found.append(memory.margin)
    return np.array(found)


def test_who_is_near_from_the_start_may_stay_so_near():
    assert margins([NEAR])[0] > SETTINGS.flank_margin + 5 * A_PLAN


def test_what_the_ego_drifts_into_is_let_have_no_more_but_little_by_little():
    drifting = margins([2.0, 2.0, *np.linspace(0.3, NEAR, 6)])
    assert drifting[1] == SETTINGS.flank_margin
    assert np.all(np.diff(drifting) <= A_PLAN)
    assert drifting[-1] < margins([NEAR])[0] - A_PLAN


def test_the_margin_is_back_as_soon_as_there_is_room_again():
    assert margins([NEAR, NEAR, 2.0])[-1] == SETTINGS.flank_margin
