"""Which objects and lines count: what the planner cannot know from a sum of risks is settled before it is taken."""

from __future__ import annotations

import math
from collections.abc import Iterable

import numpy as np

from common.geometry import rectangle_corners, wrap_angle
from common.messages import F64, NO_BRAKE, Ego, LeftOut, Map
from common.risk_sources import Bools, DynamicSources

FOLLOWER_HEADING = math.radians(45.0)
"""Largest difference of headings of a follower [rad]."""


def followers(sources: DynamicSources, ego: Ego) -> Bools:
    """Objects that at slice 0 are wholly behind the ego's rear bumper, overlap it laterally and head its way, [n].

    A follower must not push: its risk behind the ego would only make the ego flee forward. Rear traffic beside the
    ego's own lane stays, merging needs it. Who has run into the ego from behind, overlaps it and is faster, is a
    follower still: braking for him would only make it worse.
    """
    corners = rectangle_corners(
        sources.x[0] - ego.x, sources.y[0] - ego.y, sources.heading[0], sources.length[0], sources.width[0]
    )
    c, s = math.cos(ego.heading), math.sin(ego.heading)
    along = c * corners[..., 0] + s * corners[..., 1]
    beside = c * corners[..., 1] - s * corners[..., 0]
    behind = along.max(-1) < -ego.length / 2
    overlaps = (beside.min(-1) < ego.width / 2) & (beside.max(-1) > -ego.width / 2)
    same_way = np.abs(wrap_angle(sources.heading[0] - ego.heading)) <= FOLLOWER_HEADING
    striking = (along.min(-1) < ego.length / 2) & (sources.u[0] > 0.0)
    return np.asarray((behind | striking) & overlaps & same_way)


def left_out(sources: DynamicSources, ego: Ego) -> tuple[Bools, list[LeftOut]]:
    """Which objects count, [n], and the others with the reason."""
    follows = followers(sources, ego)
    return ~follows, [LeftOut(id=int(i), reason="follower") for i in sources.id[follows]]


_OVERRUN = 0.3
"""A line is bound to be crossed if the hardest brake comes to rest further beyond it than this [m]."""


def bound_to_cross(map: Map, closed: Iterable[int], ego: Ego, hardest_brake: float) -> list[LeftOut]:
    """Closed stop lines before the ego's bumper, or under it, before which not even `hardest_brake` [m/s²] stops.

    A light that turns red, or is seen, too late: braking with all there is would end in the junction or throw whoever
    follows into the ego, and stops nobody before the line. Everything beyond it still counts. A line before which any
    brake stops holds, however late it is, and so does one on which a slow ego stands. Closed lanes always hold.
    """
    way = 0.5 * ego.speed**2 / hardest_brake - _OVERRUN
    if not way > 0.0:
        return []
    ids = set(closed)
    found = []
    for line in map.obstacles:
        if line.kind != "stop_line" or line.id not in ids:
            continue
        ahead = _ahead(line.points, ego)
        if ahead is not None and -ego.length < ahead - ego.length / 2 < way:
            found.append(LeftOut(id=line.id, reason=NO_BRAKE))
    return found


def _ahead(points: F64, ego: Ego) -> float | None:
    """How far ahead of the ego's centre a line crosses its axis [m]; None: it does not."""
    c, s = math.cos(ego.heading), math.sin(ego.heading)
    x, y = points[:, 0] - ego.x, points[:, 1] - ego.y
    along, beside = c * x + s * y, c * y - s * x
    across = np.flatnonzero((beside[:-1] <= 0.0) != (beside[1:] <= 0.0))
    if not len(across):
        return None
    a, b = beside[across], beside[across + 1]
    w = a / (a - b)
    return float(np.min(along[across] + w * (along[across + 1] - along[across])))
