"""What is said and done without usable inputs: the words, the brakes, and where the stop begins and ends."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest

from common.codec import check
from common.messages import Map, Plan
from services.planner.bezier import Start
from services.planner.safe_stop import missing_input, safe_stop, waiting
from services.planner.settings import PlannerSettings
from services.planner.trajectory import Memory, Path, brake_motion
from services.planner.volume import Volume
from tests.planner.worlds import WHEELBASE, box, ego_at, risk_of, stamped, straight_route

SETTINGS = PlannerSettings()
MS = 1_000_000
NOW = 10_000 * MS


def words(
    ego: int | None = 10, risk: int | None = 100, road: bool = True, route: bool = True, **settings: float
) -> str:
    """What is missing, with an ego and a risk of those ages [ms]."""
    state = ego_at(0.0, 0.0)
    return missing_input(
        None if ego is None else stamped(state, (NOW - ego * MS) * 1e-9),
        None if risk is None else stamped(None, (NOW - risk * MS) * 1e-9),
        stamped(Map(), 0.0) if road else None,
        stamped(straight_route(), 0.0) if route else None,
        NOW,
        msgspec.structs.replace(SETTINGS, **settings),
    )  # fmt: skip


EGO, ROAD = "no ego state yet (topic `ego`)", "no map yet (topic `map`; to drive without one, publish an empty map)"
ROUTE, RISK = "no route yet (topic `route`)", "no risk yet (topic `risk`)"


def test_everything_that_is_missing_is_named_with_its_topic() -> None:
    assert words() == ""
    assert words(ego=None) == EGO
    assert words(road=False) == ROAD
    assert words(route=False) == ROUTE
    assert words(risk=None) == RISK
    assert words(None, None, False, False) == f"{EGO}; {ROAD}; {ROUTE}; {RISK}"
    assert words(ego=None, risk=900) == EGO  # what is missing comes before what is old


def test_ages_are_allowed_up_to_their_limit_and_told_in_milliseconds() -> None:
    assert words(ego=200, risk=300, max_ego_age=0.2 + 1e-9, max_risk_age=0.3 + 1e-9) == ""
    assert words(ego=201) == "the ego state is 201 ms old, at most 200 ms"
    assert words(risk=301) == "the risk is 301 ms old, at most 300 ms"
    assert words(ego=250, risk=400) == "the ego state is 250 ms old, at most 200 ms"
    assert words(ego=250, risk=400, max_ego_age=0.3) == "the risk is 400 ms old, at most 300 ms"
    assert words(ego=60, max_ego_age=0.05) == "the ego state is 60 ms old, at most 50 ms"
    assert words(ego=0, risk=0, max_ego_age=1e-9, max_risk_age=1e-9) == ""
    assert words(ego=250, risk=250, max_ego_age=0.25, max_risk_age=0.25) == ""  # the limit itself is allowed
    assert words(ego=5000, max_ego_age=2.0) == "the ego state is 5000 ms old, at most 2000 ms"
    assert words(risk=5000, max_risk_age=2.0) == "the risk is 5000 ms old, at most 2000 ms"


def test_waiting_is_nothing_but_words() -> None:
    assert waiting("why", "default") == Plan(mode="waiting", reason="why", planner="default")
    assert waiting("w" * 1001, "paper") == Plan(mode="waiting", reason="w" * 1000, planner="paper")


def stop(
    speed: float = 10.0, acceleration: float = 0.0, curvature: float = 0.0, *, path: Path | None = None,
    distance: float = 0.0, volume: Volume | None = None, reason: str = "lost",
) -> tuple[Plan, Memory]:  # fmt: skip
    start = Start(0.0, 0.0, 0.0, curvature, speed, acceleration)
    plan, memory = safe_stop(
        reason, start, path, distance, ego_at(0.5 * WHEELBASE, 0.0, 0.0, speed), volume, SETTINGS
    )  # fmt: skip
    check(plan)
    assert memory is not None
    return plan, memory


def whole(plan: Plan, name: str) -> np.ndarray:
    """A quantity along profile and tail, their common sample once."""
    assert plan.profile is not None and plan.tail is not None
    return np.concatenate((getattr(plan.profile, name), getattr(plan.tail, name)[1:]))


def test_it_is_one_braking_cut_at_valid_for() -> None:
    plan, memory = stop()
    assert (plan.mode, plan.reason, plan.planner, plan.valid_for) == ("safe_stop", "lost", "default", 0.3)
    assert plan.profile is not None and plan.tail is not None
    assert plan.profile.t[-1] == plan.tail.t[0] == pytest.approx(0.3)
    assert np.all(np.diff(whole(plan, "t")) > 0.0)
    for name in ("x", "speed", "acceleration"):
        assert getattr(plan.tail, name)[0] == getattr(plan.profile, name)[-1]
    brake = brake_motion(0.0, 0.0, 10.0, 0.0, SETTINGS.safe_stop_brake, 4.0 * SETTINGS.safe_stop_brake)
    assert whole(plan, "speed") == pytest.approx(np.interp(whole(plan, "t"), brake.t, brake.speed), abs=1e-9)
    assert whole(plan, "acceleration") == pytest.approx(
        np.interp(whole(plan, "t"), brake.t, brake.acceleration), abs=1e-9
    )
    assert whole(plan, "x") == pytest.approx(
        np.interp(whole(plan, "t"), brake.t, brake.distance) + 0.5 * WHEELBASE, abs=5e-3
    )
    assert plan.tail.speed[-1] == 0.0 and whole(plan, "acceleration").min() == pytest.approx(-3.0)
    assert np.all(whole(plan, "y") == 0.0)
    assert (memory.capture_ns, memory.valid_for, memory.target_name) == (0, 0.3, "")
    assert (memory.target_speed, memory.remaining, memory.s) == (0.0, 0.0, -1.0)
    assert np.array_equal(memory.motion.t, plan.profile.t) and np.array_equal(memory.tail.t, plan.tail.t)
    assert stop(reason="r" * 1200)[0].reason == "r" * 1000


def test_it_goes_on_from_the_acceleration_of_a_moving_ego_alone() -> None:
    assert whole(stop(10.0, 1.5)[0], "acceleration")[0] == 1.5
    assert whole(stop(0.01, -1.0)[0], "acceleration")[0] == -1.0
    assert np.all(whole(stop(0.0, 1.5)[0], "acceleration") == 0.0)


def test_without_a_path_it_goes_round_its_own_circle_which_is_long_enough() -> None:
    plan, memory = stop(12.0, curvature=0.02)
    assert np.all(whole(plan, "curvature") == 0.02)
    length = 12.0**2 / 3.0 + 2.0 * 12.0 + 5.0
    assert memory.path.step * (len(memory.path.x) - 1) == pytest.approx(length, abs=memory.path.step)
    assert whole(plan, "heading") == pytest.approx(0.02 * np.interp(whole(plan, "t"), *_way(memory)), abs=1e-9)
    # wherever on another path one would be counts for nothing on this circle
    assert whole(stop(12.0, curvature=0.02, distance=50.0)[0], "x") == pytest.approx(whole(plan, "x"))


def _way(memory: Memory) -> tuple[np.ndarray, np.ndarray]:
    return (
        np.append(memory.motion.t, memory.tail.t[1:]),
        np.append(memory.motion.distance, memory.tail.distance[1:]),
    )


def test_on_a_path_it_begins_where_the_ego_is_on_it() -> None:
    points = 2.0 * np.arange(60)
    path = Path(2.0, points, np.full(60, 1.0), np.zeros(60), np.zeros(60))
    plan, memory = stop(8.0, path=path, distance=30.0)
    assert whole(plan, "x")[0] == pytest.approx(30.0 + 0.5 * WHEELBASE) and np.all(whole(plan, "y") == 1.0)
    assert memory.path is path


@pytest.mark.parametrize("speed", [0.0, 0.02, 0.3])
def test_who_stands_or_nearly_does_has_a_profile_to_rest_and_a_tail_that_stands(speed: float) -> None:
    plan, memory = stop(speed)
    assert plan.profile is not None and plan.tail is not None
    assert plan.profile.t[-1] == plan.tail.t[0] == pytest.approx(0.3)
    assert plan.profile.speed[-1] == 0.0 and np.all(plan.tail.speed == 0.0) and np.all(plan.tail.acceleration == 0.0)
    assert np.all(plan.tail.x == plan.profile.x[-1])
    assert len(plan.tail.t) == 2 and plan.tail.t[-1] == pytest.approx(0.4)
    assert np.array_equal(memory.tail.t, plan.tail.t)


def test_one_that_just_outlasts_valid_for_is_cut_there_and_one_that_just_does_not_stands() -> None:
    still = moving = 0
    for speed in np.linspace(0.3, 0.9, 61):
        plan, _ = stop(float(speed))
        end = brake_motion(0.0, 0.0, float(speed), 0.0, 3.0, 12.0).t[-1]
        assert plan.tail is not None and plan.profile is not None
        assert plan.tail.t[0] == pytest.approx(0.3)
        if end <= 0.3:
            still += 1
            assert plan.profile.speed[-1] == 0.0
        else:
            moving += 1
            assert plan.tail.speed[0] > 0.0 and plan.tail.t[-1] == pytest.approx(end)
    assert still and moving


def test_the_profile_is_as_long_as_the_settings_have_it() -> None:
    longer = msgspec.structs.replace(SETTINGS, valid_for=0.5)
    plan, memory = safe_stop(
        "lost", Start(0.0, 0.0, 0.0, 0.0, 10.0, 0.0), None, 0.0, ego_at(1.35, 0.0, 0.0, 10.0), None, longer
    )
    assert plan.valid_for == 0.5 and plan.profile is not None and plan.tail is not None and memory is not None
    assert plan.profile.t[-1] == plan.tail.t[0] == 0.5 == memory.valid_for


def volume(at: float) -> Volume:
    return Volume.of(risk_of(ego_at(0.0, 0.0), [box(at, 0.0)], ahead=70.0), 0, 0)


def test_it_brakes_firmly_and_hard_only_where_firmly_would_meet_something() -> None:
    for clear in (None, volume(40.0)):
        assert whole(stop(10.0, volume=clear)[0], "acceleration").min() == pytest.approx(-3.0)
    plan, memory = stop(10.0, volume=volume(18.0))
    assert whole(plan, "acceleration").min() == pytest.approx(-8.0)
    hard = brake_motion(0.0, 0.0, 10.0, 0.0, 8.0, 32.0)
    assert whole(plan, "speed") == pytest.approx(np.interp(whole(plan, "t"), hard.t, hard.speed), abs=1e-9)
    assert memory.tail.distance[-1] == pytest.approx(hard.distance[-1], abs=5e-3)


def test_what_counts_as_meeting_something_is_the_footprint_as_the_settings_have_it() -> None:
    beside = Volume.of(risk_of(ego_at(0.0, 0.0), [box(14.0, 2.05)], ahead=70.0), 0, 0)
    assert whole(stop(10.0, volume=beside)[0], "acceleration").min() == pytest.approx(-3.0)
    strict = msgspec.structs.replace(SETTINGS, flank_margin=0.0, r_hit=0.3)
    plan, _ = safe_stop(
        "lost", Start(0.0, 0.0, 0.0, 0.0, 10.0, 0.0), None, 0.0, ego_at(1.35, 0.0, 0.0, 10.0), beside, strict
    )
    assert whole(plan, "acceleration").min() == pytest.approx(-8.0)
