"""Training of the predictor: `forefield train predictor --tracks FILES … --out DIR`.

Trains the network and its ablations, fits the ridge baseline, and writes a folder of weights with its model card.
Recorded and generated tables (recordings named `sumo_…`) fill batches apart. Whole sites may be held out; otherwise
every fifth recording of each site is. Nothing is trained on held-out windows; the figures in the card are theirs.
"""

from __future__ import annotations

import gzip
import hashlib
import json
import platform
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from common.messages import PREDICTION_FRAMES
from common.risk import RiskParameters
from evaluation import prediction_scores as scoring
from evaluation.eval_prediction import unseen
from evaluation.prediction_methods import as_service
from evaluation.ridge import Ridge
from evaluation.training import LEARNED_CLASSES, Fitted, Options, Pool, augmented, fit, learnable
from evaluation.trajectory_windows import Recording, Windows, joined, recordings, windows
from services.predictor.kinematic import constant_velocity, estimate
from services.predictor.learned import motion_of
from services.predictor.lstm import Architecture
from services.predictor.settings import PredictorSettings
from services.predictor.weight_files import CARD, SCHEMA, SHARE, SPREAD_FRAMES, Loaded, save

GENERATED = "sumo_"
"""How recordings of generated traffic are named."""
LEAST_FUTURE = 10
"""Recorded windows with at least so many frames of future are trained on."""
RIDGE_WINDOWS = 40_000
"""Windows that ridge regression is fitted to."""
HELD = 5
"""Every fifth recording is held out where no site is."""
LIMITS = (
    "Trained on cars on one motorway and one signalised arterial, and on generated cars and trucks: it speaks for "
    "cars, trucks and buses; cycles and pedestrians stay kinematic.",
    "Generated traffic holds to lanes and rules; real traffic of other countries does less.",
    "It knows no map: which way a branch is taken shows only in the motion of the last three seconds.",
    "It gives one trajectory. Its spread is one radius for all speeds, measured on held-out recordings of the places "
    "it was trained on: elsewhere fewer positions lie within it.",
    "Across a junction without lanes it turns less than drivers do.",
)


@dataclass(frozen=True)
class Plan:
    """One network to train."""

    name: str
    architecture: Architecture
    steps: int


def plans(names: Sequence[str], hidden: int, steps: int) -> list[Plan]:
    """The networks that a folder of weights may hold."""
    known = {
        "lstm": Architecture(hidden=hidden),
        "lstm_no_risk": Architecture(hidden=hidden, risk=False),
        "lstm_no_attention": Architecture(hidden=hidden, attention=False),
        "lstm_no_leader": Architecture(hidden=hidden, leader=False),
        "lstm_paper": Architecture(form="paper", hidden=hidden),
    }
    unknown = [n for n in names if n not in known]
    if unknown:
        raise ValueError(f"no network {unknown[0]!r}; there are {', '.join(known)}")
    return [Plan(n, known[n], steps) for n in names]


@dataclass(frozen=True)
class Data:
    """Windows to train on and to validate with."""

    recorded: Windows
    generated: Windows | None
    validation: Windows


def digests(files: Sequence[Path]) -> dict[str, str]:
    """SHA-256 of each table's text, whatever packed it."""
    found = {}
    for f in files:
        with (gzip.open if f.name.endswith(".gz") else open)(f, "rb") as table:
            found[f.name] = hashlib.file_digest(table, "sha256").hexdigest()
    return found


