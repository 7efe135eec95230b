"""What the validator refuses."""

from __future__ import annotations

from collections.abc import Callable

import msgspec
import numpy as np
import pytest

from common.messages import Map, Plan, Trajectory
from services.planner.core import Planner
from services.planner.settings import PlannerSettings
from services.planner.validator import _brakes_hard, validate
from services.planner.volume import Volume
from tests.planner.worlds import box, ego_at, risk_of, stamped, straight_route

SETTINGS = PlannerSettings(offsets=(0.0, 0.8, -0.8), lengths=((9.0, 2.2), (24.0, 5.0)))
EGO = ego_at(0, 0, 0, 8)


@pytest.fixture(scope="module")
def good() -> Plan:
    risk = stamped(risk_of(EGO, [], ahead=70.0), 1.0)
    return Planner(SETTINGS).step(
        stamped(EGO, 1.0), risk, stamped(Map(), 0), stamped(straight_route(), 0), 1_000_000_000
    )


def volume(*boxes: object) -> Volume:
    return Volume.of(risk_of(EGO, list(boxes), ahead=70.0), 0, 0)  # type: ignore[arg-type]


def test_a_good_plan_passes(good: Plan):
    assert good.mode == "drive"
    assert validate(good, EGO, volume(), SETTINGS) == ""


def at(field: str, index: int, change: Callable[[float], float]) -> Callable[[Trajectory], Trajectory]:
    def edit(part: Trajectory) -> Trajectory:
        values = getattr(part, field).copy()
        values[index] = change(values[index])
        return msgspec.structs.replace(part, **{field: values})

    return edit


EDITS = {
    "not finite": at("x", 5, lambda _: np.nan),
    "speed is not finite": at("speed", 5, lambda _: np.nan),
    "times do not increase": at("t", 5, lambda t: t - 0.2),
    "curvature": at("curvature", 5, lambda _: 0.4),
    "curvature rate": at("curvature", 5, lambda k: k + 0.15),
    "acceleration": at("acceleration", 5, lambda _: 6.0),
    "braking": at("acceleration", 5, lambda _: -12.0),
    "position and speed disagree": at("x", 5, lambda x: x + 0.5),
    "slide": at("y", 5, lambda y: y + 0.3),
    "heading and curvature disagree": at("heading", 5, lambda h: h + 0.05),
    "speed and acceleration disagree": at("speed", 5, lambda v: v + 0.3),
    "speed below 0": at("speed", 5, lambda _: -0.1),
}


@pytest.mark.parametrize("name", EDITS)
def test_a_broken_profile_is_refused_by_name(good: Plan, name: str):
    assert good.profile is not None
    plan = msgspec.structs.replace(good, profile=EDITS[name](good.profile))
    problem = validate(plan, EGO, volume(), SETTINGS)
    assert problem.startswith("profile: ")
    assert name in problem or name in ("slide", "curvature rate", "heading and curvature disagree")


def test_a_tail_that_does_not_end_at_rest_is_refused(good: Plan):
    assert good.tail is not None
    t = good.tail
    cut = Trajectory(**{f: getattr(t, f)[:-3] for f in t.__struct_fields__})
    assert "not at rest" in validate(msgspec.structs.replace(good, tail=cut), EGO, volume(), SETTINGS)


def test_a_tail_that_starts_elsewhere_is_refused(good: Plan):
    assert good.tail is not None
    moved = msgspec.structs.replace(good.tail, y=good.tail.y + 0.3)
    assert "does not start" in validate(msgspec.structs.replace(good, tail=moved), EGO, volume(), SETTINGS)
    late = msgspec.structs.replace(good, valid_for=0.5)
    assert "tail starts at" in validate(late, EGO, volume(), SETTINGS)


def test_contact_with_the_risk_volume_is_refused(good: Plan):
    assert "profile: meets risk" in validate(good, EGO, volume(box(20, 0)), SETTINGS)
    assert validate(good, EGO, volume(box(20, 4.0)), SETTINGS) == ""


def test_contact_on_the_tail_alone_is_refused(good: Plan):
    assert good.profile is not None
    short = msgspec.structs.replace(
        good, profile=Trajectory(**{f: getattr(good.profile, f)[:5] for f in good.profile.__struct_fields__})
    )
    assert good.tail is not None
    ahead = good.tail.x[-1] + 2.0
    assert "tail: meets risk" in validate(short, EGO, volume(box(float(ahead), 0)), SETTINGS)


def test_a_drive_plan_without_a_tail_is_refused(good: Plan):
    assert validate(msgspec.structs.replace(good, tail=None), EGO, volume(), SETTINGS)


def test_what_the_validator_refuses_is_never_published(monkeypatch: pytest.MonkeyPatch):
    import services.planner.core as core

    monkeypatch.setattr(core, "validate", lambda *_: "it is crooked")
    risk = stamped(risk_of(EGO, [], ahead=70.0), 1.0)
    plan = Planner(SETTINGS).step(
        stamped(EGO, 1.0), risk, stamped(Map(), 0), stamped(straight_route(), 0), 1_000_000_000
    )
    assert plan.mode == "safe_stop"
    assert "it is crooked" in plan.reason
    assert plan.tail is not None
    assert plan.tail.speed[-1] == 0.0


def test_creeping_into_contact_is_not_braking_hard() -> None:
    t = 0.1 * np.arange(31)
    zero = np.zeros(31)
    creep = Trajectory(t=t, x=0.9 * t, y=zero, heading=zero, curvature=zero, speed=zero + 0.9, acceleration=zero)
    assert not _brakes_hard(creep, PlannerSettings())
