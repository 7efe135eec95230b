"""Small roads for the built-in scenarios: lines from curvature, lanes beside them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from common.geometry import Polyline
from common.messages import F64, BoundaryType, Lane

STEP_M = 1.0
"""Spacing of points [m]."""


def line_of(
    pieces: Sequence[tuple[float, float, float]],
    start: tuple[float, float, float] = (0.0, 0.0, 0.0),
    step: float = 0.25,
) -> F64:
    """Points of a line whose curvature is linear on each piece (length [m], κ at its start, κ at its end [1/m]).

    Straight pieces, arcs and clothoids; `start` is x, y, heading. Integrated by the midpoint rule; shape [n, 2].
    """
    x, y, heading = start
    points = [(x, y)]
    for length, k0, k1 in pieces:
        n = max(1, round(length / step))
        h = length / n
        for i in range(n):
            a = heading + (k0 + (k1 - k0) * (i + 0.25) / n) * h / 2
            x, y = x + h * np.cos(a), y + h * np.sin(a)
            heading += (k0 + (k1 - k0) * (i + 0.5) / n) * h
            points.append((x, y))
    return np.array(points, dtype=np.float64)


def turn(angle: float, radius: float, easing: float) -> list[tuple[float, float, float]]:
    """A clothoid of `easing` [m] into an arc of `radius` [m] and out again, `angle` [rad] in all, left > 0."""
    k = np.sign(angle) / radius
    arc = abs(angle) * radius - easing
    if arc < 0.0:
        raise ValueError(f"an easing of {easing} m is too long for {angle} rad at radius {radius} m")
    return [(easing, 0.0, k), (arc, k, k), (easing, k, 0.0)]


def beside(line: F64, offset: float) -> F64:
    """The line shifted to its left by `offset` [m] along its normals (|offset| below its radius), shape as `line`."""
    direction = np.gradient(line, axis=0)
    direction /= np.hypot(direction[:, 0], direction[:, 1])[:, None]
    return np.asarray(line + offset * np.stack((-direction[:, 1], direction[:, 0]), axis=-1))


def thinned(line: F64, step: float = STEP_M) -> F64:
    """The line with points about every `step` [m]."""
    return Polyline.of(line).resampled(step).points


def lane(
    id: int,
    line: F64,
    offset: float = 0.0,
    width: float = 3.5,
    *,
    reverse: bool = False,
    left: BoundaryType = "dashed",
    right: BoundaryType = "road_edge",
    limit: float = 13.9,
    successors: Sequence[int] = (),
    left_lane: int | None = None,
    left_same: bool = True,
    right_lane: int | None = None,
) -> Lane:
    """A lane `offset` [m] to the left of `line`; `reverse`: it runs against it. `left` and `right` are seen driving."""
    side = -width / 2 if reverse else width / 2
    lines = [beside(line, offset), beside(line, offset + side), beside(line, offset - side)]
    centre, l_line, r_line = (np.ascontiguousarray(thinned(p[::-1] if reverse else p)) for p in lines)
    return Lane(
        id=id,
        centre=centre,
        left=l_line,
        right=r_line,
        left_type=left,
        right_type=right,
        speed_limit=limit,
        successors=list(successors),
        left_neighbour=left_lane,
        left_same_direction=left_same,
        right_neighbour=right_lane,
    )


def two_way(
    line: F64, width: float = 3.5, limit: float = 13.9, ids: tuple[int, int] = (1, 2), centre: BoundaryType = "dashed"
) -> list[Lane]:
    """A road of two lanes about `line`: the first along it on its right, the second against it on its left."""
    along, against = ids
    return [
        lane(along, line, -width / 2, width, limit=limit, left=centre, left_lane=against, left_same=False),
        lane(against, line, width / 2, width, reverse=True, limit=limit, left=centre, left_lane=along, left_same=False),
    ]


def one_way(line: F64, lanes: int = 2, width: float = 3.5, limit: float = 13.9, first_id: int = 1) -> list[Lane]:
    """A road of `lanes` lanes that all run along `line`, which is the rightmost one's centre; ids grow to the left."""
    return [
        lane(
            first_id + k,
            line,
            k * width,
            width,
            limit=limit,
            right="dashed" if k else "road_edge",
            left="dashed" if k < lanes - 1 else "road_edge",
            right_lane=first_id + k - 1 if k else None,
            left_lane=first_id + k + 1 if k < lanes - 1 else None,
        )
        for k in range(lanes)
    ]


def smooth(line: F64) -> Polyline:
    """The line with points every half metre."""
    return Polyline.of(line).resampled(0.5)
