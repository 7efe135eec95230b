"""Who no longer can stop before a closed line drives on over it, and the plan says so."""

from __future__ import annotations

import numpy as np
import pytest

from common.messages import NO_BRAKE, Closures, Map, Obstacle
from common.risk import RiskParameters
from services.planner.core import Planner
from services.planner.settings import PlannerSettings
from services.riskfield.core import RiskField
from services.riskfield.settings import RiskfieldSettings
from tests.planner.worlds import LENGTH, ego_at, stamped, straight_route
from tests.riskfield.scenes import prediction


@pytest.mark.parametrize(("ahead", "over"), [(2.0, True), (30.0, False)])
def test_the_plan_drives_on_over_the_line_and_says_so_or_stops_before_it(ahead: float, over: bool):
    field = RiskField(RiskfieldSettings(), RiskParameters(), device="cpu")
    x = ahead + LENGTH / 2
    world = Map(obstacles=[Obstacle(id=7, kind="stop_line", points=np.array([[x, -1.75], [x, 1.75]]))])
    ego = stamped(ego_at(0.0, 0.0, 0.0, 9.0), 0.0)
    risk = field.step(stamped(prediction([]), 0.0), ego, world, Closures(ids=[7]))
    plan = Planner(PlannerSettings()).step(
        ego, stamped(risk, 0.0), stamped(world, 0.0), stamped(straight_route(speed=9.0), 0.0), 10_000_000
    )
    assert plan.profile is not None
    assert plan.decision is not None
    assert (NO_BRAKE in plan.decision.sentence) == over
    assert "line 7" in plan.reason
    if over:
        assert np.all(plan.profile.acceleration > -1.0)
    else:
        assert plan.profile.speed[-1] < 6.0
