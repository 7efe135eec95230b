"""What stands around each object, sampled with every message and kept for three seconds.

A sample is the nine surrounding risks and the leader signals of every object at that instant. The service keeps
the samples of the last messages; `history` reads them at 10 Hz backwards, so that a network sees in service what it saw
in training: at each frame of the history the others as they were *then*, also those that are gone now.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from common.messages import F32, F64, FRAME_S, HISTORY_FRAMES, I64, U8, Ego, ObjectClass, Objects
from common.risk import RiskParameters
from services.predictor.history import Frames
from services.predictor.leader import LEADER_SIGNALS, leader_signals
from services.predictor.surrounding_risk import (
    RISK_POINTS,
    Scene,
    backward_velocity,
    surrounding_risk,
)

SIGNALS = RISK_POINTS + LEADER_SIGNALS
"""Signals of one object at one instant: surrounding risk first."""
SPACING_NS = 80_000_000
"""Least spacing of kept samples [ns]; of faster messages the newest replaces the one before."""
KEPT = 40
"""Samples kept; with the least spacing they reach farther back than 30 frames."""


@dataclass(frozen=True)
class Sample:
    """Signals of m objects, sorted by id, captured at `capture_ns`."""

    capture_ns: int
    id: I64
    values: F32  # [m, SIGNALS]


Samples = tuple[Sample, ...]
"""Oldest first."""


def instant_signals(scene: Scene, targets: int, p: RiskParameters, *, risk: bool = True) -> F32:
    """Signals of the first `targets` road users of a scene, shape [targets, SIGNALS]; without `risk` zeros for it."""
    field = surrounding_risk(scene, targets, p) if risk else np.zeros((targets, RISK_POINTS), dtype=np.float32)
    return np.concatenate((field, leader_signals(scene, targets)), axis=1)


def scene_of(objects: Objects, frames: Frames, ego: Ego | None) -> Scene:
    """Objects with their velocities by backward differences; the ego last, as one more road user."""
    vx, vy = backward_velocity(frames.x, frames.y, frames.steps)
    me = [] if ego is None else [ego]

    def with_ego(values: F64 | U8, ego_values: list[float]) -> F64:
        return np.concatenate((values, ego_values)).astype(np.float64)

    return Scene(
        x=with_ego(objects.x, [e.x for e in me]),
        y=with_ego(objects.y, [e.y for e in me]),
        heading=with_ego(objects.heading, [e.heading for e in me]),
        vx=with_ego(vx, [e.vx for e in me]),
        vy=with_ego(vy, [e.vy for e in me]),
        length=with_ego(objects.length, [e.length for e in me]),
        width=with_ego(objects.width, [e.width for e in me]),
        mass=with_ego(objects.mass, [0.0 for _ in me]),
        cls=with_ego(objects.cls, [ObjectClass.CAR for _ in me]).astype(np.uint8),
    )


def observed(samples: Samples, capture_ns: int, ids: I64, values: F32, gap_ns: int) -> Samples:
    """Add one sample; one before the last is ignored; after a gap longer than `gap_ns` everything starts anew."""
    if samples and -gap_ns <= capture_ns - samples[-1].capture_ns < 0:
        return samples
    order = np.argsort(ids, kind="stable")
    new = Sample(capture_ns, ids[order], values[order])
    if samples and not 0 <= capture_ns - samples[-1].capture_ns <= gap_ns:
        samples = ()
    crowded = len(samples) >= 2 and samples[-1].capture_ns - samples[-2].capture_ns < SPACING_NS
    same = bool(samples) and samples[-1].capture_ns == capture_ns
    return (*(samples[:-1] if crowded or same else samples), new)[-KEPT:]


def history(samples: Samples, ids: I64) -> F32:
    """Signals of the objects `ids` at 30 frames back from the last sample, newest first, shape [n, 30, SIGNALS].

    Each frame takes the sample nearest in time; before the first that holds an object, that one's values go on.
    """
    result = np.zeros((len(ids), HISTORY_FRAMES, SIGNALS), dtype=np.float32)
    if not samples or not len(ids):
        return result
    ages = (samples[-1].capture_ns - np.array([s.capture_ns for s in samples])) * 1e-9
    nearest = np.abs(ages[None] - FRAME_S * np.arange(HISTORY_FRAMES)[:, None]).argmin(axis=1)
    for k, i in enumerate(nearest):
        sample = samples[i]
        if k and i == nearest[k - 1]:
            result[:, k] = result[:, k - 1]
            continue
        row = np.minimum(np.searchsorted(sample.id, ids), max(len(sample.id) - 1, 0))
        held = sample.id[row] == ids if len(sample.id) else np.zeros(len(ids), dtype=bool)
        result[held, k] = sample.values[row[held]]
        if k:
            result[~held, k] = result[~held, k - 1]
    return result
