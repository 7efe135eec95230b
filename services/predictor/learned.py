"""The learned predictor in service: samples of what stood around, one batch through the network, motion out.

    p(t) = p_0 + v t + gate(|v|) · shrink(|v|) · (Z(t) − v t)

with Z from p_0 on and v, the constant velocity, from the kinematic state, so that what stands stays where it is.
Headings follow the course of the predicted positions; speeds are their steps.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from common.geometry import wrap_angle
from common.messages import F32, F64, FRAME_S, PREDICTION_FRAMES, U8, Ego, ObjectClass, Objects, Stamped
from common.risk import RiskParameters
from services.predictor import features, signals
from services.predictor.history import Bool, Frames
from services.predictor.kinematic import Motion, State, constant_velocity
from services.predictor.selection import LEARNED_POLICIES
from services.predictor.settings import PredictorSettings
from services.predictor.surrounding_risk import VELOCITY_STEPS
from services.predictor.weight_files import SHIPPED, Loaded, WeightsError, load

GAP_NS = 1_000_000_000
COURSE_MPS = 0.5
"""Predicted speed below which the heading is held [m/s]."""


def load_learned(settings: PredictorSettings, risk: RiskParameters) -> tuple[LearnedPredictor | None, str]:
    """The predictor that the policy asks for, warmed up; otherwise None and the reason for the status.

    An empty reason: the policy wants no network. One thread: more of them only disturb the other services.
    """
    if settings.policy not in LEARNED_POLICIES:
        return None, ""
    torch.set_num_threads(1)
    chosen = settings.learned
    try:
        loaded = load(Path(chosen.weights) if chosen.weights else SHIPPED, chosen.network)
    except WeightsError as e:
        return None, f"refused, kinematic instead: {e}"
    learned = LearnedPredictor(loaded, risk)
    learned.warm_up()
    return learned, loaded.name


class LearnedPredictor:
    """A network with the samples of the last three seconds."""

    def __init__(self, loaded: Loaded, risk: RiskParameters) -> None:
        self.loaded = loaded
        self.name = loaded.name
        self.classes: Bool = np.isin(np.arange(len(ObjectClass)), [int(c) for c in loaded.classes])
        """By class: whether the network speaks for it."""
        self.spread = loaded.spread
        self._risk = risk
        self._samples: signals.Samples = ()

    def warm_up(self) -> None:
        """Run once, so that the first frame is as fast as the others."""
        x = np.zeros((32, 30, 4 + signals.SIGNALS), dtype=np.float32)
        with torch.inference_mode():
            self.loaded.network(torch.from_numpy(x), torch.zeros(32, features.CONTEXT))

    def observe(self, objects: Objects, history: Frames, ego: Stamped[Ego] | None, capture_ns: int) -> None:
        """Sample surrounding risk and leaders of every object of one message."""
        scene = signals.scene_of(objects, history, None if ego is None else ego.value)
        reads_risk = self.loaded.network.architecture.risk
        values = signals.instant_signals(scene, len(objects.id), self._risk, risk=reads_risk)
        self._samples = signals.observed(self._samples, capture_ns, objects.id, values, GAP_NS)

    def predict(self, objects: Objects, history: Frames, state: State, wanted: Bool) -> Motion:
        """Motion of the objects where `wanted` (each with 30 frames of history), one row for each of these."""
        around = signals.history(self._samples, objects.id[wanted])
        return motion_of(
            self.loaded,
            history.x[wanted],
            history.y[wanted],
            objects.cls[wanted],
            objects.length[wanted],
            around,
            state.take(wanted),
        )


def motion_of(loaded: Loaded, x: F64, y: F64, cls: U8, length: F64, around: F32, state: State) -> Motion:
    """Motion of n objects from histories [n, 30] (newest first) and signals [n, 30, SIGNALS]."""
    frame = features.OwnFrame.of(x, y, state.heading)
    own = frame.into(x, y)
    velocity = (own[:, 0] - own[:, VELOCITY_STEPS]) / (VELOCITY_STEPS * FRAME_S)
    straight = constant_velocity(state)
    speed = np.hypot(state.vx, state.vy)
    share = (features.gate(speed) * features.shrinkage(speed, loaded.shrink))[:, None]
    plain = loaded.network.architecture.form == "paper"
    inputs = features.plain_inputs(own, around) if plain else features.residual_inputs(own, velocity, around)
    context = features.context(cls, length, velocity)
    with torch.inference_mode():
        z = loaded.network(torch.from_numpy(inputs), torch.from_numpy(context)).numpy().astype(np.float64)
    if not plain:
        z += velocity[:, None] * (FRAME_S * np.arange(1, PREDICTION_FRAMES + 1))[:, None]
    ahead = frame.turned_out(z)
    dx, dy = ahead[..., 0] + state.x[:, None] - straight.x, ahead[..., 1] + state.y[:, None] - straight.y
    return along(straight.x + share * dx, straight.y + share * dy, state)


def along(x: F64, y: F64, state: State) -> Motion:
    """Positions [n, 60] with the speeds of their steps, and the body turning with their course."""
    steps_x = np.diff(x, axis=1, prepend=state.x[:, None])
    steps_y = np.diff(y, axis=1, prepend=state.y[:, None])
    speed = np.hypot(steps_x, steps_y) / FRAME_S
    course = np.arctan2(steps_y, steps_x)
    turns = np.zeros_like(course)
    turns[:, 1:] = wrap_angle(np.diff(course, axis=1))
    believed = np.minimum(speed, np.concatenate((speed[:, :1], speed[:, :-1]), axis=1)) > COURSE_MPS
    # a reversal of the last centimetres is not a turn
    turns = np.where(believed & (np.abs(turns) < 0.5), turns, 0.0)
    offset = wrap_angle(course[:, 0] - state.course)
    offset = np.where(believed[:, 0] & (np.abs(offset) < 0.5), offset, 0.0)
    return Motion(x=x, y=y, heading=(state.heading + offset)[:, None] + np.cumsum(turns, axis=1), speed=speed)
