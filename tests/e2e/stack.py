"""The three services as real processes on a loopback router, and a vehicle that drives a straight road beside them."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from common import topics
from common.bus import Bus, BusSettings, open_bus, router
from common.clock import monotonic
from common.messages import Plan, Risk, Stamped, Status
from tests import samples
from tests.processes import end_with_the_test

ROOT = Path(__file__).parents[2]
SERVICES = ("predictor", "riskfield", "planner")
SPEED = 8.0


class Vehicle:
    """Publishes ego at 50 Hz, objects at 10 Hz from a thread; map and route when told; hears plan, risk, statuses."""

    def __init__(self, bus: Bus) -> None:
        self.bus = bus
        self.objects_too = self.ego_too = True
        self._publishers = {t.suffix: bus.publisher(t) for t in (topics.EGO, topics.OBJECTS, topics.MAP, topics.ROUTE)}
        self._inboxes = {
            t.suffix: bus.inbox(t) for t in (topics.PLAN, topics.RISK, *(topics.STATUS_OF[s] for s in SERVICES))
        }
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def put_map(self) -> None:
        self._publishers["map"].put(samples.world(), capture_ns=monotonic())

    def put_route(self) -> None:
        self._publishers["route"].put(samples.route(), capture_ns=monotonic())

    def newest(self, suffix: str) -> Stamped | None:
        inbox = self._inboxes[suffix]
        inbox.take()
        return inbox.fresh(monotonic())

    def plan(self) -> Plan | None:
        stamped = self.newest("plan")
        return None if stamped is None else stamped.value

    def risk(self) -> Risk | None:
        stamped = self.newest("risk")
        return None if stamped is None else stamped.value

    def status(self, service: str) -> Status | None:
        stamped = self.newest(f"status/{service}")
        return None if stamped is None else stamped.value

    def drives(self) -> bool:
        plan = self.plan()
        return plan is not None and plan.mode == "drive"

    def close(self) -> None:
        self._stop.set()
        self._thread.join(5)

    def _run(self) -> None:
        begin = time.monotonic()
        k = 0
        while not self._stop.wait(max(begin + 0.02 * k - time.monotonic(), 0.0)):
            t = 0.02 * k
            now = monotonic()
            # round and round on the first 100 m, so that the road never ends; the jump back is a new beginning
            x = -40.0 + (SPEED * t) % 100.0
            if self.ego_too:
                self._publishers["ego"].put(samples.ego(x=x, vx=SPEED), capture_ns=now)
            if k % 5 == 0 and self.objects_too:
                self._publishers["objects"].put(samples.objects(1, x=samples.objects(1).x + x), capture_ns=now)
            k += 1


class Stack:
    """Starts, kills and counts service processes."""

    def __init__(self, endpoint: str) -> None:
        self._environment = {
            **os.environ, "FOREFIELD__VEHICLE": "stack", "FOREFIELD__BUS__CONNECT": f'["{endpoint}"]',
            "FOREFIELD__RISKFIELD__H": "0.5", "FOREFIELD__SERVICE__STATUS_HZ": "10", "OMP_NUM_THREADS": "1",
        }  # fmt: skip
        self.processes: dict[str, subprocess.Popen[bytes]] = {}

    def start(self, service: str) -> None:
        self.processes[service] = subprocess.Popen(
            [sys.executable, "-m", f"services.{service}"], cwd=ROOT, env=self._environment, stderr=subprocess.DEVNULL,
            preexec_fn=end_with_the_test,
        )  # fmt: skip

    def kill(self, service: str) -> None:
        process = self.processes.pop(service)
        process.kill()
        process.wait()

    def close(self) -> None:
        for process in self.processes.values():
            process.kill()
            process.wait()


@contextmanager
def stack() -> Iterator[tuple[Stack, Vehicle]]:
    """An empty stack and a vehicle that has published neither map nor route."""
    with router() as endpoint, open_bus(BusSettings(connect=(endpoint,)), "stack", "vehicle") as bus:
        vehicle, services = Vehicle(bus), Stack(endpoint)
        try:
            yield services, vehicle
        finally:
            vehicle.close()
            services.close()
