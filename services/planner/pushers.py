"""Who would run into the ego from behind: a reason to look for another path, none to brake.

The volume holds everybody where he is predicted to be, and nobody is predicted to brake for the ego. Somebody faster
behind it is therefore predicted to drive through it, and from then on stands in front of it: whoever brakes for that
is hit the sooner. A source that comes first to the rear bumper is a pusher; who cuts in comes to the flank first.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt

from services.planner.footprint import CORNER, Footprint, PathRisk, rear_risk
from services.planner.volume import NOBODY, Volume

F32 = npt.NDArray[np.float32]
F64 = npt.NDArray[np.float64]
U8 = npt.NDArray[np.uint8]
Bools = npt.NDArray[np.bool_]


def pushers(volume: Volume, footprint: Footprint, x: F64, y: F64, heading: F64, t: F64, r_hit: float) -> frozenset[int]:
    """Numbers of the sources that come first to the rear bumper of a motion.

    Args:
        volume: The volume on the plan's clock.
        footprint: The ego's.
        x: Rear axle at the motion's samples, `map` frame [m] [m].
        y: The same.
        heading: Of the body there [m] [rad].
        t: Plan times of the samples, increasing, near enough that none is jumped over [m] [s].
        r_hit: Risk of contact [E_max].
    """
    if not (rear_risk(volume, footprint, x, y, heading, t) >= r_hit - 1e-3).any():
        return frozenset()
    fx, fy = footprint.at(x, y, heading)
    fx, fy = fx[:, : footprint.outline], fy[:, : footprint.outline]
    slices = volume.slice_at(t)
    values = volume.sample_at(fx, fy, slices)
    touching = values >= r_hit
    if not touching[:, footprint.rear[: footprint.outline]].any():
        return frozenset()
    name = volume.who[volume.dominant_at(fx, fy, slices)]
    rear = footprint.rear[: footprint.outline][None]
    bumper = (footprint.x <= footprint.x[: footprint.outline].min() + 1e-9)[: footprint.outline]
    bumper &= np.abs(footprint.y[: footprint.outline]) <= footprint.half_width - CORNER
    found = set()
    for k in np.unique(name[touching & rear]):
        mine = touching & (name == k)
        behind, before = (mine & rear).sum(axis=1), (mine & ~rear).sum(axis=1)
        first = int(np.argmax(behind + before > 0))
        if k != NOBODY and behind[first] > before[first] and mine[first, bumper].any():
            found.add(int(k))
    return frozenset(found)


def without(risk: PathRisk, whom: frozenset[int], paths: Bools) -> PathRisk:
    """The risk on some paths [n] without what is met of `whom`: there the risk of the first slice stands instead.

    What is hidden under a pusher predicted over it is found where it is now, no further away than it will be.
    """
    if not whom or risk.who is None:
        return risk
    masked = np.isin(risk.who, np.fromiter(whom, dtype=np.uint8)) & paths[None, :, None, None]  # [4, n, S, p]

    def cleared(values: F32, mask: Bools) -> F32:
        now = np.where(mask[:, :1], np.float32(0.0), values[:, :1])
        return np.where(mask, np.minimum(values, now), values)

    four = [risk.contact, risk.ahead, *(risk.sides if risk.sides is not None else (None, None))]
    contact, ahead, left, right = (None if v is None else cleared(v, m) for v, m in zip(four, masked, strict=True))
    sides = None if left is None or right is None else np.stack((left, right))
    return replace(risk, contact=contact, ahead=ahead, sides=sides, who=np.where(masked, np.uint8(NOBODY), risk.who))
