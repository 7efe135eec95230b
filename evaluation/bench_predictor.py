"""Speed of the learned predictor: `forefield bench predictor`.

In one run, one thread, alternating: surrounding risk, leaders and the shipped network for 32 and 128 objects; the same
model in the paper's autoregressive form, eager, with the same inputs and as many hidden units; and the floor: the
matrix products of the shipped network alone, on contiguous arrays.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch

from common.messages import FRAME_S, HISTORY_FRAMES, Objects, Stamped
from common.risk import RiskParameters
from evaluation.bench_scene import BenchScene
from services.predictor import features, signals
from services.predictor.history import Frames, Tracks, frames, observe
from services.predictor.kinematic import State, estimate
from services.predictor.learned import LearnedPredictor
from services.predictor.lstm import Architecture, Network
from services.predictor.settings import PredictorSettings
from services.predictor.surrounding_risk import RISK_POINTS
from services.predictor.weight_files import SHIPPED, Loaded, load

SIZES = (32, 128)
START_NS = 10**9


def measure(weights: Path | None = None, *, name: str = "lstm", rounds: int = 60) -> dict[str, Any]:
    """Times in milliseconds (medians) and their ratios; `name`: the network, by default the one that reads the risk."""
    torch.set_num_threads(1)
    loaded = load(SHIPPED if weights is None else weights, name)
    architecture = loaded.network.architecture
    eager = Network(Architecture(form="paper", hidden=architecture.hidden)).eval().requires_grad_(False)
    jobs: dict[str, Callable[[], object]] = {}
    for n in SIZES:
        jobs[f"ms_{n}"] = _service(loaded, n)
        jobs[f"eager_{n}"] = _service(Loaded("eager", eager, loaded.shrink, loaded.classes), n)
        jobs[f"network_{n}"] = _network(loaded.network, n)
        jobs[f"eager_network_{n}"] = _network(eager, n)
        jobs[f"gemm_floor_{n}"] = _products(architecture, n)
    ms = _interleaved(jobs, rounds)
    return {
        "schema": "forefield.bench_predictor.v1",
        "network": loaded.name,
        "architecture": architecture.as_dict(),
        "ms_32": ms["ms_32"],
        "ms_128": ms["ms_128"],
        "ratio_vs_eager": ms["eager_network_32"] / ms["ms_32"],
        "ratio_vs_eager_with_risk": ms["eager_32"] / ms["ms_32"],
        "ratio_vs_gemm_floor": ms["network_32"] / ms["gemm_floor_32"],
        "ratio_128_to_32": ms["ms_128"] / ms["ms_32"],
        "rounds": rounds,
        "detail_ms": ms,
    }


def _service(loaded: Loaded, n: int) -> Callable[[], object]:
    """Sample what stands around and predict all n objects, with full histories."""
    risk, settings = RiskParameters(), PredictorSettings()
    scene, tracks = BenchScene(n), Tracks.empty()
    learned = LearnedPredictor(loaded, risk)
    objects, history, now = scene.objects(0.0), None, START_NS
    for k in range(HISTORY_FRAMES):
        now = START_NS + round(k * FRAME_S * 1e9)
        objects = scene.objects(k * FRAME_S)
        tracks = observe(tracks, objects, now, settings.history)
        history = frames(tracks, objects.id)
        learned.observe(objects, history, None, now)
    assert history is not None
    state = estimate(objects, history, settings.kinematic)
    return _once(learned, objects, history, state, scene, now)


def _once(
    learned: LearnedPredictor, objects: Objects, history: Frames, state: State, scene: BenchScene, now: int
) -> Callable[[], object]:
    ego = Stamped(scene.ego(0.0), now, now)
    everyone = np.ones(len(objects.id), dtype=bool)

    def once() -> object:
        learned.observe(objects, history, ego, now)
        return learned.predict(objects, history, state, everyone)

    return once


def _network(network: Network, n: int) -> Callable[[], object]:
    first = 2 if network.architecture.form == "paper" else 4
    x, context = torch.randn(n, HISTORY_FRAMES, first + signals.SIGNALS), torch.randn(n, features.CONTEXT)
    if network.architecture.form == "paper":
        x = x[..., : first + RISK_POINTS].contiguous()

    def once() -> object:
        with torch.inference_mode():
            return network(x, context)

    return once


def _products(a: Architecture, n: int) -> Callable[[], object]:
    """The matrix products of one inference: the encoder's inputs at once, its 30 recurrences, attention, the head."""
    h, f = a.hidden, HISTORY_FRAMES
    x, w_in = torch.randn(n * f, a.inputs), torch.randn(a.inputs, 4 * h)
    state, w_rec = torch.randn(n, h), torch.randn(h, 4 * h)
    outputs, w_qkv = torch.randn(n * f, h), torch.randn(h, 3 * h)
    q, k, v = torch.randn(n, f, h), torch.randn(n, h, f), torch.randn(n, f, h)
    seen, w_body = torch.randn(n, 2 * h + features.CONTEXT), torch.randn(2 * h + features.CONTEXT, h)
    w_head = torch.randn(h, 2 * features.BASIS)
    coefficients, basis = torch.randn(2 * n, features.BASIS), torch.randn(features.BASIS, 60)

    def once() -> object:
        with torch.inference_mode():
            _ = x @ w_in
            for _ in range(f):
                _ = state @ w_rec
            if a.attention:
                _ = outputs @ w_qkv
                _ = (q @ k) @ v
            return (seen @ w_body) @ w_head, coefficients @ basis

    return once


def _interleaved(jobs: dict[str, Callable[[], object]], rounds: int) -> dict[str, float]:
    """Median of each job [ms]; jobs take turns, so that a busy machine disturbs all alike."""
    times: dict[str, list[float]] = {name: [] for name in jobs}
    for k in range(rounds + 5):
        for name, job in jobs.items():
            begin = time.perf_counter()
            job()
            if k >= 5:
                times[name].append((time.perf_counter() - begin) * 1e3)
    return {name: float(np.median(t)) for name, t in times.items()}
