"""The last look at a plan: what breaks one of these rules is never published.

Every check reads `not (x <= limit)`, so that NaN fails. The risk rule: while the vehicle moves, the footprint's risk
stays below contact, or, if it is higher at the start (somebody drove into us), it must not get worse; a motion that
does nothing but brake hard is always allowed, for there is nothing better.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from common.geometry import wrap_angle
from common.messages import Ego, Plan, Trajectory
from services.planner.contact import STEP, meets
from services.planner.footprint import Footprint, timed_risk
from services.planner.settings import PlannerSettings
from services.planner.trajectory import brake_motion
from services.planner.volume import Volume

F64 = npt.NDArray[np.float64]


def validate(plan: Plan, ego: Ego, volume: Volume | None, settings: PlannerSettings) -> str:
    """Why a plan may not be published, in a sentence; empty: it may."""
    profile, tail = plan.profile, plan.tail
    if profile is None or tail is None:
        return "" if plan.mode != "drive" else "a plan to drive without profile or tail"
    for name, part in (("profile", profile), ("tail", tail)):
        problem = _motion_problem(part, ego, settings)
        if problem:
            return f"{name}: {problem}"
    if not (abs(tail.speed[-1]) <= 0.0):
        return f"the tail ends at {tail.speed[-1]:.2f} m/s, not at rest"
    problem = _joint_problem(profile, tail, plan.valid_for)
    if problem or volume is None:
        return problem
    apart = max(float(np.hypot(np.diff(part.x), np.diff(part.y)).max()) for part in (profile, tail))
    footprint = Footprint.of(ego, settings.footprint_spacing, settings.flank_margin, stride=max(apart, STEP))
    met = trajectory_risk(profile, volume, footprint, ego)
    start_risk, start_known = float(met[0][0]), bool(met[1][0])
    for name, part in (("profile", profile), ("tail", tail)):
        found = met if part is profile else trajectory_risk(part, volume, footprint, ego)
        stops_within = part is tail and start_known  # who is already off the grid can only come back
        problem = _risk_problem(part, found, ego, volume, footprint, start_risk, settings, stops_within)
        if problem:
            return f"{name}: {problem}"
    return ""


def trajectory_risk(
    part: Trajectory, volume: Volume, footprint: Footprint, ego: Ego
) -> tuple[F64, npt.NDArray[np.bool_]]:
    """How near to contact each sample of a trajectory is [m], slice by its time, and whether all of it is known."""
    half = 0.5 * ego.wheelbase
    x, y = part.x - half * np.cos(part.heading), part.y - half * np.sin(part.heading)
    return timed_risk(volume, footprint, x, y, part.heading, part.t)


def _motion_problem(part: Trajectory, ego: Ego, settings: PlannerSettings) -> str:
    if len(part.t) < 2:
        return "fewer than two samples"
    for name in ("t", "x", "y", "heading", "curvature", "speed", "acceleration"):
        if not np.all(np.isfinite(getattr(part, name))):
            return f"{name} is not finite"
    dt = np.diff(part.t)
    if not np.all(dt > 0.0):
        return "times do not increase"
    if not np.all(part.speed >= 0.0):
        return "speed below 0"
    for value, limit, what in (
        (np.abs(part.curvature), 1.1 * settings.max_curvature, "curvature {:.3f} 1/m"),
        (part.acceleration, settings.max_accel, "acceleration {:.2f} m/s²"),
        (-part.acceleration, settings.max_brake, "braking {:.2f} m/s²"),
        (part.speed**2 * np.abs(part.curvature), settings.max_lateral_accel, "lateral acceleration {:.2f} m/s²"),
        (np.abs(np.diff(part.curvature)) / dt, 2.0 * settings.max_curvature_rate, "curvature rate {:.3f} 1/(m s)"),
    ):
        if not np.all(value <= limit):
            return what.format(float(np.max(value))) + f", at most {limit:.3g}"
    # what is said about speed, heading and curvature must be the motion of the points
    half = 0.5 * ego.wheelbase
    x, y = part.x - half * np.cos(part.heading), part.y - half * np.sin(part.heading)
    mean = 0.5 * (part.speed[1:] + part.speed[:-1])
    way = mean * dt
    middle = part.heading[:-1] + 0.5 * wrap_angle(np.diff(part.heading))
    along = np.cos(middle) * np.diff(x) + np.sin(middle) * np.diff(y)
    across = -np.sin(middle) * np.diff(x) + np.cos(middle) * np.diff(y)
    turn = 0.5 * (part.curvature[1:] + part.curvature[:-1]) * way
    low = np.minimum(part.acceleration[1:], part.acceleration[:-1]) * dt  # between two samples it is one of these
    high = np.maximum(part.acceleration[1:], part.acceleration[:-1]) * dt
    change = np.diff(part.speed)
    # within the step that ends at rest the brake is let go: any that the limits allow will do
    low = np.where(part.speed[1:] <= 0.0, -settings.max_brake * dt, low)
    for value, bound, what in (
        (np.abs(along - way), 0.05 + 0.03 * way, "position and speed disagree by {:.3f} m"),
        (np.abs(across), 0.05 + 0.02 * way, "the vehicle would slide by {:.3f} m"),
        (
            np.abs(wrap_angle(np.diff(part.heading)) - turn),
            0.015 + 0.02 * way,
            "heading and curvature disagree by {:.3f} rad",
        ),
        (np.maximum(low - change, change - high), 0.03 + 0.0 * way, "speed and acceleration disagree by {:.3f} m/s"),
    ):
        if not np.all(value <= bound):
            return what.format(float(np.max(value)))
    return ""


def _joint_problem(profile: Trajectory, tail: Trajectory, valid_for: float) -> str:
    if not (abs(tail.t[0] - valid_for) <= 1e-6):
        return f"the tail starts at {tail.t[0]:.3f} s, the profile is valid for {valid_for:.3f} s"
    for name, limit in (("x", 0.05), ("y", 0.05), ("heading", 0.02), ("speed", 0.05), ("curvature", 0.02)):
        at = float(np.interp(valid_for, profile.t, getattr(profile, name)))
        if not (abs(at - getattr(tail, name)[0]) <= limit):
            return f"the tail does not start where the profile is at {valid_for:.1f} s ({name})"
    return ""


def contact_bound(start_risk: float, settings: PlannerSettings) -> float:
    """Risk that a moving footprint must stay below: contact, or no worse than where it already is.

    The search reads the volume between stations, this check at the samples: 0.05 E_max (5 cm) stands between them.
    """
    return max(settings.r_hit, start_risk + 0.05) + 0.05


def _risk_problem(
    part: Trajectory,
    met: tuple[F64, npt.NDArray[np.bool_]],
    ego: Ego,
    volume: Volume,
    footprint: Footprint,
    start_risk: float,
    settings: PlannerSettings,
    stops_within: bool,
) -> str:
    """What is wrong with a part that has `met` this (see `trajectory_risk`); `stops_within` the grid it must."""
    risk, known = met
    moving = part.speed > 0.05
    bound = contact_bound(start_risk, settings)
    braking = bool(np.all(np.diff(part.speed) <= 1e-9)) and _brakes_hard(part, settings)
    bad = moving & ~(risk <= bound)
    if bad.any():
        half = 0.5 * ego.wheelbase
        x, y = part.x - half * np.cos(part.heading), part.y - half * np.sin(part.heading)
        bad &= meets(volume, footprint, x, y, part.heading, part.t, bound)
        bad &= ~_comes_over(part, ego, volume, footprint, settings)
    if bad.any() and not braking:
        i = int(np.argmax(bad))
        return f"meets risk {risk[i]:.2f} at {part.t[i]:.1f} s, contact is {settings.r_hit:.2f}"
    if stops_within and (moving & ~known).any() and not braking:
        return "it runs beyond the grid before it stands"
    return ""


def _comes_over(
    part: Trajectory, ego: Ego, volume: Volume, footprint: Footprint, settings: PlannerSettings
) -> npt.NDArray[np.bool_]:
    """From when on somebody is where the ego is now and where the hardest brake would have brought it along this way.

    Not if he was there at first. No plan prevents that.
    """
    half, t = 0.5 * ego.wheelbase, part.t
    x, y = ego.x - half * np.cos(ego.heading), ego.y - half * np.sin(ego.heading)
    # the way of the rear axle from where it is now on
    way_x = np.append(x, part.x - half * np.cos(part.heading))
    way_y = np.append(y, part.y - half * np.sin(part.heading))
    turns = np.unwrap(np.append(ego.heading, part.heading))
    way = np.concatenate(([0.0], np.cumsum(np.hypot(np.diff(way_x), np.diff(way_y)))))
    hardest = brake_motion(0.0, 0.0, ego.speed, 0.0, settings.tier_brake[-1], settings.tier_jerk[-1])
    braked = np.interp(t, hardest.t, hardest.distance)
    here = timed_risk(volume, footprint, np.full(len(t), x), np.full(len(t), y), np.full(len(t), ego.heading), t)[0]
    now = timed_risk(volume, footprint, np.array([x]), np.array([y]), np.array([ego.heading]), np.zeros(1))[0]
    bx, by, bend = (np.interp(braked, way, q) for q in (way_x, way_y, turns))
    there = timed_risk(volume, footprint, bx, by, bend, t)[0]
    if now[0] >= settings.r_hit:
        return np.zeros(len(t), dtype=bool)
    return np.asarray(np.minimum(np.maximum.accumulate(here), np.maximum.accumulate(there)) >= settings.r_hit)


def _brakes_hard(part: Trajectory, settings: PlannerSettings) -> bool:
    """Whether it brakes with the emergency tier, the time to build up and let go aside, and is at rest accordingly."""
    brake, jerk = settings.tier_brake[-1], settings.tier_jerk[-1]
    last = float(part.t[part.speed > 0.05].max(initial=part.t[0]) - part.t[0])
    if not (last <= float(part.speed[0]) / (0.5 * brake) + brake / jerk + 0.5):
        return False
    fast = part.speed > 1.0
    late = part.t - part.t[0] > settings.tier_brake[-1] / settings.tier_jerk[-1] + 0.15
    return bool(np.all(part.acceleration[fast & late] <= -0.8 * settings.tier_brake[-1]))
