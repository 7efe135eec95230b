"""What happens if nobody reacts: contact, or a near miss told by the post-encroachment time. Never from the field.

The post-encroachment time (PET) of two road users is the least time between the presence of the one and of the other
at a common place: min |t_a − t_b| over all moments at which the ego's rectangle at t_a and the other's at t_b overlap.
Contact is PET = 0. What lies between the two bounds is neither clearly dangerous nor clearly harmless.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from common.geometry import distance_between_rectangles, rectangle_corners
from common.messages import F64
from evaluation.hazards.episode import STEP_S, Episode
from rig.world import EGO_SIZE

PET_HAZARD_S = 0.5
"""A PET up to this is a hazard [s]."""
PET_HARMLESS_S = 1.0
"""From this PET on it is harmless [s]; in between lies the grey zone."""
LAG_S = 0.04
"""Step of the time lags that are looked at [s], a multiple of the time grid's."""

Label = Literal["hazard", "harmless", "grey"]


@dataclass(frozen=True)
class Truth:
    """What happens if nobody reacts."""

    label: Label
    contact: bool
    event_s: float | None
    """First contact; without one, when the second arrives where the first has just been [s]; None: harmless."""
    pet_s: float
    """Least PET, at most just above `PET_HARMLESS_S` [s]."""
    actor: int | None
    """Who it is."""
    clearance_m: float
    """Least distance between the ego and anybody [m]."""


def truth_of(episode: Episode) -> Truth:
    """Simulate: all keep doing what they do, the ego its path and speed."""
    t = episode.times
    after = t >= -1e-9
    contact_s, contact_with, clearance = np.inf, None, np.inf
    best, best_s, best_with = PET_HARMLESS_S + LAG_S, None, None
    ego = rectangle_corners(*episode.ego_poses(t), *EGO_SIZE[:2])
    for i, a in enumerate(episode.actors):
        other = rectangle_corners(a.x, a.y, a.heading, a.length, a.width)
        gap = _distances(ego[after], other[after])
        clearance = min(clearance, float(gap.min()))
        touched = np.flatnonzero(gap == 0.0)
        if len(touched) and t[after][touched[0]] < contact_s:
            contact_s, contact_with = float(t[after][touched[0]]), i
        pet, event = _encroachment(ego, other, t)
        if event is not None and pet < best:
            best, best_s, best_with = pet, event, i
    if contact_with is not None:
        return Truth("hazard", True, contact_s, 0.0, contact_with, 0.0)
    label: Label = "hazard" if best <= PET_HAZARD_S else ("grey" if best < PET_HARMLESS_S else "harmless")
    return Truth(label, False, best_s if label == "hazard" else None, best, best_with, clearance)


def _encroachment(ego: F64, other: F64, t: F64) -> tuple[float, float | None]:
    """Least PET below `PET_HARMLESS_S` and when the second one arrives; (inf, None): there is none."""
    step = round(LAG_S / STEP_S)
    for k in range(0, round(PET_HARMLESS_S / STEP_S) + 1, step):
        arrivals = []
        for first, second in ((ego, other), (other, ego)):
            gap = _distances(first[: len(t) - k], second[k:])
            hit = np.flatnonzero((gap == 0.0) & (t[k:] >= -1e-9))
            if len(hit):
                arrivals.append(float(t[k + hit[0]]))
        if arrivals:
            return k * STEP_S, min(arrivals)
    return np.inf, None


def _distances(a: F64, b: F64) -> F64:
    """Distances of rectangles given by corners [k, 4, 2] [m]; far ones only roughly, from below."""
    centre = np.hypot(*(a.mean(-2) - b.mean(-2)).T)
    radius = np.hypot(*(a[:, 0] - a.mean(-2)).T) + np.hypot(*(b[:, 0] - b.mean(-2)).T)
    gap = np.maximum(centre - radius, 0.0)
    near = gap < 1.0
    if near.any():
        gap[near] = distance_between_rectangles(a[near], b[near])
    return np.asarray(gap)
