"""The closed loop in simulated time: real cores, stated latencies, the same result every time."""

from dataclasses import replace

import numpy as np
import pytest

from common import codec
from evaluation.closed_loop import Cores, DriveResult, Latency, drive, main, row
from rig.sources import load_scenario


@pytest.fixture(scope="module")
def result() -> DriveResult:
    return drive(replace(load_scenario("straight"), duration_s=5.0), {})


def test_an_empty_road_is_driven_without_stop_or_collision(result: DriveResult) -> None:
    ego = result.summary["ego"]
    assert not ego["collision"]
    assert ego["min_clearance_m"] is None
    assert result.share("drive") > 0.99
    assert sum(result.modes.values()) == pytest.approx(5.0, abs=0.03)
    assert ego["distance_m"] > 45.0
    assert result.summary["interventions"] == []
    assert "straight" in row(result)
    assert result.as_dict(plans=True)["plans"]


def test_a_plan_is_in_force_when_the_run_starts(result: DriveResult) -> None:
    assert result.plans[0]["t"] < -0.5
    assert all(p["mode"] == "drive" for p in result.plans if p["t"] > -0.5)
    t = np.array([p["t"] for p in result.plans])
    assert np.diff(t).max() <= 0.06 + 1e-9


def test_the_same_drive_twice_is_the_same_drive() -> None:
    s = replace(load_scenario("crossing_pedestrian"), duration_s=1.5)
    a, b = drive(s, {}), drive(s, {})
    assert a.plans == b.plans
    assert a.summary == b.summary


def test_every_state_that_is_measured_keeps_the_contract() -> None:
    seen = []
    s = replace(load_scenario("following"), duration_s=1.0)
    drive(s, {}, watch=lambda t, ego, objects, plan: seen.append((t, ego, objects, plan)))
    assert seen[0][0] == 0.0
    assert seen[-1][0] == pytest.approx(1.0, abs=0.02)
    for _, ego, objects, plan in seen:
        codec.check(ego)
        codec.check(objects)
        assert plan is not None
        codec.check(plan)


def test_plans_arrive_late_by_the_stated_latency() -> None:
    """With a planner that takes 300 ms nothing newer than that is ever driven, and fewer plans are made."""
    s = replace(load_scenario("straight"), duration_s=1.0)
    ages = []
    slow = Latency(planner=300.0)
    fast_plans = drive(s, {}).plans
    run = drive(s, {}, latency=slow, cores=Cores.of({}), watch=lambda t, ego, objects, plan: ages.append(t))
    assert len(run.plans) < len(fast_plans) / 3
    t = np.array([p["t"] for p in run.plans])
    assert np.diff(t).min() >= 0.3 - 0.021


def test_the_command_prints_a_table_and_refuses_what_it_does_not_know(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["nowhere"]) == 2
    assert "no scenario 'nowhere'" in capsys.readouterr().err
    assert main(["straight", "--set", "planner.no_such_key=1"]) == 2
    assert "no_such_key" in capsys.readouterr().err
