"""What stands alone in the lane is driven round or waited behind with room to steer out; a queue is not overtaken."""

from __future__ import annotations

import numpy as np
import pytest

from common.messages import Map
from services.planner.passing import LEAST, OUT, Blocked, patience, waiting_gap
from services.planner.settings import PlannerSettings
from tests.planner.worlds import Box, Drive, box, drive, ego_at, lane, straight_route

SETTINGS = PlannerSettings()
TWO_WAY = Map(
    lanes=[
        lane(1, 0.0, left_neighbour=2, left_same_direction=False),
        lane(2, 3.5, against=True, left_neighbour=1, left_same_direction=False),
    ]
)
PARKED = [box(40.0, -0.4)]


def driven(boxes: list[Box], seconds: float) -> Drive:
    return drive(boxes, straight_route(), ego_at(0, 0, 0, 8.0), seconds=seconds, road=TWO_WAY)


def test_what_stands_alone_is_driven_round_with_room_to_spare():
    d = driven(PARKED, 11.0)
    assert d.x[-1] > 50.0
    assert min(d.clearance) > 0.3
    assert abs(d.y[-1]) < 1.0


def test_while_the_way_round_is_taken_the_ego_waits_where_it_can_steer_out():
    oncoming = [box(x, 3.5, -8.0, heading=np.pi, id=10 + k) for k, x in enumerate(np.arange(30.0, 130.0, 20.0))]
    d = driven([*PARKED, *oncoming], 9.0)
    beside = oncoming[-1].pose
    waits = np.array([beside(t)[0] > 45.0 for t in d.t]) & (np.abs(d.y) < 0.3)
    assert waits.any()
    assert 40.0 - 2.25 - (d.x[waits].max() + 2.25) > 4.0


def test_a_queue_is_not_overtaken():
    d = driven([box(40.0 + 6.5 * k, 0.0, id=1 + k) for k in range(5)], 9.0)
    assert d.x.max() < 40.0 - 4.5
    assert np.abs(d.y).max() < 0.6


@pytest.mark.parametrize("speed", [0.0, 2.0, 6.0, 12.0])
def test_the_waiting_gap_never_asks_for_firm_braking(speed: float):
    for distance in np.linspace(1.0, 60.0, 40):
        gap = waiting_gap(Blocked(float(distance), True), speed, SETTINGS)
        assert SETTINGS.gap <= gap <= SETTINGS.gap_round
        room = distance - gap - speed * SETTINGS.headway
        assert gap == SETTINGS.gap or speed**2 <= 2.0 * SETTINGS.curve_brake * room + 1e-9


def test_patience_ends_with_waiting_stays_so_while_something_stands_there_and_comes_back_when_the_lane_is_free():
    there, queue = Blocked(10.0, True), Blocked(10.0, False)
    share = 1.0
    for _ in range(200):
        share = patience(there, share, 1.0, 0.05, SETTINGS)
    assert share == LEAST
    assert patience(there, 1.0, 9.0, 0.05, SETTINGS) == 1.0
    assert patience(queue, share, 1.0, 0.05, SETTINGS) == share
    assert patience(Blocked(25.0, False), share, 1.0, 0.05, SETTINGS) == 1.0
    assert patience(queue, 1.0, 0.0, 9.0, SETTINGS) == 1.0
    assert patience(there, OUT, 1.0, 0.05, SETTINGS) == OUT < LEAST
    assert patience(None, share, 1.0, 0.05, SETTINGS) == 1.0
