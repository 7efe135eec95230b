"""The goal is a place to be reached, and where no road is nobody drives."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import settings as examples
from hypothesis import strategies as st

from common.messages import Goal, Map, Route
from services.planner.bezier import Target, build_paths
from services.planner.goal import goal_cost
from services.planner.lanes import RouteLanes
from services.planner.reference import ReferenceLine
from services.planner.settings import PlannerSettings
from tests.planner.worlds import Drive, box, drive, ego_at, lane

SETTINGS = PlannerSettings()
FEW = PlannerSettings(offsets=(0.0, 0.6, -0.6), lengths=((9.0, 2.2), (24.0, 5.0)))
LIMIT = 14.0


def two_lanes(length: float = 400.0) -> Map:
    """Lane 1 along y = 0, lane 2 to its left."""
    return Map(
        lanes=[
            lane(1, 0.0, length, limit=LIMIT, left_neighbour=2, left_same_direction=True),
            lane(2, 3.5, length, limit=LIMIT, right_neighbour=1, right_same_direction=True),
        ]
    )


def route_to(goal_x: float, goal_y: float, lane_ids: list[int], length: float = 400.0, y: float = 0.0) -> Route:
    return Route(
        reference=np.array([[-20.0, y], [length, y]]),
        goal=Goal(x=goal_x, y=goal_y, radius=3.0),
        speed_limit=LIMIT,
        lane_ids=lane_ids,
    )


REFERENCE = ReferenceLine.of(np.array([[-20.0, 0.0], [400.0, 0.0]]))
LANES = RouteLanes.of(REFERENCE, route_to(300.0, 0.0, [1]), two_lanes())


def costs(left: float, speed: float, radius: float = 3.0) -> np.ndarray:
    """In the lane left of the goal's, so far before it: cost of changing to the goal's lane, and of staying."""
    reference, lanes = REFERENCE, LANES
    s0 = 320.0 - left
    s = s0 + 0.5 * np.arange(300)
    zero = np.zeros_like(s)
    track = next(k for k, t in enumerate(lanes.tracks) if abs(t.centre[100] - 3.5) < 0.1)
    paths = build_paths(
        reference, s, (s0, 3.5, 0.0, 0.0), [Target("a", zero, zero, zero), Target("b", zero + 3.5, zero, zero)],
        np.array([30.0, 30.0]), step=1.0, points=72, max_curvature=0.24,
    )  # fmt: skip
    return goal_cost(paths, lanes, np.array([-1, track]), (320.0, 0.0, radius), speed, SETTINGS)


@examples(max_examples=30, deadline=None)
@given(st.floats(1.0, 250.0), st.floats(1.0, 250.0), st.floats(0.0, 20.0))
def test_the_nearer_the_goal_the_dearer_is_another_lane_and_changing_to_the_goals_costs_nothing(
    a: float, b: float, v: float
):
    near, far = costs(min(a, b), v), costs(max(a, b), v)
    assert near[1] >= far[1] > 0.0
    assert near[0] <= near[1] and far[0] <= far[1]
    if min(a, b) > 30.0:  # the way over is no longer than that
        assert near[0] == far[0] == 0.0


def test_beyond_the_goal_and_where_the_goal_is_wide_enough_no_lane_is_dear():
    assert costs(-5.0, 10.0)[1] == 0.0
    assert costs(20.0, 10.0, radius=6.0)[1] == 0.0


@pytest.mark.long
def test_a_free_lane_beside_a_slow_lead_is_left_again_in_time_for_the_goal():
    """On the goal's lane a car drives at 7 m/s, the other is empty: without the goal it would stay there."""
    goal_x = 140.0
    lead = box(25.0, 0.0, 7.0)
    found = drive([lead], route_to(goal_x, 0.0, [1]), ego_at(0.0, 0.0, speed=10.0), seconds=30.0, road=two_lanes(),
                  settings=FEW)  # fmt: skip
    assert _nearest(found, goal_x, 0.0) <= 3.0
    assert min(found.clearance) > 0.3


def _nearest(found: Drive, x: float, y: float) -> float:
    return float(np.hypot(found.x - x, found.y - y).min())


def test_where_the_lanes_end_before_the_line_it_stands_with_its_front_on_the_road():
    road = Map(lanes=[lane(1, 0.0, 70.0, limit=LIMIT)])  # its lines reach 30 m further
    found = drive([], route_to(300.0, 0.0, [1]), ego_at(0.0, 0.0, speed=10.0), seconds=16.0, road=road, settings=FEW)
    assert found.speed[-1] < 0.05
    assert 94.0 < found.x[-1] + 2.25 <= 100.1
    assert found.acceleration.min() > -1.5
    assert "end of what is known" in found.plans[-1].reason


def test_a_goal_short_of_the_roads_end_is_driven_through_and_what_comes_then_is_stopped_at():
    road = Map(lanes=[lane(1, 0.0, 70.0, limit=LIMIT)])
    found = drive([], route_to(50.0, 0.0, [1]), ego_at(0.0, 0.0, speed=10.0), seconds=14.0, road=road, settings=FEW)
    assert found.speed[np.argmax(found.x > 48.0)] > 11.0
    assert found.speed[-1] < 0.05
    assert found.x[-1] + 2.25 <= 100.1


def test_a_line_that_runs_against_the_lanes_is_not_driven():
    road = Map(lanes=[lane(1, 0.0, against=True)])
    found = drive([], route_to(200.0, 0.0, []), ego_at(0.0, 0.0), seconds=3.0, road=road, settings=FEW)
    assert found.x[-1] < 0.1
    assert "end of what is known" in found.plans[-1].reason


def test_a_line_beside_all_lanes_is_believed_as_where_no_map_is():
    found = drive([], route_to(200.0, 0.0, []), ego_at(0.0, 0.0), seconds=4.0, road=Map(lanes=[lane(1, 60.0)]),
                  settings=FEW)  # fmt: skip
    assert found.speed[-1] > 2.0
