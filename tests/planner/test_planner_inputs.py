"""Whatever it is given, the planner answers with a valid plan and says why it does not drive."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import HealthCheck, given
from hypothesis import settings as examples
from hypothesis import strategies as st

from common.codec import check
from common.messages import Goal, Map, Plan, Risk, Route
from services.planner import core
from services.planner.core import Planner
from services.planner.settings import PlannerSettings
from tests.planner.worlds import WHEELBASE, box, ego_at, follow, lane, risk_of, stamped, straight_route

SETTINGS = PlannerSettings(offsets=(0.0, 0.8, -0.8, 2.0, -2.0), lengths=((9.0, 2.2), (24.0, 5.0)))
INPUTS = ("ego", "risk", "map", "route")


def inputs(speed: float = 8.0, t: float = 1.0) -> dict[str, object]:
    ego = ego_at(0, 0, 0, speed)
    return {
        "ego": stamped(ego, t),
        "risk": stamped(risk_of(ego, [], ahead=70.0), t),
        "map": stamped(Map(), 0.0),
        "route": stamped(straight_route(), 0.0),
        "now_ns": round(t * 1e9) + 10_000_000,
    }


def ends_at_rest(plan: Plan) -> bool:
    return plan.tail is not None and plan.tail.speed[-1] == 0.0


@pytest.mark.parametrize("missing", INPUTS)
def test_without_an_input_a_standing_ego_waits_and_the_reason_names_the_topic(missing: str):
    plan = Planner(SETTINGS).step(**(inputs(speed=0.0) | {missing: None}))  # type: ignore[arg-type]
    check(plan)
    assert plan.mode == "waiting"
    assert plan.profile is None
    assert f"`{missing}`" in plan.reason


@pytest.mark.parametrize("missing", ["risk", "map", "route"])
def test_a_moving_ego_without_an_input_is_brought_to_rest(missing: str):
    plan = Planner(SETTINGS).step(**(inputs() | {missing: None}))  # type: ignore[arg-type]
    check(plan)
    assert plan.mode == "safe_stop"
    assert ends_at_rest(plan)
    assert f"`{missing}`" in plan.reason


def test_no_map_is_not_an_empty_map():
    assert Planner(SETTINGS).step(**(inputs(speed=0.0) | {"map": None})).mode == "waiting"  # type: ignore[arg-type]
    assert Planner(SETTINGS).step(**inputs(speed=0.0)).mode == "drive"  # type: ignore[arg-type]


@pytest.mark.parametrize(("what", "age", "mode"), [("risk", 0.29, "drive"), ("risk", 0.31, "safe_stop")])
def test_risk_older_than_300_ms_is_a_safe_stop(what: str, age: float, mode: str):
    given_ = inputs()
    given_["risk"] = stamped(given_["risk"].value, 1.01 - age)  # type: ignore[attr-defined]
    plan = Planner(SETTINGS).step(**given_)  # type: ignore[arg-type]
    check(plan)
    assert plan.mode == mode
    assert ends_at_rest(plan)
    if mode == "safe_stop":
        assert "300 ms" in plan.reason


def test_a_stale_ego_is_a_safe_stop_that_goes_on_from_the_last_plan():
    planner = Planner(SETTINGS)
    first = planner.step(**inputs())  # type: ignore[arg-type]
    later = inputs() | {"now_ns": 1_250_000_000}
    later["risk"] = stamped(later["risk"].value, 1.2)  # type: ignore[attr-defined]
    plan = planner.step(**later)  # type: ignore[arg-type]
    check(plan)
    assert plan.mode == "safe_stop"
    assert "200 ms" in plan.reason
    assert plan.profile is not None
    assert first.profile is not None
    # its times count from now, so that it is never refused as old: 0.25 s after the first plan's ego
    assert planner.capture_ns(later["ego"], 1_250_000_000) == 1_250_000_000  # type: ignore[arg-type]
    assert plan.profile.t[0] == 0.0
    assert abs(plan.profile.x[0] - np.interp(0.25, first.profile.t, first.profile.x)) < 0.05
    assert ends_at_rest(plan)


def test_a_lost_input_leads_to_rest_and_stays_there():
    planner = Planner(SETTINGS)
    planner.step(**inputs())  # type: ignore[arg-type]
    ego, speeds = ego_at(0, 0, 0, 8), []
    for k in range(140):
        t = 1.05 + 0.05 * k
        plan = planner.step(**(inputs() | {"ego": stamped(ego, t), "risk": None, "now_ns": round(t * 1e9)}))  # type: ignore[arg-type]
        check(plan)
        assert plan.mode == "safe_stop"
        ego = follow(plan, ego, 0.05)
        speeds.append(ego.speed)
    assert np.all(np.diff(speeds) <= 1e-6)
    assert speeds[-1] == 0.0
    assert 8.0 < ego.x < 22.0


def test_an_error_inside_is_a_safe_stop_that_names_it(monkeypatch: pytest.MonkeyPatch):
    def broken(*_: object) -> None:
        raise ZeroDivisionError("by nothing")

    monkeypatch.setattr(core, "plan_default", broken)
    plan = Planner(SETTINGS).step(**inputs())  # type: ignore[arg-type]
    check(plan)
    assert plan.mode == "safe_stop"
    assert "ZeroDivisionError: by nothing" in plan.reason
    assert ends_at_rest(plan)


def test_a_route_that_cannot_be_driven_is_a_safe_stop():
    route = Route(reference=np.zeros((3, 2)), goal=Goal(x=0, y=0, radius=1))
    plan = Planner(SETTINGS).step(**(inputs() | {"route": stamped(route, 0)}))  # type: ignore[arg-type]
    assert plan.mode == "safe_stop"
    assert "route" in plan.reason


def test_an_ego_across_the_route_is_not_driven_on():
    ego = ego_at(0, 0, 1.5, 0.0)
    given_ = inputs() | {"ego": stamped(ego, 1.0), "risk": stamped(risk_of(ego, []), 1.0)}
    plan = Planner(SETTINGS).step(**given_)  # type: ignore[arg-type]
    assert plan.mode == "safe_stop"
    assert "across" in plan.reason


def test_somebody_in_our_footprint_does_not_forbid_stopping():
    ego = ego_at(0, 0, 0, 5)
    given_ = inputs(5.0) | {"risk": stamped(risk_of(ego, [box(1.0, 0.3)], ahead=70.0), 1.0)}
    plan = Planner(SETTINGS).step(**given_)  # type: ignore[arg-type]
    check(plan)
    assert plan.profile is not None
    assert ends_at_rest(plan)
    assert plan.profile.speed[-1] < 0.1
    assert np.all(np.diff(plan.profile.speed) <= 1e-6)


def test_a_new_route_and_map_are_taken_at_once():
    planner = Planner(SETTINGS)
    slow = planner.step(**inputs())  # type: ignore[arg-type]
    fast_map = Map(lanes=[lane(1, 0.0, limit=3.0)])
    limited = planner.step(**(inputs() | {"map": stamped(fast_map, 0)}))  # type: ignore[arg-type]
    assert slow.desired_speed > 7.0
    assert limited.desired_speed <= 3.0 + 1e-9


finite = st.floats(allow_nan=False, allow_infinity=False)


@examples(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(
    seed=st.integers(0, 2**31),
    speed=st.floats(0, 30),
    y=st.floats(-2, 2),
    heading=st.floats(-0.6, 0.6),
    yaw_rate=st.floats(-1, 1),
    acceleration=st.floats(-8, 3),
    age=st.floats(0, 0.35),
    scale=st.sampled_from([0.0, 0.3, 1.0, 5.0]),
)
def test_any_volume_gives_a_plan_that_is_finite_valid_and_ends_at_rest(
    seed: int,
    speed: float,
    y: float,
    heading: float,
    yaw_rate: float,
    acceleration: float,
    age: float,
    scale: float,
):
    rng = np.random.default_rng(seed)
    ego = ego_at(0, y, heading, speed, yaw_rate=yaw_rate, acceleration=acceleration)
    base = risk_of(ego, [], ahead=70.0)
    blobs = np.zeros(base.volume.shape)
    for _ in range(6):
        i, j = rng.integers(0, base.grid.rows), rng.integers(0, base.grid.columns)
        blobs[:, i : i + rng.integers(1, 40), j : j + rng.integers(1, 20)] += rng.random() * scale
    risk = Risk(
        grid=base.grid,
        slice_times=base.slice_times,
        slots=[],
        volume=blobs.astype(rng.choice([np.float32, np.float16])),
        dominant=base.dominant,
    )
    planner = Planner(SETTINGS)
    for k in range(2):
        t = 1.0 + 0.05 * k
        plan = planner.step(
            stamped(ego, t), stamped(risk, t - age), stamped(Map(), 0), stamped(straight_route(), 0), round(t * 1e9)
        )
        check(plan)
        assert plan.mode in ("drive", "safe_stop")
        assert "planner failed" not in plan.reason
        assert ends_at_rest(plan)
        assert plan.profile is not None
        assert abs(plan.profile.x[0] - WHEELBASE / 2 * np.cos(plan.profile.heading[0])) < 40
        ego = follow(plan, ego, 0.05)
