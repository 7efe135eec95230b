"""The goal is a place to be reached: being in another lane costs more and more as the way left to change it falls.

The mandatory incentive of lane-change models (MOBIL's authors, Kesting et al. 2007, leave it open; here as the ratio of
the time that the changes take to the time that is left, squared): far from the goal whoever is faster in another lane
may drive there, near it even a slower gap in the goal's lane is better.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from services.planner.bezier import Paths
from services.planner.lanes import RouteLanes
from services.planner.search import LATER
from services.planner.settings import PlannerSettings

F64 = npt.NDArray[np.float64]

_LANE = 3.5  # m
_INSIDE = 0.4  # m; so much nearer than the goal's radius it is to be passed
_BEGIN_S, _CHANGE_S = 2.0, 4.0  # to begin a change, and for each lane [s]
_SLOW = 2.5  # m/s; who creeps is not hurried
_MOST = 1.25  # ratio beyond which nothing gets dearer


def goal_cost(
    paths: Paths,
    lanes: RouteLanes,
    tracks: npt.NDArray[np.intp],
    goal: tuple[float, float, float],
    speed: float,
    settings: PlannerSettings,
) -> F64:
    """What speaks against paths that lead past the goal [n] [m/s].

    Args:
        paths: The candidates.
        lanes: The road.
        tracks: Which of `lanes.tracks` each path follows; −1: none [n].
        goal: (s, d, radius) of the goal on the reference line [m].
        speed: The ego's [m/s].
        settings: `goal_cost`.
    """
    goal_s, goal_d, radius = goal
    here = float(paths.s[0, 0])
    n, p = paths.s.shape
    end = np.minimum(np.searchsorted(paths.s[0] - here, paths.length), p - 1)
    end[[name.startswith(LATER) for name in paths.target]] = p - 1  # they change further on
    reached = np.minimum(end, np.argmax(paths.s >= goal_s, axis=1) + (p - 1) * ~(paths.s >= goal_s).any(axis=1))
    at = paths.d[np.arange(n), reached]
    away = np.maximum(np.abs(at - goal_d) - max(radius - _INSIDE, 0.3), 0.0)
    for k in np.unique(tracks[tracks >= 0]):
        mine, track = tracks == k, lanes.tracks[k]
        # a lane that ends before the goal is left for its end's sake, not for the goal's
        past = abs(float(track.centre[lanes.index(goal_s)]) - goal_d) - max(radius - _INSIDE, 0.3)
        away[mine] = max(past, 0.0) if lanes.stations[track.last] >= goal_s - 1.0 else 0.0
    left = goal_s - here
    takes = np.where(away > 0.0, _BEGIN_S + _CHANGE_S * away / _LANE, 0.0)
    ratio = np.clip(takes * max(speed, _SLOW) / max(left, 1e-3), 0.0, _MOST)
    return settings.goal_cost * ratio**2 if left > 0.0 else np.zeros(n)
