"""What a review comes to, as plain values: the JSON of `forefield review`."""

from __future__ import annotations

from collections import Counter
from typing import Any

import numpy as np

from common.topics import TOPICS
from evaluation.review import hindsight
from evaluation.review.bounds import Bounds
from evaluation.review.charts import risk_along
from evaluation.review.drive import Drive
from evaluation.review.hindsight import Errors, Group
from evaluation.review.recording import STAGES, Recording
from rig.statuses import by_topic
from rig.tally import quantiles
from viz import account

TOLERANCE = 0.03
"""A controller that keeps a bound touches it: what is no further beyond counts as kept."""


def result(recording: Recording, drive: Drive, bounds: Bounds, errors: dict[Group, list[Errors]]) -> dict[str, Any]:
    """Summary, interventions, latencies, prediction error; times count from the begin of the run [s]."""
    refused, skipped = unused(recording, drive)
    return {
        "recording": recording.path.name,
        "account": ".".join(str(v) for v in account.VERSION),
        "summary": _summary(recording, drive, bounds),
        "interventions": [
            {**found.as_dict(), "recording_t": round(found.t + drive.began, 2)} for found in drive.interventions
        ],
        "latency_ms": {
            stage: quantiles(recording.latency_ms[stage][1][recording.latency_ms[stage][0] >= drive.began])
            for stage in STAGES
        },
        "refused": refused,
        "skipped": skipped,
        "prediction_error": hindsight.table(errors),
    }


def _summary(recording: Recording, drive: Drive, bounds: Bounds) -> dict[str, Any]:
    seconds = drive.mode_seconds()
    peaks: Counter[str] = Counter()
    for leg in drive.legs:
        for name, value in leg.motion.peaks().items():
            peaks[name] = max(peaks[name], value)  # type: ignore[assignment]
    clearance, risk = drive.clearance, risk_along(drive)[1]
    near = int(np.nanargmin(clearance.distance)) if np.any(np.isfinite(clearance.distance)) else None
    kinds = Counter(found.kind for found in drive.interventions)
    return {
        "scenario": recording.name,
        "began_at_recording_t": round(drive.began, 3),
        "duration_s": round(drive.duration_s, 2),
        "distance_m": round(drive.distance_m, 1),
        "mean_speed_mps": round(drive.distance_m / drive.duration_s, 2) if drive.duration_s > 0 else 0.0,
        "legs": len(drive.legs),
        "modes_s": {mode: round(s, 2) for mode, s in seconds.items()},
        "slow_downs": kinds["slow"],
        "stops": kinds["stop"],
        **{name: round(value, 3) for name, value in peaks.items()},
        "share_beyond_comfort": _beyond(drive, bounds),
        "bounds": {name: round(value, 3) for name, value in vars(bounds).items()},
        "min_clearance_m": None if near is None else round(float(clearance.distance[near]), 3),
        "min_clearance_at": None
        if near is None
        else {"t": round(float(clearance.t[near]), 2), "id": int(clearance.id[near])},
        "contacts": _contacts(drive),
        "highest_risk": round(float(np.nanmax(risk)), 3) if np.any(np.isfinite(risk)) else None,
        "frames": {
            "ego": len(drive.states.t),
            "objects": sum(seen.t >= drive.began for seen in recording.seen),
            "prediction": sum(foreseen.t >= drive.began for foreseen in recording.foreseen),
            "plan": sum(plan.t >= drive.began for plan in recording.plans),
        },
    }


def _contacts(drive: Drive) -> list[dict[str, Any]]:
    """First contact with each road user that was ever the nearest and touched."""
    first: dict[int, float] = {}
    for t, distance, identity in zip(drive.clearance.t, drive.clearance.distance, drive.clearance.id, strict=True):
        if distance <= 0.0:
            first.setdefault(int(identity), float(t))
    return [{"t": round(t, 2), "id": identity} for identity, t in first.items()]


def _beyond(drive: Drive, bounds: Bounds) -> dict[str, float]:
    """Share of the time more than TOLERANCE beyond each bound of comfort."""
    over = 1.0 + TOLERANCE
    speed_up, brake, lateral, jerk = [], [], [], []
    for leg in drive.legs:
        m = leg.motion
        speed_up.append(m.acceleration > over * bounds.accel)
        brake.append(m.acceleration < -over * bounds.brake)
        lateral.append(np.abs(m.lateral) > over * bounds.lateral)
        jerk.append(np.abs(m.jerk) > over * bounds.jerk)

    def share(parts: list[Any]) -> float:
        every = np.concatenate(parts) if parts else np.zeros(0)
        return round(float(np.mean(every)), 4) if len(every) else 0.0

    return {"accel": share(speed_up), "brake": share(brake), "lateral": share(lateral), "jerk": share(jerk)}


def unused(recording: Recording, drive: Drive) -> tuple[dict[str, dict[str, int]], ...]:
    """(refused, skipped) during the drive by topic and reason, as every service counted them."""
    counts: list[Counter[str]] = []
    for said in recording.statuses.values():
        before = [s for t, s in said if t <= drive.began]
        after = Counter(said[-1][1].counters)
        after.subtract(Counter(before[-1].counters) if before else {})
        counts.append(+after)
    return by_topic(counts, TOPICS)
