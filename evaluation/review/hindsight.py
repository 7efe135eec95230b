"""Prediction error in hindsight: the recording holds both what was predicted and what then happened.

An error is the distance between the predicted displacement after a horizon and the one perceived: position against
position, of the same object, from the same moment. Only objects that were perceived at both moments count. Beside each
method stands constant velocity from the same moments: what no model at all would have given.
"""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass
from typing import Any

import numpy as np

from common.messages import F64, FRAME_S, Method
from evaluation.review.recording import Foreseen, Recording, Seen
from viz.account import HORIZONS_S

MOVING_MPS = 0.5
"""Whoever is slower at the moment of the prediction counts as standing [m/s]."""
LATE_S = FRAME_S / 4
"""What was perceived within this of a moment counts as perceived then [s]."""


@dataclass(frozen=True)
class Errors:
    """Errors of one group at one horizon: [n] [m], and constant velocity's at the same moments."""

    method: F64
    constant_velocity: F64


Group = tuple[str, bool]
"""Name of the method, and whether the object moved."""


def errors(recording: Recording) -> dict[Group, list[Errors]]:
    """Every error by method and by whether the object moved, a list with an entry for each horizon."""
    frames = recording.seen
    at = np.array([seen.t for seen in frames])
    index = [{int(i): k for k, i in enumerate(seen.id)} for seen in frames]
    found: dict[Group, list[list[tuple[float, float]]]] = defaultdict(lambda: [[] for _ in HORIZONS_S])
    for foreseen in recording.foreseen:
        now = _frame(at, foreseen.t)
        if now is None:
            continue
        later = [_frame(at, foreseen.t + h) for h in HORIZONS_S]
        for k, identity in enumerate(foreseen.id):
            start = index[now].get(int(identity))
            if start is None:
                continue
            group = (Method(int(foreseen.method[k])).name.lower(), _moves(frames[now], start))
            for h, then in enumerate(later):
                end = None if then is None else index[then].get(int(identity))
                if then is not None and end is not None:
                    found[group][h].append(_error(foreseen, k, h, frames[now], start, frames[then], end))
    return {
        group: [Errors(*np.array(rows).reshape(-1, 2).T) for rows in by_horizon]
        for group, by_horizon in sorted(found.items())
    }


def _frame(at: F64, t: float) -> int | None:
    """The frame perceived at a time."""
    if not len(at):
        return None
    k = int(np.clip(np.searchsorted(at, t), 1, len(at) - 1)) if len(at) > 1 else 0
    k = k - 1 if k and abs(at[k - 1] - t) < abs(at[k] - t) else k
    return k if abs(at[k] - t) <= LATE_S else None


def _moves(seen: Seen, k: int) -> bool:
    return bool(np.hypot(seen.vx[k], seen.vy[k]) >= MOVING_MPS)


def _error(
    foreseen: Foreseen, k: int, h: int, seen: Seen, start: int, then: Seen, end: int
) -> tuple[float, float]:  # fmt: skip
    dx, dy = float(then.x[end] - seen.x[start]), float(then.y[end] - seen.y[start])
    ahead = HORIZONS_S[h]
    plain = float(np.hypot(seen.vx[start] * ahead - dx, seen.vy[start] * ahead - dy))
    return float(np.hypot(foreseen.dx[k, h] - dx, foreseen.dy[k, h] - dy)), plain


def table(found: dict[Group, list[Errors]]) -> list[dict[str, Any]]:
    """Rows `{method, moving, horizon_s, n, mean_m, p50_m, p95_m, constant_velocity_mean_m}`."""
    rows = []
    for (method, moving), by_horizon in found.items():
        for horizon, e in zip(HORIZONS_S, by_horizon, strict=True):
            if not len(e.method):
                continue
            rows.append(
                {
                    "method": method,
                    "moving": moving,
                    "horizon_s": horizon,
                    "n": len(e.method),
                    "mean_m": round(float(np.mean(e.method)), 3),
                    "p50_m": round(float(np.median(e.method)), 3),
                    "p95_m": round(float(np.percentile(e.method, 95)), 3),
                    "constant_velocity_mean_m": round(float(np.mean(e.constant_velocity)), 3),
                }
            )
    return rows
