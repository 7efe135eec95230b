"""The shared-memory override: whom it covers, what Compose makes of it, and that the setting it turns on works."""

from __future__ import annotations

import json
import shutil
import subprocess
from pathlib import Path
from typing import Any

import pytest

from common import topics
from common.bus import BusSettings, open_bus, router
from common.clock import monotonic
from tests import samples
from tests.contract.test_codec import equal
from tests.waiting import until

yaml = pytest.importorskip("yaml")
ROOT = Path(__file__).parents[2]
ASKED = {"FOREFIELD__BUS__SHARED_MEMORY": "true"}


def read(name: str) -> dict[str, Any]:
    return dict(yaml.safe_load((ROOT / name).read_text())["services"])


def test_every_service_asks_for_it_and_shares_the_routers_memory() -> None:
    base, override = read("compose.yaml"), read("compose.shm.yaml")
    assert set(override) == set(base)
    for name, service in override.items():
        assert service["environment"] == ASKED
        assert service["ipc"] == ("shareable" if name == "router" else "service:router")


def test_compose_merges_it() -> None:
    docker = shutil.which("docker")
    if docker is None or subprocess.run([docker, "compose", "version"], capture_output=True, check=False).returncode:
        pytest.skip("needs Docker Compose")
    files = ["-f", "compose.yaml", "-f", "compose.shm.yaml"]
    done = subprocess.run(
        [docker, "compose", *files, "config", "--format", "json"], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    services = json.loads(done.stdout)["services"]
    for name, service in services.items():
        assert service["environment"]["FOREFIELD__BUS__SHARED_MEMORY"] == "true"
        assert service["read_only"] is True and service["cap_drop"] == ["ALL"], name
        assert name == "router" or service["environment"]["FOREFIELD__BUS__CONNECT"] == '["tcp/router:7447"]'


def test_with_it_a_risk_volume_crosses_the_router_unchanged() -> None:
    settings = BusSettings(shared_memory=True)
    risk = samples.risk(320, 160)
    with router(settings=settings) as endpoint:
        there = BusSettings(connect=(endpoint,), shared_memory=True)
        with open_bus(there, "shared", "riskfield") as a, open_bus(there, "shared", "planner") as b:
            inbox, out = b.inbox(topics.RISK), a.publisher(topics.RISK)

            def crossed() -> bool:
                out.put(risk, capture_ns=monotonic())
                return inbox.take() is not None

            until(crossed, within_s=20, every_s=0.05, what="a risk volume")
            assert inbox.latest is not None and equal(inbox.latest.value, risk)
