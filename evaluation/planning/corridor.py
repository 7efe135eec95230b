"""Who is in the way: road users and closed lines in the strip that a body sweeps along its path."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from common.geometry import Polyline, rectangle_corners
from common.messages import F64, Closures, Map, Objects

MARGIN_M = 0.2
"""Kept to each side."""


@dataclass(frozen=True)
class Leader:
    """The nearest in the way."""

    gap: float = math.inf  # from bumper to bumper along the path [m]
    speed: float = 0.0  # along the path [m/s]
    index: int = -1  # which body; −1: nobody, or a line


def bodies(objects: Objects) -> F64:
    """Corners of everybody, [n, 4, 2]."""
    return rectangle_corners(objects.x, objects.y, objects.heading, objects.length, objects.width)


def leader(
    line: Polyline, s: float, half_length: float, half_width: float, corners: F64, velocity: F64, reach: float
) -> Leader:
    """The nearest body whose outline reaches into the strip ahead of `s` on `line`.

    Args:
        line: The path of the centre.
        s: Where the centre is on it [m].
        half_length: Of the own body [m].
        half_width: Of the own body [m].
        corners: Of the others, [n, 4, 2].
        velocity: Of the others, [n, 2] [m/s].
        reach: How far to look [m].
    """
    if not len(corners):
        return Leader()
    part = line.cut(max(s - 10.0, -10.0), s + reach)
    start = max(s - 10.0, -10.0)
    centre = corners.mean(axis=1)
    origin = line.at(s)
    near = np.flatnonzero(np.hypot(*(centre - origin).T) < reach + 15.0)
    if not len(near):
        return Leader()
    middle = 0.5 * (corners[near] + np.roll(corners[near], 1, axis=1))
    along, beside = part.project(np.concatenate((corners[near], middle), axis=1))
    along = along + start
    half = half_width + MARGIN_M
    enters = (beside.min(axis=1) < half) & (beside.max(axis=1) > -half)
    body_s, _ = part.project(centre[near])
    ahead = (body_s + start > s) & (along.min(axis=1) < s + reach)
    found = np.flatnonzero(enters & ahead)
    if not len(found):
        return Leader()
    # only the part of an outline that lies in the strip counts; a long body across it has all of it there
    inside = np.abs(beside[found]) <= half + 0.5
    first = np.where(inside, along[found], np.inf).min(axis=1)
    first = np.where(np.isfinite(first), first, along[found].mean(axis=1))
    k = int(np.argmin(first))
    i = int(near[found[k]])
    direction = float(line.heading(float(first[k])))
    speed = float(velocity[i, 0] * math.cos(direction) + velocity[i, 1] * math.sin(direction))
    return Leader(float(first[k]) - s - half_length, speed, i)


def stops_along(line: Polyline, road: Map | None, half_width: float) -> list[tuple[float, int, str]]:
    """Where static lines cross the path: (arc length [m], id, kind), in order."""
    if road is None:
        return []
    found = []
    for o in road.obstacles:
        points = Polyline.of(o.points).resampled(0.5).points
        s, d = line.project(points)
        across = np.flatnonzero((np.abs(d) < half_width) & (s > 0.0) & (s < line.length))
        if len(across):
            found.append((float(s[across].min()), o.id, o.kind))
    return sorted(found)


def closed_at(stops: list[tuple[float, int, str]], closures: Closures, s: float) -> float:
    """Arc length of the next line ahead of `s` that must not be crossed now; infinite: none."""
    shut = set(closures.ids)
    ahead = [at for at, id, kind in stops if at > s and (kind != "stop_line" or id in shut)]
    return min(ahead, default=math.inf)
