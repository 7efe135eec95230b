"""Each service stands alone: its own extra is enough, and the planner hears only what it may."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from services.planner.__main__ import SERVICE as PLANNER
from services.predictor.__main__ import SERVICE as PREDICTOR
from services.riskfield.__main__ import SERVICE as RISKFIELD

ROOT = Path(__file__).parents[2]
SERVICES = {"predictor": PREDICTOR, "riskfield": RISKFIELD, "planner": PLANNER}


def test_the_planner_subscribes_to_ego_map_route_and_risk_and_nothing_else() -> None:
    assert {t.suffix for t in PLANNER.subscribes} == {"ego", "map", "route", "risk"}


def test_services_subscribe_to_what_they_read_and_nothing_else() -> None:
    assert {t.suffix for t in PREDICTOR.subscribes} == {"ego", "objects", "map"}
    assert {t.suffix for t in RISKFIELD.subscribes} == {"ego", "map", "closures", "prediction"}
    assert [s.publishes.suffix for s in SERVICES.values()] == ["prediction", "risk", "plan"]


@pytest.mark.parametrize("name", SERVICES)
@pytest.mark.timeout(300)
def test_a_service_passes_its_unit_tests_with_only_its_own_extra(name: str) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-p", "tests.only", "-p", "no:cacheprovider", f"tests/{name}", "-x",
         "-m", "not slow and not docker and not whole"],
        cwd=ROOT, env={**os.environ, "FOREFIELD_TEST_ONLY": name}, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-1000:]
    assert " passed" in done.stdout


@pytest.mark.parametrize("name", SERVICES)
def test_the_guard_of_that_test_works(name: str) -> None:
    other = next(n for n in SERVICES if n != name)
    code = f"from tests.only import block; block({name!r}); import services.{name}.core; import services.{other}.core"
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert f"services.{other}" in done.stderr and "blocked" in done.stderr
