"""`forefield bench planner`: a result with all its figures; the kernel and the NumPy gather find the same."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from evaluation import bench_planner
from rig.application import app
from services.planner.footprint import Footprint
from services.planner.settings import PlannerSettings
from services.planner.volume import Volume

pytest.importorskip("warp", reason="the benchmark measures the kernels")


def test_the_command_writes_every_figure(tmp_path: Path) -> None:
    out = tmp_path / "planner.json"
    args = ["bench", "planner", "--json", str(out), "--rounds", "3", "--cycles", "10", "--objects", "4"]
    done = CliRunner().invoke(app, args)
    assert done.exit_code == 0, done.output
    result = json.loads(out.read_text())
    for name in ("ours_ms", "numpy_ms", "ratio_vs_numpy", "evaluated_ms", "cycle_ms_p50", "cycle_ms_p99"):
        assert result[name] > 0.0, name
    assert result["frenetix_ms"] is None or result["frenetix_ms"] > 0.0
    assert result["frenetix"]
    assert result["candidates"] == 256


def test_the_rivals_do_the_same_work() -> None:
    settings = PlannerSettings()
    _road, route, frames = bench_planner._frames({}, 8, 3)
    ego, risk = frames[1]
    paths, _start = bench_planner._paths(route.value, ego.value, settings)
    volume = Volume.of(risk.value, risk.capture_ns, ego.capture_ns)
    footprint = Footprint.of(ego.value, settings.footprint_spacing, settings.flank_margin)
    ours, gather = bench_planner._look_ups(paths, volume, footprint)
    np.testing.assert_allclose(ours(), np.maximum(gather(), 0.0), atol=2e-3)
    assert np.max(ours()) > 0.1


def test_a_wrong_setting_is_bad_input() -> None:
    done = CliRunner().invoke(app, ["bench", "planner", "--set", "planner.nonsense=1"])
    assert done.exit_code == 2
