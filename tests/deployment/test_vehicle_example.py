"""The example that an integrator copies drives: against the real services, over loopback, behind another car."""

from __future__ import annotations

import importlib.util
import os
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from common.bus import router
from common.messages import Plan, Stamped
from tests import samples
from tests.e2e.stack import SERVICES, Stack

EXAMPLE = Path(__file__).parents[2] / "docs" / "examples" / "vehicle.py"
S = 1_000_000_000


@pytest.fixture(scope="module")
def example() -> ModuleType:
    spec = importlib.util.spec_from_file_location("example_vehicle", EXAMPLE)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.timeout(170)
def test_it_drives_with_the_real_services(tmp_path: Path) -> None:
    with router() as endpoint:
        stack = Stack(endpoint)
        environment = {
            **os.environ, "FOREFIELD__VEHICLE": "stack", "FOREFIELD__BUS__CONNECT": f'["{endpoint}"]',
            "PYTHONPATH": str(EXAMPLE.parents[2]),
        }  # fmt: skip
        try:
            for service in SERVICES:
                stack.start(service)
            done = subprocess.run(
                [sys.executable, str(EXAMPLE), "--metres", "15"],
                cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=160, check=False,
            )  # fmt: skip
        finally:
            stack.close()
    assert done.returncode == 0, done.stdout + done.stderr
    assert "drive: " in done.stdout
    assert "drove 15." in done.stdout


def test_it_drives_the_profile_then_the_tail_then_stands(example: ModuleType) -> None:
    plan = samples.plan()
    assert plan.profile is not None and plan.tail is not None
    stamped: Stamped[Plan] = Stamped(plan, capture_ns=0, received_ns=0)
    for t in (0.0, 0.1, 0.29):
        assert example.wanted(stamped, round(t * S))[0] == pytest.approx(
            np.interp(t, plan.profile.t, plan.profile.speed)
        )
    for t in (0.31, 1.0, 2.0):
        assert example.wanted(stamped, round(t * S))[0] == pytest.approx(np.interp(t, plan.tail.t, plan.tail.speed))
    assert example.wanted(stamped, round((plan.tail.t[-1] + 0.01) * S)) == (0.0, 0.0, 0.0)
    waiting: Stamped[Plan] = Stamped(Plan(mode="waiting", reason="no risk"), capture_ns=0, received_ns=0)
    assert example.wanted(waiting, 0) == (0.0, 0.0, 0.0)
    assert example.wanted(None, 0) == (0.0, 0.0, 0.0)
