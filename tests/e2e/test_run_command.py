"""`forefield run` end to end: real processes, a real router, a built-in scenario, the JSON of the command contract."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

import common
from common.bus import free_port
from tests.processes import end_with_the_test
from tests.waiting import until

ROOT = Path(common.__file__).parent.parent
RUN = [sys.executable, "-m", "rig.command", "run"]
ENVIRONMENT = {**os.environ, "PYTHONPATH": str(ROOT), "COLUMNS": "200", "OMP_NUM_THREADS": "1"}

pytestmark = pytest.mark.timeout(240)


@contextmanager
def started(*arguments: str | Path, cwd: Path) -> Iterator[subprocess.Popen[str]]:
    """A `forefield …` in its own session, gone afterwards."""
    process = subprocess.Popen(
        [sys.executable, "-m", "rig.command", *map(str, arguments)],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=cwd, env=ENVIRONMENT,
        preexec_fn=end_with_the_test,
    )  # fmt: skip
    try:
        yield process
    finally:
        process.kill()
        process.wait()


def children(pid: int) -> dict[str, int]:
    """Services among the children of a process, by module."""
    found = {}
    for task in Path(f"/proc/{pid}/task").iterdir():
        for child in (task / "children").read_text().split():
            words = Path(f"/proc/{child}/cmdline").read_bytes().decode().split("\0")
            if "-m" in words and words[words.index("-m") + 1] != "rig.child":
                found[words[words.index("-m") + 1]] = int(child)
    return found


def gone(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] == "Z"
    except OSError:
        return True


def crew_of(process: subprocess.Popen[str]) -> dict[str, int]:
    """Wait until all three services are processes of their own."""

    def complete() -> dict[str, int]:
        found = children(process.pid) if process.poll() is None else {}
        return found if len(found) == 3 else {}

    return until(complete, within_s=60.0, what="three services")


def driving(process: subprocess.Popen[str], file: Path) -> dict[str, int]:
    """Wait until the run has a plan: its planner says so in the kept log."""
    crew = crew_of(process)
    until(
        lambda: process.poll() is not None or (file.is_file() and "ready: driving" in file.read_text()),
        within_s=120.0,
        what="a plan to drive",
    )
    assert process.poll() is None, process.communicate()
    return crew


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    folder = tmp_path_factory.mktemp("run")
    done = subprocess.run(
        [*RUN, *["--scenario", "following", "--duration", "5", "--json", "out.json", "--set", "rig.run_up_s=0.8"]],
        capture_output=True, text=True, cwd=folder, env=ENVIRONMENT,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert "outcome" in done.stdout
    assert [p.name for p in folder.iterdir()] == ["out.json"]
    return json.loads((folder / "out.json").read_text())


def test_the_report_has_the_shape_of_the_contract(report):
    quantiles = {"p50", "p95", "p99", "max"}
    assert report["scenario"] == "following"
    assert report["duration_s"] == pytest.approx(5.0)
    assert set(report["frames"]) == {"objects", "prediction", "risk", "plan"}
    assert set(report["latency_ms"]) == {"predictor", "riskfield", "planner", "end_to_end"}
    for stage, q in report["latency_ms"].items():
        assert set(q) == quantiles
        assert 0.0 < q["p50"] <= q["p95"] <= q["p99"] <= q["max"], stage
    assert set(report["period_ms"]) == {"p50", "p99"}
    assert set(report["modes"]) == {"drive", "waiting", "safe_stop"}
    assert sum(report["modes"].values()) == pytest.approx(5.0)
    for table in (report["refused"], report["skipped"]):
        assert all(isinstance(n, int) for reasons in table.values() for n in reasons.values())
    for intervention in report["interventions"]:
        assert {"t", "kind", "source_id", "term", "slice_s", "speed_from", "speed_to"} <= set(intervention)
        assert intervention["kind"] in ("slow", "stop")
    assert {
        "collision", "min_clearance_m", "distance_m", "mean_speed_mps", "max_abs_accel_lon", "max_abs_accel_lat",
        "max_abs_jerk", "reached_goal",
    } <= set(report["ego"])  # fmt: skip
    assert report["recording"] is None


def test_the_report_tells_of_a_real_drive(report):
    assert report["frames"]["objects"] == 51
    assert report["frames"]["prediction"] >= 40
    assert report["frames"]["risk"] >= 15  # a busy machine skips frames, and says so
    assert report["frames"]["plan"] >= 15
    assert report["modes"]["drive"] >= 2.0
    assert report["ego"]["distance_m"] > 15.0
    assert not report["ego"]["collision"]
    assert report["outcome"] == "completed"


def test_the_resolved_configuration_stands_in_the_report(report):
    assert report["configuration"]["rig"]["run_up_s"] == 0.8
    assert report["configuration"]["planner"]["valid_for"] == 0.3
    assert report["configuration"]["bus"]["connect"][0].startswith("tcp/127.0.0.1:")


def test_ctrl_c_ends_a_run_in_order_and_leaves_no_process_and_a_report(tmp_path):
    with started("run", "--scenario", "demo", "--logs", "logs", "--json", "out.json", cwd=tmp_path) as process:
        crew = driving(process, tmp_path / "logs" / "planner.log")
        process.send_signal(signal.SIGINT)
        _, said = process.communicate(timeout=30)
    assert process.returncode == 130
    assert "stopped by SIGINT" in said
    assert "Traceback" not in said
    assert all(gone(pid) for pid in crew.values())
    assert json.loads((tmp_path / "out.json").read_text())["outcome"] == "interrupted"


def test_a_service_killed_during_a_run_ends_it_with_code_1_and_the_tail_of_its_log(tmp_path):
    with started("run", "--scenario", "demo", "--logs", "logs", "--json", "out.json", cwd=tmp_path) as process:
        crew = driving(process, tmp_path / "logs" / "planner.log")
        os.kill(crew["services.riskfield"], signal.SIGKILL)
        _, said = process.communicate(timeout=30)
    assert process.returncode == 1
    assert "service riskfield was killed by signal 9" in said
    assert "riskfield INFO" in said
    assert all(gone(pid) for pid in crew.values())
    result = json.loads((tmp_path / "out.json").read_text())
    assert result["outcome"] == "failed"
    assert "riskfield" in result["failures"][0]


def test_a_run_killed_by_sigkill_leaves_no_orphans(tmp_path):
    with started("run", "--scenario", "demo", cwd=tmp_path) as process:
        crew = crew_of(process)
        process.kill()
        process.wait()
        until(lambda: all(gone(pid) for pid in crew.values()), what="the end of the services")
    assert not list(tmp_path.iterdir())


def test_a_configuration_that_a_service_refuses_is_bad_input(tmp_path):
    with started("run", "--scenario", "straight", "--device", "cuda", cwd=tmp_path) as process:
        _, said = process.communicate(timeout=90)
    if process.returncode == 0:
        pytest.skip("this machine has a CUDA device")
    assert process.returncode == 2
    assert "no CUDA device" in said
    assert len(said.strip().splitlines()) == 1


def test_services_serve_a_vehicle_from_elsewhere_and_health_says_so(tmp_path):
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    with started("services", "--listen", endpoint, cwd=tmp_path) as services:
        assert services.stderr is not None
        until(lambda: "up at" in services.stderr.readline(), within_s=90.0, what="services")
        connect = f'bus.connect=["{endpoint}"]'
        run = ["run", "--scenario", "demo", "--attach", "--json", "out.json", "--set", connect]
        with started("health", "--connect", endpoint, cwd=tmp_path) as waiting:
            shown, _ = waiting.communicate(timeout=30)
            assert waiting.returncode == 1
            assert "waiting" in shown
        with started(*run, cwd=tmp_path) as vehicle:

            def ready() -> bool:
                with started("health", "--connect", endpoint, cwd=tmp_path) as asked:
                    shown, _ = asked.communicate(timeout=30)
                    # a busy machine makes them late, which they say, and which is not being ready
                    late = "late:" in shown and not any(word in shown for word in ("waiting", "silent", "starting"))
                    return asked.returncode == 0 or late

            until(ready, within_s=60.0, what="a healthy system")
            assert vehicle.stderr is not None
            until(lambda: "demo: run\n" in vehicle.stderr.readline(), within_s=60.0, what="the drive after the run-up")
            vehicle.send_signal(signal.SIGTERM)
            vehicle.communicate(timeout=30)
            assert vehicle.returncode == 143
        assert json.loads((tmp_path / "out.json").read_text())["frames"]["objects"] > 0
        services.send_signal(signal.SIGTERM)
        services.communicate(timeout=30)
        assert services.returncode == 0
