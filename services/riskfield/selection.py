"""Which objects count: what the planner cannot know from a sum of risks is settled before the sum is taken."""

from __future__ import annotations

import math

import numpy as np

from common.geometry import rectangle_corners, wrap_angle
from common.messages import Ego, LeftOut
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
