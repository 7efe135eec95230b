"""Roads and routes that are wrong: each ends in a plan that can be driven or in a stop with its reason, never worse."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import HealthCheck, given
from hypothesis import settings as examples
from hypothesis import strategies as st

from common.codec import check
from common.messages import Ego, Goal, Grid, Lane, Map, Plan, Risk, Route
from services.planner.core import Planner
from services.planner.settings import PlannerSettings
from tests.planner.worlds import box, ego_at, lane, risk_of, stamped, straight_route

SETTINGS = PlannerSettings(offsets=(0.0, 0.8, -0.8), lengths=((9.0, 2.2), (24.0, 5.0)))


def planned(ego: Ego, route: Route, road: Map, risk: Risk | None = None) -> Plan:
    """Two cycles, so that the second starts from the first's plan."""
    planner = Planner(SETTINGS)
    for k in range(2):
        t = 1.0 + 0.05 * k
        plan = planner.step(
            stamped(ego, t),
            stamped(risk or risk_of(ego, [], ahead=70.0), t),
            stamped(road, 0.0),
            stamped(route, 0.0),
            round(t * 1e9) + 10_000_000,
        )
        check(plan)
        assert "planner failed" not in plan.reason, plan.reason
        assert plan.mode in ("drive", "safe_stop")
        assert plan.reason
        assert plan.tail is not None and plan.tail.speed[-1] == 0.0
        assert plan.profile is not None
        for part in (plan.profile, plan.tail):
            assert all(np.all(np.isfinite(getattr(part, name))) for name in ("t", "x", "y", "heading", "speed"))
    return plan


def with_lines(centre: np.ndarray, left: np.ndarray, right: np.ndarray, **more: object) -> Lane:
    return Lane(id=1, centre=centre, left=left, right=right, speed_limit=14.0, **more)  # type: ignore[arg-type]


X = np.linspace(-30.0, 430.0, 60)


def at(y: np.ndarray | float) -> np.ndarray:
    return np.stack((X, np.zeros_like(X) + y), axis=1)


ROADS = {
    "a lane of zero width": Map(lanes=[with_lines(at(0.0), at(0.0), at(0.0))]),
    "a boundary that crosses the other": Map(lanes=[with_lines(at(0.0), at(2.0 * np.cos(X / 9)), at(-2.0))]),
    "a boundary that crosses itself": Map(
        lanes=[with_lines(at(0.0), np.stack((X + 12.0 * np.sin(X / 3), 1.7 + np.cos(X / 3)), axis=1), at(-1.7))]
    ),
    "successors that are not there": Map(lanes=[with_lines(at(0.0), at(1.7), at(-1.7), successors=[99])]),
    "a lane that follows itself": Map(lanes=[with_lines(at(0.0), at(1.7), at(-1.7), successors=[1])]),
    "a neighbour that is the lane itself": Map(
        lanes=[with_lines(at(0.0), at(1.7), at(-1.7), left_neighbour=1, left_same_direction=True)]
    ),
    "a lane of two equal points": Map(lanes=[with_lines(np.zeros((2, 2)), np.zeros((2, 2)), np.zeros((2, 2)))]),
    "lanes elsewhere": Map(lanes=[lane(1, 500.0)]),
    "oncoming lanes only": Map(lanes=[lane(1, 0.0, against=True)]),
}


@pytest.mark.parametrize("road", ROADS.values(), ids=list(ROADS))
def test_a_broken_map_never_keeps_the_ego_from_a_plan(road: Map):
    plan = planned(ego_at(0, 0, 0, 8.0), straight_route(), road)
    assert plan.mode == "drive"
    assert plan.profile is not None
    assert np.abs(plan.profile.y).max() < 2.0


def test_a_route_that_names_lanes_that_do_not_connect_is_driven_on_its_line():
    road = Map(lanes=[lane(1, 0.0, length=60.0), lane(7, 40.0), lane(9, -80.0)])
    route = straight_route()
    route = Route(reference=route.reference, goal=route.goal, lane_ids=[1, 7, 9, 1234], speed_limit=9.0)
    assert planned(ego_at(0, 0, 0, 8.0), route, road).mode == "drive"


@pytest.mark.parametrize("y", [0.0, 300.0, -5000.0])
def test_a_goal_off_the_map_or_off_the_route_does_not_stop_the_ego_from_following_its_line(y: float):
    route = straight_route(120.0)
    off = Route(reference=route.reference, goal=Goal(x=1e4, y=y, radius=2.0, stop=True), speed_limit=9.0)
    plan = planned(ego_at(0, 0, 0, 8.0), off, Map(lanes=[lane(1, 0.0)]))
    assert plan.mode == "drive"


