"""`forefield bench riskfield`: the same field from every variant, a result with all its figures, clear errors."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
from typer.testing import CliRunner

from common.config import ConfigError
from common.risk import RiskParameters
from evaluation import bench_riskfield as bench
from evaluation import bench_riskfield_frames as frames
from evaluation.bench_riskfield_rivals import array_volume
from rig.application import app

FIGURES = (
    "ours_ms", "numpy_f32_ms", "naive_warp_ms", "numba_ms", "memset_ms", "ratio_vs_numpy", "ratio_vs_naive",
    "ratio_vs_numba", "max_error",
)  # fmt: skip


def tiny():
    return frames.make("tiny", objects=6, length=32.0, width=16.0)


@pytest.fixture
def small(monkeypatch):
    monkeypatch.setitem(bench.FRAMES, "standard", tiny)
    monkeypatch.setattr(bench, "OBJECT_STEPS", (2, 4))
    monkeypatch.setattr(bench, "AREA_STEPS", ((20, 20), (40, 20)))
    monkeypatch.setattr(bench, "installed", lambda library: False)  # numba compiles for a minute


def test_the_frames_are_those_of_the_notes():
    for name, (objects, shape) in {
        "standard": (32, (400, 160)), "dense": (128, (400, 160)), "fine": (32, (1000, 400)),
    }.items():  # fmt: skip
        frame = frames.FRAMES[name]()
        assert (frame.grid.rows, frame.grid.columns) == shape
        assert frame.settings.slices == 13
        assert [sum(frame.prediction.cls == c) for c in (1, 2, 6)] == [objects * k // 32 for k in (20, 4, 8)]
        _, _, lines = frame.sources(RiskParameters())
        assert (
            sorted((line.kind, len(line.points)) for line in lines) == [("barrier", 50)] * 2 + [("lane_line", 50)] * 6
        )


def test_a_result_has_every_figure_and_none_is_left_to_chance(small, tmp_path):
    out = tmp_path / "bench.json"
    done = CliRunner().invoke(
        app, ["bench", "riskfield", "--frames", "standard", "--rounds", "1", "--json", str(out)], catch_exceptions=False
    )
    assert done.exit_code == 0, done.output
    result = json.loads(out.read_text())
    frame = result["frames"]["standard"]
    for key in FIGURES:
        assert key in frame
        if "numba" in key:
            assert frame[key] is None
        else:
            assert math.isfinite(frame[key]) and frame[key] > 0.0
    assert frame["ratio_vs_numpy"] == pytest.approx(frame["numpy_f32_ms"] / frame["ours_ms"], rel=0.01)
    assert frame["max_error"] <= bench.ERROR
    assert [row["objects"] for row in result["scaling"]["objects"]] == [2, 4]
    assert result["scaling"]["cells"][1]["cells"] == 2 * result["scaling"]["cells"][0]["cells"]
    assert result["allocation"]["fresh_volumes_per_frame"] == 0.0
    assert "NumPy float32" in done.output
    assert "not installed" in done.output


@pytest.mark.slow
def test_the_numba_form_computes_the_same_field():
    if not bench.installed("numba"):
        pytest.skip("numba is not installed: pip install -e '.[bench]'")
    from evaluation.bench_riskfield_numba import NumbaField

    p = RiskParameters()
    ours = bench.Ours(tiny(), p, "cpu", dtype="float32", accuracy="exact")
    assert np.abs(NumbaField(ours.rows())() - ours()).max() <= bench.ERROR


def test_a_variant_that_computes_something_else_is_refused(small, monkeypatch):
    monkeypatch.setattr(bench, "array_volume", lambda rows: array_volume(rows) * 1.01)
    with pytest.raises(ConfigError, match="numpy_f32_ms differs"):
        bench.measure(["standard"], rounds=1, device="cpu", scaling=False, points=20)


@pytest.mark.parametrize(
    ("arguments", "says"), [(["--frames", "huge"], "standard, dense, fine"), (["--frames", ""], "--frames")]
)
def test_unknown_frames_are_refused_with_the_known_ones(arguments, says):
    done = CliRunner().invoke(app, ["bench", "riskfield", *arguments])
    assert done.exit_code == 2
    assert says in " ".join(done.output.split())


def test_a_missing_card_is_said_in_one_line():
    import warp as wp

    wp.init()
    if wp.is_cuda_available():
        pytest.skip("there is a GPU here")
    done = CliRunner().invoke(app, ["bench", "riskfield", "--device", "cuda"])
    assert done.exit_code == 2
    assert "--device cpu" in " ".join(done.output.split())
