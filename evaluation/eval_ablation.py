"""The paper's ablations: `forefield eval ablation`, the same network with and without an input, over several seeds.

For every seed the arms see the same batches in the same order. A difference is the arm's error minus its reference's
in per cent of the reference's (positive: leaving it out hurts); the reference is the full network of the same form, and
for `motion_alone` the arm without leaders, so that it tells what surrounding risk is worth to a network that sees no
one ahead. `risk_of_another` and `leader_of_another` are the full network, not trained again, that is shown what stood
around another window's vehicle: what they change is how much the network goes by it. Intervals resample seeds and
recordings together.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from rich.table import Table

from common.messages import F64, PREDICTION_FRAMES
from evaluation import prediction_scores as scoring
from evaluation.prediction_methods import as_service
from evaluation.train_predictor import Data
from evaluation.training import LEARNED_CLASSES, Options, fit, learnable
from evaluation.trajectory_windows import Windows
from services.predictor.kinematic import estimate
from services.predictor.learned import motion_of
from services.predictor.lstm import Architecture, Form
from services.predictor.settings import PredictorSettings
from services.predictor.surrounding_risk import RISK_POINTS
from services.predictor.weight_files import Loaded

REFERENCE = {
    "no_risk": "full",
    "no_attention": "full",
    "no_leader": "full",
    "motion_alone": "no_leader",
    "risk_of_another": "full",
    "leader_of_another": "full",
    "paper_no_risk": "paper",
    "paper_no_attention": "paper",
}
"""What each arm is compared with; `full` and `paper` are the references."""
OF_ANOTHER = {"risk_of_another": slice(0, RISK_POINTS), "leader_of_another": slice(RISK_POINTS, None)}
"""Which signals an arm takes from another window."""


def arms(form: Form | Literal["both"], hidden: int) -> dict[str, Architecture]:
    """The full networks and what each arm leaves out; the paper's form has no leaders to leave out."""
    full, paper = Architecture(hidden=hidden), Architecture(form="paper", hidden=hidden)
    residual_arms = {
        "full": full,
        "no_risk": replace(full, risk=False),
        "no_attention": replace(full, attention=False),
        "no_leader": replace(full, leader=False),
        "motion_alone": replace(full, leader=False, risk=False),
    }
    paper_arms = {
        "paper": paper,
        "paper_no_risk": replace(paper, risk=False),
        "paper_no_attention": replace(paper, attention=False),
    }
    return {**(residual_arms if form != "paper" else {}), **(paper_arms if form != "residual" else {})}


def ablation(
    data: Data,
    test: Windows,
    architectures: Mapping[str, Architecture],
    options: Options,
    seeds: Sequence[int],
    *,
    checkpoints: Path | None = None,
    device: str = "cpu",
    repeats: int = 2000,
    progress: Callable[[str], None] = lambda _: None,
) -> dict[str, Any]:
    """Train every arm with every seed and compare on windows of vehicles that move, pooled and by site."""
    torch.set_num_threads(1)
    chosen = learnable(test.take(test.known >= PREDICTION_FRAMES))
    chosen = chosen.take(chosen.moving)
    if not len(chosen):
        raise ValueError("no moving vehicle with 3 s of history and 6 s of future to compare on")
    error: dict[str, list[F64]] = {
        name: [] for name in (*architectures, *(OF_ANOTHER if "full" in architectures else ()))
    }
    begin, done, whole = time.monotonic(), 0, len(seeds) * len(architectures)
    for seed in seeds:
        for name, architecture in architectures.items():
            own = replace(options, seed=seed)
            file = None if checkpoints is None else checkpoints / f"{architecture.form}-{name}-{seed}.checkpoint"
            fitted = fit(architecture, data.recorded, data.generated, own, device=device, checkpoint=file)
            loaded = Loaded(name, fitted.network, (1.0, 1.0), frozenset(LEARNED_CLASSES))
            error[name].append(_errors(loaded, chosen))
            for other, columns in OF_ANOTHER.items() if name == "full" else ():
                error[other].append(_errors(loaded, _of_another(chosen, columns, seed)))
            done += 1
            to_go = (time.monotonic() - begin) / done * (whole - done)
            fde = error[name][-1][:, 2, 1].mean()
            progress(f"{done} of {whole}: seed {seed}, {name}: FDE at 6 s {fde:.2f} m; {to_go:.0f} s to go")
    stacked = {name: np.stack(e) for name, e in error.items()}
    sites = np.array(chosen.sites)[chosen.recording]
    rows = {"pooled": np.ones(len(chosen), dtype=bool), **{s: sites == s for s in sorted(set(sites))}}
    return {
        "schema": "forefield.eval_ablation.v1",
        "seeds": list(seeds),
        "windows": len(chosen),
        "options": asdict(options),
        "arms": {n: a.as_dict() for n, a in architectures.items()},
        "results": {s: _compared(stacked, chosen, r, repeats) for s, r in rows.items() if r.any()},
    }


