"""Ridge regression on the history points: the baseline that a network must beat.

Twelve points of the history in the own frame, as deviations from constant velocity, and the speed predict the 60
deviations of the future by one linear map. Its weights are one more safetensors file of a folder of weights.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from safetensors.numpy import load as load_tensors
from safetensors.numpy import save as save_tensors

from common.messages import F64, FRAME_S, PREDICTION_FRAMES
from evaluation.trajectory_windows import Windows
from services.predictor import features
from services.predictor.kinematic import State, constant_velocity
from services.predictor.surrounding_risk import VELOCITY_STEPS
from services.predictor.weight_files import WeightsError

POINTS = (1, 2, 3, 4, 6, 8, 10, 13, 16, 20, 24, 29)
"""Frames of the history that are read."""
PENALTY = 1e-3


@dataclass(frozen=True)
class Ridge:
    """future deviation = inputs · weights."""

    weights: F64  # [26, 120]

    @staticmethod
    def inputs(data: Windows) -> tuple[F64, F64, features.OwnFrame]:
        """Regressors [n, 26], velocity in the own frame [n, 2], and the frame."""
        frame = features.OwnFrame.of(data.x, data.y, data.heading[:, 0])
        own = frame.into(data.x, data.y)
        velocity = (own[:, 0] - own[:, VELOCITY_STEPS]) / (VELOCITY_STEPS * FRAME_S)
        points = np.asarray(POINTS)
        deviation = own[:, points] + velocity[:, None] * (FRAME_S * points)[:, None]
        speed = np.hypot(velocity[:, 0], velocity[:, 1])
        z = np.concatenate((deviation.reshape(len(own), -1), np.stack((np.ones_like(speed), speed / 10), -1)), axis=1)
        return z, velocity, frame

    @staticmethod
    def fit(data: Windows) -> Ridge:
        """Least squares over windows with 60 frames of future."""
        z, velocity, frame = Ridge.inputs(data)
        ahead = frame.into(data.future[..., 0], data.future[..., 1])
        t = FRAME_S * np.arange(1, PREDICTION_FRAMES + 1)
        y = (ahead - velocity[:, None] * t[:, None]).reshape(len(z), -1)
        gram = z.T @ z / len(z) + PENALTY * np.eye(z.shape[1])
        return Ridge(np.asarray(np.linalg.solve(gram, z.T @ y / len(z)), dtype=np.float64))

    def predict(self, data: Windows, state: State) -> F64:
        """Positions [n, 60, 2], behind the same stop gate as the networks."""
        z, _, frame = Ridge.inputs(data)
        turned = frame.turned_out((z @ self.weights).reshape(len(z), PREDICTION_FRAMES, 2))
        straight = constant_velocity(state)
        gate = features.gate(np.hypot(state.vx, state.vy))[:, None, None]
        return np.asarray(np.stack((straight.x, straight.y), axis=-1) + gate * turned)

    def save(self, folder: Path) -> dict[str, Any]:
        """Write the file; return its entry in the card."""
        data = save_tensors({"weights": self.weights.astype(np.float32)})
        (folder / "ridge.safetensors").write_bytes(data)
        return {"file": "ridge.safetensors", "sha256": hashlib.sha256(data).hexdigest(), "bytes": len(data)}

    @staticmethod
    def load(folder: Path, entry: Mapping[str, Any]) -> Ridge:
        """Read the file.

        Raises:
            WeightsError: missing, changed, or of another shape.
        """
        path = folder / Path(str(entry["file"])).name
        try:
            data = path.read_bytes()
            if hashlib.sha256(data).hexdigest() != entry["sha256"]:
                raise WeightsError(f"{path}: its SHA-256 is not the card's")
            weights = load_tensors(data)["weights"].astype(np.float64)
        except (OSError, KeyError) as e:
            raise WeightsError(f"{path}: {e}") from None
        if weights.shape != (2 * len(POINTS) + 2, 2 * PREDICTION_FRAMES) or not np.isfinite(weights).all():
            raise WeightsError(f"{path}: weights of shape {weights.shape}")
        return Ridge(weights)