def read(
    files: Sequence[Path],
    hold_out: Sequence[str],
    risk: RiskParameters,
    stride: int,
    progress: Callable[[str, int, int], None] = unseen,
) -> Data:
    """Read tables and split them by site, or by recording; `progress` gets what is done, how far, of how much.

    Raises:
        ScenarioError: a table cannot be used.
        ValueError: a site to hold out is not there, or nothing is left to train on.
    """
    found = [r for f in files for r in recordings(f)]
    sites = sorted({r.site for r in found})
    for site in hold_out:
        if site not in sites:
            raise ValueError(f"no site {site!r} to hold out; there are {', '.join(sites)}")
    held = [r for r in found if _held(r, found, hold_out)]
    kept = [r for r in found if r not in held]
    recorded = [r for r in kept if not r.name.startswith(GENERATED)]
    generated = [r for r in kept if r.name.startswith(GENERATED)]

    def cut(what: str, chosen: Sequence[Recording], every: int, least: int = PREDICTION_FRAMES) -> Windows:
        told = partial(progress, f"windows, {what}")
        return learnable(windows(chosen, risk, stride=every, future_least=least, progress=told))

    data = Data(
        cut("recorded", recorded, max(1, stride // 2), LEAST_FUTURE),
        cut("generated", generated, 2 * stride) if generated else None,
        cut("held out", held, stride),
    )
    if not len(data.recorded) and (data.generated is None or not len(data.generated)):
        raise ValueError("no moving vehicle with 3 s of history in these tables: nothing to train on")
    return data


def _held(recording: Recording, found: Sequence[Recording], hold_out: Sequence[str]) -> bool:
    if hold_out:
        return recording.site in hold_out
    if recording.name.startswith(GENERATED):
        return False
    return sorted(r.name for r in found if r.site == recording.site).index(recording.name) % HELD == HELD - 1


def train(
    data: Data,
    wanted: Sequence[Plan],
    out: Path,
    options: Options,
    *,
    shrink: tuple[float, float],
    device: str,
    about: Mapping[str, Any],
    progress: Callable[[str, int, int, float, float, float], None] = lambda *_: None,
) -> dict[str, Any]:
    """Train, write the folder and return the card. Checkpoints in it let an interrupted training go on."""
    torch.set_num_threads(1)
    out.mkdir(parents=True, exist_ok=True)
    networks: dict[str, Any] = {}
    curves: dict[str, Fitted] = {}
    moving = data.validation.take(data.validation.known >= PREDICTION_FRAMES)
    moving = moving.take(moving.moving)
    for plan in wanted:
        own = Options(**{**asdict(options), "steps": plan.steps})

        def told(*a: Any, name: str = plan.name) -> None:
            progress(name, *a)

        fitted = fit(
            plan.architecture, data.recorded, data.generated, own,
            validation=data.validation, device=device, checkpoint=out / f"{plan.name}.checkpoint", progress=told,
        )  # fmt: skip
        curves[plan.name] = fitted
        entry = save(out, plan.name, fitted.network)
        loaded = Loaded(plan.name, fitted.network, shrink, frozenset(LEARNED_CLASSES))
        networks[plan.name] = {
            **entry,
            "shrink": list(shrink),
            "steps": plan.steps,
            **figures(loaded, moving),
        }
    card = {
        "schema": SCHEMA,
        "default": wanted[0].name,
        "classes": [c.name.lower() for c in LEARNED_CLASSES],
        "networks": networks,
        "ridge": _ridge(data, options).save(out),
        "data": {
            "recorded_windows": len(data.recorded),
            "recorded_sites": sorted({data.recorded.sites[i] for i in np.unique(data.recorded.recording)}),
            "generated_windows": 0 if data.generated is None else len(data.generated),
            "held_out_windows": len(moving),
            "held_out": sorted({data.validation.sites[i] for i in np.unique(data.validation.recording)}),
        },
        "options": asdict(options),
        "limits": list(LIMITS),
        "made": datetime.now(UTC).strftime("%Y-%m-%d"),
        "versions": {"torch": torch.__version__, "python": platform.python_version()},
        **about,
    }
    (out / CARD).write_text(json.dumps(card, indent=1) + "\n")
    curve(curves, out / "training.png")
    return card


def _ridge(data: Data, options: Options) -> Ridge:
    """The baseline, fitted to what the networks see: the same shares, augmentation and noise."""
    rng = np.random.default_rng([options.seed, 7])
    parts = []
    share = options.recorded_share if data.generated is not None else 1.0
    for windows_, part in ((data.recorded, share), (data.generated, 1.0 - share)):
        whole = None if windows_ is None else windows_.take(windows_.known >= PREDICTION_FRAMES)
        if whole is not None and len(whole):
            parts.append(augmented(Pool(whole).draw(round(RIDGE_WINDOWS * part), rng), rng, options))
    if not parts:
        raise ValueError("no window with 6 s of future: nothing to fit the ridge baseline to")
    return Ridge.fit(joined(parts))


def figures(loaded: Loaded, data: Windows) -> dict[str, Any]:
    """On windows of vehicles that move: ADE and FDE [m], their ratios to constant velocity, and the spread [m]."""
    if not len(data):
        return {"held_out": {}}
    objects, frames = as_service(data)
    state = estimate(objects, frames, PredictorSettings().kinematic)
    straight = constant_velocity(state)
    motion = motion_of(loaded, data.x, data.y, data.cls, data.length, data.signals, state)
    own, base = (scoring.errors(np.stack((m.x, m.y), axis=-1), data).mean(axis=0) for m in (motion, straight))
    away = np.hypot(motion.x - data.future[..., 0], motion.y - data.future[..., 1])
    radii = np.quantile(away[:, np.asarray(SPREAD_FRAMES) - 1], SHARE, axis=0)
    held_out = {
        str(k): {
            "ade": round(float(own[h, 0]), 3),
            "fde": round(float(own[h, 1]), 3),
            "ade_ratio": round(float(own[h, 0] / base[h, 0]), 3),
            "fde_ratio": round(float(own[h, 1] / base[h, 1]), 3),
        }
        for h, k in enumerate(scoring.HORIZONS)
    }
    return {"held_out": held_out, "spread": [round(float(r), 2) for r in radii]}


def curve(fitted: Mapping[str, Fitted], path: Path) -> None:
    """Training and validation loss over the steps, as a picture."""
    import matplotlib as mpl

    mpl.use("agg")
    from matplotlib import pyplot as plt

    figure, axis = plt.subplots(figsize=(7, 4))
    for name, f in fitted.items():
        if f.curve:
            steps, training, held = zip(*f.curve, strict=True)
            (line,) = axis.plot(steps, training, lw=1, label=name)
            axis.plot(steps, held, lw=1, ls="--", color=line.get_color())
    axis.set_xlabel("step")
    axis.set_ylabel("loss [m²], dashed: held out")
    axis.set_yscale("log")
    axis.legend(fontsize=7)
    figure.savefig(path, dpi=120, bbox_inches="tight")
    plt.close(figure)
