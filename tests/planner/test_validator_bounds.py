"""Where the validator's limits lie: what is just allowed, what is just not, and the words in which it says so."""

from __future__ import annotations

from collections.abc import Callable

import msgspec
import numpy as np
import pytest

from common.messages import Ego, Plan, Risk, Trajectory
from services.planner import validator
from services.planner.footprint import Footprint, timed_risk
from services.planner.settings import PlannerSettings
from services.planner.validator import _brakes_hard, _comes_over, contact_bound, trajectory_risk, validate
from services.planner.volume import Volume
from tests.planner.worlds import WHEELBASE, box, ego_at, risk_of

SETTINGS = PlannerSettings()
HALF = 0.5 * WHEELBASE
DT = 0.1


def moved(
    v: list[float] | np.ndarray, *, k: float | np.ndarray = 0.0, a: np.ndarray | None = None, t0: float = 0.0,
    at: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> Trajectory:  # fmt: skip
    """A motion of the rear axle with those speeds, every 0.1 s, that begins at (x, y, heading)."""
    v = np.asarray(v, dtype=np.float64)
    t = t0 + DT * np.arange(len(v))
    way = DT * 0.5 * (v[1:] + v[:-1])
    curvature = np.broadcast_to(np.asarray(k, dtype=np.float64), v.shape).copy()
    turn = 0.5 * (curvature[1:] + curvature[:-1]) * way
    heading = at[2] + np.concatenate(([0.0], np.cumsum(turn)))
    middle = 0.5 * (heading[1:] + heading[:-1])
    x = at[0] + np.concatenate(([0.0], np.cumsum(way * np.cos(middle))))
    y = at[1] + np.concatenate(([0.0], np.cumsum(way * np.sin(middle))))
    slope = np.gradient(v, DT) if a is None else a
    return Trajectory(
        t=t, x=x + HALF * np.cos(heading), y=y + HALF * np.sin(heading), heading=heading, curvature=curvature,
        speed=v, acceleration=slope,
    )  # fmt: skip


def end_of(part: Trajectory, t: float) -> tuple[float, float, float]:
    heading = float(np.interp(t, part.t, part.heading))
    x, y = (float(np.interp(t, part.t, q)) for q in (part.x, part.y))
    return x - HALF * np.cos(heading), y - HALF * np.sin(heading), heading


def braked(v0: float, brake: float = 2.0, t0: float = 0.3, **more: object) -> Trajectory:
    """From v0 to rest."""
    n = int(np.ceil(v0 / brake / DT)) + 1
    v = np.maximum(v0 - brake * DT * np.arange(n + 1), 0.0)
    a = np.where(v > 0.0, -brake, 0.0)
    return moved(v, a=a, t0=t0, **more)  # type: ignore[arg-type]


def plan_of(profile: Trajectory, tail: Trajectory | None = None, **more: object) -> Plan:
    if tail is None:
        v = float(np.interp(0.3, profile.t, profile.speed))
        k = float(np.interp(0.3, profile.t, profile.curvature))
        tail = braked(v, k=k, at=end_of(profile, 0.3))
    return Plan(**({"mode": "drive", "reason": "", "profile": profile, "tail": tail, "valid_for": 0.3} | more))  # type: ignore[arg-type]


def ego_of(speed: float = 10.0) -> Ego:
    return ego_at(HALF, 0.0, 0.0, speed)


def said(plan: Plan, ego: Ego | None = None, volume: Volume | None = None, **settings: object) -> str:
    changed = msgspec.structs.replace(SETTINGS, **settings)
    return validate(plan, ego or ego_of(), volume, changed)


def edited(part: Trajectory, **changes: Callable[[np.ndarray], np.ndarray]) -> Trajectory:
    return msgspec.structs.replace(part, **{k: f(getattr(part, k).copy()) for k, f in changes.items()})


def add(index: int, by: float) -> Callable[[np.ndarray], np.ndarray]:
    def change(values: np.ndarray) -> np.ndarray:
        values[index] += by
        return values

    return change


STEADY = moved(np.full(31, 10.0))


def test_the_plain_plan_passes_and_so_do_curves_and_braking() -> None:
    assert said(plan_of(STEADY)) == ""
    assert said(plan_of(moved(np.full(31, 4.0), k=0.2))) == ""
    assert said(plan_of(moved(10.0 - 0.2 * np.arange(31)))) == ""
    assert said(plan_of(moved(np.full(31, 10.0), at=(3.0, -4.0, 3.1)))) == ""


@pytest.mark.parametrize(("mode", "problem"), [("drive", "a plan to drive without profile or tail"), ("waiting", "")])
@pytest.mark.parametrize("missing", ["profile", "tail"])
def test_only_a_plan_to_drive_needs_profile_and_tail(mode: str, problem: str, missing: str) -> None:
    assert said(msgspec.structs.replace(plan_of(STEADY), mode=mode, **{missing: None})) == problem


@pytest.mark.parametrize("part", ["profile", "tail"])
@pytest.mark.parametrize("name", ["t", "x", "y", "heading", "curvature", "speed", "acceleration"])
@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_what_is_not_finite_is_named(part: str, name: str, bad: float) -> None:
    plan = plan_of(STEADY)
    broken = edited(getattr(plan, part), **{name: add(2, bad)})
    assert said(msgspec.structs.replace(plan, **{part: broken})) == f"{part}: {name} is not finite"


def test_two_samples_are_the_least() -> None:
    plan = plan_of(STEADY)
    one = Trajectory(**{f: getattr(STEADY, f)[:1] for f in STEADY.__struct_fields__})
    assert said(msgspec.structs.replace(plan, profile=one)) == "profile: fewer than two samples"
    two = moved(np.full(2, 3.0))
    tail = braked(3.0, t0=0.1, at=end_of(two, 0.1))
    assert said(plan_of(two, tail, valid_for=0.1)) == ""


def test_times_increase_and_speeds_are_no_less_than_zero() -> None:
    plan = plan_of(STEADY)
    same = edited(STEADY, t=lambda t: np.concatenate((t[:5], t[4:5], t[6:])))
    assert said(msgspec.structs.replace(plan, profile=same)) == "profile: times do not increase"
    back = edited(STEADY, speed=add(7, -10.001))
    assert said(msgspec.structs.replace(plan, profile=back)) == "profile: speed below 0"
    standing = moved(np.zeros(5))
    assert said(plan_of(standing, moved(np.zeros(3), t0=0.3))) == ""


LIMITS = [
    # speeds, curvature, what is said beyond the limit
    (lambda s: moved(np.full(31, 1.0), k=0.264 * s), "curvature {:.3f} 1/m, at most 0.264", 0.264),
    (lambda s: moved(2.0 + 0.3 * s * np.arange(20)), "acceleration {:.2f} m/s², at most 3", 3.0),
    (lambda s: moved(np.maximum(20.0 - 0.85 * s * np.arange(20), 0.0)), "braking {:.2f} m/s², at most 8.5", 8.5),
    (lambda s: moved(np.full(31, 10.0), k=0.05 * s), "lateral acceleration {:.2f} m/s², at most 5", 5.0),
    (lambda s: moved(np.full(31, 10.0), k=-0.05 * s), "lateral acceleration {:.2f} m/s², at most 5", 5.0),
    (lambda s: moved(np.full(5, 1.0), k=0.06 * s * np.arange(5)),
     "curvature rate {:.3f} 1/(m s), at most 0.6", 0.6),
    (lambda s: moved(np.full(5, 1.0), k=-0.06 * s * np.arange(5)),
     "curvature rate {:.3f} 1/(m s), at most 0.6", 0.6),
]  # fmt: skip


@pytest.mark.parametrize(("make", "text", "limit"), LIMITS)
def test_every_limit_is_held_to_a_thousandth(make: Callable[[float], Trajectory], text: str, limit: float) -> None:
    assert said(plan_of(make(0.999), msgspec.structs.replace(braked(0.5), t=braked(0.5).t))) not in (None, "profile: ")
    within, beyond = make(0.9995), make(1.01)
    assert not said(plan_of(within)).startswith("profile: ")
    assert said(plan_of(beyond)) == "profile: " + text.format(1.01 * limit)


def test_position_and_speed_agree_within_a_few_centimetres() -> None:
    plan = plan_of(STEADY)  # 1 m a step: 0.05 + 0.03 m

    def problem(**changes: Callable[[np.ndarray], np.ndarray]) -> str:
        return said(msgspec.structs.replace(plan, profile=edited(STEADY, **changes)))

    assert problem(x=add(5, 0.0799)) == "" == problem(x=add(5, -0.0799))
    assert problem(x=add(5, 0.081)) == "profile: position and speed disagree by 0.081 m"
    assert problem(y=add(5, 0.0699)) == "" == problem(y=add(5, -0.0699))
    assert problem(y=add(5, 0.071)) == "profile: the vehicle would slide by 0.071 m"


def turned(by: float) -> Trajectory:
    """The heading of one sample is off, the rear axle stays where it was."""
    return edited(
        STEADY, heading=add(5, by), x=add(5, HALF * (np.cos(by) - 1.0)), y=add(5, HALF * np.sin(by))
    )  # fmt: skip


def test_heading_and_curvature_agree_within_a_degree_or_two() -> None:
    plan = plan_of(STEADY)
    for sign in (1.0, -1.0):
        assert said(msgspec.structs.replace(plan, profile=turned(0.0349 * sign))) == ""
        words = "profile: heading and curvature disagree by 0.036 rad"
        assert said(msgspec.structs.replace(plan, profile=turned(0.036 * sign))) == words
    bend = moved(np.full(31, 5.0), k=0.1)
    straight = edited(bend, curvature=lambda k: 0.0 * k)
    assert said(plan_of(straight)).startswith("profile: heading and curvature disagree by 0.050 rad")


def test_speed_and_acceleration_agree() -> None:
    plan = plan_of(STEADY)
    for sign in (1.0, -1.0):
        assert said(msgspec.structs.replace(plan, profile=edited(STEADY, speed=add(5, 0.0299 * sign)))) == ""
        words = "profile: speed and acceleration disagree by 0.031 m/s"
        assert said(msgspec.structs.replace(plan, profile=edited(STEADY, speed=add(5, 0.031 * sign)))) == words
    # between two samples the acceleration is one of theirs: a jump is allowed at either end
    v = np.concatenate((np.full(10, 10.0), 10.0 - 0.2 * np.arange(1, 21)))
    for first in (9, 10):
        a = np.where(np.arange(30) >= first, -2.0, 0.0)
        assert said(plan_of(moved(v, a=a))) == ""


def test_within_the_step_to_rest_the_brake_may_be_let_go_but_not_be_harder_than_the_hardest() -> None:
    def stopping(last: float) -> Plan:
        v = np.array([last, 0.0, 0.0])
        profile = moved(np.full(31, last))
        return plan_of(profile, moved(v, a=np.array([0.0, 0.0, 0.0]), t0=0.3, at=end_of(profile, 0.3)))

    assert said(stopping(0.879)) == ""  # 8.5 m/s² for 0.1 s, and 0.03 m/s
    assert said(stopping(0.882)) == "tail: speed and acceleration disagree by 0.032 m/s"


def test_a_tail_that_does_not_end_at_rest_is_refused_in_words() -> None:
    plan = plan_of(STEADY)
    assert plan.tail is not None
    cut = Trajectory(**{f: getattr(plan.tail, f)[:-5] for f in plan.tail.__struct_fields__})
    assert said(msgspec.structs.replace(plan, tail=cut)) == f"the tail ends at {cut.speed[-1]:.2f} m/s, not at rest"


JOINT = [("x", 0.05), ("y", 0.05), ("heading", 0.02), ("speed", 0.05), ("curvature", 0.02)]


def test_the_tail_starts_when_the_profile_has_ended() -> None:
    plan = plan_of(STEADY)
    assert plan.tail is not None
    late = edited(plan.tail, t=lambda t: t + 2e-6)
    assert (
        said(msgspec.structs.replace(plan, tail=late)) == "the tail starts at 0.300 s, the profile is valid for 0.300 s"
    )
    assert said(msgspec.structs.replace(plan, tail=edited(plan.tail, t=lambda t: t - 0.9e-6))) == ""
    early = edited(plan.tail, t=lambda t: t - 0.1)
    assert (
        said(msgspec.structs.replace(plan, tail=early))
        == "the tail starts at 0.200 s, the profile is valid for 0.300 s"
    )


@pytest.mark.parametrize(("name", "limit"), JOINT)
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_the_tail_starts_where_the_profile_is(name: str, limit: float, sign: float) -> None:
    profile, tail = moved(np.full(31, 5.0)), braked(5.0, at=(1.5, 0.0, 0.0))
    for share, problem in ((0.99, ""), (1.01, f"the tail does not start where the profile is at 0.3 s ({name})")):
        off = edited(tail, **{name: lambda q, share=share: q + sign * share * limit})
        assert validator._joint_problem(profile, off, 0.3) == problem


# --- risk ---


def volume_of(*boxes: object, ahead: float = 70.0, speed: float = 10.0, now: float = 0.0) -> Volume:
    return Volume.of(risk_of(ego_of(speed), list(boxes), now, ahead=ahead), 0, 0)  # type: ignore[arg-type]


def painted(value: Callable[[np.ndarray, np.ndarray, float], np.ndarray], ahead: float = 70.0) -> Volume:
    """A volume whose cells are worked out from x, y [m] and the slice's start [s]."""
    empty = risk_of(ego_of(), [], ahead=ahead)
    g = empty.grid
    x = g.x + (np.arange(g.rows) + 0.5)[:, None] * g.h
    y = g.y + (np.arange(g.columns) + 0.5)[None, :] * g.h
    cells = np.stack([np.broadcast_to(value(x, y, t), (g.rows, g.columns)) for t in empty.slice_times])
    risk = Risk(
        grid=g, slice_times=empty.slice_times, slots=[], volume=cells.astype(np.float32), dominant=empty.dominant
    )
    return Volume.of(risk, 0, 0)


def everywhere(level: float) -> Volume:
    return painted(lambda x, y, t: level + 0.0 * x * y)


def test_contact_is_r_hit_or_what_there_was_at_the_start_with_a_little_more() -> None:
    assert contact_bound(0.0, SETTINGS) == pytest.approx(0.85)
    assert contact_bound(0.75, SETTINGS) == pytest.approx(0.85)
    assert contact_bound(0.9, SETTINGS) == pytest.approx(1.0)
    assert contact_bound(0.0, msgspec.structs.replace(SETTINGS, r_hit=0.5)) == pytest.approx(0.55)


def test_the_risk_of_a_trajectory_is_that_of_its_rear_axle_at_its_times() -> None:
    volume, ego = volume_of(box(18.0, 3.0, vx=-1.0)), ego_of()
    footprint = Footprint.of(ego, SETTINGS.footprint_spacing, SETTINGS.flank_margin)
    part = moved(np.full(31, 6.0), k=0.03)
    x, y = part.x - HALF * np.cos(part.heading), part.y - HALF * np.sin(part.heading)
    risk, known = trajectory_risk(part, volume, footprint, ego)
    wanted, whole = timed_risk(volume, footprint, x, y, part.heading, part.t)
    assert np.array_equal(risk, wanted) and np.array_equal(known, whole)
    assert risk.max() > 0.5 and np.unique(np.round(risk, 4)).size > 10


@pytest.mark.parametrize(("level", "passes"), [(0.0, True), (0.84, True), (0.9, True), (1.5, True)])
def test_what_is_no_worse_than_at_the_start_may_be_driven(level: float, passes: bool) -> None:
    assert (said(plan_of(STEADY), volume=everywhere(level)) == "") is passes


def wall(x0: float, level: float) -> Volume:
    return painted(lambda x, y, t: np.where(x > x0, level, 0.0) + 0.0 * y)


def test_a_wall_ahead_is_contact_from_the_bound_on_and_told_with_time_and_risk() -> None:
    plan = plan_of(STEADY)
    assert said(plan, volume=wall(25.0, 0.84)) == ""
    problem = said(plan, volume=wall(25.0, 0.95))
    assert problem.startswith("profile: meets risk 0.95 at 2.") and problem.endswith(" s, contact is 0.80")
    assert said(plan, volume=wall(25.0, 0.95), r_hit=0.95) == ""
    short = plan_of(moved(np.full(6, 10.0)))
    assert said(short, volume=wall(25.0, 0.95)).startswith("tail: meets risk 0.95 at ")
    assert said(short, volume=wall(45.0, 0.95)) == ""


def test_what_stands_is_no_motion_into_contact() -> None:
    standing = plan_of(moved(np.zeros(11)), moved(np.zeros(11), t0=0.3))
    later = painted(lambda x, y, t: np.where(t > 0.4, 2.0, 0.0) + 0.0 * x * y)
    assert said(standing, ego_of(0.0), later) == ""
    creeping = plan_of(moved(np.full(31, 0.2)), braked(0.2, at=(0.06, 0.0, 0.0)))
    # it is in force from 0.5 s on, but only where a brake would have kept us out of it
    ahead = painted(lambda x, y, t: np.where((t > 0.4) & (x > 4.0), 2.0, 0.0) + 0.0 * y)
    assert said(creeping, ego_of(0.2), ahead).startswith("profile: meets risk")


def test_the_tail_may_not_run_beyond_the_grid_before_it_stands() -> None:
    plan = plan_of(moved(np.full(4, 10.0)))
    assert said(plan, volume=volume_of(ahead=40.0)) == ""
    for ahead in (20.0, 6.0, 4.0, 3.0):  # at 4 m the tail begins beyond it, at 3 m the ego's nose is just within
        assert said(plan, volume=volume_of(ahead=ahead)) == "tail: it runs beyond the grid before it stands"
    # the profile alone may: it is driven for 0.3 s
    long = plan_of(STEADY, plan.tail)
    assert said(long, volume=volume_of(ahead=35.0)) == ""


def test_who_brakes_as_hard_as_possible_may_meet_what_cannot_be_helped() -> None:
    v = np.concatenate((np.full(2, 10.0), np.maximum(10.0 - 0.8 * np.arange(1, 30), 0.0)))
    profile = moved(v, a=np.where((v > 0.0) & (np.arange(31) >= 2), -8.0, 0.0))
    tail = Trajectory(**{f: getattr(profile, f)[3:] for f in profile.__struct_fields__})
    plan = plan_of(profile, tail)
    assert _brakes_hard(profile, SETTINGS)
    assert said(plan, volume=wall(9.0, 2.0)) == ""
    assert said(plan, volume=volume_of(ahead=6.0)) == ""
    soft = plan_of(moved(np.maximum(10.0 - 0.3 * np.arange(40), 0.0), a=np.where(np.arange(40) < 33, -3.0, 0.0)))
    assert said(soft, volume=wall(9.0, 2.0)).startswith("profile: meets risk 1.84 at 0.6 s")


def slowing(v0: float, brake: float, delay: float = 0.0) -> Trajectory:
    t = DT * np.arange(80)
    v = np.clip(v0 - brake * np.maximum(t - delay, 0.0), 0.0, v0)
    return moved(v, a=np.where((v > 0.0) & (t > delay), -brake, 0.0))


@pytest.mark.parametrize(
    ("v0", "brake", "delay", "hard_enough"),
    [
        (10.0, 8.0, 0.0, True), (10.0, 6.4, 0.0, True), (10.0, 6.3, 0.0, False), (10.0, 8.0, 0.4, True),
        (10.0, 8.0, 0.5, False), (20.0, 8.0, 0.3, True), (1.0, 8.0, 0.3, True), (0.9, 0.5, 0.0, False),
        (0.9, 1.3, 0.0, True), (0.04, 0.01, 0.0, True), (0.0, 1.0, 0.0, True),
    ],
)  # fmt: skip
def test_braking_hard_is_the_emergency_brake_after_the_time_it_takes_to_build_up(
    v0: float, brake: float, delay: float, hard_enough: bool
) -> None:
    assert _brakes_hard(slowing(v0, brake, delay), SETTINGS) is hard_enough


def comes(v: float, volume: Volume, n: int = 31) -> np.ndarray:
    footprint = Footprint.of(ego_of(v), SETTINGS.footprint_spacing, SETTINGS.flank_margin)
    return _comes_over(moved(np.full(n, v)), ego_of(v), volume, footprint, SETTINGS)


def test_nobody_comes_over_us_where_nobody_is_or_where_he_was_at_first() -> None:
    assert not comes(10.0, everywhere(0.0)).any()
    assert not comes(10.0, everywhere(0.9)).any()


def test_who_comes_over_where_we_are_and_where_the_hardest_brake_brings_us_is_excused_from_then_on() -> None:
    # from 1 s on everything is risk: no brake prevents that
    found = comes(10.0, painted(lambda x, y, t: np.where(t >= 1.0, 2.0, 0.0) + 0.0 * x * y))
    assert not found[:10].any() and found[10:].all()
    # only where the ego is now: had it driven on, nothing would have come over it
    assert not comes(10.0, painted(lambda x, y, t: np.where((t >= 1.0) & (x < 3.5), 2.0, 0.0) + 0.0 * y)).any()
    # only where the hardest brake would bring it (some 7 m on): had it stayed …
    assert not comes(10.0, painted(lambda x, y, t: np.where((t >= 1.0) & (x > 7.0), 2.0, 0.0) + 0.0 * y)).any()
    # once it came it has come, though it goes again
    gone = comes(10.0, painted(lambda x, y, t: np.where((t >= 1.0) & (t < 1.5), 2.0, 0.0) + 0.0 * x * y))
    assert not gone[:10].any() and gone[10:].all()


def test_contact_that_no_brake_prevents_is_no_reason_to_refuse_a_plan() -> None:
    plan = plan_of(moved(np.full(31, 3.0)))
    rolled_over = painted(lambda x, y, t: np.where((t >= 0.5) & (x < 12.0), 2.0, 0.0) + 0.0 * y)
    assert said(plan, ego_of(3.0), rolled_over) == ""
    avoidable = painted(lambda x, y, t: np.where((t >= 0.5) & (x > 6.5), 2.0, 0.0) + 0.0 * y)
    assert said(plan, ego_of(3.0), avoidable).startswith("profile: meets risk 2.00 at ")
