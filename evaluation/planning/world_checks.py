"""What the world says about a drive: emergencies, times to collision, whether a brake had a cause."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from common.geometry import Polyline, distance_between_rectangles, rectangle_corners, wrap_angle
from common.messages import FRAME_S, Ego, Objects
from evaluation.hazards.ttc import ttc_2d
from evaluation.planning import corridor
from evaluation.planning.recorder import Recorder
from rig.world import Scenario

GENTLE = 1.5
"""An emergency is where this brake from then on would not avoid contact [m/s²]."""
STEP = 2
"""Frames between the moments at which contact is looked for."""
AFTER_S = 1.0
"""An emergency's brake is built up and let go until so long after it [s]."""
FRONT = 0.6
"""Share of the ego's length, from its front, that counts: nobody brakes for who comes from behind."""


def emergencies(record: Recorder, until_s: float = math.inf) -> npt.NDArray[np.bool_]:
    """For each frame whether a brake of 1.5 m/s² from then on, along the way really driven, would meet somebody.

    The others move as they did. Nobody brakes for who comes from behind: contacts of the ego's rear do not count, nor
    those who are behind it at that moment and head its way; nor what happens after it stands. Frames after `until_s`
    [s] (the first collision: bodies have gone through each other) are not judged.
    """
    found = np.zeros(len(record.frames), dtype=bool)
    for k, row in enumerate(record.at_frame):
        ego = record.ego[row]
        v = ego.speed
        if v < 0.3 or record.t[row] >= until_s:
            continue
        steps = np.arange(0, min(math.ceil(v / GENTLE / FRAME_S), len(record.frames) - k), STEP)
        t = steps * FRAME_S
        s = record.driven[row] + v * t - 0.5 * GENTLE * t * t
        x, y, heading = record.poses(s)
        ahead = (1.0 - FRONT) / 2 * ego.length
        x, y = x + ahead * np.cos(heading), y + ahead * np.sin(heading)
        mine = rectangle_corners(x, y, heading, FRONT * ego.length, ego.width)
        behind = _behind(ego, record.frames[k])
        found[k] = any(_meets(x[i], y[i], mine[i], record, k + int(n), ego.length, behind) for i, n in enumerate(steps))
    return found


def _behind(ego: Ego, o: Objects) -> npt.NDArray[np.int64]:
    """Ids of those whose centre lies behind the ego's and who head within 45° of it."""
    ahead = np.cos(ego.heading) * (o.x - ego.x) + np.sin(ego.heading) * (o.y - ego.y)
    turned = np.abs(wrap_angle(o.heading - ego.heading))
    return np.asarray(o.id[(ahead < 0.0) & (turned < np.pi / 4)])


def _meets(
    x: float,
    y: float,
    mine: np.ndarray,
    record: Recorder,
    frame: int,
    length: float,
    behind: npt.NDArray[np.int64],
) -> bool:
    o = record.frames[frame]
    if not len(o.id):
        return False
    near = np.hypot(o.x - x, o.y - y) < (length + np.hypot(o.length, o.width)) / 2 + 0.5
    near &= ~np.isin(o.id, behind)
    if not near.any():
        return False
    others = rectangle_corners(o.x[near], o.y[near], o.heading[near], o.length[near], o.width[near])
    return bool((distance_between_rectangles(mine, others) <= 0.0).any())


def emergency_times(record: Recorder, found: npt.NDArray[np.bool_], t: npt.ArrayLike) -> npt.NDArray[np.bool_]:
    """For each time whether it lies in an emergency or at most 1 s after one."""
    at = np.array([record.t[row] for row in record.at_frame])[found]
    times = np.asarray(t)[:, None]
    return np.asarray(((times >= at - FRAME_S) & (times <= at + AFTER_S)).any(axis=1))


def min_ttc(record: Recorder) -> float | None:
    """Least time in which the ego, going on along its way at its speed, would meet one who keeps his velocity [s]."""
    best = math.inf
    for k, row in enumerate(record.at_frame):
        ego = record.ego[row]
        if len(record.frames[k].id):
            s = float(record.path.project(np.array([ego.x, ego.y]))[0]) if k == 0 else float(record.driven[row])
            best = min(best, ttc_2d(ego, s, max(ego.speed, 0.0), record.path, record.frames[k]))
    return None if math.isinf(best) else round(best, 2)


def brake_had_cause(record: Recorder, scenario: Scenario, t: float) -> bool:
    """Whether somebody was in, or about to come into, the ego's way, or a line was closed, in the 2 s before `t`."""
    for k, row in enumerate(record.at_frame):
        if not t - 2.0 <= record.t[row] <= t:
            continue
        ego, o = record.ego[row], record.frames[k]
        reach = 10.0 + 4.0 * ego.speed
        line = scenario.route.reference
        way = record.path if record.path.length > 20.0 else Polyline.of(line)
        s = float(way.project(np.array([ego.x, ego.y]))[0])
        half = ego.width / 2 + 0.8
        velocity = np.stack((o.vx, o.vy), axis=-1)
        corners = corridor.bodies(o)
        for later in (0.0, 1.0, 2.0, 3.0):
            lead = corridor.leader(way, s, ego.length / 2, half, corners + (velocity * later)[:, None], velocity, reach)
            if lead.index >= 0:
                return True
        shut = corridor.stops_along(way, scenario.map, half)
        if corridor.closed_at(shut, scenario.closures_at(record.t[row]), s) < s + reach:
            return True
    return False