@pytest.mark.parametrize(("heading", "word"), [(np.pi, "across"), (-2.0, "across"), (1.6, "across")])
def test_an_ego_that_faces_the_wrong_way_is_stopped_with_the_angle(heading: float, word: str):
    plan = planned(ego_at(0, 0, heading, 5.0), straight_route(), Map(lanes=[lane(1, 0.0)]))
    assert plan.mode == "safe_stop"
    assert word in plan.reason and "°" in plan.reason


@pytest.mark.parametrize("y", [6.0, -15.0, 60.0])
def test_an_ego_off_the_road_gets_a_valid_plan_or_a_reason(y: float):
    planned(ego_at(0, y, 0.0, 5.0), straight_route(), Map(lanes=[lane(1, 0.0)]))


def test_beyond_the_end_of_the_route_it_stands():
    route = straight_route(30.0)
    plan = planned(ego_at(60.0, 0, 0.0, 5.0), route, Map())
    assert plan.desired_speed < 0.5 or plan.mode == "safe_stop" or plan.profile.speed[-1] < 1.0  # type: ignore[union-attr]


@pytest.mark.parametrize("ahead", [2.0, 8.0, 20.0])
def test_a_volume_that_does_not_cover_the_path_is_stopped_within(ahead: float):
    ego = ego_at(0, 0, 0, 6.0)
    plan = planned(ego, straight_route(), Map(), risk_of(ego, [], ahead=2.25 + ahead))
    assert plan.profile is not None and plan.tail is not None
    brake = 8.5 if ahead < 8.0 else 3.0
    assert plan.tail.x[-1] <= max(ahead, 6.0 * 0.35 + 36.0 / (2 * brake) + 2.0) + 0.5


def test_a_volume_that_lies_elsewhere_is_not_driven_into():
    ego = ego_at(0, 0, 0, 6.0)
    there = risk_of(ego_at(500.0, 500.0, 0.0, 6.0), [])
    plan = planned(ego, straight_route(), Map(), there)
    assert plan.profile is not None
    assert np.all(np.diff(plan.profile.speed) <= 1e-9)
    assert plan.profile.speed[-1] < 1.5


def test_a_grid_of_one_cell_is_no_error():
    ego = ego_at(0, 0, 0, 3.0)
    base = risk_of(ego, [])
    tiny = Risk(
        grid=replace_grid(base.grid),
        slice_times=base.slice_times,
        slots=[],
        volume=np.zeros((13, 2, 2), np.float32),
        dominant=np.full((13, 1, 1), 255, np.uint8),
    )
    planned(ego, straight_route(), Map(), tiny)


def replace_grid(grid: Grid) -> Grid:
    return Grid(x=grid.x, y=grid.y, heading=grid.heading, rows=2, columns=2, h=grid.h)


@examples(max_examples=12, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(
    kinks=st.lists(st.tuples(st.floats(-30, 30), st.floats(-30, 30)), min_size=2, max_size=9),
    speed=st.floats(0, 15),
)
def test_any_line_as_a_route_gives_a_plan_or_a_reason(kinks: list[tuple[float, float]], speed: float):
    reference = np.array(kinks)
    route = Route(reference=reference, goal=Goal(x=0.0, y=0.0, radius=1.0), speed_limit=9.0)
    planned(ego_at(0, 0, 0, speed), route, Map(lanes=[lane(1, 0.0)]))


@examples(max_examples=12, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(seed=st.integers(0, 2**31), speed=st.floats(0, 14))
def test_outside_emergencies_plans_stay_within_comfort(seed: int, speed: float):
    """A slower lead with room to brake, cars beside: nobody forces more than comfort on the ego."""
    rng = np.random.default_rng(seed)
    gap = 14.0 + 2.2 * speed + speed**2 / 2.0
    boxes = [box(4.5 + gap, 0.0, float(rng.uniform(0, speed + 1.0)))]
    boxes += [box(float(rng.uniform(-20, 40)), side, speed, id=2 + k) for k, side in enumerate((3.6, -3.6))]
    plan = planned(
        ego_at(0, 0, 0, speed), straight_route(), Map(lanes=[lane(1, 0.0)]), risk_of(ego_at(0, 0, 0, speed), boxes)
    )
    assert plan.mode == "drive"
    assert plan.profile is not None
    assert plan.profile.acceleration.min() >= -1.5 and plan.profile.acceleration.max() <= 1.5
    assert np.max(plan.profile.speed**2 * np.abs(plan.profile.curvature)) <= 1.2


@pytest.mark.parametrize("wild", [(1e6, 0.0), (3e8, -1e9), (1e300, 0.0)])
def test_one_wild_point_of_a_route_is_a_reason_and_no_memory(wild: tuple[float, float]):
    line = np.vstack((straight_route().reference, wild))
    route = Route(reference=line, goal=Goal(x=100.0, y=0.0, radius=2.0), speed_limit=9.0)
    plan = planned(ego_at(0, 0, 0, 8.0), route, Map(lanes=[lane(1, 0.0)]))
    assert plan.mode == "safe_stop"
    assert "km long" in plan.reason
