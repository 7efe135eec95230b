"""Time to collision: along the lane to the car ahead, and in two dimensions between footprints. Infinite: none."""

from __future__ import annotations

import numpy as np

from common.geometry import Polyline, distance_between_rectangles, rectangle_corners
from common.messages import Ego, Objects

LANE_HALF = 1.75
"""Who is at most so far beside the ego's path counts as in its lane [m]."""
HORIZON_S = 8.0
"""Later collisions are not looked for in two dimensions [s]."""
STEP_S = 0.1
HALVINGS = 7


def ttc_lane(ego: Ego, s_ego: float, speed: float, path: Polyline, objects: Objects) -> float:
    """TTC = gap / closing speed, along the ego's path, to the nearest road user ahead in its lane [s].

    Both keep their speeds along the path. In the lane is whose centre lies within half a lane's width of the path.
    """
    if not len(objects.id):
        return float("inf")
    s, d = path.project(np.stack((objects.x, objects.y), axis=-1))
    inside = np.flatnonzero((np.abs(d) <= LANE_HALF) & (s > s_ego))
    if not len(inside):
        return float("inf")
    lead = inside[np.argmin(s[inside])]
    direction = float(path.heading(s[lead]))
    along = float(objects.vx[lead] * np.cos(direction) + objects.vy[lead] * np.sin(direction))
    # extent of the lead along the path: as long as it is if it points along it, as wide as it is if across
    turned = float(objects.heading[lead]) - direction
    extent = abs(np.cos(turned)) * objects.length[lead] + abs(np.sin(turned)) * objects.width[lead]
    gap = float(s[lead]) - s_ego - (ego.length + float(extent)) / 2
    closing = speed - along
    if gap <= 0.0:
        return 0.0
    return gap / closing if closing > 1e-6 else float("inf")


def ttc_2d(ego: Ego, s_ego: float, speed: float, path: Polyline, objects: Objects) -> float:
    """When the ego's rectangle, going on along its own path at its speed, first meets another's at constant velocity.

    The fair form: any direction, true sizes, and the ego's own path is known to it.
    """
    n = len(objects.id)
    if not n:
        return float("inf")

    def gap(t: np.ndarray, rows: np.ndarray) -> np.ndarray:
        s = s_ego + speed * t
        p, d = path.at(s), path.at(s + 0.5) - path.at(s - 0.5)
        mine = rectangle_corners(p[..., 0], p[..., 1], np.arctan2(d[..., 1], d[..., 0]), ego.length, ego.width)
        x, y = objects.x[rows] + objects.vx[rows] * t, objects.y[rows] + objects.vy[rows] * t
        other = rectangle_corners(x, y, objects.heading[rows], objects.length[rows], objects.width[rows])
        return np.asarray(distance_between_rectangles(mine, other))

    t = np.arange(0.0, HORIZON_S + 1e-9, STEP_S)
    s = s_ego + speed * t
    p = path.at(s)
    centre = np.hypot(
        p[:, None, 0] - objects.x - objects.vx * t[:, None], p[:, None, 1] - objects.y - objects.vy * t[:, None]
    )
    reach = np.hypot(ego.length, ego.width) / 2 + np.hypot(objects.length, objects.width) / 2
    k, rows = np.nonzero(centre <= reach)
    if not len(k):
        return float("inf")
    hit = gap(t[k], rows) == 0.0
    best = float("inf")
    for row in np.unique(rows[hit]):
        first = int(k[hit & (rows == row)].min())
        if first == 0:
            return 0.0
        low, high = t[first - 1], t[first]
        one = np.array([row])
        for _ in range(HALVINGS):
            mid = (low + high) / 2
            if gap(np.array([mid]), one)[0] == 0.0:
                high = mid
            else:
                low = mid
        best = min(best, float(high))
    return best
