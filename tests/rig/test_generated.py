"""The built-in scenarios are worlds one can drive in, nominal and varied."""

import numpy as np
import pytest

from common import codec
from common.geometry import Polyline, distance_between_rectangles, rectangle_corners, wrap_angle
from common.messages import PREDICTION_FRAMES
from rig.sources import ScenarioError, builtin_scenarios, generated, load_scenario

NAMES = sorted(builtin_scenarios())
SEEDS = (0, 1, 7, 1234)


def test_the_promised_ones_are_there() -> None:
    promised = {
        "straight", "following", "stop_and_go", "hard_braking_lead", "cut_in", "slow_pedestrian", "truck_adjacent",
        "car_adjacent", "crossing_pedestrian", "crossing_cyclist", "left_turn", "right_turn", "u_turn",
        "unprotected_left", "ramp_merge", "lane_ends", "roundabout", "red_light", "stop_line", "double_parked",
        "blocked_road", "queue", "narrow_street", "dead_end", "demo",
    }  # fmt: skip
    assert promised <= set(NAMES)
    assert all(builtin_scenarios().values())


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("name", NAMES)
def test_every_message_keeps_the_contract(name: str, seed: int) -> None:
    s = load_scenario(name, seed=seed)
    assert s.map is not None
    assert s.map.lanes
    assert 15.0 <= s.duration_s <= 40.0
    for message in (s.map, s.route, s.ego0, s.closures_at(0.0)):
        codec.check(message)
    for t in np.arange(-1.0, s.duration_s, 0.37):
        codec.check(s.objects_at(float(t)))


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("name", NAMES)
def test_the_ego_starts_on_its_route_facing_along_it_before_the_goal(name: str, seed: int) -> None:
    s = load_scenario(name, seed=seed)
    line = Polyline.of(s.route.reference)
    at, beside = line.project(np.array([s.ego0.x, s.ego0.y]))
    goal, off = line.project(np.array([s.route.goal.x, s.route.goal.y]))
    assert abs(beside) < 0.05
    assert abs(wrap_angle(s.ego0.heading - line.heading(at))) < 0.02
    assert abs(off) < 0.1
    assert 50.0 < goal - at < 20.0 * s.duration_s
    assert line.length - goal >= 100.0


@pytest.mark.parametrize("name", NAMES)
def test_the_route_lies_on_its_lanes_and_can_be_steered(name: str) -> None:
    s = load_scenario(name)
    assert s.map is not None
    lanes = {k.id: k for k in s.map.lanes}
    line = Polyline.of(s.route.reference).resampled(0.5)
    heading = np.unwrap(np.arctan2(*np.diff(line.points, axis=0).T[::-1]))
    assert np.abs(np.diff(heading) / 0.5).max() < np.tan(0.55) / 2.7
    at = float(line.project(np.array([s.ego0.x, s.ego0.y]))[0])
    goal = float(line.project(np.array([s.route.goal.x, s.route.goal.y]))[0])
    driven = line.at(np.arange(at, goal, 2.0))
    distance = [np.abs(Polyline.of(lanes[i].centre).project(driven)[1]) for i in s.route.lane_ids]
    assert np.min(distance, axis=0).max() < 0.5
    for a, b in zip(s.route.lane_ids, s.route.lane_ids[1:], strict=False):
        assert b in lanes[a].successors


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("name", NAMES)
def test_nobody_starts_in_the_ego_or_nearer_than_beside_it_in_the_next_lane(name: str, seed: int) -> None:
    s = load_scenario(name, seed=seed)
    o = s.objects_at(0.0)
    if len(o.id):
        ego = rectangle_corners(s.ego0.x, s.ego0.y, s.ego0.heading, s.ego0.length, s.ego0.width)
        others = rectangle_corners(o.x, o.y, o.heading, o.length, o.width)
        assert distance_between_rectangles(ego, others).min() > 1.2


@pytest.mark.parametrize("name", NAMES)
def test_objects_move_as_their_heading_says_and_none_teleports(name: str) -> None:
    s = load_scenario(name)
    for k in s.tracks:
        speed = np.hypot(*k.velocity.T)
        assert speed.max() < 20.0
        # m/s in 0.1 s: who walks, or a door, can stop in a step; nobody brakes harder than 8 m/s²
        a_step = 1.5 if k.cls in (generated.ObjectClass.PEDESTRIAN, generated.ObjectClass.UNKNOWN) else 0.8
        assert np.abs(np.diff(speed)).max() < a_step
        moving = speed > 0.5
        direction = np.arctan2(k.velocity[:, 1], k.velocity[:, 0])
        assert np.abs(wrap_angle(direction - k.heading)[moving]).max(initial=0.0) < 0.1
        assert len(k.x) >= PREDICTION_FRAMES


def test_the_same_seed_gives_the_same_world_and_another_one_another() -> None:
    a, b, c = (load_scenario("following", seed=n) for n in (3, 3, 4))
    assert np.array_equal(a.route.reference, b.route.reference)
    assert all(np.array_equal(p.x, q.x) for p, q in zip(a.tracks, b.tracks, strict=True))
    assert not np.array_equal(a.tracks[0].x, c.tracks[0].x)


def test_the_neighbour_can_be_a_car_instead_of_a_truck() -> None:
    s = generated.truck_adjacent(generated.Draw(0), generated.ObjectClass.CAR)
    assert s.tracks[0].cls == generated.ObjectClass.CAR
    assert s.tracks[0].length < 6.0
    assert load_scenario("car_adjacent").tracks[0].cls == generated.ObjectClass.CAR


def test_an_unknown_name_is_refused_with_a_suggestion() -> None:
    with pytest.raises(ScenarioError, match="slow_pedestrian") as e:
        load_scenario("slow_pedestrain")
    assert "Did you mean slow_pedestrian" in str(e.value)
    with pytest.raises(ScenarioError, match="no such file"):
        load_scenario("nowhere/nothing.xml")


@pytest.mark.parametrize("seed", [0, 1, 7, 1234, 977200205])
def test_who_cuts_in_leaves_the_time_that_un_regulation_157_asks_of_anybody(seed: int) -> None:
    s = load_scenario("cut_in", seed=seed)
    line = Polyline.of(s.route.reference)
    begin = float(line.project(np.array([s.ego0.x, s.ego0.y]))[0])
    for t in np.arange(0.0, 10.0, 0.05):
        o = s.objects_at(float(t))
        at, beside = line.project(np.array([o.x[0], o.y[0]]))
        if beside - o.width[0] / 2 < 1.75 - 0.3:  # 0.3 m over the line
            closing = 13.9 - float(np.hypot(o.vx[0], o.vy[0]))
            gap = at - (begin + 13.9 * t) - 4.5
            assert gap / closing > closing / 12.0 + 0.35 - 0.15
            return
    raise AssertionError("it never cuts in")
