"""Collision, fault, clearance, comfort, goal and interventions are found in the driven motion itself."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from common.messages import Decision, Ego, Goal, Lane, Map, Objects, Plan, Route
from rig.comfort import GRID_S
from rig.interventions import slow_downs
from rig.measure import Measure
from rig.world import Scenario, ego_at

DT = 0.02


def scenario(goal: Goal | None = None, map: Map | None = None) -> Scenario:
    line = np.array([[-100.0, 0.0], [1000.0, 0.0]])
    route = Route(reference=line, goal=goal or Goal(x=900.0, y=0.0, radius=3.0))
    return Scenario("test", "test", "built-in", 20.0, map or Map(), route, ego_at(0.0, 0.0, 0.0, 10.0))


def one(x: float, y: float, v: float = 0.0, heading: float = 0.0, id: int = 5) -> Objects:
    def a(value: float) -> np.ndarray:
        return np.array([value], dtype=np.float64)

    return Objects(
        id=np.array([id]), cls=np.array([1], dtype=np.uint8), x=a(x), y=a(y), heading=a(heading),
        vx=a(v * np.cos(heading)), vy=a(v * np.sin(heading)), length=a(4.0), width=a(2.0), mass=a(0.0),
    )  # fmt: skip


def nobody() -> Objects:
    o = one(0, 0)
    return Objects(**{f: getattr(o, f)[:0] for f in o.__struct_fields__})


def driven(speeds: list[float] | np.ndarray, objects, plans=None, s: Scenario | None = None, y=None) -> Measure:
    """Straight along x with a speed for each 20 ms; objects(t) and plans(t) as given."""
    m = Measure(s or scenario())
    x = 0.0
    speeds = np.asarray(speeds, dtype=float)
    for i, v in enumerate(speeds):
        t = i * DT
        a = (speeds[i] - speeds[i - 1]) / DT if i else 0.0
        e = ego_at(x, 0.0 if y is None else y(t), 0.0, v, acceleration=float(np.clip(a, -50, 50)))
        m.observe(t, e, objects(t), plans(t) if plans else None)
        x += v * DT
    return m


def test_a_known_collision_is_found_once_with_its_moment() -> None:
    # rectangles of 4.5 and 4 m: contact when the centres are 4.25 m apart, after 45.75 m, at 4.575 s
    m = driven([10.0] * 300, lambda t: one(50.0, 0.0))
    found = m.summary()["ego"]
    assert found["collision"]
    assert found["collision_at_fault"]
    assert len(found["collisions"]) == 1
    assert found["collisions"][0]["t"] == pytest.approx(4.58, abs=0.03)
    assert found["min_clearance_m"] == 0.0


@given(st.floats(2.1, 30.0), st.floats(-60.0, 60.0))
@settings(max_examples=30, deadline=None)
def test_clearance_is_the_smallest_distance_between_the_bodies(beside: float, ahead: float) -> None:
    m = driven([5.0] * 50, lambda t: one(ahead, beside))
    gap_y = beside - 1.0 - 0.9
    x = np.arange(50) * DT * 5.0
    gap_x = np.maximum(np.abs(ahead - x) - 2.0 - 2.25, 0.0)
    expected = float(np.hypot(gap_x, gap_y).min())
    assert m.summary()["ego"]["min_clearance_m"] == pytest.approx(expected, abs=2e-3)
    assert not m.summary()["ego"]["collision"]


def test_with_nobody_there_clearance_is_not_a_number_made_up() -> None:
    assert driven([5.0] * 10, lambda t: nobody()).summary()["ego"]["min_clearance_m"] is None


def struck(speeds, y=None, offset: float = 0.0, s: Scenario | None = None) -> dict:
    """A follower that starts 12 m behind and drives 15 m/s into a slower ego's rear."""
    m = driven(speeds, lambda t: one(-12.0 + 15.0 * t, (y(t) if y else 0.0) + offset, 15.0), y=y, s=s)
    return m.summary()["ego"]


def test_struck_from_behind_while_keeping_the_lane_is_not_at_fault() -> None:
    found = struck([10.0] * 200)
    assert found["collision"]
    assert not found["collision_at_fault"]


def test_struck_from_behind_after_a_hard_brake_is_at_fault() -> None:
    found = struck(np.maximum(10.0 - 6.0 * np.arange(200) * DT, 0.0))
    assert found["collision_at_fault"]
    assert "braking" in found["collisions"][0]["why"]


def test_struck_from_behind_while_changing_lanes_is_at_fault() -> None:
    found = struck([10.0] * 200, y=lambda t: 1.5 * t)
    assert found["collision_at_fault"]
    assert "leaving the lane" in found["collisions"][0]["why"]


def test_following_the_lanes_own_bend_is_keeping_the_lane() -> None:
    bent = np.array([[-20.0, 0.0], [0.0, 0.0], [200.0, 30.0]])
    up = np.array([0.0, 1.75])
    left, right = bent + up, bent - up
    lane = Lane(id=1, centre=bent, left=left, right=right)
    found = struck([10.0] * 200, y=lambda t: 0.15 * 10.0 * t, s=scenario(map=Map(lanes=[lane])))
    assert found["collision"]
    assert not found["collision_at_fault"]


def test_driving_into_a_standing_car_and_a_crossing_one_is_at_fault() -> None:
    assert driven([10.0] * 300, lambda t: one(30.0, 0.0)).summary()["ego"]["collision_at_fault"]
    side = driven([10.0] * 300, lambda t: one(20.0, 20.0 - 10.0 * t, 10.0, -np.pi / 2)).summary()["ego"]
    assert side["collision"]
    assert side["collision_at_fault"]


