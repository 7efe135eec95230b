"""The stopping tail: from the profile's state at `valid_for` to rest, along the same path."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from services.planner.footprint import Footprint, timed_risk
from services.planner.settings import PlannerSettings
from services.planner.trajectory import Motion, Path, brake_motion
from services.planner.validator import contact_bound
from services.planner.volume import Volume

F64 = npt.NDArray[np.float64]


def stopping_tail(
    path: Path, profile: Motion, volume: Volume | None, footprint: Footprint, settings: PlannerSettings
) -> Motion:
    """The gentlest of the tail's brakes that meets nothing while moving; the hardest if none does."""
    s, v, a = profile.at(settings.valid_for)
    a = min(a, 0.0) if v <= 0.0 else a
    motions = [brake_motion(settings.valid_for, s, v, a, b, max(3.0 * b, 4.0)) for b in settings.tail_brakes]
    if volume is None or v <= 0.0:
        return motions[0]
    risk = float(motion_risk(path, profile.until(0.1), volume, footprint)[0][0])
    bound = contact_bound(risk, settings)
    for motion in motions[:-1]:
        if first_contact(path, motion, volume, footprint, bound) is None:
            return motion
    return motions[-1]


def first_contact(
    path: Path, motion: Motion, volume: Volume, footprint: Footprint, r_hit: float
) -> tuple[int, float] | None:
    """First sample of a motion that, moving, has a risk of r_hit or more, or leaves the grid; and that risk."""
    risk, known = motion_risk(path, motion, volume, footprint)
    moving = motion.speed > 0.05
    bad = moving & (~(risk < r_hit) | ~known)
    return (int(np.argmax(bad)), float(risk[np.argmax(bad)])) if bad.any() else None


def motion_risk(path: Path, motion: Motion, volume: Volume, footprint: Footprint) -> tuple[F64, npt.NDArray[np.bool_]]:
    """How near to contact ahead each sample of a motion is in its slice [m], and whether all of it is on the grid."""
    x, y, heading, _ = path.at(motion.distance)
    return timed_risk(volume, footprint, x, y, heading, motion.t)
