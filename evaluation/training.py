"""Fitting a network to windows: batches, augmentation, the loss, checkpoints that resume.

Every batch draws a share of recorded windows and fills up with generated ones, each site alike by the square root of
its size. Augmentation happens on positions before the own frame is laid, so that noise turns the frame as it does in
service. Futures may be shorter than 60 frames: frames beyond `known` carry no loss.
"""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from common.messages import F32, F64, FRAME_S, PREDICTION_FRAMES
from evaluation.trajectory_windows import Windows, gate_is_open
from services.predictor import features
from services.predictor.kinematic import VEHICLES
from services.predictor.leader import SPEEDS
from services.predictor.lstm import Architecture, Network
from services.predictor.surrounding_risk import RISK_POINTS, VELOCITY_STEPS

MIRROR = np.array([2, 1, 0, 5, 4, 3, 8, 7, 6])
"""The nine points seen in a mirror."""
CHECK_STEPS = 100
"""Steps between two checks on what is held out, and between checkpoints."""
LEARNED_CLASSES = VEHICLES
"""The class rule: networks learn from and speak for these alone."""


@dataclass(frozen=True)
class Options:
    """How to train."""

    steps: int = 1000
    batch: int = 128
    rate: float = 1e-3
    warm_up: int = 60
    decay: float = 0.02
    clip: float = 1.0
    recorded_share: float = 0.2
    """Share of recorded windows in each batch, the rest is generated."""
    speed_scale: float = 0.35
    """Speeds are scaled by e^±this."""
    turn_rad: float = 0.05
    """Own frames are laid askew by up to this."""
    noise_m: float = 0.3
    """Largest deviation of correlated noise of the positions [m], small ones oftener; white noise gets a third."""
    late: float = 1.0
    """Errors at time t weigh (0.5 s + t)^−late: 0 counts metres alike, 1 leaves the far end a little more."""
    average: float = 0.995
    """Weights are averaged exponentially over the steps, by this factor."""
    seed: int = 0


@dataclass(frozen=True)
class Batch:
    """Network inputs and targets, own frame."""

    x: F32
    context: F32
    target: F32  # positions (paper form) or residual to constant velocity [m], [n, 60, 2]
    weight: F32  # [n, 60]


class Pool:
    """Windows to draw from, every place alike by the square root of its number of windows."""

    def __init__(self, data: Windows) -> None:
        self.data = data
        groups = np.array([_place(n, s) for n, s in zip(data.names, data.sites, strict=True)])[data.recording]
        _, group, count = np.unique(groups, return_inverse=True, return_counts=True)
        weight = 1.0 / np.sqrt(count)
        self.chance = weight[group] / weight[group].sum() if len(data) else np.zeros(0)
        self._sum = np.cumsum(self.chance)

    def draw(self, n: int, rng: np.random.Generator) -> Windows:
        """n windows with replacement."""
        rows = np.searchsorted(self._sum, rng.random(n) * self._sum[-1])
        return self.data.take(np.minimum(rows, len(self.data) - 1))


def _place(recording: str, site: str) -> str:
    """Generated recordings are places of their own by network (`sumo_NETWORK_…`), recorded ones by site."""
    return "_".join(recording.split("_")[:2]) if recording.startswith("sumo_") else site


def learnable(data: Windows) -> Windows:
    """Windows of the learned classes whose present speed opens the stop gate."""
    return data.take(np.isin(data.cls, LEARNED_CLASSES) & gate_is_open(data))


def augmented(data: Windows, rng: np.random.Generator, options: Options) -> Windows:
    """Windows mirrored, faster or slower, and with noise in their histories; each about its own present position."""
    n = len(data)
    ox, oy = data.x[:, :1], data.y[:, :1]
    flip = np.where(rng.random(n) < 0.5, -1.0, 1.0)[:, None]
    scale = np.exp(rng.uniform(-1.0, 1.0, n) * options.speed_scale)[:, None]
    noise = _noise(rng, n, data.x.shape[1], options.noise_m)
    ahead = (data.future[..., 0] - ox) * scale, (data.future[..., 1] - oy) * scale * flip
    risk = np.where(flip[:, :, None] < 0, data.signals[..., MIRROR], data.signals[..., :RISK_POINTS])
    leader = data.signals[..., RISK_POINTS:].copy()
    leader[..., SPEEDS] *= scale[:, :, None]
    return replace(
        data,
        x=(data.x - ox) * scale + noise[..., 0],
        y=(data.y - oy) * scale * flip + noise[..., 1],
        heading=data.heading * flip,
        future=np.stack(ahead, axis=-1),
        signals=np.concatenate((risk, leader), axis=-1),
    )


