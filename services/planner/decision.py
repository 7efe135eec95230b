"""Why this speed: the slice, the cell, the source and the term that decided, in a sentence."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from msgspec.structs import replace

from common.messages import Decision, ObjectClass, Slot
from services.planner.footprint import Footprint
from services.planner.trajectory import Path
from services.planner.volume import OTHER, Volume

_REACH = 3.0  # m; how far to the side the source is looked for


@dataclass(frozen=True)
class Obstruction:
    """Where a path meets the risk that limits its speed."""

    path: Path
    distance: float  # of the rear axle along it [m]
    slices: tuple[int, ...]  # that were read, counted from the one now in force


def explain(
    desired: float, speed: float, obstruction: Obstruction, volume: Volume, footprint: Footprint, kind: str
) -> Decision:
    """Name what limits the speed to `desired`: the highest risk on the outline at the obstruction."""
    x, y, heading, _ = obstruction.path.at(np.array([obstruction.distance]))
    fx, fy = footprint.at(x, y, heading)
    slices = sorted({min(max(j, 0), volume.slices - 1) for j in obstruction.slices})
    values, _known = volume.sample(fx[:, : footprint.outline], fy[:, : footprint.outline], slices)  # [slices, 1, k]
    worst = int(np.argmax(values.max(axis=(1, 2))))
    j, k = slices[worst], int(np.argmax(values[worst, 0]))
    px, py = float(fx[0, k]), float(fy[0, k])
    cell = volume.cell(px, py)
    index = volume.first + j
    slot = volume.source(index, *cell)
    known = slot if slot is not None and slot.label != OTHER else None
    cx, cy = volume.cell_centre(*cell)
    side = _side(obstruction.path, obstruction.distance, float(footprint.x[k]), float(footprint.y[k]), volume, j)
    where = f"{abs(side):.1f} m {'left' if side > 0 else 'right'} of the path" if abs(side) > 0.3 else "on the path"
    term = slot.term if slot is not None else None
    start = float(volume.starts[j])
    source = _name(slot) + (f", {term} term" if term else "")
    sentence = (
        f"{verb(desired, speed)}: {source}, slice {max(start, 0.0):.1f} s, {where},"
        f" {obstruction.distance:.0f} m ahead{_why(kind)}"
    )
    return Decision(
        sentence=sentence,
        slice=index,
        slice_s=start,
        cell=cell,
        x=cx,
        y=cy,
        source_id=known.id if known is not None else None,
        source_cls=known.cls if known is not None else None,
        term=term,
        risk=float(values[worst, 0, k]),
    )


def _side(path: Path, distance: float, ahead: float, sample: float, volume: Volume, j: int) -> float:
    """How far from the footprint's centre line the source begins, on the side of the sample that met it; > 0: left."""
    x, y, heading, _ = path.at(np.array([distance]))
    c, s = np.cos(heading), np.sin(heading)
    across = np.linspace(0.0, _REACH, 13) * (1.0 if sample >= 0.0 else -1.0)
    (values,), _known = volume.sample(x + c * ahead - s * across, y + s * ahead + c * across, (j,))
    high = values >= 0.9 * values.max()
    return float(across[int(np.argmax(high))])


def explain_cap(desired: float, speed: float, cause: str, distance: float) -> Decision:
    """Name the curve, limit, goal or horizon that sets the speed."""
    text = {
        "limit": "the speed limit",
        "curve": "a curve",
        "goal": "the goal",
        "horizon": "the end of what is known or of the route",
    }[cause]
    ahead = f", {distance:.0f} m ahead" if distance > 1.0 else ""
    return Decision(sentence=f"{verb(desired, speed)}: {text}{ahead}", term=cause)


def through_a_gap(why: Decision, desired: float, speed: float) -> Decision:
    """Why the ego creeps and drives no faster: what would stop it if it were not looked at closely."""
    _, _, who = why.sentence.partition(": ")
    return replace(why, sentence=f"{verb(desired, speed)}, through a gap just wide enough: {who}")


def verb(desired: float, speed: float) -> str:
    """What is done about the speed."""
    if desired < 0.05:
        return "standing still" if speed < 0.05 else "stopping"
    if desired < speed - 0.3:
        return f"slowed to {desired:.1f} m/s"
    return f"driving at {desired:.1f} m/s"


def _name(slot: Slot | None) -> str:
    if slot is None:
        return "an unnamed source"
    if slot.label == OTHER:
        return "one of several sources that share a slot"
    kind = ObjectClass(slot.cls).name.lower() if 0 <= slot.cls <= max(ObjectClass) else slot.label or "static line"
    return f"{kind.replace('_', ' ')} {slot.id}"


def _why(kind: str) -> str:
    return {
        "stop": ", to be able to stop behind it",
        "stays": ", it may stay where it is",
    }.get(kind, "")
