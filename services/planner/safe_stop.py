"""What to do without usable inputs: wait, or brake to rest along the current path; always with the reason.

`waiting`: never had what driving needs, and the ego stands or is not known. `safe_stop`: had it and lost it, or the ego
moves. No map at all counts as missing: what has no map says so with an empty one.
"""

from __future__ import annotations

import numpy as np

from common.messages import Ego, Map, Plan, Risk, Route, Stamped
from services.planner.bezier import Start
from services.planner.contact import STEP
from services.planner.footprint import Footprint
from services.planner.settings import PlannerSettings
from services.planner.stopping import first_contact
from services.planner.trajectory import Memory, Motion, Path, brake_motion, trajectory_of
from services.planner.volume import Volume


def missing_input(
    ego: Stamped[Ego] | None,
    risk: Stamped[Risk] | None,
    road: Stamped[Map] | None,
    route: Stamped[Route] | None,
    now_ns: int,
    settings: PlannerSettings,
) -> str:
    """What is missing or too old, in a sentence; empty: nothing."""
    nothing = [
        text
        for value, text in (
            (ego, "no ego state yet (topic `ego`)"),
            (road, "no map yet (topic `map`; to drive without one, publish an empty map)"),
            (route, "no route yet (topic `route`)"),
            (risk, "no risk yet (topic `risk`)"),
        )
        if value is None
    ]
    if nothing:
        return "; ".join(nothing)
    assert ego is not None
    assert risk is not None
    if not (ego.age_s(now_ns) <= settings.max_ego_age):
        return f"the ego state is {ego.age_s(now_ns) * 1e3:.0f} ms old, at most {settings.max_ego_age * 1e3:.0f} ms"
    if not (risk.age_s(now_ns) <= settings.max_risk_age):
        return f"the risk is {risk.age_s(now_ns) * 1e3:.0f} ms old, at most {settings.max_risk_age * 1e3:.0f} ms"
    return ""


def waiting(reason: str, planner: str) -> Plan:
    """Hold still, nothing else."""
    return Plan(mode="waiting", reason=reason[:1000], planner=planner)


def safe_stop(
    reason: str,
    start: Start,
    path: Path | None,
    distance: float,
    ego: Ego,
    volume: Volume | None,
    settings: PlannerSettings,
) -> tuple[Plan, Memory | None]:
    """Brake from `start` along `path`, on which it stands at `distance`; without a path along its own circle.

    Args:
        reason: Why, in a sentence.
        start: State of the rear axle.
        path: The path driven so far, if it is known.
        distance: Where on the path the start is [m].
        ego: For size and wheelbase.
        volume: The risk, if it is still good for anything: the stop is harder where a firm one would meet something.
        settings: The brakes.
    """
    if path is None:
        path, distance = Path.arc(start, start.speed**2 / settings.safe_stop_brake + 2.0 * start.speed + 5.0), 0.0
    a = start.acceleration if start.speed > 0.0 else 0.0

    def braking(brake: float) -> Motion:
        return brake_motion(0.0, distance, start.speed, a, brake, 4.0 * brake)

    motion = braking(settings.safe_stop_brake)
    if volume is not None:
        apart = max(float(np.diff(motion.distance).max()), STEP)
        footprint = Footprint.of(ego, settings.footprint_spacing, settings.flank_margin, stride=apart)
        if first_contact(path, motion, volume, footprint, settings.r_hit) is not None:
            motion = braking(settings.tier_brake[-1])
    valid_for = settings.valid_for
    if motion.t[-1] <= valid_for + 1e-3:
        profile = motion.until(valid_for)
        tail = brake_motion(valid_for, float(motion.distance[-1]), 0.0, 0.0, settings.safe_stop_brake, 1.0)
    else:
        profile = motion.until(valid_for)
        later = motion.t > valid_for + 1e-3
        tail = Motion(
            np.append(profile.t[-1], motion.t[later]),
            np.append(profile.distance[-1], motion.distance[later]),
            np.append(profile.speed[-1], motion.speed[later]),
            np.append(profile.acceleration[-1], motion.acceleration[later]),
        )
    plan = Plan(
        mode="safe_stop",
        reason=reason[:1000],
        planner=settings.name,
        valid_for=valid_for,
        profile=trajectory_of(path, profile, ego.wheelbase),
        tail=trajectory_of(path, tail, ego.wheelbase),
    )
    return plan, Memory(0, path, profile, tail, valid_for, "", 0.0, 0.0, -1.0)
