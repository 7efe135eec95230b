"""The pipeline benchmark: a scene of constant load, and a result that says what it claims."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import common
from common.codec import encode_body
from common.topics import EGO, MAP, OBJECTS, ROUTE
from evaluation.bench_scene import WINDOW, BenchScene

ROOT = Path(common.__file__).parent.parent


@given(st.integers(0, 200), st.floats(0.0, 500.0))
@settings(max_examples=40, deadline=None)
def test_the_load_is_the_same_at_any_time(n, t):
    scene = BenchScene(n)
    objects, ego = scene.objects(t), scene.ego(t)
    assert len(objects.id) == n
    assert np.all((objects.x - ego.x >= WINDOW[0]) & (objects.x - ego.x <= WINDOW[1]))
    for topic, message in ((OBJECTS, objects), (EGO, ego), (MAP, scene.map()), (ROUTE, scene.route())):
        encode_body(topic, message)


@given(st.floats(0.0, 400.0), st.floats(0.01, 0.2))
@settings(max_examples=40, deadline=None)
def test_everyone_moves_as_he_says_until_he_leaves_and_comes_in_as_somebody_new(t, dt):
    scene = BenchScene(64)
    a, b = scene.objects(t), scene.objects(t + dt)
    same = a.id == b.id
    assert np.allclose((b.x - a.x)[same], a.vx[same] * dt, atol=1e-6)
    assert np.all(np.abs(b.x - a.x)[~same] > 100.0)


def test_nobody_but_the_lead_is_ever_in_the_egos_lane():
    objects = BenchScene(64).objects(123.0)
    assert np.count_nonzero(np.abs(objects.y) < 2.0) == 1


@pytest.mark.slow
def test_the_period_is_the_slowest_stage_and_not_the_sum(tmp_path):
    out = tmp_path / "bench.json"
    subprocess.run(
        [sys.executable, "-m", "rig.command", "bench", "pipeline", "--frames", "200", "--json", out],
        check=True, env={**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}, cwd=tmp_path,
    )  # fmt: skip
    result = json.loads(out.read_text())
    assert set(result["stages_ms"]) == {"predictor", "riskfield", "planner"}
    assert result["sum_of_stages_ms"] == pytest.approx(sum(result["stages_ms"].values()), abs=0.01)
    assert result["ratio_period_to_sum"] == pytest.approx(result["period_ms"] / result["sum_of_stages_ms"], abs=1e-3)
    assert 0.0 < result["end_to_end_ms"]["p50"] <= result["end_to_end_ms"]["p99"]
    assert result["modes"]["pipeline"].get("drive", 0) > 0.9 * sum(result["modes"]["pipeline"].values())
    assert result["ratio_period_to_sum"] <= 0.8
