"""The one loop, as a process over real Zenoh: it answers, counts, survives, declares, and ends when asked."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from common import heartbeat, topics
from common.bus import Bus, BusSettings, Inbox, Publisher, free_port, open_bus, router
from common.clock import monotonic
from common.health import Health
from common.messages import Status
from common.service import Idle, Inputs, Service, _loop
from tests import samples
from tests.processes import end_with_the_test
from tests.waiting import until

ROOT = Path(__file__).parents[2]


class Toy:
    """The toy service, and a vehicle beside it."""

    def __init__(self, bus: Bus, process: subprocess.Popen[str]) -> None:
        self.process = process
        self.objects: Publisher = bus.publisher(topics.OBJECTS)
        self.prediction: Inbox = bus.inbox(topics.PREDICTION)
        self._status: Inbox = bus.inbox(topics.STATUS_OF["predictor"])

    def status(self) -> Status | None:
        self._status.take()
        return None if self._status.latest is None else self._status.latest.value

    def send(self, code: float) -> int:
        return self.objects.put(samples.objects(x=np.full(3, code)), capture_ns=monotonic()).seq

    def answered(self, code: float) -> bool:
        self.send(code)
        self.prediction.take()
        return self.prediction.latest is not None and self.prediction.latest.value.x0[0] == code


def start(endpoint: str, **environment: str) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-m", "tests.contract.toy_service"], cwd=ROOT, text=True, stderr=subprocess.PIPE,
        env={**os.environ, "FOREFIELD__VEHICLE": "toy", "FOREFIELD__BUS__CONNECT": f'["{endpoint}"]', **environment},
        preexec_fn=end_with_the_test,
    )  # fmt: skip


@pytest.fixture
def toy(tmp_path: Path) -> Iterator[Toy]:
    with router() as endpoint, open_bus(BusSettings(connect=(endpoint,)), "toy", "vehicle") as bus:
        process = start(
            endpoint, FOREFIELD__SERVICE__HEARTBEAT=str(tmp_path / "beat"), FOREFIELD__SERVICE__STATUS_HZ="20"
        )
        try:
            toy = Toy(bus, process)
            until(lambda: (s := toy.status()) and s.state == "waiting", within_s=30, what="the service")
            yield toy
        finally:
            process.kill()
            process.communicate()


def test_it_answers_and_its_answer_names_the_cause(toy: Toy) -> None:
    until(lambda: toy.answered(7.0), every_s=0.1, what="an answer")
    answer = toy.prediction.latest
    assert answer is not None and answer.cause is not None
    assert answer.cause.boot == toy.objects._boot
    assert answer.work_ns > 0
    status = until(lambda: toy.answered(7.0) and (s := toy.status()) and s.state == "ready" and s, what="ready")
    assert status.counters["prediction:sent"] >= 1
    assert status.inputs["objects"].valid and not status.inputs["map"].alive


def test_an_exception_is_counted_declared_and_survived(toy: Toy) -> None:
    toy.send(-1.0)
    status = until(lambda: (s := toy.status()) and s.state == "degraded" and s, what="degraded")
    assert status.counters["step:KeyError"] >= 1
    assert "as asked" in status.reason and "KeyError" in status.detail["last_error"]
    until(lambda: toy.answered(8.0), every_s=0.1, what="an answer after the exception")


def test_its_own_broken_message_is_counted_and_not_sent(toy: Toy) -> None:
    toy.send(-2.0)
    status = until(lambda: (s := toy.status()) and s.counters.get("prediction:not_sent_non_finite") and s, what="count")
    assert "prediction.x0" in status.detail["last_error"]
    assert toy.prediction.take() is None


def test_a_result_later_than_a_period_is_a_deadline_missed(toy: Toy) -> None:
    def counted() -> Status | None:
        toy.send(-4.0)
        status = toy.status()
        return status if status is not None and status.counters.get("deadline:missed") else None

    status = until(counted, every_s=0.3, what="the count")
    assert status.counters["deadline:missed"] <= status.counters["prediction:sent"]


def test_a_result_whose_basis_became_too_old_meanwhile_is_not_sent_and_the_next_step_knows_it(toy: Toy) -> None:
    heard: list[tuple[float, int]] = []

    def answered() -> bool:
        stamped = toy.prediction.take()
        if stamped is not None:
            heard.append((float(stamped.value.x0[0]), stamped.seq))
        else:
            toy.send(-5.0)
        return any(code == 6.0 for code, _ in heard)

    until(answered, every_s=0.2, what="the answer as of now")
    assert all(code == 6.0 for code, _ in heard)
    assert heard[0][1] > 0, "the number of what was not sent is left out"
    status = until(
        lambda: (s := toy.status()) and s.counters.get("prediction:not_sent_too_late") and s, what="the count"
    )
    assert status.counters["prediction:sent"] >= 1


def test_a_fatal_error_ends_the_process_with_code_1(toy: Toy) -> None:
    toy.send(-3.0)
    assert toy.process.wait(10) == 1


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_it_ends_within_three_seconds_when_asked_also_under_load(toy: Toy, number: int) -> None:
    until(lambda: toy.answered(7.0), every_s=0.1, what="an answer")
    for _ in range(100):
        toy.send(7.0)
    began = time.monotonic()
    toy.process.send_signal(number)
    assert toy.process.wait(10) == 0
    assert time.monotonic() - began <= 3.0


def test_it_ends_when_asked_while_it_waits_for_its_router() -> None:
    process = start(f"tcp/127.0.0.1:{free_port()}")
    assert process.stderr is not None
    try:
        assert "waiting for the router" in process.stderr.readline()
        began = time.monotonic()
        process.terminate()
        assert process.wait(10) == 0
        assert time.monotonic() - began <= 3.0
    finally:
        process.kill()
        process.communicate()


def test_its_heartbeat_beats_while_it_lives_and_not_after(toy: Toy, tmp_path: Path) -> None:
    beat = tmp_path / "beat"
    until(beat.exists, what="the heartbeat")
    assert heartbeat.main([str(beat)]) == 0
    toy.process.send_signal(signal.SIGSTOP)
    until(lambda: heartbeat.main([str(beat), "--max-age", "0.7"]) == 1, what="silence of a stopped process")
    toy.process.send_signal(signal.SIGCONT)
    until(lambda: heartbeat.main([str(beat), "--max-age", "0.7"]) == 0, what="the heartbeat again")


def test_a_bad_configuration_ends_it_with_code_2_and_names_the_key() -> None:
    process = start("tcp/127.0.0.1:1", FOREFIELD__SERVICE__STATUS_HERTZ="3")
    assert process.wait(20) == 2
    assert "status_hertz" in process.communicate()[1]


def test_a_vehicle_name_that_cannot_stand_in_a_key_ends_it_with_code_2() -> None:
    process = start("tcp/127.0.0.1:1", FOREFIELD__VEHICLE="a/b")
    assert process.wait(20) == 2
    assert "vehicle name 'a/b'" in process.communicate()[1]


def test_a_mistake_of_our_own_is_no_bad_configuration_and_shows_where() -> None:
    with router() as endpoint:
        process = start(endpoint, FOREFIELD__PREDICTOR__ANY="1")
        assert process.wait(20) == 1
    said = process.communicate()[1]
    assert "Traceback" in said and "a mistake of ours" in said


def test_what_a_step_never_had_before_it_is_counted() -> None:
    """Ego comes ten times as often as steps do: each is either before a step, or overwritten, and counted once."""
    had: list[int] = []

    def step(inputs: Inputs) -> Idle:
        ego = inputs.latest(topics.EGO)
        if topics.EGO.suffix in inputs.new and ego is not None:
            had.append(ego.seq)
        return Idle("as asked")

    service = Service("toy", (topics.OBJECTS, topics.EGO), topics.PREDICTION, topics.OBJECTS, 0.1, lambda *_: step)
    stop = threading.Event()
    with router() as endpoint:
        settings = BusSettings(connect=(endpoint,))
        with open_bus(settings, "toy", "vehicle") as vehicle, open_bus(settings, "toy", "toy") as bus:
            inboxes = {t.suffix: bus.inbox(t) for t in service.subscribes}
            health: Health = bus.health
            loop = threading.Thread(
                target=_loop, args=(service, bus, health, inboxes, bus.publisher(topics.PREDICTION), step, stop)
            )
            loop.start()
            try:
                ego = vehicle.publisher(topics.EGO)
                until(lambda: ego._raw.matching_status.matching, what="the subscriber")
                for _ in range(100):
                    ego.put(samples.ego(), capture_ns=monotonic())
                    time.sleep(0.01)
                monitor = inboxes["ego"]._monitor
                until(lambda: monitor.view(monotonic()).received == 100, what="all of them")
                until(lambda: had and had[-1] == 99, what="the step that has the last one")
            finally:
                stop.set()
                bus.interrupt()
                loop.join(10)
            unused = sum(n for name, n in health.counters.items() if name.startswith("ego:"))
            assert len(had) < 50, "there are fewer steps than messages"
            assert len(had) + unused == 100


def test_a_router_whose_heartbeat_cannot_be_written_goes_on_and_says_so(tmp_path: Path) -> None:
    port = free_port()
    command = [sys.executable, "-m", "common.router", "--listen", f"tcp/127.0.0.1:{port}"]
    with subprocess.Popen(
        [*command, "--heartbeat", str(tmp_path / "no" / "folder")], cwd=ROOT, text=True, stderr=subprocess.PIPE,
        preexec_fn=end_with_the_test,
    ) as process:  # fmt: skip
        try:
            assert process.stderr is not None
            until(lambda: "heartbeat" in process.stderr.readline(), within_s=20, what="the warning")
            with open_bus(BusSettings(connect=(f"tcp/127.0.0.1:{port}",)), "toy", "any", wait_s=10):
                pass
            process.terminate()
            assert process.wait(10) == 0
        finally:
            process.kill()