def batch_of(data: Windows, form: str, rng: np.random.Generator | None, options: Options) -> Batch:
    """Inputs and targets; with a generator they are augmented."""
    if rng is not None:
        data = augmented(data, rng, options)
    x, y, future, signals = data.x, data.y, data.future, data.signals
    heading, length = data.heading[:, 0], data.length
    frame = features.OwnFrame.of(x, y, heading)
    if rng is not None:
        a = rng.uniform(-1.0, 1.0, len(data)) * options.turn_rad
        c, s = np.cos(a), np.sin(a)
        frame = features.OwnFrame(frame.x, frame.y, frame.cos * c - frame.sin * s, frame.sin * c + frame.cos * s)
    own, ahead = frame.into(x, y), frame.into(future[..., 0], future[..., 1])
    velocity = (own[:, 0] - own[:, VELOCITY_STEPS]) / (VELOCITY_STEPS * FRAME_S)
    t = FRAME_S * np.arange(1, PREDICTION_FRAMES + 1)
    if form == "paper":
        inputs, target = features.plain_inputs(own, signals), ahead
    else:
        inputs = features.residual_inputs(own, velocity, signals)
        target = ahead - velocity[:, None] * t[:, None]
    weight = (np.arange(PREDICTION_FRAMES) < data.known[:, None]) * (0.5 + t) ** -options.late
    return Batch(
        inputs,
        features.context(data.cls, length, velocity),
        target.astype(np.float32),
        weight.astype(np.float32),
    )


def _noise(rng: np.random.Generator, n: int, frames: int, size: float) -> F64:
    """Correlated and white noise of positions [m], shape [n, frames, 2]; strength differs between windows."""
    strength = size * rng.random((n, 1, 1)) ** 2
    white = rng.standard_normal((n, frames, 2))
    phase, period = rng.uniform(0, 2 * np.pi, (n, 1, 2)), rng.uniform(0.8, 4.0, (n, 1, 2))
    slow = np.sin(2 * np.pi * FRAME_S * np.arange(frames)[None, :, None] / period + phase)
    return np.asarray(strength * (white / 3.0 * rng.random((n, 1, 1)) + slow))


def loss_of(network: Network, batch: Batch, device: str) -> torch.Tensor:
    """Weighted mean square error [m²]."""
    x, context, target, weight = (torch.from_numpy(a).to(device) for a in _arrays(batch))
    error = ((network(x, context) - target) ** 2).sum(-1)
    mean: torch.Tensor = (error * weight).sum() / weight.sum().clamp(min=1e-6)
    return mean


def _arrays(batch: Batch) -> tuple[F32, ...]:
    return batch.x, batch.context, batch.target, batch.weight


@dataclass
class Fitted:
    """A trained network and how it came about."""

    network: Network
    curve: list[tuple[int, float, float]]
    """Step, training loss, validation loss (NaN without)."""


