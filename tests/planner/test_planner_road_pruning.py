"""A map may be a whole city: the road along the route is the same as if all of it had been looked at, for less work."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import fields
from unittest.mock import patch

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from common.messages import Goal, Lane, Map, Plan, Route
from services.planner.core import Planner
from services.planner.lanes import RouteLanes
from services.planner.projections import Projections
from services.planner.reference import ReferenceLine
from services.planner.settings import PlannerSettings
from services.planner.work import Work, advance
from tests.planner.worlds import ego_at, follow, risk_of, stamped

BLOCK = 80.0  # m


def wandering(random: np.random.Generator, length: float, turn: float) -> np.ndarray:
    """A line that bends and, now and then, turns sharply; points every 1 to 3 m."""
    step = random.uniform(1.0, 3.0)
    n = max(int(length / step), 2)
    sharp = np.where(random.random(n) < 0.02, random.uniform(-1.7, 1.7, n), 0.0)
    heading = random.uniform(-np.pi, np.pi) + np.cumsum(random.normal(0.0, turn, n) + sharp)
    return np.cumsum(step * np.stack((np.cos(heading), np.sin(heading)), axis=1), axis=0)


def beside(line: np.ndarray, offset: float) -> np.ndarray:
    way = np.gradient(line, axis=0)
    way /= np.maximum(np.hypot(*way.T), 1e-9)[:, None]
    return line + offset * np.stack((-way[:, 1], way[:, 0]), axis=1)


def network(random: np.random.Generator) -> tuple[Map, Route]:
    """Lanes along parts of the route, to both sides and both ways, and others anywhere."""
    route = wandering(random, random.uniform(20.0, 600.0), 0.03)
    lanes: list[Lane] = []
    for i in range(random.integers(1, 25)):
        if random.random() < 0.6:
            a, b = np.sort(random.integers(0, len(route), 2))
            part = route[a : max(b, a + 2) + 1] if a + 2 < len(route) else route
            centre = beside(part, float(random.uniform(-14.0, 14.0)))
        else:
            centre = wandering(random, random.uniform(5.0, 300.0), 0.05) + random.choice(route)
        if random.random() < 0.3:
            centre = centre[::-1]
        others = [int(k) for k in random.integers(0, 25, random.integers(0, 3))]
        lanes.append(
            Lane(
                id=i,
                centre=np.ascontiguousarray(centre),
                left=beside(centre, 1.75),
                right=beside(centre, -1.75),
                speed_limit=float(random.choice([0.0, 8.0, 14.0])),
                successors=others,
                left_neighbour=int(random.integers(0, 25)) if random.random() < 0.5 else None,
                right_neighbour=int(random.integers(0, 25)) if random.random() < 0.5 else None,
                right_same_direction=bool(random.random() < 0.5),
            )
        )
    named = [int(k) for k in random.integers(0, 25, 6)] if random.random() < 0.5 else []
    goal = Goal(x=float(route[-1, 0]), y=float(route[-1, 1]), radius=3.0)
    return Map(lanes=lanes), Route(reference=route, goal=goal, lane_ids=named)


def against_every_vertex(line: ReferenceLine, lines: list[np.ndarray]) -> list[tuple[np.ndarray, np.ndarray]]:
    """What `project_lines` promises, from the nearest of all vertices."""
    stride = max(round(1.0 / line.spacing), 1)
    x, y, h = line.x[::stride], line.y[::stride], line.heading[::stride]
    out = []
    for p in lines:
        i = np.argmin((p[:, None, 0] - x) ** 2 + (p[:, None, 1] - y) ** 2, axis=1)
        dx, dy = p[:, 0] - x[i], p[:, 1] - y[i]
        s = line.spacing * stride * i + np.cos(h[i]) * dx + np.sin(h[i]) * dy
        out.append((s, -np.sin(h[i]) * dx + np.cos(h[i]) * dy))
    return out


def every_lane(self: Projections, lanes: list[Lane], reach: float) -> Work[list[Lane]]:
    yield 0
    return lanes


def parts(value: object) -> list[object]:
    """All arrays and numbers inside, in order."""
    if hasattr(value, "__dataclass_fields__"):
        return [q for f in fields(value) for q in parts(getattr(value, f.name))]
    return [q for v in value for q in parts(v)] if isinstance(value, tuple) else [value]


@settings(deadline=None, max_examples=150)
@given(seed=st.integers(0, 2**32 - 1))
def test_the_road_is_the_same_as_if_every_lane_were_projected_on_the_whole_line(seed: int):
    road, route = network(np.random.default_rng(seed))
    reference = ReferenceLine.of(route.reference)
    pruned = RouteLanes.of(reference, route, road)
    with (
        patch.object(Projections, "near", every_lane),
        patch.object(ReferenceLine, "project_lines", against_every_vertex),
    ):
        whole = RouteLanes.of(reference, route, road)
    assert len(pruned.tracks) == len(whole.tracks)
    for a, b in zip(parts(pruned), parts(whole), strict=True):
        assert np.array_equal(a, b, equal_nan=True)


@settings(deadline=None, max_examples=100)
@given(seed=st.integers(0, 2**32 - 1), scale=st.sampled_from([0.1, 1.0, 30.0]))
def test_points_find_the_nearest_of_all_vertices_wherever_they_are(seed: int, scale: float):
    random = np.random.default_rng(seed)
    line = ReferenceLine.of(wandering(random, 400.0, 0.05))
    lines = [scale * wandering(random, random.uniform(3.0, 500.0), 0.2) for _ in range(random.integers(0, 6))]
    for found, all_of_it in zip(line.project_lines(lines), against_every_vertex(line, lines), strict=True):
        assert np.array_equal(found, all_of_it)


def city(streets: int) -> Map:
    """Streets with one lane each way, crossing every block; lanes end at the crossings."""
    lanes: list[Lane] = []
    t = np.linspace(0.0, BLOCK, 9)
    for across in (False, True):
        for i in range(-streets, streets + 1):
            for k in range(-streets, streets):
                for side in (1.75, -1.75):
                    x, y = k * BLOCK + t, np.full_like(t, i * BLOCK + side)
                    line = np.stack((y, x) if across else (x, y), axis=1)
                    lanes.append(Lane(id=len(lanes), centre=line, left=line + 1.75, right=line - 1.75))
    return Map(lanes=lanes)


def work(road: Map, reference: np.ndarray) -> tuple[int, int]:
    """How many points are projected, and with how many vertices they are compared."""
    line = ReferenceLine.of(reference)
    points, compared, plain = [], [], ReferenceLine.project_lines
    vertices = type(line.pieces).vertices

    def counted(self: ReferenceLine, lines: list[np.ndarray]) -> list[tuple[np.ndarray, np.ndarray]]:
        points.extend(len(p) for p in lines)
        return plain(self, lines)

    def looked_at(self: object, near: np.ndarray) -> np.ndarray:
        found = vertices(self, near)
        compared.append(len(found))
        return found

    goal = Goal(x=0.0, y=0.0, radius=3.0)
    with patch.object(ReferenceLine, "project_lines", counted), patch.object(type(line.pieces), "vertices", looked_at):
        RouteLanes.of(line, Route(reference=reference, goal=goal), road)
    return sum(points), max(compared)


def corner(leg: float) -> np.ndarray:
    """East along a street, then north along another: its box is a square of the city."""
    x = np.arange(-leg, 1.75, 2.0)
    return np.vstack((np.stack((x, np.full_like(x, -1.75)), 1), np.stack((np.full_like(x, 1.75), x + leg), 1)))


def test_a_larger_map_costs_no_more_projections():
    assert work(city(4), corner(2 * BLOCK)) == work(city(12), corner(2 * BLOCK))


def test_a_route_twice_as_long_costs_twice_the_projections_though_its_box_is_four_times_as_large():
    road = city(12)
    short, long = work(road, corner(4 * BLOCK)), work(road, corner(8 * BLOCK))
    assert long[0] == pytest.approx(2.0 * short[0], rel=0.2)
    assert long[1] <= short[1] * 1.2


@settings(deadline=None, max_examples=25)
@given(seed=st.integers(0, 2**32 - 1), amount=st.integers(1, 60))
def test_the_road_is_the_same_however_little_of_it_is_prepared_at_a_time(seed: int, amount: int):
    road, route = network(np.random.default_rng(seed))
    reference = ReferenceLine.of(route.reference)
    work = RouteLanes.preparing(reference, route, road)
    while (found := advance(work, amount)) is None:
        pass
    for a, b in zip(parts(found), parts(RouteLanes.of(reference, route, road)), strict=True):
        assert np.array_equal(a, b, equal_nan=True)


OLD, NEW = 9.0, 5.0  # m/s


@pytest.fixture
def projected() -> Iterator[list[int]]:
    """How many lines were projected, call by call."""
    plain, calls = ReferenceLine.project_lines, list[int]()

    def counted(self: ReferenceLine, lines: list[np.ndarray]) -> list[tuple[np.ndarray, np.ndarray]]:
        calls.append(len(lines))
        return plain(self, lines)

    with patch.object(ReferenceLine, "project_lines", counted):
        yield calls


def through_the_city(speed_limit: float) -> Route:
    line = corner(10 * BLOCK)
    goal = Goal(x=float(line[-1, 0]), y=float(line[-1, 1]), radius=3.0)
    return Route(reference=line, goal=goal, speed_limit=speed_limit)


def renewed(resend: bool, projected: list[int]) -> tuple[list[Plan], list[int]]:
    """Plans from the moment a city and a slower route replace a road without a map, and the lines projected for each.

    resend: the map comes again, as another object, at every step.
    """
    planner = Planner(PlannerSettings(offsets=(0.0,), lengths=((24.0, 5.0),)))
    plans, lines = list[Plan](), list[int]()
    ego, blank, whole = ego_at(-700.0, -1.75, 0.0, 7.0), stamped(Map(), 0.0), city(12)
    before, after = stamped(through_the_city(OLD), 0.0), stamped(through_the_city(NEW), 0.0)
    for step in range(40):
        t, new = 0.05 * step, step >= 2
        road = stamped(Map(lanes=whole.lanes) if resend else whole, 0.0) if new else blank
        risk = stamped(risk_of(ego, [], t), t)
        count = sum(projected)
        plan = planner.step(stamped(ego, t), risk, road, after if new else before, round(t * 1e9))
        if new:
            plans.append(plan)
            lines.append(sum(projected) - count)
        ego = follow(plan, ego, 0.05)
    return plans, lines


@pytest.mark.long
def test_while_a_city_is_prepared_the_planner_drives_on_over_the_old_road(projected: list[int]):
    plans, lines = renewed(False, projected)
    assert {p.mode for p in plans} == {"drive"}
    wanted = np.array([p.desired_speed for p in plans])
    assert wanted[0] > NEW + 0.5
    assert wanted[-1] <= NEW + 0.1
    assert 1 < np.count_nonzero(lines) < 20
    assert max(lines) <= 160 < sum(lines)


@pytest.mark.long
def test_a_map_that_comes_again_before_it_is_prepared_still_comes_into_force(projected: list[int]):
    plans, lines = renewed(True, projected)
    assert {p.mode for p in plans} == {"drive"}
    assert plans[-1].desired_speed <= NEW + 0.1
    assert max(lines) <= 160
