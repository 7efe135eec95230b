"""The wheel as users get it: it holds what it must, nothing else, and runs from any folder."""

from __future__ import annotations

import os
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("wheel")
    done = subprocess.run(
        [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--wheel-dir", str(out), str(ROOT)],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr[-2000:]
    (found,) = out.glob("*.whl")
    return found


def test_it_holds_our_packages_and_no_tests_or_data(wheel: Path) -> None:
    names = zipfile.ZipFile(wheel).namelist()
    tops = {n.split("/")[0] for n in names if not n.split("/")[0].endswith(".dist-info")}
    assert tops == {"common", "services", "viz", "rig", "evaluation"}
    assert all(
        n.endswith((".py", ".c", ".json", ".md", ".png", ".safetensors", ".typed", ".html.j2")) or ".dist-info/" in n
        for n in names
    )
    assert sum(i.file_size for i in zipfile.ZipFile(wheel).infolist()) < 8 * 2**20


def test_it_runs_from_any_folder_without_the_checkout(wheel: Path, tmp_path: Path) -> None:
    site = tmp_path / "site"
    subprocess.run(
        [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--target", str(site), str(wheel)], check=True
    )
    env = {k: v for k, v in os.environ.items() if k != "FOREFIELD_DATA"} | {"PYTHONPATH": str(site)}
    where = subprocess.run(
        [sys.executable, "-P", "-c", "import services.planner.core as m; print(m.__file__)"],
        cwd=tmp_path, env=env, capture_output=True, text=True, check=True,
    )  # fmt: skip
    assert where.stdout.startswith(str(site))
    listed = subprocess.run(
        [sys.executable, "-P", "-m", "rig.command", "scenarios"],
        cwd=tmp_path, env=env, capture_output=True, text=True, check=True,
    )  # fmt: skip
    assert "slow_pedestrian" in listed.stdout


@pytest.mark.slow
@pytest.mark.parametrize("service", ["predictor", "riskfield", "planner"])
def test_a_service_runs_in_an_environment_with_its_own_extra_alone(wheel: Path, tmp_path: Path, service: str) -> None:
    venv = tmp_path / "venv"
    subprocess.run([sys.executable, "-m", "venv", str(venv)], check=True)
    python = str(venv / "bin" / "python")
    install = f"forefield[{service}] @ {wheel.as_uri()}"
    subprocess.run(
        [python, "-m", "pip", "install", "--quiet", install, "pytest", "hypothesis", "pytest-timeout"], check=True
    )
    done = subprocess.run(
        [python, "-P", "-m", "pytest", "-p", "no:cacheprovider", f"tests/{service}", "-m", "not slow and not whole"],
        cwd=ROOT, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout[-3000:]
    for other in {"torch", "warp", "rerun", "commonroad", "typer"} - {"predictor": {"torch"}}.get(service, {"warp"}):
        found = subprocess.run([python, "-c", f"import {other}"], capture_output=True, check=False)
        assert found.returncode != 0, other
