"""A decision names what really limits the speed: without it the ego is faster, without another it is not."""

from __future__ import annotations

import numpy as np
import pytest

from common.messages import NO_SLOT, Map, Plan, Risk, Slot
from services.planner.core import Planner
from services.planner.settings import PlannerSettings
from services.planner.volume import NOBODY, Volume
from tests.planner.worlds import Box, barrier, box, ego_at, lane, risk_of, stamped, straight_route

SETTINGS = PlannerSettings(offsets=(0.0, 0.6, -0.6), lengths=((9.0, 2.2), (24.0, 5.0)))


def walls(px: np.ndarray, py: np.ndarray) -> np.ndarray:
    return barrier(2.4)(px, py) + barrier(-2.4, -1.0)(px, py)


def planned(boxes: list[Box], speed: float = 9.0, risk: Risk | None = None) -> Plan:
    ego = ego_at(0, 0, 0, speed)
    return Planner(SETTINGS).step(
        stamped(ego, 1.0),
        stamped(risk or risk_of(ego, boxes, statics=walls), 1.0),
        stamped(Map(lanes=[lane(1, 0.0)]), 0.0),
        stamped(straight_route(), 0.0),
        1_010_000_000,
    )


SCENES = {
    "a lead": ([box(28, 0.0, 4.0, id=3), box(40, 3.8, 9.0, id=4), box(-15, 3.8, 9.0, id=5)], 3),
    "a car that stands": ([box(34, 0.3, id=8), box(70, -0.4, id=9)], 8),
    "one who crosses": ([box(26, -3.5, 0.0, 1.2, length=0.6, width=0.6, id=6, cls=6), box(55, 3.8, 9.0, id=7)], 6),
    "one at the edge": ([box(16, -1.5, 1.0, length=0.6, width=0.6, id=11, cls=6), box(80, 0.0, 9.0, id=12)], 11),
}


@pytest.mark.parametrize(("boxes", "cause"), SCENES.values(), ids=list(SCENES))
def test_without_the_named_source_the_ego_is_faster_and_without_another_it_is_not(boxes: list[Box], cause: int):
    plan = planned(boxes)
    d = plan.decision
    assert plan.mode == "drive" and d is not None
    assert d.source_id == cause
    assert d.term == "potential" and d.slice is not None and d.cell is not None
    assert str(cause) in d.sentence and d.sentence == plan.reason
    others = [b for b in boxes if b.id != cause]
    assert planned(others).desired_speed > plan.desired_speed + 0.5
    for b in others:
        rest = [o for o in boxes if o is not b]
        assert planned(rest).desired_speed <= plan.desired_speed + 0.5


def test_the_named_cell_holds_the_named_risk_in_the_named_slice():
    ego = ego_at(0, 0, 0, 9.0)
    risk = risk_of(ego, [box(28, 0.0, 4.0, id=3)], statics=walls)
    d = planned([], risk=risk).decision
    assert d is not None and d.cell is not None and d.slice is not None and d.risk is not None
    i, j = d.cell
    near = risk.volume[d.slice, max(i - 1, 0) : i + 2, max(j - 1, 0) : j + 2]
    assert near.min() - 1e-3 <= d.risk <= near.max() + 1e-3
    assert d.slice_s is not None and abs(d.slice_s - risk.slice_times[d.slice]) < 0.11
    g = risk.grid
    assert abs(d.x - (g.x + (i + 0.5) * g.h)) < 1e-6 and abs(d.y - (g.y + (j + 0.5) * g.h)) < 1e-6


def test_sources_that_share_a_slot_are_not_given_one_name():
    ego = ego_at(0, 0, 0, 9.0)
    base = risk_of(ego, [box(28, 0.0, 4.0, id=3)], statics=walls)
    shared = Risk(
        grid=base.grid,
        slice_times=base.slice_times,
        slots=[Slot(-1, "potential", -1, "other")],
        volume=base.volume,
        dominant=np.where(base.dominant == NO_SLOT, NO_SLOT, 0).astype(np.uint8),
    )
    d = planned([], risk=shared).decision
    assert d is not None
    assert d.source_id is None
    assert "one of several sources" in d.sentence and "-1" not in d.sentence
    assert Volume.of(shared, 0, 0).who[0] == NOBODY


def test_a_free_road_and_a_limit_say_so():
    free = planned([])
    assert free.decision is not None and free.decision.source_id is None
    assert "free" in free.decision.sentence
