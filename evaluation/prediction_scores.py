"""Scores of predictions: ADE, FDE and misses at 2, 4 and 6 s, by group, with bootstrap intervals.

ADE at k frames: mean distance over frames 1 … k [m]; FDE: the distance at frame k [m]; miss: FDE above 2 m. Intervals
resample recordings (with fewer than two of them: tracks), so that windows that overlap do not count as many.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from common.messages import F64, I64, ObjectClass
from evaluation.trajectory_windows import Windows
from services.predictor.kinematic import VEHICLES

HORIZONS = (20, 40, 60)
"""Frames of 0.1 s."""
MISS_M = 2.0
FIGURES = (
    "ade",
    "fde",
    "miss",
    "resampled_by",
    "ade_ci",
    "ade_ratio",
    "ade_ratio_ci",
    "fde_ci",
    "fde_ratio",
    "fde_ratio_ci",
)
LEVEL = (2.5, 97.5)
"""Percentiles of the intervals."""
CYCLES = (ObjectClass.MOTORCYCLE, ObjectClass.BICYCLE)

Bool = npt.NDArray[np.bool_]
Score = dict[str, Any]


def groups(data: Windows) -> dict[str, Bool]:
    """Which windows belong to which group."""
    moving = data.moving
    vehicle, cycle = np.isin(data.cls, VEHICLES), np.isin(data.cls, CYCLES)
    pedestrian = data.cls == ObjectClass.PEDESTRIAN
    return {
        "all": np.ones(len(data), dtype=bool),
        "moving": moving,
        "vehicle_moving": vehicle & moving,
        "pedestrian_moving": pedestrian & moving,
        "cycle_moving": cycle & moving,
        "vehicle_stopped": vehicle & ~moving,
        "pedestrian_stopped": pedestrian & ~moving,
        "cycle_stopped": cycle & ~moving,
    }


def errors(positions: F64, data: Windows) -> F64:
    """Mean and final distance at every horizon [m], shape [n, horizon, (mean, final)]."""
    distance = np.linalg.norm(positions - data.future, axis=-1)
    return np.stack([np.stack((distance[:, :k].mean(1), distance[:, k - 1]), axis=-1) for k in HORIZONS], axis=1)


def resampled(units: I64, repeats: int, seed: int) -> F64:
    """How often each of the distinct units is drawn in each repeat, shape [repeats, u]."""
    u = int(units.max(initial=-1)) + 1
    rng = np.random.default_rng(seed)
    return rng.multinomial(u, np.full(u, 1.0 / u), size=repeats).astype(np.float64) if u else np.zeros((repeats, 0))


def scores(
    error: F64, reference: F64, data: Windows, rows: Bool, *, repeats: int = 1000, seed: int = 0
) -> dict[str, Score]:
    """Scores of the windows `rows`, by horizon; `reference`: constant velocity's errors, for paired ratios.

    Without a window `n` is 0 and every figure None.
    """
    chosen = np.flatnonzero(rows)
    if not len(chosen):
        return {str(k): {**dict.fromkeys(FIGURES), "n": 0, "recordings": 0} for k in HORIZONS}
    units = data.recording[chosen]
    by = "recording"
    if len(np.unique(units)) < 2:
        units, by = data.track[chosen], "track"
    units = np.unique(units, return_inverse=True)[1]
    drawn = resampled(units, repeats, seed)
    count = np.bincount(units).astype(np.float64)
    drawn_count = drawn @ count
    result: dict[str, Score] = {}
    for h, k in enumerate(HORIZONS):
        e, r = error[chosen, h], reference[chosen, h]
        score: Score = {"ade": float(e[:, 0].mean()), "fde": float(e[:, 1].mean())}
        score |= {"miss": float((e[:, 1] > MISS_M).mean()), "n": len(chosen), "resampled_by": by}
        score["recordings"] = len(np.unique(data.recording[chosen]))
        for c, name in enumerate(("ade", "fde")):
            sums, reference_sums = (np.bincount(units, weights=v[:, c]) for v in (e, r))
            score[f"{name}_ci"] = _interval(drawn @ sums / drawn_count) if len(count) > 1 else None
            base = float(r[:, c].mean())
            score[f"{name}_ratio"] = score[name] / base if base > 0 else None
            with np.errstate(divide="ignore", invalid="ignore"):
                ratios = (drawn @ sums) / (drawn @ reference_sums)
            fine = len(count) > 1 and bool(np.isfinite(ratios).all())
            score[f"{name}_ratio_ci"] = _interval(ratios) if fine else None
        result[str(k)] = score
    return result


def _interval(values: F64) -> list[float]:
    low, high = np.percentile(values, LEVEL)
    return [float(low), float(high)]