def test_distance_mean_speed_and_goal() -> None:
    s = scenario(goal=Goal(x=50.0, y=0.0, radius=2.0))
    found = driven([10.0] * 501, lambda t: nobody(), s=s).summary()["ego"]
    assert found["distance_m"] == pytest.approx(100.0, abs=0.3)
    assert found["mean_speed_mps"] == pytest.approx(10.0, abs=0.05)
    assert found["reached_goal"]
    assert found["goal_t"] == pytest.approx(4.8, abs=0.03)


def test_a_goal_to_stop_at_is_not_reached_by_driving_through() -> None:
    s = scenario(goal=Goal(x=50.0, y=0.0, radius=2.0, stop=True))
    assert not driven([10.0] * 501, lambda t: nobody(), s=s).summary()["ego"]["reached_goal"]


@given(st.floats(0.5, 6.0))
@settings(max_examples=20, deadline=None)
def test_a_ramp_of_speed_gives_its_acceleration_and_a_step_of_acceleration_a_finite_jerk(a: float) -> None:
    t = np.arange(500) * DT
    found = driven(10.0 + a * np.clip(t - 3.0, 0.0, 2.0), lambda t: nobody()).summary()["ego"]
    assert found["max_abs_accel_lon"] == pytest.approx(a, rel=0.02)
    assert found["max_abs_jerk"] == pytest.approx(a / 0.2, rel=0.3)


def test_lateral_acceleration_is_speed_times_yaw_rate() -> None:
    m = Measure(scenario())
    e = ego_at(0.0, 0.0, 0.0, 8.0)
    turning = Ego(**{f: getattr(e, f) for f in e.__struct_fields__ if f != "yaw_rate"}, yaw_rate=0.2)
    for i in range(100):
        m.observe(i * DT, turning, nobody(), None)
    assert m.summary()["ego"]["max_abs_accel_lat"] == pytest.approx(1.6, rel=1e-3)


# --- interventions ---


def because(id: int, term: str) -> Plan:
    d = Decision(sentence=f"slowed by {id}", source_id=id, term=term, slice_s=1.5)
    return Plan(mode="waiting", reason="held", decision=d)


def test_a_slow_down_is_found_and_explained_by_the_plan_in_force_while_speed_was_lost() -> None:
    t = np.arange(1000) * DT
    speed = 10.0 - 2.0 * np.clip(t - 5.0, 0.0, 2.0)
    m = driven(speed, lambda t: nobody(), plans=lambda t: because(1, "limit") if t < 5.3 else because(42, "potential"))
    found = m.summary()["interventions"]
    assert len(found) == 1
    assert found[0]["kind"] == "slow"
    assert (found[0]["source_id"], found[0]["term"], found[0]["slice_s"]) == (42, "potential", 1.5)
    assert found[0]["t"] == pytest.approx(5.0, abs=0.1)
    assert found[0]["speed_from"] == pytest.approx(10.0)
    assert found[0]["speed_to"] == pytest.approx(6.0, abs=0.01)


def test_a_stop_is_found_even_from_a_crawl() -> None:
    t = np.arange(1000) * DT
    m = driven(np.maximum(0.8 - 0.2 * t, 0.0), lambda t: nobody())
    found = m.summary()["interventions"]
    assert [i["kind"] for i in found] == ["stop"]
    assert found[0]["speed_to"] < 0.1


def test_two_slow_downs_with_a_recovery_between_are_two() -> None:
    t = np.arange(2000) * DT
    speed = 10.0 - 2.0 * np.clip(t - 3, 0, 1) + 2.0 * np.clip(t - 8, 0, 1) - 3.0 * np.clip(t - 15, 0, 1)
    found = driven(speed, lambda t: nobody()).summary()["interventions"]
    assert [round(i["speed_to"], 1) for i in found] == [8.0, 7.0]


@given(st.floats(0.0, 0.45))
@settings(max_examples=20, deadline=None)
def test_a_gentle_or_no_slow_down_is_none(rate: float) -> None:
    t = np.arange(0.0, 20.0, GRID_S)
    assert slow_downs(t, 15.0 - rate * t) == []


def test_standing_all_the_time_is_no_intervention() -> None:
    assert driven([0.0] * 500, lambda t: nobody()).summary()["interventions"] == []


@given(st.lists(st.floats(0.0, 20.0), min_size=2, max_size=8))
@settings(max_examples=50, deadline=None)
def test_every_slow_down_is_one(knots: list[float]) -> None:
    """Whatever the motion: what is reported lost at least 1 m/s or stopped, in order, without overlap."""
    t = np.arange(0.0, 3.0 * (len(knots) - 1), GRID_S)
    v = np.interp(t, 3.0 * np.arange(len(knots)), knots)
    last = -1
    for a, b in slow_downs(t, v):
        assert last <= a < b
        assert v[a] - v[b] >= 1.0 - 1e-9 or v[b] < 0.1
        last = b


def test_the_summary_of_nothing_is_a_summary() -> None:
    found = Measure(scenario()).summary()
    assert found["ego"]["distance_m"] == 0.0
    assert found["interventions"] == []


def test_a_run_that_begins_inside_its_goal_is_not_over_before_it_began() -> None:
    s = scenario(goal=Goal(x=0.0, y=0.0, radius=4.0))
    left_for_good = driven([10.0] * 300, lambda t: nobody(), s=s)
    assert left_for_good.goal_t is None
    stayed = driven([0.0] * 1001, lambda t: nobody(), s=s)
    assert stayed.goal_t == pytest.approx(s.duration_s, abs=0.06)
