"""What the networks read and write: an object's own frame, inputs X, and the basis of the outputs Z.

The own frame has its origin at the object's present position and its x axis along the displacement of the last half
second, for what hardly moved along the body. In it, with p_i the positions of the history, v the constant velocity and
τ = 0.1 s:

    paper form      X_i = (p_i / 10 m, 9 surrounding risks)
    residual form   X_i = (p_i − (p_0 + v t_i), (p_i − p_{i−1}) / τ − v, 9 surrounding risks, leader signals)

The residual form's output is an acceleration at every half second beside the constant velocity, and a correction of
that velocity; integrated twice (`basis`) it gives 60 positions that leave the present smoothly.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from common.messages import F32, F64, FRAME_S, HISTORY_FRAMES, PREDICTION_FRAMES, U8, ObjectClass
from services.predictor.surrounding_risk import RISK_POINTS

AXIS_FRAMES = 5
"""The own frame's x axis is the displacement over so many frames."""
AXIS_M = 0.25
"""Displacement below which the body's heading is taken instead [m]."""
POSITION_SCALE = 10.0
"""Positions of the paper form are given in units of this [m]."""
KNOT_FRAMES = 5
"""Frames between the knots of the residual acceleration."""
KNOTS = PREDICTION_FRAMES // KNOT_FRAMES
BASIS = KNOTS + 1
"""Coefficients of one coordinate: the velocity's correction, then the accelerations."""
CONTEXT = 7
"""Class (4), speed, its square, length."""
GATE_MPS = (0.5, 1.0)
"""The residual fades in between these current speeds [m/s]."""

SHRINK_MPS = (8.0, 12.0)
"""Between these speeds the shrinkage of the residual goes over from the slow to the fast value [m/s]."""

_KIND = np.zeros(len(ObjectClass), dtype=np.int64)
_KIND[[ObjectClass.TRUCK, ObjectClass.BUS]] = 1
_KIND[[ObjectClass.MOTORCYCLE, ObjectClass.BICYCLE]] = 2
_KIND[ObjectClass.PEDESTRIAN] = 3


@dataclass(frozen=True)
class OwnFrame:
    """Present positions and axes of n objects, `map` frame."""

    x: F64  # [m]
    y: F64
    cos: F64
    sin: F64

    @staticmethod
    def of(x: F64, y: F64, heading: F64) -> OwnFrame:
        """From histories [n, 30], newest first, and the present headings [n]."""
        dx, dy = x[:, 0] - x[:, AXIS_FRAMES], y[:, 0] - y[:, AXIS_FRAMES]
        length = np.hypot(dx, dy)
        moved = length >= AXIS_M
        safe = np.where(moved, length, 1.0)
        return OwnFrame(
            x[:, 0],
            y[:, 0],
            np.where(moved, dx / safe, np.cos(heading)),
            np.where(moved, dy / safe, np.sin(heading)),
        )

    def into(self, x: F64, y: F64) -> F64:
        """Points [n, k] of the `map` frame in the own frames, shape [n, k, 2]."""
        dx, dy = x - self.x[:, None], y - self.y[:, None]
        return self.turned_into(np.stack((dx, dy), axis=-1))

    def turned_into(self, v: F64) -> F64:
        """Vectors [n, k, 2] of the `map` frame in the own frames."""
        c, s = self.cos[:, None], self.sin[:, None]
        return np.stack((v[..., 0] * c + v[..., 1] * s, v[..., 1] * c - v[..., 0] * s), axis=-1)

    def turned_out(self, v: npt.NDArray[np.floating]) -> F64:
        """Vectors [n, k, 2] of the own frames in the `map` frame."""
        c, s = self.cos[:, None], self.sin[:, None]
        return np.stack((v[..., 0] * c - v[..., 1] * s, v[..., 0] * s + v[..., 1] * c), axis=-1)


def plain_inputs(own: F64, signals: F32) -> F32:
    """X of the paper form, oldest first, shape [n, 30, 11]; `own`: positions in the own frame, newest first."""
    x = np.concatenate((own / POSITION_SCALE, signals[..., :RISK_POINTS]), axis=-1)
    return np.ascontiguousarray(x[:, ::-1], dtype=np.float32)


def residual_inputs(own: F64, velocity: F64, signals: F32) -> F32:
    """X of the residual form, oldest first, shape [n, 30, 4 + SIGNALS]; `velocity` [n, 2] in the own frame [m/s]."""
    t = -FRAME_S * np.arange(HISTORY_FRAMES)
    deviation = own - velocity[:, None] * t[:, None]
    steps = np.zeros_like(own)
    steps[:, :-1] = (own[:, :-1] - own[:, 1:]) / FRAME_S - velocity[:, None]
    steps[:, -1] = steps[:, -2]
    x = np.concatenate((deviation / 2.0, steps / 2.0, signals), axis=-1)
    return np.ascontiguousarray(np.clip(x[:, ::-1], -20.0, 20.0), dtype=np.float32)


def context(cls: U8, length: F64, velocity: F64) -> F32:
    """What does not change over the history, shape [n, CONTEXT]."""
    speed = np.hypot(velocity[:, 0], velocity[:, 1]) / 10.0
    kind = np.eye(4)[_KIND[cls]]
    return np.concatenate((kind, np.stack((speed, speed**2 / 4.0, length / 5.0), axis=-1)), axis=-1).astype(np.float32)


def gate(speed: npt.NDArray[np.floating]) -> npt.NDArray[np.floating]:
    """The stop gate: 0 for what stands, 1 from 1 m/s on; `speed` is the current one [m/s]."""
    low, high = GATE_MPS
    return np.asarray(np.clip((speed - low) / (high - low), 0.0, 1.0))


def shrinkage(speed: npt.NDArray[np.floating], shrink: tuple[float, float]) -> npt.NDArray[np.floating]:
    """How much of the residual is taken at a speed [m/s]: `shrink` in the city, and on fast roads."""
    return np.asarray(np.interp(speed, SHRINK_MPS, shrink))


def basis() -> F32:
    """Positions [m] at the 60 frames from the coefficients of one coordinate, shape [60, BASIS].

    Column 0: velocity correction, t. Column k: the acceleration at knot k, linear between knots (zero now),
    integrated twice over frames of 0.1 s.
    """
    frames = np.arange(PREDICTION_FRAMES + 1)
    knots = np.arange(KNOTS + 1) * KNOT_FRAMES
    hats = np.stack([np.interp(frames, knots, np.eye(KNOTS + 1)[k]) for k in range(1, KNOTS + 1)], axis=-1)
    a = (hats[1:] + hats[:-1]) / 2
    v = np.cumsum(a, axis=0) * FRAME_S
    before = np.concatenate((np.zeros((1, KNOTS)), v[:-1]))
    positions = np.cumsum((before + v) / 2, axis=0) * FRAME_S
    return np.concatenate((FRAME_S * frames[1:, None], positions), axis=1).astype(np.float32)
