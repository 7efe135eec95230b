"""viz as a process beside real Zenoh: it draws what it hears, survives what it cannot draw, and finishes its file."""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

pytest.importorskip("rerun")

from common import topics
from common.bus import Bus, BusSettings, free_port, open_bus, router
from common.clock import monotonic
from common.health import Health
from common.messages import Cause, Status
from tests.processes import end_with_the_test
from tests.viz import synthetic
from tests.viz.reading import rows
from tests.waiting import until
from viz import __main__ as process

ROOT = Path(__file__).parents[2]
DRIVE = synthetic.Drive(rows=64, columns=32, h=1.25)
ENDS_WITHIN_S = 3.0


def start(endpoint: str, *arguments: str) -> subprocess.Popen[str]:
    environment = {**os.environ, "FOREFIELD__BUS__CONNECT": f'["{endpoint}"]', "FOREFIELD__SERVICE__STATUS_HZ": "20",
                   "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}  # fmt: skip
    return subprocess.Popen(
        [sys.executable, "-m", "viz", *arguments], cwd=ROOT, text=True, stderr=subprocess.PIPE, env=environment,
        preexec_fn=end_with_the_test,
    )  # fmt: skip


def end(viz: subprocess.Popen[str]) -> tuple[int, str]:
    """Ask viz to end; its exit code and what it said. Fails if it takes too long."""
    asked = time.monotonic()
    viz.send_signal(signal.SIGTERM)
    _, said = viz.communicate(timeout=20)
    assert time.monotonic() - asked < ENDS_WITHIN_S
    return viz.returncode, said


class Vehicle:
    """Says on the bus what vehicle and services would."""

    def __init__(self, bus: Bus) -> None:
        self.out = {t.suffix: bus.publisher(t) for t in topics.TOPICS.values() if t.suffix != "status/viz"}
        self.heard = bus.inbox(topics.STATUS_OF["viz"])

    def status(self) -> Status | None:
        self.heard.take()
        return None if self.heard.latest is None else self.heard.latest.value

    def drawn(self, topic: str) -> int:
        status = self.status()
        return status.inputs[topic].used if status is not None and topic in status.inputs else 0

    def say(self, frame: int) -> None:
        t, now = 0.1 * frame, monotonic()
        self.out["ego"].put(DRIVE.ego(t), capture_ns=now)
        cause = self.out["objects"].put(DRIVE.objects(t), capture_ns=now)
        for topic in ("prediction", "risk", "plan"):
            self.out[topic].put(getattr(DRIVE, topic)(t), capture_ns=now, cause=cause, arrived_ns=now)
        self.out["status/planner"].put(DRIVE.status("planner", t), capture_ns=now)


@pytest.fixture
def endpoint() -> Iterator[str]:
    with router() as endpoint:
        yield endpoint


@pytest.fixture
def vehicle(endpoint: str) -> Iterator[Vehicle]:
    with open_bus(BusSettings(connect=(endpoint,)), "ego", "vehicle") as bus:
        yield Vehicle(bus)


def test_it_records_and_serves_what_it_hears_and_ends_when_asked(endpoint, vehicle, tmp_path):
    path, port = tmp_path / "run.rrd", free_port()
    vehicle.out["map"].put(DRIVE.map(), capture_ns=monotonic())  # before viz is there: it is latched
    viz = start(endpoint, "--record", str(path), "--scenario", "made up", "--serve", str(port))
    try:
        until(lambda: (s := vehicle.status()) and s.state == "ready", within_s=30, what="viz")
        vehicle.out["route"].put(DRIVE.route(), capture_ns=monotonic())
        frame = 0

        def told(topic: str) -> bool:
            nonlocal frame
            vehicle.say(frame)
            frame += 1
            return vehicle.drawn(topic) >= 3

        for topic in ("objects", "risk", "plan"):
            until(lambda topic=topic: told(topic), within_s=20, every_s=0.1, what=f"three {topic}")
        with socket.create_connection(("127.0.0.1", port), timeout=2):
            pass
        status = vehicle.status()
        assert status is not None and not [c for c in status.counters if ":draw_" in c]
        code, said = end(viz)
    finally:
        viz.kill()
        viz.communicate()
    assert code == 0 and "Traceback" not in said
    verify = [Path(sys.executable).with_name("rerun"), "rrd", "verify", path]
    assert subprocess.run(verify, capture_output=True, timeout=60, check=False).returncode == 0
    for entity in ("/world/map/surface", "/world/route/goal", "/planner"):
        assert rows(path, entity), entity
    for entity in ("/world/ego", "/world/objects/box", "/world/risk/now", "/world/plan/profile"):
        frames = [frame for frame, _ in rows(path, entity)]
        assert len(frames) >= 3 and frames == sorted(frames), entity
    assert rows(path, "/plot/latency/end_to_end")


def test_without_a_router_it_waits_and_ends_when_asked(tmp_path):
    viz = start(f"tcp/127.0.0.1:{free_port()}", "--record", str(tmp_path / "run.rrd"))
    assert viz.stderr is not None
    try:
        until(lambda: "waiting for the router" in viz.stderr.readline(), within_s=20, what="the first words")
        code, _ = end(viz)
    finally:
        viz.kill()
        viz.communicate()
    assert code == 0


@pytest.mark.parametrize(
    ("arguments", "said"),
    [(("--record", "/nowhere/at/all/run.rrd"), "no such folder"), (("--serve", "70000"), "serve")],
)
def test_what_it_cannot_do_it_says_and_leaves(endpoint, arguments, said):
    viz = start(endpoint, *arguments)
    _, heard = viz.communicate(timeout=30)
    assert viz.returncode == 2
    assert said in heard and "Traceback" not in heard


def test_a_taken_port_is_named(endpoint, tmp_path):
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        viz = start(endpoint, "--serve", str(port), "--record", str(tmp_path / "run.rrd"))
        _, heard = viz.communicate(timeout=30)
    assert viz.returncode == 2
    assert f"127.0.0.1:{port}" in heard and "choose another port" in heard and "Traceback" not in heard


class Picky:
    """A scene that cannot draw its first objects, nor any plan."""

    def __init__(self) -> None:
        self.drawn: list[str] = []

    def __getattr__(self, name: str):
        return lambda *_: self.drawn.append(name)

    def objects(self, _) -> None:
        if "failed" not in self.drawn:
            self.drawn.append("failed")
            raise ZeroDivisionError("as asked")
        self.drawn.append("objects")

    def plan(self, _) -> None:
        raise KeyError("as asked")


def test_what_cannot_be_drawn_is_counted_by_its_name_and_the_rest_is_drawn(endpoint, vehicle):
    scene, health, stop = Picky(), Health("viz", monotonic), threading.Event()
    with open_bus(BusSettings(connect=(endpoint,)), "ego", "viz", health=health) as bus:
        drawing = threading.Thread(target=process._draw, args=(bus, health, scene, stop))
        drawing.start()
        try:
            until(lambda: health.state == "ready", what="viz")

            def told() -> bool:
                vehicle.say(0)
                return "objects" in scene.drawn and "risk" in scene.drawn and health.counters["plan:draw_KeyError"] > 1

            until(told, every_s=0.1, what="what can be drawn")
            assert drawing.is_alive()
        finally:
            stop.set()
            bus.interrupt()
            drawing.join(timeout=5)
    assert not drawing.is_alive()
    assert health.counters["objects:draw_ZeroDivisionError"] == 1
    assert "as asked" in health.detail["last_error"]
    assert isinstance(health.status(), Status)


def test_what_the_bus_refuses_reaches_no_drawing(endpoint, vehicle):
    scene, health, stop = Picky(), Health("viz", monotonic), threading.Event()
    with open_bus(BusSettings(connect=(endpoint,)), "ego", "viz", health=health) as bus:
        drawing = threading.Thread(target=process._draw, args=(bus, health, scene, stop))
        drawing.start()
        try:
            until(lambda: health.state == "ready", what="viz")

            def told() -> bool:
                old = monotonic() - 10**10
                vehicle.out["risk"].put(DRIVE.risk(0.0), capture_ns=old, cause=Cause("synthetic0", 1))
                return health.counters["risk:stale"] > 0

            until(told, every_s=0.1, what="a refusal")
        finally:
            stop.set()
            bus.interrupt()
            drawing.join(timeout=5)
    assert "risk" not in scene.drawn


def test_it_does_not_outlive_a_test_that_was_killed(endpoint: str) -> None:
    script = (
        "from tests.viz.test_viz_process import start\n"
        f"viz = start({endpoint!r})\n"
        "print(viz.pid, flush=True)\n"
        "viz.communicate()\n"
    )
    with subprocess.Popen([sys.executable, "-c", script], cwd=ROOT, text=True, stdout=subprocess.PIPE) as test:
        assert test.stdout is not None
        number = int(test.stdout.readline())
        test.kill()
    try:
        until(lambda: state(number) == "Z", within_s=10, what="its end")
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.kill(number, signal.SIGKILL)


def state(number: int) -> str:
    with contextlib.suppress(OSError):
        return Path(f"/proc/{number}/stat").read_text().rsplit(")", 1)[1].split()[0]
    return "Z"
