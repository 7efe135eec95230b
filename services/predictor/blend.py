"""The lane says where, the network says how fast: an object's predicted arc length, laid along its lane's path.

With s_i the arc length of the network's positions and P the path of the map-based prediction (straight on beyond its
end), the position is P(s_i). Networks here know no map, and a map knows neither leaders nor habits of speed.
"""

from __future__ import annotations

import numpy as np

from common.messages import F64, FRAME_S
from services.predictor.kinematic import Motion, State

BEYOND_M = 1000.0
"""How far a path goes on straight [m]."""
SHORT_M = 1.0
"""A mapped path shorter than this gives no direction: the network's own positions stay [m]."""


def lane_path_network_speed(state: State, mapped: Motion, learned: Motion) -> Motion:
    """Motion of n objects on the mapped paths at the learned speeds."""
    px, py = _with_start(state.x, mapped.x), _with_start(state.y, mapped.y)
    s = np.cumsum(np.hypot(np.diff(px, axis=1), np.diff(py, axis=1)), axis=1, dtype=np.float64)
    s = np.concatenate((np.zeros((len(s), 1)), s), axis=1)
    lx, ly = _with_start(state.x, learned.x), _with_start(state.y, learned.y)
    steps = np.hypot(np.diff(lx, axis=1), np.diff(ly, axis=1))
    wanted = np.cumsum(steps, axis=1)
    x, y, heading = learned.x.copy(), learned.y.copy(), learned.heading.copy()
    headings = np.concatenate((mapped.heading[:, :1], mapped.heading, mapped.heading[:, -1:]), axis=1)
    for k in np.flatnonzero(s[:, -1] >= SHORT_M):
        # the last metre of the path, not its last step, gives the direction beyond
        back = int(np.searchsorted(s[k], s[k, -1] - SHORT_M, side="right")) - 1
        length = s[k, -1] - s[k, back]
        at = np.append(s[k], s[k, -1] + BEYOND_M)
        ex = px[k, -1] + (px[k, -1] - px[k, back]) / length * BEYOND_M
        ey = py[k, -1] + (py[k, -1] - py[k, back]) / length * BEYOND_M
        x[k] = np.interp(wanted[k], at, np.append(px[k], ex))
        y[k] = np.interp(wanted[k], at, np.append(py[k], ey))
        heading[k] = np.interp(wanted[k], at, headings[k])
    return Motion(x=x, y=y, heading=heading, speed=np.asarray(steps / FRAME_S))


def _with_start(now: F64, ahead: F64) -> F64:
    return np.concatenate((now[:, None], ahead), axis=1)
