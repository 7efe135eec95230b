"""Kinematic prediction: constant velocity, and constant turn rate and acceleration (CTRA).

The state is estimated from the past alone, by backward differences. With p_k the position k frames ago and τ = 0.1 s:

    v = (p_0 − p_k) / (k τ)                                      mean of the last k steps, k by class
    ω = (∠(p_0 − p_5) − ∠(p_5 − p_10)) / 5τ                       turn rate, from the two halves of a second
    a = (|p_0 − p_5| − |p_5 − p_10|) / (5τ)² · φ / sin φ           acceleration along the path; φ = ω 5τ / 2

ω and a are taken from the last second and from the second that ended half a second ago, and only what both say
counts: noise seldom says the same twice. A turn or a braking that is far stronger than noise counts at once.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from common.geometry import wrap_angle
from common.messages import F64, FRAME_S, PREDICTION_FRAMES, SPEED_LIMIT, ObjectClass, Objects
from services.predictor.history import Bool, Frames
from services.predictor.settings import KinematicSettings

HALF = 5
"""Frames in each half of the second that gives turn rate and acceleration."""
VELOCITY_LEAST = 3
"""Fewest steps of history whose mean is preferred to the velocity in the message."""
VEHICLES = (ObjectClass.CAR, ObjectClass.TRUCK, ObjectClass.BUS)
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

    def take(self, rows: Bool) -> Motion:
        """The chosen objects alone."""
        return Motion(self.x[rows], self.y[rows], self.heading[rows], self.speed[rows])


def estimate(objects: Objects, frames: Frames, settings: KinematicSettings) -> State:
    """Current motion of the objects, from their histories.

    With fewer than three steps of history the velocity is the message's. The velocity of what moved less than
    `standing_mps` over the last second is zero, so that noise neither moves nor turns standing objects. Turn rate and
    acceleration need 1.5 s of history.
    """
    rows, steps = np.arange(len(objects.id)), frames.steps
    x0, y0 = frames.x[:, 0], frames.y[:, 0]

    def velocity(k: np.ndarray[tuple[int], np.dtype[np.int64]]) -> tuple[F64, F64]:
        span = FRAME_S * np.maximum(k, 1)
        return (x0 - frames.x[rows, k]) / span, (y0 - frames.y[rows, k]) / span

    known = steps >= VELOCITY_LEAST
    wanted = np.where(np.isin(objects.cls, VEHICLES), settings.velocity_steps, settings.other_steps)
    k = np.minimum(steps, wanted)
    vx, vy = velocity(k)
    vx, vy = np.where(known, vx, objects.vx), np.where(known, vy, objects.vy)
    wx, wy = velocity(np.minimum(steps, 2 * HALF))
    believed = _fade_in(np.where(known, np.hypot(wx, wy), np.hypot(vx, vy)), settings.standing_mps)
    factor = believed * SPEED_LIMIT / np.maximum(np.hypot(vx, vy), SPEED_LIMIT)
    vx, vy = vx * factor, vy * factor
    v, heading = np.hypot(vx, vy), wrap_angle(objects.heading)

    turns, accelerations = zip(*(_halves(frames, back, settings) for back in (0, HALF)), strict=True)
    a = _common(*accelerations)
    a = np.where(_begins(-accelerations[0], -accelerations[1], settings.braking_sure_mps2), accelerations[0], a)
    a = np.clip(a, -settings.deceleration_max_mps2, settings.acceleration_max_mps2) * believed
    a = np.where((np.abs(a) >= settings.acceleration_min_mps2) & (v > 0), a, 0.0)
    omega = _common(*turns)
    begins = _begins(turns[0], turns[1], settings.turn_sure) | _begins(-turns[0], -turns[1], settings.turn_sure)
    omega = np.where(begins, turns[0], omega)
    bound = np.minimum(settings.turn_rate_max, settings.lateral_max_mps2 / np.maximum(v, 1e-3))
    omega = np.clip(omega, -bound, bound) * _fade_in(v, settings.turn_from_mps)
    omega = np.where(np.abs(omega) >= settings.turn_rate_min, omega, 0.0)

    # the mean velocity is that of half its span ago, and its chord is shorter than the arc
    since = np.where(known, FRAME_S * k / 2, 0.0)
    speed = v / np.sinc(omega * since / np.pi) + a * since
    course = np.where(v > 0, np.arctan2(vy, vx) + omega * since, heading)
    return State(
        x=objects.x,
        y=objects.y,
        heading=heading,
        vx=vx,
        vy=vy,
        speed=np.clip(speed, 0.0, SPEED_LIMIT),
        course=wrap_angle(course),
        turn_rate=omega,
        acceleration=a,
    )


def _halves(frames: Frames, back: int, settings: KinematicSettings) -> tuple[F64, F64]:
    """ω and a of the second that ended `back` frames ago; 0 where it was not seen, or was no smooth turn."""
    span = HALF * FRAME_S
    (x0, y0), (x1, y1), (x2, y2) = ((frames.x[:, k], frames.y[:, k]) for k in (back, back + HALF, back + 2 * HALF))
    change = wrap_angle(np.arctan2(y0 - y1, x0 - x1) - np.arctan2(y1 - y2, x1 - x2))
    v1, v2 = np.hypot(x1 - x2, y1 - y2) / span, np.hypot(x0 - x1, y0 - y1) / span
    smooth = (frames.steps >= back + 2 * HALF) & (np.abs(change) < TURN_AROUND)
    turning = smooth & (np.minimum(v1, v2) >= settings.turn_from_mps)
    change = np.where(turning, change, 0.0)
    return change / span, np.where(smooth, (v2 - v1) / (span * np.sinc(change / (2 * np.pi))), 0.0)


def _common(a: F64, b: F64) -> F64:
    """What both say: the smaller magnitude where the signs agree, otherwise 0."""
    return np.asarray(np.where(a * b > 0, np.copysign(np.minimum(np.abs(a), np.abs(b)), a), 0.0))


def _begins(now: F64, before: F64, sure: float) -> Bool:
    """Whether the last second alone says it: beyond `sure`, growing, and not against what the second before says."""
    return np.asarray((now > sure) & (now > before) & (before > -sure / 4))


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
    """Turn rate and acceleration go on as `speeds_ahead` and `turn_decay_s` say; the turn ends with the motion.

    Each step is the chord of an arc: Δs · sin(Δψ/2) / (Δψ/2) along the mean course; the body turns with the course.
    """
    v = speeds_ahead(state.speed, state.acceleration, settings)
    before = np.concatenate((state.speed[:, None], v[:, :-1]), axis=1)
    v_mean = (before + v) / 2
    # the turn rate is held while the speed is, and falls with it
    share = np.minimum(v_mean / np.maximum(state.speed, 1e-9)[:, None], 1.0)
    mid = FRAME_S * (np.arange(PREDICTION_FRAMES) + 0.5)
    turn = state.turn_rate[:, None] * FRAME_S * share * np.exp(-mid / settings.turn_decay_s)
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