@dataclass
class _Run:
    """A training under way: all that changes with its steps, and what a checkpoint holds."""

    architecture: Architecture
    options: Options
    network: Network
    average: Network
    """Its weights, averaged over the steps: what is kept in the end."""
    optimiser: torch.optim.Optimizer
    step: int = 0
    curve: list[tuple[int, float, float]] = field(default_factory=list)

    @staticmethod
    def begun(architecture: Architecture, options: Options, device: str) -> _Run:
        torch.manual_seed(options.seed)
        network = Network(architecture).to(device)
        average = Network(architecture).to(device)
        average.load_state_dict(network.state_dict())
        optimiser = torch.optim.AdamW(network.parameters(), lr=options.rate, weight_decay=options.decay)
        return _Run(architecture, options, network, average, optimiser)

    @property
    def _identity(self) -> str:
        return json.dumps([self.architecture.as_dict(), asdict(self.options)], sort_keys=True)

    def save(self, path: Path) -> None:
        """Write a checkpoint, whole or not at all."""
        state: dict[str, Any] = {"identity": self._identity, "step": self.step, "curve": self.curve}
        state |= {name: getattr(self, name).state_dict() for name in ("network", "average", "optimiser")}
        draft = path.with_name(f".{path.name}.{os.getpid()}")
        torch.save(state, draft)
        draft.replace(path)

    def resume(self, path: Path) -> None:
        """Go on from a checkpoint of the same architecture and options; another one's is not used."""
        state = torch.load(path, weights_only=True)
        if state["identity"] == self._identity:
            for name in ("network", "average", "optimiser"):
                getattr(self, name).load_state_dict(state[name])
            self.step, self.curve = int(state["step"]), [tuple(c) for c in state["curve"]]

    def advance(self, batch: Batch, device: str) -> float:
        """One step of the optimiser; the loss before it."""
        for group in self.optimiser.param_groups:
            group["lr"] = self.options.rate * _schedule(self.step, self.options)
        self.optimiser.zero_grad()
        loss = loss_of(self.network, batch, device)
        loss.backward()  # type: ignore[no-untyped-call]
        torch.nn.utils.clip_grad_norm_(self.network.parameters(), self.options.clip)
        self.optimiser.step()
        mix = min(self.options.average, self.step / (self.step + 10.0))
        with torch.no_grad():
            for a, b in zip(self.average.parameters(), self.network.parameters(), strict=True):
                a.lerp_(b, 1.0 - mix)
        self.step += 1
        return float(loss.detach())


def fit(
    architecture: Architecture,
    recorded: Windows,
    generated: Windows | None,
    options: Options,
    *,
    validation: Windows | None = None,
    device: str = "cpu",
    checkpoint: Path | None = None,
    progress: Callable[[int, int, float, float, float], None] = lambda *_: None,
    stop_at: int | None = None,
) -> Fitted:
    """Train; with a checkpoint file that exists, go on from there. `stop_at` ends early, as an interruption would.

    `progress` gets step, steps, training loss, validation loss and seconds to go.
    """
    run = _Run.begun(architecture, options, device)
    form = architecture.form
    pools = _pools(recorded, generated, options)
    checks = None if validation is None or not len(validation) else batch_of(validation, form, None, options)
    if checkpoint is not None and checkpoint.is_file():
        run.resume(checkpoint)
    first, begin, running = run.step, time.monotonic(), float("nan")
    while run.step < min(options.steps, options.steps if stop_at is None else stop_at):
        rng = np.random.default_rng([options.seed, run.step])
        parts = [
            batch_of(pool.draw(max(1, round(options.batch * share)), rng), form, rng, options) for pool, share in pools
        ]
        batch = Batch(*(np.concatenate(a) for a in zip(*map(_arrays, parts), strict=True)))
        value = run.advance(batch, device)
        running = value if running != running else 0.98 * running + 0.02 * value
        if run.step % CHECK_STEPS == 0 or run.step == options.steps:
            held = float("nan")
            if checks is not None:
                with torch.no_grad():
                    held = float(loss_of(run.average, checks, device))
            run.curve.append((run.step, running, held))
            to_go = (time.monotonic() - begin) / (run.step - first) * (options.steps - run.step)
            progress(run.step, options.steps, running, held, to_go)
            if checkpoint is not None:
                run.save(checkpoint)
    return Fitted(run.average.to("cpu").eval(), run.curve)


def _pools(recorded: Windows, generated: Windows | None, options: Options) -> list[tuple[Pool, float]]:
    """What batches are drawn from, with each one's share."""
    if generated is None or not len(generated):
        return [(Pool(recorded), 1.0)]
    if not len(recorded):
        return [(Pool(generated), 1.0)]
    return [(Pool(recorded), options.recorded_share), (Pool(generated), 1.0 - options.recorded_share)]


def _schedule(step: int, options: Options) -> float:
    """Warm-up, then a cosine."""
    if step < options.warm_up:
        return (step + 1) / options.warm_up
    u = (step - options.warm_up) / max(options.steps - options.warm_up, 1)
    return 0.01 + 0.99 * 0.5 * (1.0 + float(np.cos(np.pi * u)))
