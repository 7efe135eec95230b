"""The stack as it stands in a vehicle: mutual TLS, no rig, metrics on loopback, a vehicle that comes from outside."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import urllib.request
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

from common.bus import free_port
from rig.certificates import NAMES
from tests.docker.engine import ROOT, SERVICES, Project, needs_engine
from tests.waiting import until

pytestmark = needs_engine
FILES = ("compose.yaml", "compose.secure.yaml", "compose.vehicle.yaml", "compose.metrics.yaml")
PRESENT = SERVICES - {"rig"}


@dataclass
class Car:
    stack: Project
    certificates: Path
    port: int

    def environment(self, role: str, protocol: str = "tls") -> dict[str, str]:
        folder = self.certificates / role
        return {
            **os.environ, "FOREFIELD__VEHICLE": "van7", "PYTHONPATH": str(ROOT),
            "FOREFIELD__BUS__CONNECT": f'["{protocol}/127.0.0.1:{self.port}"]',
            "FOREFIELD__BUS__TLS__CA": str(folder / "ca.pem"),
            "FOREFIELD__BUS__TLS__CERTIFICATE": str(folder / "certificate.pem"),
            "FOREFIELD__BUS__TLS__KEY": str(folder / "key.pem"),
        }  # fmt: skip

    def drives(self, role: str, *, seconds: float = 120) -> bool:
        """Whether the example vehicle, with the certificate of `role`, is driven 10 m from outside the containers."""
        try:
            done = subprocess.run(
                [sys.executable, "docs/examples/vehicle.py", "--metres", "10"],
                cwd=ROOT, env=self.environment(role), capture_output=True, text=True, timeout=seconds, check=False,
            )  # fmt: skip
        except subprocess.TimeoutExpired:
            return False
        assert done.returncode == 0, done.stderr
        return "drove 10" in done.stdout


@pytest.fixture(scope="module")
def car(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Car]:
    folder = tmp_path_factory.mktemp("certificates")
    forefield = [sys.executable, "-m", "rig.command"]
    made = subprocess.run(
        [*forefield, "certs", str(folder), "--vehicle", "van7", "--owner", "10001"],
        cwd=ROOT, capture_output=True, text=True, check=False,
    )  # fmt: skip
    if "not permitted" in made.stderr:
        pytest.skip("only root may give the keys to the containers' user")
    assert made.returncode == 0, made.stderr
    port = free_port()
    stack = Project(
        "forefield-secured", FILES,
        {"FOREFIELD_VEHICLE": "van7", "FOREFIELD_CERTIFICATES": str(folder), "FOREFIELD_PORT": str(port)},
    )  # fmt: skip
    try:
        stack.up()
        yield Car(stack, folder, port)
    finally:
        stack.down()


def test_all_but_the_rig_are_healthy_over_mutual_tls(car: Car) -> None:
    assert car.stack.health() == dict.fromkeys(PRESENT, "healthy")


def test_a_vehicle_from_outside_is_driven_with_its_own_certificate_and_not_with_anothers(car: Car) -> None:
    assert car.drives("vehicle")
    assert not car.drives("viz", seconds=15)
    assert car.drives("vehicle")


@pytest.mark.parametrize("service", sorted(PRESENT))
def test_a_container_sees_its_own_certificate_and_no_other_and_cannot_change_it(car: Car, service: str) -> None:
    look = (
        "import json, os; f = '/certificates/'; "
        "print(json.dumps([sorted(os.listdir(f)), os.access(f + 'key.pem', os.W_OK),"
        " open(f + 'certificate.pem').read()]))"
    )
    files, writable, certificate = json.loads(car.stack.python(service, look))
    assert files == ["ca.pem", "certificate.pem", "key.pem"]
    assert not writable
    owners = {name for name in NAMES if (car.certificates / name / "certificate.pem").read_text() == certificate}
    assert owners == {service}


@pytest.mark.parametrize(("service", "offset"), [("predictor", 0), ("riskfield", 1), ("planner", 2), ("viz", 3)])
def test_metrics_are_served_on_loopback(car: Car, service: str, offset: int) -> None:
    with urllib.request.urlopen(f"http://127.0.0.1:{9100 + offset}/metrics", timeout=10) as answer:
        text = answer.read().decode()
    assert f'forefield_uptime_seconds{{service="{service}"}}' in text


def test_every_published_port_is_on_loopback_alone(car: Car) -> None:
    ports = [json.loads(line)["Publishers"] for line in car.stack.compose("ps", "--format", "json").splitlines()]
    published = [p for row in ports for p in row or () if p["PublishedPort"]]
    assert {p["URL"] for p in published} == {"127.0.0.1"}
    assert len(published) >= 5, "the router and four sets of metrics"


def test_logs_are_json_with_boot_and_vehicle(car: Car) -> None:
    def lines() -> list[dict[str, object]]:
        return [json.loads(line) for line in car.stack.logs("planner") if line.startswith("{")]

    known = until(lambda: [x for x in lines() if "boot" in x], within_s=30, every_s=1, what="a line with a boot")
    assert all(x["service"] == "planner" and x["vehicle"] == "van7" and x["level"] and x["time"] for x in known)
    assert any("seq" in x for x in lines())
