"""One drive measured: what the world says of it, as plain values."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from common.messages import FRAME_S
from evaluation.planning import criteria
from evaluation.planning.loop import DriveResult
from evaluation.planning.recorder import Recorder
from evaluation.planning.road_area import RoadArea
from evaluation.planning.unavoidable import unavoidable
from evaluation.planning.world_checks import brake_had_cause, emergencies, emergency_times, min_ttc
from evaluation.planning.yardstick import Yardstick
from rig.comfort import motion
from rig.world import Scenario

OFF_ROAD_M = 0.15
"""The outline may reach so far beyond the drivable area: maps are drawn with wider pens."""
CONFIDENCE = 0.95
FELT = 0.1
"""Accelerations below this are not felt as a change of sign [m/s²]."""


def measured(scenario: Scenario, result: DriveResult, record: Recorder, yard: Yardstick, family: str) -> dict[str, Any]:
    """Everything about one drive.

    Args:
        scenario: The world.
        result: What the loop measured.
        record: Every state of it.
        yard: The other driver.
        family: Name of the manoeuvre whose criterion applies; empty: none.
    """
    ego = result.summary["ego"]
    collisions = [_judged(c, record, scenario) for c in ego["collisions"]]
    crash = min((c["t"] for c in collisions), default=math.inf)
    lost = bool(collisions) and unavoidable(record, crash)
    found = emergencies(record, crash)
    felt = motion(record.t, [e.speed for e in record.ego], [e.yaw_rate for e in record.ego])
    urgent = emergency_times(record, found, felt.t_acceleration) | (felt.t_acceleration >= crash)
    urgent_jerk = emergency_times(record, found, felt.t_jerk) | (felt.t_jerk >= crash)
    moving = np.array([record.ego[row].speed > 0.3 and record.t[row] < crash for row in record.at_frame])
    end = min(result.duration_s, yard.end_s) if yard.end_s > 0 else result.duration_s
    area = RoadArea.of(scenario.map)
    overhang = area.overhang(record.ego) if area is not None else None
    allowed = OFF_ROAD_M + (max(0.0, float(overhang[0])) if overhang is not None else 0.0)
    work = result.work_ms.get("planner", [])
    first = np.array([p["t"] >= 0.0 for p in result.plans])
    cycle = [round(ms, 2) for ms, driving in zip(work, first, strict=False) if driving and not math.isnan(ms)]
    entry: dict[str, Any] = {
        "family": family,
        "collision": bool(collisions),
        "collision_at_fault": any(c["at_fault"] for c in collisions),
        "collisions": collisions,
        "collision_unavoidable": lost,
        "min_clearance_m": ego["min_clearance_m"],
        "min_ttc_s": min_ttc(record),
        "goal": bool(ego["reached_goal"]),
        "goal_t": ego["goal_t"],
        "duration_s": round(result.duration_s, 3),
        "off_road": None if overhang is None else bool((overhang > allowed).any()),
        "off_road_m": None if overhang is None else round(float(overhang.max()), 2),
        "distance_m": ego["distance_m"],
        "mean_speed_mps": ego["mean_speed_mps"],
        "yardstick": yard.who if yard.fair else f"{yard.who}, which collided",
        "compared_m": round(record.distance(end), 2),
        "yardstick_m": round(yard.distance(end), 2),
        "comfortable_m": None if yard.comfortable is None else round(yard.comfortable(end), 2),
        "max_accel_lon": _peak(felt.acceleration[~urgent]),
        "max_accel_lat": _peak(felt.lateral[~urgent]),
        "p95_accel_lon": _p95(felt.acceleration[~urgent]),
        "p95_accel_lat": _p95(felt.lateral[~urgent]),
        "p95_jerk": _p95(felt.jerk[~urgent_jerk]),
        "max_jerk": _peak(felt.jerk[~urgent_jerk]),
        "with_emergencies": {
            "max_accel_lon": _peak(felt.acceleration),
            "max_accel_lat": _peak(felt.lateral),
            "p95_jerk": _p95(felt.jerk),
        },
        "sign_changes_per_min": _sign_changes(felt.acceleration, float(felt.t[-1]) if len(felt.t) else 0.0),
        "interventions": len(result.summary["interventions"]),
        "emergency_share": round(float(found[moving].mean()), 4) if moving.any() else 0.0,
        "judged_s": round(float(moving.sum()) * FRAME_S, 1),
        "safe_stop_share": round(result.share("safe_stop"), 4),
        "end_reason": result.plans[-1]["reason"] if result.plans else "",
        "end_mode": result.plans[-1]["mode"] if result.plans else "",
        "end_decision": result.plans[-1]["decision"] if result.plans else "",
        "reasons": dict(result.reasons.most_common(5)),
        "warnings": list(result.warnings),
    }
    comparable = yard.fair and entry["yardstick_m"] > 1.0
    entry["efficiency"] = round(entry["compared_m"] / entry["yardstick_m"], 3) if comparable else None
    entry["criterion"] = criteria.judge(family, scenario, record, entry) if family else None
    entry["wall_s"] = round(result.wall_s, 2)
    entry["cycle_ms"] = cycle
    return entry


def _judged(c: dict[str, Any], record: Recorder, scenario: Scenario) -> dict[str, Any]:
    """A brake without a cause in the world is our fault, however gentle."""
    if c["at_fault"]:
        return c
    past = [e for t, e in zip(record.t, record.ego, strict=True) if c["t"] - 2.0 <= t <= c["t"]]
    if max((-e.acceleration for e in past), default=0.0) > 1.0 and not brake_had_cause(record, scenario, c["t"]):
        return {**c, "at_fault": True, "why": "struck from behind while braking without a cause in the world"}
    return c


def _peak(values: np.ndarray) -> float:
    return round(float(np.max(np.abs(values))), 3) if len(values) else 0.0


def _p95(values: np.ndarray) -> float:
    return round(float(np.percentile(np.abs(values), 95)), 3) if len(values) else 0.0


def _sign_changes(a: np.ndarray, span: float) -> float:
    felt = a[np.abs(a) > FELT]
    changes = int(np.sum(np.diff(np.sign(felt)) != 0)) if len(felt) > 1 else 0
    return round(60.0 * changes / span, 2) if span > 1.0 else 0.0


def poisson_bound(events: int, km: float) -> float:
    """Upper bound of the rate per 1000 km at 95 % confidence, for so many events in so many kilometres."""

    def at_most(mean: float) -> float:
        return float(sum(math.exp(k * math.log(mean) - mean - math.lgamma(k + 1)) for k in range(events + 1)))

    low, high = 1e-9, 10.0 * (events + 5)
    for _ in range(80):
        mean = 0.5 * (low + high)
        low, high = (mean, high) if at_most(mean) > 1.0 - CONFIDENCE else (low, mean)
    return low / km * 1000.0 if km > 0 else math.inf


def pooled_efficiency(entries: list[dict[str, Any]], who: str = "", of: str = "yardstick_m") -> float | None:
    """Distance driven as a share of the others' in the same time, pooled over distance; `of` is their entry."""
    kept = [e for e in entries if e["efficiency"] is not None and (e[of] or 0.0) > 1.0]
    kept = [e for e in kept if not who or e["yardstick"] == who]
    there = sum(e[of] for e in kept)
    share = sum(e["compared_m"] for e in kept) / there if there > 0 else math.nan
    return None if math.isnan(share) else round(share, 3)
