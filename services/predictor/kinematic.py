"""Kinematic prediction: constant velocity, and constant turn rate and acceleration (CTRA).

The state is estimated from the past alone, by backward differences. With p_k the position k frames ago and τ = 0.1 s:

    v   = (p_0 − p_k) / (k τ)                                   mean of the last k steps
    ω   = (∠(p_0 − p_h) − ∠(p_h − p_2h)) / (h τ)                 turn rate, from the two halves of the last second
    v_i = |chord_i| / (h τ) · φ / sin φ,   φ = ω h τ / 2          speed in each half, exact on a circle
    a   = (v_2 − v_1) / (h τ)                                   acceleration along the path
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from common.geometry import wrap_angle
from common.messages import F64, FRAME_S, PREDICTION_FRAMES, SPEED_LIMIT, Objects
from services.predictor.history import Bool, Frames
from services.predictor.settings import KinematicSettings

HALF = 5
"""Frames in each half of the window that gives turn rate and acceleration; at least HALF_LEAST."""
HALF_LEAST = 3
VELOCITY_LEAST = 3
"""Fewest steps of history whose mean is preferred to the velocity in the message."""
TURN_AROUND = 1.5
"""A course that changes by more than this between the halves is not a turn but a reversal or noise [rad]."""


@dataclass(frozen=True)
class State:
    """Motion of n objects now, `map` frame."""

    x: F64  # centre [m]
    y: F64
    heading: F64  # body yaw in [−π, π) [rad]
    vx: F64  # mean velocity of the last steps; 0 for what stands [m/s]
    vy: F64
    speed: F64  # speed at this instant, along the path [m/s]
    course: F64  # direction of motion at this instant; the heading for what stands [rad]
    turn_rate: F64  # of the course [rad/s]; 0: none believed
    acceleration: F64  # along the path [m/s²]; 0 where unknown

    def take(self, rows: Bool) -> State:
        """The chosen objects alone."""
        return State(*(getattr(self, name)[rows] for name in self.__dataclass_fields__))


@dataclass(frozen=True)
class Motion:
    """Predicted motion, shape [n, 60]: frame i lies (i + 1) · 0.1 s ahead."""

    x: F64  # [m]
    y: F64
    heading: F64  # body yaw [rad], continuous
    speed: F64  # ≥ 0 [m/s]


def estimate(objects: Objects, frames: Frames, settings: KinematicSettings) -> State:
    """Current motion of the objects, from their histories.

    With fewer than three steps of history the velocity is the message's. The velocity of what moved less than
    `standing_mps` over the last second is zero, so that noise neither moves nor turns standing objects.
    """
    n = len(objects.id)
    rows, steps = np.arange(n), frames.steps
    x0, y0 = frames.x[:, 0], frames.y[:, 0]

    def velocity(k: np.ndarray[tuple[int], np.dtype[np.int64]]) -> tuple[F64, F64]:
        span = FRAME_S * np.maximum(k, 1)
        return (x0 - frames.x[rows, k]) / span, (y0 - frames.y[rows, k]) / span

    known = steps >= VELOCITY_LEAST
    vx, vy = velocity(np.minimum(steps, settings.velocity_steps))
    vx, vy = np.where(known, vx, objects.vx), np.where(known, vy, objects.vy)
    wx, wy = velocity(np.minimum(steps, 2 * HALF))
    window = np.where(known, np.hypot(wx, wy), np.hypot(vx, vy))
    fast = SPEED_LIMIT / np.maximum(np.hypot(vx, vy), SPEED_LIMIT)
    factor = fast * _fade_in(window, settings.standing_mps)
    vx, vy = vx * factor, vy * factor
    v = np.hypot(vx, vy)
    heading = wrap_angle(objects.heading)

    # the two halves of the last second
    h = np.minimum(steps // 2, HALF)
    halves = h >= HALF_LEAST
    xh, yh = frames.x[rows, h], frames.y[rows, h]
    x2, y2 = x0 - xh, y0 - yh
    x1, y1 = xh - frames.x[rows, 2 * h], yh - frames.y[rows, 2 * h]
    span = FRAME_S * np.maximum(h, 1)
    v1, v2 = np.hypot(x1, y1) / span, np.hypot(x2, y2) / span
    change = wrap_angle(np.arctan2(y2, x2) - np.arctan2(y1, x1))
    halves &= np.abs(change) < TURN_AROUND
    omega = np.where(halves, change, 0.0) / span
    arc = 1.0 / np.sinc(omega * span / (2 * np.pi))  # φ / sin φ
    v1, v2 = v1 * arc, v2 * arc
    a = np.where(halves, (v2 - v1) / span, 0.0)
    a = np.clip(a, -settings.deceleration_max_mps2, settings.acceleration_max_mps2)
    a = a * _fade_in(window, settings.standing_mps)
    bound = np.minimum(settings.turn_rate_max, settings.lateral_max_mps2 / np.maximum(v2, 1e-3))
    omega = np.clip(omega, -bound, bound) * _fade_in(np.minimum(v1, v2), settings.turn_from_mps)
    turning = np.abs(omega) >= settings.turn_rate_min

    speed = np.where(halves, np.maximum(v2 + a * span / 2, 0.0), v)
    course = np.where(turning, np.arctan2(y2, x2) + omega * span / 2, np.arctan2(vy, vx))
    return State(
        x=objects.x,
        y=objects.y,
        heading=heading,
        vx=vx,
        vy=vy,
        speed=np.minimum(speed, SPEED_LIMIT) * (v > 0),
        course=wrap_angle(np.where(v > 0, course, heading)),
        turn_rate=np.where(turning & (v > 0), omega, 0.0),
        acceleration=np.where(v > 0, a, 0.0),
    )


def constant_velocity(state: State) -> Motion:
    """Hold the mean velocity of the last steps; the heading stays."""
    t = FRAME_S * np.arange(1, PREDICTION_FRAMES + 1)
    still = np.zeros(PREDICTION_FRAMES)
    return Motion(
        x=state.x[:, None] + state.vx[:, None] * t,
        y=state.y[:, None] + state.vy[:, None] * t,
        heading=state.heading[:, None] + still,
        speed=np.hypot(state.vx, state.vy)[:, None] + still,
    )


def ctra(state: State, settings: KinematicSettings) -> Motion:
    """Constant turn rate, with the speeds of `speeds_ahead`; the turn ends with the motion.

    Each step is the chord of an arc: Δs · sin(Δψ/2) / (Δψ/2) along the mean course; the body turns with the course.
    """
    v = speeds_ahead(state.speed, state.acceleration, settings)
    before = np.concatenate((state.speed[:, None], v[:, :-1]), axis=1)
    v_mean = (before + v) / 2
    # the turn rate is held while the speed is, and falls with it
    share = np.minimum(v_mean / np.maximum(state.speed, 1e-9)[:, None], 1.0)
    turn = state.turn_rate[:, None] * FRAME_S * share
    turned = np.cumsum(turn, axis=1)
    chord = v_mean * FRAME_S * np.sinc(turn / (2 * np.pi))
    course = state.course[:, None] + turned - turn / 2
    return Motion(
        x=state.x[:, None] + np.cumsum(chord * np.cos(course), axis=1),
        y=state.y[:, None] + np.cumsum(chord * np.sin(course), axis=1),
        heading=state.heading[:, None] + turned,
        speed=v,
    )


def speeds_ahead(speed: F64, acceleration: F64, settings: KinematicSettings) -> F64:
    """Speed at the 60 frames [m/s], shape [n, 60]: never below zero, never rising again after a brake.

    An acceleration fades, a = a_0 e^(−t/τ). Hard braking is held until the object rests: a driver who brakes hard has
    a reason that lasts. Between `braking_from` and `braking_held` the two blend.
    """
    t = FRAME_S * np.arange(1, PREDICTION_FRAMES + 1)
    tau = settings.acceleration_decay_s
    held = braking(acceleration, settings)[:, None]
    gained = held * t + (1.0 - held) * tau * (1.0 - np.exp(-t / tau))
    return np.asarray(np.clip(speed[:, None] + acceleration[:, None] * gained, 0.0, SPEED_LIMIT))


def braking(acceleration: F64, settings: KinematicSettings) -> F64:
    """How much of a deceleration is held, 0 … 1."""
    width = max(settings.braking_held_mps2 - settings.braking_from_mps2, 1e-6)
    return np.asarray(np.clip((-acceleration - settings.braking_from_mps2) / width, 0.0, 1.0))


def _fade_in(value: F64, start: float) -> F64:
    """0 up to `start`, 1 from twice that on."""
    return np.asarray(np.clip(value / start - 1.0, 0.0, 1.0))