def _of_another(data: Windows, columns: slice, seed: int) -> Windows:
    """Each window with those signals of another one, drawn at random."""
    signals = data.signals.copy()
    signals[..., columns] = data.signals[np.random.default_rng(seed).permutation(len(data)), :, columns]
    return replace(data, signals=signals)


def _errors(loaded: Loaded, data: Windows) -> F64:
    objects, frames = as_service(data)
    state = estimate(objects, frames, PredictorSettings().kinematic)
    motion = motion_of(loaded, data.x, data.y, data.cls, data.length, data.signals, state)
    return scoring.errors(np.stack((motion.x, motion.y), axis=-1), data)


def _compared(error: Mapping[str, F64], data: Windows, rows: scoring.Bool, repeats: int) -> dict[str, Any]:
    """Errors [m] of each arm and paired differences [%]; resampled by seed and by recording (one only: by track)."""
    units = data.recording[rows]
    if len(np.unique(units)) < 2:
        units = data.track[rows]
    units = np.unique(units, return_inverse=True)[1]
    drawn = scoring.resampled(units, repeats, 0)
    seeds = next(iter(error.values())).shape[0]
    drawn_seeds = scoring.resampled(np.arange(seeds), repeats, 1)
    result: dict[str, Any] = {"n": int(rows.sum()), "units": int(units.max()) + 1}
    for name, e in error.items():
        entry: dict[str, Any] = {}
        for h, k in enumerate(scoring.HORIZONS):
            for c, what in enumerate(("ade", "fde")):
                own = e[:, rows, h, c]
                per_seed = own.mean(axis=1)
                score: dict[str, Any] = {"mean": float(per_seed.mean()), "sd_of_seeds": float(per_seed.std(ddof=1))}
                reference = REFERENCE.get(name)
                if reference is not None:
                    other = error[reference][:, rows, h, c]
                    sums = [np.stack([np.bincount(units, weights=s) for s in v]) for v in (own, other)]
                    a, b = (np.einsum("rs,su,ru->r", drawn_seeds, s, drawn) for s in sums)
                    low, high = np.percentile(100.0 * (a / b - 1.0), scoring.LEVEL)
                    score["reference"] = reference
                    score["change_percent"] = float(100.0 * (own.mean() / other.mean() - 1.0))
                    score["change_ci"] = [float(low), float(high)]
                    score["seeds_worse"] = int((per_seed > other.mean(axis=1)).sum())
                entry[f"{what}_{k}"] = score
        result[name] = entry
    return result


def tables(result: Mapping[str, Any]) -> list[Table]:
    """Change at 6 s when an input is left out, pooled and by site."""
    seeds = len(result["seeds"])
    made = []
    for site, compared in result["results"].items():
        of = f"{compared['n']} windows, {compared['units']} units resampled, {seeds} seeds"
        out = Table(title=f"{site}: change of the error at 6 s when left out; {of}")
        for column in ("arm", "ADE/FDE [m]", "± by seed", "against", "ADE [%]", "FDE [%]", "seeds worse"):
            out.add_column(column, no_wrap=True)
        for arm in (a for a in compared if a not in ("n", "units")):
            ade, fde = compared[arm]["ade_60"], compared[arm]["fde_60"]
            cells = [f"{ade[k]:.2f}/{fde[k]:.2f}" for k in ("mean", "sd_of_seeds")]
            changes = ["", "", "", ""]
            if "reference" in fde:
                changes = [fde["reference"], *(_change(s) for s in (ade, fde)), f"{fde['seeds_worse']}/{seeds}"]
            out.add_row(arm, *cells, *changes)
        made.append(out)
    return made


def _change(score: Mapping[str, Any]) -> str:
    low, high = score["change_ci"]
    return f"{score['change_percent']:+.1f} ({low:+.1f} … {high:+.1f})"
