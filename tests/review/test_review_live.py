"""Live runs over the bus: a review finds what the run's JSON counts, with the right source, in recorded traffic too."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("rerun")

from evaluation.review.command import review

DATA = Path(os.environ.get("FOREFIELD_DATA", "../shared/data"))
RECORDED = ("USA_US101-3_1_T-1", "USA_Lanker-2_4_T-1", "CHN_SIND-8021_75_T-1")
WORDS = ("kind", "source_id", "term")


@pytest.mark.slow
@pytest.mark.timeout(400)
@pytest.mark.parametrize("scenario", ["demo", *RECORDED])
def test_a_live_drive_is_reviewed_as_it_was_measured(tmp_path: Path, scenario: str) -> None:
    if scenario != "demo" and not (DATA / "commonroad" / f"{scenario}.xml").is_file():
        pytest.skip("FOREFIELD_DATA names no folder with recorded scenarios")
    rrd, told = tmp_path / "run.rrd", tmp_path / "run.json"
    command = [sys.executable, "-m", "rig.command", "run", "--scenario", scenario, "--record", rrd, "--json", told]
    env = {**os.environ, "FOREFIELD_DATA": str(DATA.absolute())}
    done = subprocess.run([str(c) for c in command], env=env, capture_output=True, text=True, timeout=300, check=False)
    assert told.is_file(), done.stderr
    run = json.loads(told.read_text())
    found = review(rrd).result
    assert [[i[k] for k in WORDS] for i in found["interventions"]] == [
        [i[k] for k in WORDS] for i in run["interventions"]
    ]
    for a, b in zip(found["interventions"], run["interventions"], strict=True):
        assert a["t"] == pytest.approx(b["t"], abs=0.15)
        assert (a["speed_from"], a["speed_to"]) == pytest.approx((b["speed_from"], b["speed_to"]), abs=0.1)
    assert found["summary"]["duration_s"] == pytest.approx(run["duration_s"], abs=0.2)
    assert found["summary"]["distance_m"] == pytest.approx(run["ego"]["distance_m"], abs=1.0)
