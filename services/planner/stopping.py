"""The stopping tail: from the profile's state at `valid_for` to rest, along the same path."""

from __future__ import annotations

import numpy as np

from services.planner.contact import meets
from services.planner.footprint import Footprint, timed_risk
from services.planner.settings import PlannerSettings
from services.planner.trajectory import Motion, Path, brake_motion
from services.planner.validator import contact_bound
from services.planner.volume import Volume


def stopping_tail(
    path: Path, profile: Motion, volume: Volume | None, footprint: Footprint, settings: PlannerSettings
) -> Motion:
    """The gentlest of the tail's brakes that meets nothing while moving; the hardest if none does."""
    s, v, a = profile.at(settings.valid_for)
    a = min(a, 0.0) if v <= 0.0 else a

    def braking(brake: float) -> Motion:
        return brake_motion(settings.valid_for, s, v, a, brake, max(3.0 * brake, 4.0))

    *gentler, hardest = settings.tail_brakes
    if volume is None or v <= 0.0:
        return braking(settings.tail_brakes[0])
    x, y, heading, _ = path.at(profile.distance[:1])
    risk = float(timed_risk(volume, footprint, x, y, heading, profile.t[:1])[0][0])
    bound = contact_bound(risk, settings)
    for motion in map(braking, gentler):
        if first_contact(path, motion, volume, footprint, bound) is None:
            return motion
    return braking(hardest)


def first_contact(
    path: Path, motion: Motion, volume: Volume, footprint: Footprint, r_hit: float
) -> tuple[int, float] | None:
    """First sample of a motion that, moving, has a risk of r_hit or more, or leaves the grid; and that risk."""
    x, y, heading, _ = path.at(motion.distance)
    risk, known = timed_risk(volume, footprint, x, y, heading, motion.t)
    moving = motion.speed > 0.05
    near = moving & ~(risk < r_hit - 0.02)  # what lies between two samples is looked for only there
    met = near & meets(volume, footprint, x, y, heading, motion.t, r_hit) if near.any() else near
    bad = moving & (met | ~known)
    return (int(np.argmax(bad)), float(risk[np.argmax(bad)])) if bad.any() else None
