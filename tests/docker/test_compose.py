"""`docker compose up` on a real engine: all healthy, plans recorded, only what each needs, back after a crash."""

from __future__ import annotations

import json
import subprocess
import time
from collections.abc import Iterator

import pytest

from tests.docker.engine import SERVICES, Project, needs_engine
from tests.waiting import until

pytestmark = needs_engine
STACK = Project("forefield-test")
compose, health = STACK.compose, STACK.health


@pytest.fixture(scope="module")
def up() -> Iterator[None]:
    try:
        STACK.up()
        yield
    finally:
        STACK.down()


def test_all_are_healthy(up: None) -> None:
    assert health() == dict.fromkeys(SERVICES, "healthy")


def test_the_recording_in_the_volume_has_plans(up: None) -> None:
    count = (
        "from pathlib import Path\nfrom rerun.chunk import RrdReader\n"
        "try: print(sum(c.num_rows for p in Path('/recordings').glob('*.rrd') for c in RrdReader(p).stream()"
        " if c.entity_path == '/world/plan/profile'))\n"
        "except Exception: print(0)"
    )
    until(lambda: int(compose("exec", "viz", "python", "-c", count)) > 20, within_s=90, every_s=2, what="plans")


@pytest.mark.parametrize("service", sorted(SERVICES))
def test_an_image_holds_only_what_its_service_needs_and_runs_without_rights(up: None, service: str) -> None:
    look = (
        "import importlib.util, os, json; "
        "writable = any(os.access(p, os.W_OK) for p in ('/usr', '/app')); "
        "found = [m for m in ('torch', 'warp', 'rerun', 'commonroad', 'zenoh') if importlib.util.find_spec(m)]; "
        "print(json.dumps([os.getuid(), writable, found]))"
    )
    uid, writable, found = json.loads(compose("exec", service, "python", "-c", look))
    needs = {
        "predictor": ["torch"],
        "riskfield": ["warp"],
        "planner": ["warp"],
        "viz": ["rerun"],
        "rig": ["commonroad"],
    }
    assert uid != 0
    assert not writable
    assert found == [*needs.get(service, []), "zenoh"]


def test_a_service_killed_inside_its_container_comes_back(up: None) -> None:
    container = compose("ps", "--quiet", "riskfield").strip()

    def restarts() -> int:
        shown = subprocess.run(
            ["docker", "inspect", "--format", "{{.RestartCount}}", container],
            capture_output=True,
            text=True,
            check=True,
        )
        return int(shown.stdout)

    before = restarts()
    kill = (
        "import os; [os.kill(int(p), 9) for p in os.listdir('/proc') if p.isdigit() and int(p) not in (1, os.getpid())]"
    )
    subprocess.run(["docker", "exec", container, "python", "-c", kill], capture_output=True, check=False)
    until(lambda: restarts() > before, within_s=30, every_s=0.5, what="a restart")
    until(lambda: health()["riskfield"] == "healthy", within_s=60, every_s=1, what="health again")


def test_one_service_is_replaced_while_the_others_run(up: None) -> None:
    def containers() -> dict[str, str]:
        lines = compose("ps", "--format", "json").splitlines()
        return {row["Service"]: row["ID"] for row in map(json.loads, lines)}

    before = containers()
    compose("build", "planner")
    compose("up", "--detach", "--no-deps", "--force-recreate", "--wait", "--wait-timeout", "60", "planner")
    after = containers()
    assert {s for s in SERVICES if after[s] != before[s]} == {"planner"}
    assert health() == dict.fromkeys(SERVICES, "healthy")


def test_down_is_clean_within_fifteen_seconds(up: None) -> None:
    began = time.monotonic()
    compose("down", timeout=60)
    assert time.monotonic() - began <= 15.0
    assert compose("ps", "--all", "--quiet") == ""
