"""Whether a drive was lost before it began: every constant acceleration on the limit of grip meets somebody."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from common.geometry import distance_between_rectangles, rectangle_corners
from common.messages import F64, FRAME_S, Ego
from evaluation.planning.recorder import Recorder

GRIP = 8.0
"""Acceleration at the limit of grip on a dry road [m/s²]."""
DIRECTIONS = 72
"""So many directions of it are tried, from full braking through full lateral acceleration to full throttle."""
TIGHTEST = 0.2
"""No car turns tighter than this curvature [1/m]."""
WITHIN_S = 3.0
"""A collision later than this is nobody's start [s]."""


def unavoidable(record: Recorder, collision_t: float) -> bool:
    """Whether a collision `collision_t` seconds into a drive was certain from its first state.

    From that state every constant acceleration on the circle of grip is driven at once, without reaction, plan or jerk,
    until the ego stands or the collision is 0.5 s past; the others move as they did. A collision later than 3 s into
    the drive counts as avoidable. The family of motions is finite, and nobody reacts to them: it points at drives that
    were lost, it proves none, and takes nothing from the fault.
    """
    if not record.frames or not 0.0 <= collision_t <= WITHIN_S:
        return False
    free = np.ones(DIRECTIONS, dtype=bool)
    first = record.ego[record.at_frame[0]]
    length, width = np.float64(first.length), np.float64(first.width)
    x, y, heading = _motions(first, collision_t + 0.5)
    for k in range(min(x.shape[1], len(record.frames))):
        o = record.frames[k]
        if len(o.id):
            others = rectangle_corners(o.x, o.y, o.heading, o.length, o.width)
            left = np.flatnonzero(free)
            mine = rectangle_corners(x[left, k], y[left, k], heading[left, k], length, width)
            free[left] = (distance_between_rectangles(mine[:, None], others[None]) > 0.0).all(axis=1)
        if not free.any():
            return True
    return False


def _motions(ego: Ego, until_s: float) -> tuple[F64, F64, F64]:
    """Centre x, y [m] and heading [rad] of every motion at whole 0.1 s, each [DIRECTIONS, frames]."""
    per = 10
    angle: npt.NDArray[np.float64] = np.linspace(0.0, 2.0 * np.pi, DIRECTIONS, endpoint=False)
    along, across = GRIP * np.cos(angle), GRIP * np.sin(angle)
    v = np.full(DIRECTIONS, max(ego.speed, 0.0))
    rear = ego.wheelbase / 2  # the rear axle follows the curve, the centre swings
    x = np.full(DIRECTIONS, ego.x - rear * np.cos(ego.heading))
    y = np.full(DIRECTIONS, ego.y - rear * np.sin(ego.heading))
    turned = np.full(DIRECTIONS, ego.heading)
    frames = []
    dt = FRAME_S / per
    for _ in range(int(until_s / FRAME_S) + 1):
        frames.append((x + rear * np.cos(turned), y + rear * np.sin(turned), turned))
        for _ in range(per):
            bend = np.clip(across / np.maximum(v, 0.1) ** 2, -TIGHTEST, TIGHTEST)
            x, y = x + v * np.cos(turned) * dt, y + v * np.sin(turned) * dt
            turned = turned + v * bend * dt
            v = np.maximum(v + along * dt, 0.0)
    out = np.array(frames)
    return out[:, 0].T, out[:, 1].T, out[:, 2].T
