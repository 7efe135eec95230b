"""How good predictions are: `forefield eval prediction --tracks FILES | --scenarios FILES`.

Windows of recorded traffic, the errors of every method (`prediction_methods`) on them, and their scores pooled, by site
and by recording.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from common.messages import F64
from common.risk import RiskParameters
from evaluation import prediction_scores as scoring
from evaluation.prediction_methods import Case, Models, predictions
from evaluation.trajectory_windows import Recorded, Recording, Windows, gate_is_open, joined, recordings, windows
from rig.settings import RigSettings
from rig.sources import load_scenario
from rig.world import Scenario, Track
from services.predictor.settings import PredictorSettings


def unseen(what: str, done: int, whole: int) -> None:
    """Tell nobody."""


def track_cases(
    files: Sequence[Path], risk: RiskParameters, stride: int, progress: Callable[[str, int, int], None] = unseen
) -> list[Case]:
    """Windows of trajectory tables; all are read before the first is worked on.

    `progress` gets what is being done, how much of it is done, and how much there is.
    """
    found = []
    for k, f in enumerate(files):
        progress("read", k, len(files))
        found.append(recordings(f))
    return [
        Case(windows(r, risk, stride=stride, progress=partial(progress, f"windows of {f.name}")), None)
        for f, r in zip(files, found, strict=True)
    ]


def scenario_cases(
    files: Sequence[str],
    risk: RiskParameters,
    settings: RigSettings,
    stride: int,
    progress: Callable[[str, int, int], None] = unseen,
) -> list[Case]:
    """Windows of scenarios with their maps; the recorded driver in the ego's place is one of the objects."""
    cases = []
    for k, f in enumerate(files):
        world = load_scenario(f, settings=settings)
        cases.append(Case(windows([as_recording(world)], risk, stride=stride), world.map))
        progress("windows of scenarios", k + 1, len(files))
    return cases


def as_recording(world: Scenario) -> Recording:
    """A scenario's recorded traffic; its site is the place that the name begins with."""
    tracks = [*world.tracks, *((world.human,) if world.human is not None else ())]
    return Recording(world.name, world.name.split("-")[0], tuple(_recorded(t) for t in tracks))


def _recorded(t: Track) -> Recorded:
    return Recorded(str(t.id), int(t.cls), t.length, t.width, t.frame0, t.x, t.y, t.heading)


def evaluate(
    cases: Sequence[Case],
    models: Models,
    settings: PredictorSettings,
    *,
    repeats: int = 1000,
    progress: Callable[[str, int, int], None] = unseen,
) -> dict[str, Any]:
    """Scores of every method, pooled, by site and by recording: the JSON of the command."""
    torch.set_num_threads(1)
    found: list[tuple[Windows, dict[str, F64]]] = []
    for k, case in enumerate(cases):
        if len(case.data):
            positions = predictions(case, models, settings)
            found.append((case.data, {m: scoring.errors(p, case.data) for m, p in positions.items()}))
        progress("predictions", k + 1, len(cases))
    if not found:
        raise ValueError("no window of 30 frames of history and 60 of future")
    methods = [m for m in found[0][1] if all(m in e for _, e in found)]
    data = joined([d for d, _ in found])
    error = {m: np.concatenate([e[m] for _, e in found]) for m in methods}
    sites = sorted(set(data.sites))
    site = np.array(data.sites)[data.recording]
    used = [i for i in range(len(data.names)) if (data.recording == i).any()]
    return {
        "schema": "forefield.eval_prediction.v1",
        "windows": len(data),
        "recordings": len(used),
        "horizons": list(scoring.HORIZONS),
        "default_network": models.default,
        "policy_default": settings.policy,
        "results": _results(error, data, np.ones(len(data), dtype=bool), repeats),
        "sites": {s: _results(error, data, site == s, repeats) for s in sites},
        "spread": {
            s: within_spread(error, data, rows, models)
            for s, rows in (("pooled", np.ones(len(data), dtype=bool)), *((s, site == s) for s in sites))
        },
        "per_recording": {
            name: _results(error, data, data.recording == i, min(repeats, 200))
            for i, name in zip(used, _distinct(data, used), strict=True)
        },
    }


def within_spread(
    error: Mapping[str, F64], data: Windows, rows: scoring.Bool, models: Models
) -> dict[str, dict[str, dict[str, float]]]:
    """How many positions lie within the spread that a network's card tells, of those that it speaks for and that move.

    By network and horizon: the spread [m], the share within it, and the number of windows.
    """
    result: dict[str, dict[str, dict[str, float]]] = {}
    for name, loaded in models.networks.items():
        speaks = rows & np.isin(data.cls, [int(c) for c in loaded.classes]) & gate_is_open(data)
        if loaded.spread is not None and speaks.any():
            away = error[name][speaks, :, 1]
            result[name] = {
                str(k): {
                    "spread": float(loaded.spread[k - 1]),
                    "within": float((away[:, h] <= loaded.spread[k - 1]).mean()),
                    "n": len(away),
                }
                for h, k in enumerate(scoring.HORIZONS)
            }
    return result


def _distinct(data: Windows, used: Sequence[int]) -> list[str]:
    """Names of recordings, with their site where two sites have the same."""
    names = [data.names[i] for i in used]
    return [f"{data.sites[i]}/{n}" if names.count(n) > 1 else n for i, n in zip(used, names, strict=True)]


def _results(error: Mapping[str, F64], data: Windows, rows: scoring.Bool, repeats: int) -> dict[str, Any]:
    chosen = data.take(rows)
    groups = scoring.groups(chosen)
    reference = error["constant_velocity"][rows]
    return {
        method: {
            name: scoring.scores(e[rows], reference, chosen, members, repeats=repeats)
            for name, members in groups.items()
        }
        for method, e in error.items()
    }
