"""Where the road is, as far as the lanes along the route tell: which paths would take the outline off it."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from services.planner.bezier import Paths
from services.planner.lanes import RouteLanes

F64 = npt.NDArray[np.float64]
Bools = npt.NDArray[np.bool_]

_NARROWEST = 2.5  # m; no lane counts as narrower
_FURTHER = 0.1  # m; whoever is off the road already may come back, but not go further


def leaves_road(paths: Paths, lanes: RouteLanes, half_width: float, margin: float) -> Bools:
    """Whether each path takes a side of the outline off all lanes along the route before its lateral move is done [n].

    Where no lane lies under the reference line nothing is known, and nothing left. The reference line itself and lanes
    of the map lead nobody off the road, nor does a path that goes no further to the side than the ego is already.

    Args:
        paths: With offsets d from the reference line at arc lengths s.
        lanes: The road along it.
        half_width: Of the ego [m].
        margin: By which the outline may reach over a lane's edge [m].
    """
    at = lanes.index(paths.s)
    ahead = paths.stations[None] <= paths.length[:, None]
    d0 = float(paths.d[0, 0])
    further = (paths.d > max(d0, 0.0) + _FURTHER) | (paths.d < min(d0, 0.0) - _FURTHER)
    asked = ahead & further & lanes.mapped[at]
    if not asked.any():
        return np.zeros(len(paths.x), dtype=bool)
    left, right = lanes.own_left, lanes.own_right
    wide = np.maximum(left - right, _NARROWEST)
    spans = [(left, right, np.ones(len(left), dtype=bool))]
    spans.append((2.0 * lanes.left.centre - left, left, lanes.left.exists))
    spans.append((right, 2.0 * lanes.right.centre - right, lanes.right.exists))
    station = np.arange(len(left))
    for track in lanes.tracks:
        there = (station >= track.first) & (station <= track.last)
        spans.append((track.centre + wide / 2, track.centre - wide / 2, there))
    out = np.zeros(paths.d.shape, dtype=bool)
    for sign in (1.0, -1.0):
        edge = paths.d + sign * half_width
        covered = np.zeros(paths.d.shape, dtype=bool)
        for upper, lower, there in spans:
            covered |= there[at] & (edge <= upper[at] + margin) & (edge >= lower[at] - margin)
        out |= ~covered
    return np.asarray((out & asked).any(axis=1))
