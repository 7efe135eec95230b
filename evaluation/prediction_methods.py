"""What every method predicts for the same windows: kinematic, map-based, ridge, every network, and the policies.

Networks come from one folder of weights; `policy_…` compose methods as the service does. Without a map every object
counts as off the lanes.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from common.messages import F64, FRAME_S, HISTORY_FRAMES, Map, Method, Objects
from evaluation.ridge import Ridge
from evaluation.trajectory_windows import Windows
from services.predictor.blend import lane_path_network_speed
from services.predictor.history import Bool, Frames
from services.predictor.kinematic import Motion, State, constant_velocity, ctra, estimate
from services.predictor.lanes import LaneIndex
from services.predictor.learned import motion_of
from services.predictor.map_based import map_based
from services.predictor.selection import DRIVES_ON_LANES, POLICIES, Known, kinematic_method
from services.predictor.settings import Policy, PredictorSettings
from services.predictor.weight_files import SHIPPED, Loaded, WeightsError, load, read_card

POLICY_METHODS: dict[str, Policy] = {
    "policy_paper": "paper",
    "policy_learned_first": "learned-first",
    "policy_learned_on_lanes": "learned-on-lanes",
    "policy_map_first": "map-first",
    "policy_kinematic": "kinematic",
}
ROWS = 2048
PLAIN_STEPS = 5
"""`constant_velocity` is the mean of so many steps; `constant_velocity_gated` is the service's own."""


@dataclass(frozen=True)
class Case:
    """Windows of one file, and its map if there is one."""

    data: Windows
    map: Map | None


@dataclass(frozen=True)
class Models:
    """What `--weights` holds."""

    networks: Mapping[str, Loaded]
    ridge: Ridge | None
    default: str

    @staticmethod
    def of(folder: Path | None = None) -> Models:
        """Load all networks of a folder, or the shipped ones.

        Raises:
            WeightsError: there is no such folder, or one of them is refused.
        """
        if folder is not None and not folder.is_dir():
            raise WeightsError(f"{folder}: no such folder of weights")
        folder = SHIPPED if folder is None else folder
        card = read_card(folder)
        networks = {name: load(folder, name) for name in card["networks"]}
        entry = card.get("ridge")
        return Models(networks, Ridge.load(folder, entry) if entry else None, str(card["default"]))


def predictions(case: Case, models: Models, settings: PredictorSettings) -> dict[str, F64]:
    """Positions of every method, shape [n, 60, 2] each."""
    parts: dict[str, list[F64]] = {}
    for i in range(0, len(case.data), ROWS):
        data = case.data.take(np.arange(i, min(i + ROWS, len(case.data))))
        for name, motion in _predicted(data, case.map, models, settings).items():
            parts.setdefault(name, []).append(motion)
    return {name: np.concatenate(p) for name, p in parts.items()}


def as_service(data: Windows) -> tuple[Objects, Frames]:
    """Windows as the service would hold them: objects now and their histories."""
    n = len(data)
    objects = Objects(
        id=np.arange(n, dtype=np.int64),
        cls=data.cls,
        x=data.x[:, 0],
        y=data.y[:, 0],
        heading=data.heading[:, 0],
        vx=(data.x[:, 0] - data.x[:, 1]) / 0.1,
        vy=(data.y[:, 0] - data.y[:, 1]) / 0.1,
        length=data.length,
        width=data.width,
        mass=np.zeros(n),
    )
    known = np.ones((n, HISTORY_FRAMES), dtype=bool)
    return objects, Frames(data.x, data.y, data.heading, known, known)


def plain_state(data: Windows, state: State) -> State:
    """The usual definition of constant velocity: the mean velocity of the last five steps, of everyone."""
    span = FRAME_S * PLAIN_STEPS
    vx, vy = ((p[:, 0] - p[:, PLAIN_STEPS]) / span for p in (data.x, data.y))
    return replace(state, vx=vx, vy=vy)


def _predicted(data: Windows, map: Map | None, models: Models, settings: PredictorSettings) -> dict[str, F64]:
    objects, frames = as_service(data)
    state = estimate(objects, frames, settings.kinematic)
    motions: dict[str, Motion] = {
        "constant_velocity": constant_velocity(plain_state(data, state)),
        "constant_velocity_gated": constant_velocity(state),
        "ctra": ctra(state, settings.kinematic),
    }
    on_lane = np.zeros(len(data), dtype=bool)
    followed = motions["constant_velocity_gated"]
    if map is not None and map.lanes:
        index = LaneIndex.of(map)
        match = index.match(state, settings.map)
        on_lane = (match.lane >= 0) & DRIVES_ON_LANES[data.cls]
        if on_lane.any():
            part = map_based(state.take(on_lane), match.take(on_lane), index, settings.map, settings.kinematic)
            followed = _with(followed, part, on_lane)
        motions["map_based"] = followed
    for name, loaded in models.networks.items():
        motions[name] = motion_of(loaded, data.x, data.y, data.cls, data.length, data.signals, state)
    default = models.networks[models.default]
    speaks = np.isin(data.cls, [int(c) for c in default.classes])
    known = Known(on_lane, speaks, data.cls, kinematic_method(state, data.cls))
    by_method = {
        Method.CONSTANT_VELOCITY: motions["constant_velocity_gated"],
        Method.CTRA: motions["ctra"],
        Method.MAP_BASED: followed,
        Method.LSTM: motions[models.default],
    }
    if map is not None:
        learned = motions[models.default]
        if on_lane.any():
            part = lane_path_network_speed(state.take(on_lane), followed.take(on_lane), learned.take(on_lane))
            learned = _with(learned, part, on_lane)
        motions["lstm_on_lanes"] = learned
    on_lanes = {**by_method, Method.LSTM: motions.get("lstm_on_lanes", motions[models.default])}
    for name, policy in (*POLICY_METHODS.items(), ("policy_default", settings.policy)):
        parts = on_lanes if policy == "learned-on-lanes" else by_method
        motions[name] = _composed(POLICIES[policy](known), parts)
    positions = {name: np.stack((m.x, m.y), axis=-1) for name, m in motions.items()}
    if models.ridge is not None:
        positions["ridge"] = models.ridge.predict(data, state)
    return positions


def _with(base: Motion, part: Motion, rows: Bool) -> Motion:
    merged = Motion(base.x.copy(), base.y.copy(), base.heading.copy(), base.speed.copy())
    for name in ("x", "y", "heading", "speed"):
        getattr(merged, name)[rows] = getattr(part, name)
    return merged


def _composed(method: np.ndarray[Any, np.dtype[np.uint8]], by_method: Mapping[Method, Motion]) -> Motion:
    result = by_method[Method.CONSTANT_VELOCITY]
    for m, motion in by_method.items():
        rows = method == m
        if rows.any():
            result = _with(result, motion.take(rows), rows)
    return result
