"""Who drives ahead, and what kind of place this is: leaders, flow, traffic that goes other ways.

Seen along each road user's direction of motion, at one instant, shape [n, 7]:

    0  nearness of the leader, 1 / (1 + gap / 10 m), 0 without one
    1  nearness of whoever crosses or stands across the way ahead
    2  share of those around that stand or go another way (near 0 on a motorway)
    3  the leader's speed along that direction minus the own one, / 5 m/s
    4  mean of the same over all who drive ahead in about the same direction, nearer ones counting more, / 5 m/s
    5  the same of the leader's leader, / 5 m/s
    6  mean speed of those around, / 10 m/s

The leader is the nearest one ahead whose body reaches into the corridor that the own body sweeps.
"""

from __future__ import annotations

import numpy as np

from common.messages import F32
from services.predictor.surrounding_risk import Scene

LEADER_SIGNALS = 7
SPEEDS = slice(3, 7)
"""Those of the signals that scale with all speeds."""
REACH_M = 80.0
"""How far ahead others count [m]."""
MARGIN_M = 0.3
"""Added to the corridor's half width [m]."""
FLOW_M = 20.0
"""Distance over which the weight of those ahead falls to 1/e [m]."""
FLOW_SIDE_M = 6.0
AROUND_M = 40.0
"""Distance over which the weight of those around falls to 1/e [m]."""
SAME_WAY = 0.85
"""Cosine of the largest angle between courses that count as the same direction."""


def leader_signals(scene: Scene, targets: int) -> F32:
    """The signals of the first `targets` road users."""
    signals = np.zeros((targets, LEADER_SIGNALS), dtype=np.float32)
    if targets == 0 or len(scene.x) < 2:
        return signals
    speed = np.hypot(scene.vx, scene.vy)
    moving = speed > 0.5
    safe = np.where(moving, speed, 1.0)
    tx = np.where(moving, scene.vx / safe, np.cos(scene.heading))
    ty = np.where(moving, scene.vy / safe, np.sin(scene.heading))
    ox, oy = tx[:targets, None], ty[:targets, None]
    dx, dy = scene.x - scene.x[:targets, None], scene.y - scene.y[:targets, None]
    ahead, beside = dx * ox + dy * oy, np.abs(dy * ox - dx * oy)
    same = ox * tx + oy * ty
    relative = ox * scene.vx + oy * scene.vy - speed[:targets, None]
    # half extent of a body across and along the own direction
    turn = np.abs(np.cos(scene.heading) * oy - np.sin(scene.heading) * ox)
    straight = np.sqrt(np.maximum(1.0 - turn * turn, 0.0))
    half_across = (scene.length * turn + scene.width * straight) / 2
    half_along = (scene.length * straight + scene.width * turn) / 2
    own_half, own_length = scene.width[:targets, None] / 2, scene.length[:targets, None]
    front = (ahead > 0.3 * own_length) & (ahead < REACH_M)
    in_way = front & (beside < own_half + half_across + MARGIN_M)
    gap = np.maximum(ahead - half_along - own_length / 2, 0.0)
    nearness = 1.0 / (1.0 + gap / 10.0)

    follows = np.where(in_way & (same > 0.5), nearness, 0.0)
    rows, first = np.arange(targets), np.argmax(follows, axis=1)
    signals[:, 0] = follows[rows, first]
    signals[:, 1] = np.where(in_way & (same <= 0.5), nearness, 0.0).max(axis=1)
    signals[:, 3] = np.where(signals[:, 0] > 0, relative[rows, first], 0.0)
    follows[rows, first] = 0.0
    second = np.argmax(follows, axis=1)
    signals[:, 5] = np.where(follows[rows, second] > 0, relative[rows, second], 0.0)
    weight = np.where(front & (beside < FLOW_SIDE_M) & (same > SAME_WAY), np.exp(-ahead / FLOW_M), 0.0)
    signals[:, 4] = (weight * relative).sum(1) / np.maximum(weight.sum(1), 1e-6)
    around = np.exp(-np.hypot(dx, dy) / AROUND_M)
    around[rows, rows] = 0.0
    whole = np.maximum(around.sum(1), 1e-6)
    signals[:, 2] = np.where((same <= SAME_WAY) | ~moving, around, 0.0).sum(1) / whole
    signals[:, 6] = (around @ speed) / whole / 2.0
    signals[:, SPEEDS] = np.clip(signals[:, SPEEDS] / 5.0, -4.0, 4.0)
    return signals
