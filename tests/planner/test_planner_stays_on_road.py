"""Nobody leaves the road for a better speed, nor takes a lane that leads away from the route for a way round."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from common.messages import Goal, Lane, Map, Route
from services.planner.bezier import Paths, Start, Target, build_paths
from services.planner.lanes import RouteLanes
from services.planner.reference import ReferenceLine
from services.planner.road_edges import leaves_road
from services.planner.search import search
from services.planner.settings import PlannerSettings
from services.planner.targets import near_tracks
from tests.planner.test_planner_search import SETTINGS, blobs, field_of
from tests.planner.worlds import box, drive, ego_at, lane, straight_route

HALF = 0.9


def _paths(lanes: RouteLanes, reference: ReferenceLine, offsets: list[float], d0: float = 0.0) -> Paths:
    s = np.asarray(20.0 + 0.5 * np.arange(200))
    zero = np.zeros_like(s)
    targets = [Target(f"{o:+.1f} m", np.full_like(s, o), zero, zero) for o in offsets]
    lengths = np.full(len(offsets), 24.0)
    start = (20.0, d0, 0.0, 0.0)
    return build_paths(reference, s, start, targets, lengths, step=1.0, points=60, max_curvature=0.24)


@settings(max_examples=60, deadline=None)
@given(offset=st.floats(-6.0, 6.0), oncoming=st.booleans(), margin=st.floats(0.0, 0.4))
def test_a_path_leaves_the_road_just_where_a_side_of_the_body_is_off_every_lane(
    offset: float, oncoming: bool, margin: float
):
    route = straight_route()
    lanes = [lane(1, 0.0, **({"left_neighbour": 2, "left_same_direction": False} if oncoming else {}))]
    lanes += [lane(2, 3.5, against=True)] if oncoming else []
    reference = ReferenceLine.of(route.reference)
    road = RouteLanes.of(reference, route, Map(lanes=lanes))
    off = bool(leaves_road(_paths(road, reference, [offset]), road, HALF, margin)[0])
    left_edge = 5.25 if oncoming else 1.75
    over = max(offset + HALF - left_edge, -1.75 - (offset - HALF)) - margin
    if abs(over) > 0.02:
        assert off == (over > 0.0)


def test_without_a_map_no_path_leaves_the_road():
    route = straight_route()
    reference = ReferenceLine.of(route.reference)
    road = RouteLanes.of(reference, route, Map(lanes=[]))
    assert not leaves_road(_paths(road, reference, [-5.0, 0.0, 5.0]), road, HALF, 0.15).any()


def test_who_is_off_the_road_may_come_back_but_not_go_further():
    route = straight_route()
    reference = ReferenceLine.of(route.reference)
    road = RouteLanes.of(reference, route, Map(lanes=[lane(1, 0.0)]))
    off = leaves_road(_paths(road, reference, [-3.0, -2.0, -1.0, 0.0], d0=-2.0), road, HALF, 0.15)
    assert off.tolist() == [True, False, False, False]


def test_who_is_on_one_side_does_not_leave_the_road_on_the_other():
    route = straight_route()
    reference = ReferenceLine.of(route.reference)
    both = [lane(1, 0.0, left_neighbour=2, left_same_direction=False), lane(2, 3.5, against=True)]
    road = RouteLanes.of(reference, route, Map(lanes=both))
    off = leaves_road(_paths(road, reference, [-3.2, 0.0, 3.2], d0=3.2), road, HALF, 0.15)
    assert off.tolist() == [True, False, False]


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 2**31), speed=st.floats(1.0, 14.0))
def test_a_path_off_the_road_passes_only_where_no_path_on_it_does(seed: int, speed: float):
    rng = np.random.default_rng(seed)
    n = 5
    field = field_of(blobs(rng, n))
    off = rng.random(n) < 0.6
    cost = rng.random(n)
    start = Start(0, 0, 0, 0, speed, 0)
    v = search(field, start, SETTINGS, cost, lambda rest: np.zeros_like(rest), off)
    if off.any() and not off.all():
        on = ~off
        alone = search(field, start, SETTINGS, np.where(on, cost, 1e6), lambda rest: np.zeros_like(rest), off)
        assert alone.passed[on].any() == v.passed[on].any()
        assert not (v.passed[on].any() and v.passed[off].any())


def test_whoever_could_go_round_only_beside_the_road_stops_on_it():
    settings_ = PlannerSettings(lengths=((9.0, 2.2), (24.0, 5.0)))
    d = drive(
        [box(60.0, 0.0)], straight_route(), ego_at(0.0, 0.0, 0.0, 9.0), seconds=16.0, settings=settings_,
        road=Map(lanes=[lane(1, 0.0)]), ahead=80.0,
    )  # fmt: skip
    assert np.abs(d.y).max() < 1.0
    assert d.speed[-1] < 0.1
    assert min(d.clearance) > 1.0


def _crossroads(turn_at: float = 60.0, radius: float = 14.0) -> tuple[Map, Route]:
    """One lane up to `turn_at`; from there one lane goes straight on and the route's turns to the left."""
    angle = np.linspace(0.0, np.pi / 2, 30)
    bend = np.stack((turn_at + radius * np.sin(angle), radius * (1.0 - np.cos(angle))), axis=1)
    up = np.stack((np.full(40, turn_at + radius), radius + np.arange(1.0, 41.0) * 2.0), axis=1)
    into = np.stack((np.arange(-30.0, turn_at, 2.0), np.zeros(int((turn_at + 30.0) / 2.0))), axis=1)

    def made(id_: int, line: np.ndarray, following: list[int]) -> Lane:
        way = np.gradient(line, axis=0)
        side = 1.75 * np.stack((-way[:, 1], way[:, 0]), axis=1) / np.hypot(*way.T)[:, None]
        return Lane(id=id_, centre=line, left=line + side, right=line - side, speed_limit=9.0, successors=following)

    before = np.vstack((into, [[turn_at, 0.0]]))
    straight = np.stack((np.arange(turn_at, turn_at + 100.0, 2.0), np.zeros(50)), axis=1)
    whole = np.vstack((into, bend, up))
    road = Map(lanes=[made(1, before, [2, 3]), made(2, straight, []), made(3, np.vstack((bend, up)), [])])
    route = Route(reference=whole, goal=Goal(x=turn_at + radius, y=80.0, radius=3.0), speed_limit=9.0, lane_ids=[1, 3])
    return road, route


@pytest.mark.parametrize("s", [40.0, 55.0, 70.0, 80.0])
@pytest.mark.parametrize("speed", [2.0, 8.0])
def test_a_lane_that_goes_straight_on_where_the_route_turns_is_no_way_round(s: float, speed: float):
    road, route = _crossroads()
    lanes = RouteLanes.of(ReferenceLine.of(route.reference), route, road)
    assert any(np.abs(t.centre).max() > 3.0 for t in lanes.tracks)
    assert near_tracks(lanes, s, 0.0, max(24.0, 5.0 * speed)) == []


@pytest.mark.long
def test_whoever_waits_before_a_turn_waits_on_the_route():
    road, route = _crossroads()
    blocked = box(74.0, 24.0, heading=np.pi / 2)
    d = drive(
        [blocked], route, ego_at(30.0, 0.0, 0.0, 7.0), seconds=18.0, road=road, ahead=60.0,
        settings=PlannerSettings(lengths=((9.0, 2.2), (24.0, 5.0))),
    )  # fmt: skip
    line = ReferenceLine.of(route.reference)
    away = [abs(line.project(e.x, e.y, e.heading, None)[1]) for e in d.ego]
    assert max(away) < 1.2
    assert d.speed[-1] < 0.3
