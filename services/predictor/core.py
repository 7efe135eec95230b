"""The predictor: what is perceived now → where everything will be during the next six seconds.

One step: observe the objects into their histories, estimate their motion, find their lanes, choose a method for each,
predict. The only state is the tracks of the last seconds and the index of the last map.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
from msgspec.structs import replace

from common.geometry import wrap_angle
from common.messages import (
    F32,
    F64,
    FRAME_S,
    HISTORY_FRAMES,
    SPEED_LIMIT,
    XY_LIMIT,
    Ego,
    Map,
    Method,
    Objects,
    Prediction,
    Stamped,
)
from services.predictor.blend import lane_path_network_speed
from services.predictor.features import gate
from services.predictor.history import Bool, Frames, Tracks, frames, observe
from services.predictor.kinematic import Motion, State, constant_velocity, ctra, estimate
from services.predictor.lanes import LaneIndex, Match
from services.predictor.map_based import map_based
from services.predictor.selection import DRIVES_ON_LANES, Choice, Known, Learned, choose, full_history, kinematic_method
from services.predictor.settings import PredictorSettings

if TYPE_CHECKING:
    from common.risk import RiskParameters


class Predictor:
    """Predicts all objects of one vehicle's surroundings.

    `risk` holds the parameters of the surrounding risk, an input of learned predictors; `learned` is such a predictor,
    or None: then a policy that wants one falls back, and `detail` says so.
    """

    def __init__(self, settings: PredictorSettings, risk: RiskParameters, learned: Learned | None = None) -> None:
        self.settings = settings
        self.risk = risk
        self.detail: Mapping[str, str] = {"policy": settings.policy}
        """How the last objects were predicted, for the status."""
        self._learned = learned
        self._tracks = Tracks.empty()
        self._map: Map | None = None
        self._lanes: LaneIndex | None = None

    def step(self, objects: Stamped[Objects], ego: Stamped[Ego] | None, map: Map | None) -> Prediction:
        """Predict every object of one message; an empty list gives an empty prediction.

        A message captured before the last one adds nothing to the histories and is predicted without any.
        """
        seen, settings = objects.value, self.settings
        tracks = observe(self._tracks, seen, objects.capture_ns, settings.history)
        if tracks is self._tracks:
            tracks = observe(Tracks.empty(), seen, objects.capture_ns, settings.history)
        else:
            self._tracks = tracks
        history = frames(tracks, seen.id)
        state = estimate(seen, history, settings.kinematic)
        match, on_lane = self._match(seen, state, map)
        full = full_history(history)
        if self._learned is not None:
            self._learned.observe(seen, history, ego, objects.capture_ns)
            full &= self._learned.classes[seen.cls]
        known = Known(on_lane, full, seen.cls, kinematic_method(state, seen.cls))
        choice = choose(settings.policy, known, self._learned is not None)
        self.detail = _detail(settings.policy, choice)
        motion = self._predict(seen, history, state, match, choice)
        prediction = _prediction(seen, state, history, motion, choice, settings.past_frames)
        return replace(prediction, sigma=self._sigma(state, choice)) if settings.learned.spread else prediction

    def _sigma(self, state: State, choice: Choice) -> F32 | None:
        """Spread of every object at the 60 frames [m]; 0 where none is known: other methods, and what stands."""
        if self._learned is None or self._learned.spread is None:
            return None
        moving = (choice.method == Method.LSTM) & (gate(np.hypot(state.vx, state.vy)) > 0)
        return np.asarray(moving[:, None] * self._learned.spread, dtype=np.float32)

    def _match(self, objects: Objects, state: State, map: Map | None) -> tuple[Match | None, Bool]:
        if map is not self._map:
            self._map, self._lanes = map, None if map is None else LaneIndex.of(map)
        if self._lanes is None:
            return None, np.zeros(len(objects.id), dtype=bool)
        match = self._lanes.match(state, self.settings.map)
        return match, (match.lane >= 0) & DRIVES_ON_LANES[objects.cls]

    def _predict(
        self,
        objects: Objects,
        history: Frames,
        state: State,
        match: Match | None,
        choice: Choice,
    ) -> Motion:
        motion = constant_velocity(state)
        rows = choice.method == Method.CTRA
        if rows.any():
            _put(motion, rows, ctra(state.take(rows), self.settings.kinematic))
        learned = choice.method == Method.LSTM
        if learned.any() and self._learned is not None:
            _put(motion, learned, self._learned.predict(objects, history, state, learned))
        if match is None or self._lanes is None:
            return motion
        # on the lanes' paths, all together: at the map's speeds, or at those that the network has just told
        mapped, on_lanes = choice.method == Method.MAP_BASED, np.zeros_like(learned)
        if self.settings.policy == "learned-on-lanes" and self._learned is not None:
            on_lanes = learned & (match.lane >= 0) & DRIVES_ON_LANES[objects.cls]
        rows = mapped | on_lanes
        if rows.any():
            settings = self.settings
            paths = map_based(state.take(rows), match.take(rows), self._lanes, settings.map, settings.kinematic)
            _put(motion, mapped, paths.take(mapped[rows]))
            if on_lanes.any():
                told = paths.take(on_lanes[rows]), motion.take(on_lanes)
                _put(motion, on_lanes, lane_path_network_speed(state.take(on_lanes), *told))
        return motion


def _put(motion: Motion, rows: Bool, part: Motion) -> None:
    motion.x[rows], motion.y[rows] = part.x, part.y
    motion.heading[rows], motion.speed[rows] = part.heading, part.speed


def _prediction(
    objects: Objects, state: State, history: Frames, motion: Motion, choice: Choice, past_frames: int
) -> Prediction:
    past_x, past_y = _past(state, history, past_frames)
    return Prediction(
        id=objects.id,
        cls=objects.cls,
        x0=objects.x,
        y0=objects.y,
        heading0=state.heading,
        vx0=state.vx,
        vy0=state.vy,
        length=objects.length,
        width=objects.width,
        mass=objects.mass,
        x=np.clip(motion.x, -XY_LIMIT, XY_LIMIT),
        y=np.clip(motion.y, -XY_LIMIT, XY_LIMIT),
        heading=(motion.heading - _turns(motion.heading)).astype(np.float32),
        speed=np.clip(motion.speed, 0.0, SPEED_LIMIT).astype(np.float32),
        past_x=np.clip(past_x, -XY_LIMIT, XY_LIMIT),
        past_y=np.clip(past_y, -XY_LIMIT, XY_LIMIT),
        method=choice.method,
    )


def _turns(heading: F64) -> F64:
    """Whole turns to take off so that the first heading lies in [−π, π) and the others go on from there."""
    first = heading[:, :1]
    return np.asarray(first - wrap_angle(first))


def _past(state: State, history: Frames, n: int) -> tuple[F64, F64]:
    """Where the objects were, oldest first, one frame ago last [n, h]; straight back where they were not seen."""
    k = np.arange(n, 0, -1)
    unseen = np.maximum(k - history.steps[:, None], 0) * FRAME_S
    k = np.minimum(k, HISTORY_FRAMES - 1)
    return history.x[:, k] - state.vx[:, None] * unseen, history.y[:, k] - state.vy[:, None] * unseen


def _detail(policy: str, choice: Choice) -> dict[str, str]:
    counts = np.bincount(choice.method, minlength=len(Method))
    detail = {"policy": policy, "methods": ", ".join(f"{m.name.lower()} {counts[m]}" for m in Method if counts[m])}
    if choice.missed.any():
        detail["learned"] = f"wanted for {int(choice.missed.sum())} objects, none is loaded"
    return detail
