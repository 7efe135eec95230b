"""The live loop over a real router, driven by a planner made for the test."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import pytest

from common.bus import Bus, BusSettings, open_bus, router
from common.clock import monotonic
from common.messages import Cause, Ego, Objects, Plan, Stamped, Trajectory
from common.topics import EGO, MAP, OBJECTS, PLAN, ROUTE
from rig.launcher import LaunchError
from rig.live import LiveRun, Moment
from rig.settings import RigSettings
from rig.sources import load_scenario
from rig.statuses import Statuses
from rig.world import Scenario

QUICK = RigSettings(run_up_s=0.3, settle_s=5.0)


def straight_on(ego: Stamped[Ego], speed: float) -> Plan:
    """Keep on along the heading at `speed`, then a tail to rest."""
    e = ego.value

    def along(t: np.ndarray, s: np.ndarray, v: np.ndarray) -> Trajectory:
        n = len(t)
        return Trajectory(
            t=t, x=e.x + s * np.cos(e.heading), y=e.y + s * np.sin(e.heading), heading=np.full(n, e.heading),
            curvature=np.zeros(n), speed=v, acceleration=np.gradient(v, t),
        )  # fmt: skip

    t = np.arange(0.0, 0.61, 0.1)
    tail = np.linspace(0.0, speed / 4, 11)
    return Plan(
        mode="drive", reason="test", desired_speed=speed,
        profile=along(t, speed * t, np.full(len(t), speed)),
        tail=along(0.3 + tail, speed * (0.3 + tail) - 2 * tail**2, speed - 4 * tail),
    )  # fmt: skip


class ToyPlanner:
    """Answers every `objects` with a plan that rests on it; notes what it saw."""

    def __init__(self, bus: Bus) -> None:
        self.bus = bus
        self.mode = "drive"
        self.speed = 5.0
        self.objects: list[Stamped[Objects]] = []
        self.egos: list[Stamped[Ego]] = []
        self.latched: set[str] = set()

    def run(self, stop: threading.Event) -> None:
        ego, objects = self.bus.inbox(EGO), self.bus.inbox(OBJECTS)
        once = [self.bus.inbox(MAP), self.bus.inbox(ROUTE)]
        out = self.bus.publisher(PLAN)
        while not stop.is_set():
            self.bus.wait(0.05)
            self.latched |= {i.topic.suffix for i in once if i.take() is not None}
            if (e := ego.take()) is not None:
                self.egos.append(e)
            if (o := objects.take()) is None or ego.latest is None:
                continue
            self.objects.append(o)
            plan = straight_on(ego.latest, self.speed)
            if self.mode != "drive":
                plan = Plan(mode="waiting", reason="the toy waits")
            out.put(plan, capture_ns=ego.latest.capture_ns, cause=o.descent(), arrived_ns=o.received_ns)


@contextmanager
def world() -> Iterator[tuple[Bus, ToyPlanner]]:
    stop = threading.Event()
    with router() as endpoint:
        settings = BusSettings(connect=(endpoint,))
        with open_bus(settings, "ego", "rig") as rig, open_bus(settings, "ego", "toy") as other:
            toy = ToyPlanner(other)
            thread = threading.Thread(target=toy.run, args=(stop,))
            thread.start()
            try:
                yield rig, toy
            finally:
                stop.set()
                thread.join()


def drive(
    scenario: Scenario, bus: Bus, duration_s: float, settings: RigSettings = QUICK
) -> tuple[LiveRun, list[Moment]]:
    moments: list[Moment] = []
    live = LiveRun(bus, scenario, settings, Statuses(bus, ()))
    live.drive(duration_s, lambda: None, moments.append)
    return live, moments


@pytest.fixture(scope="module")
def scenario() -> Scenario:
    return load_scenario("straight")


def test_a_run_has_its_length_its_rates_and_a_latency_for_every_frame(scenario):
    with world() as (bus, toy):
        live, moments = drive(scenario, bus, 1.5)
    result, tally = live.result, live.tally
    assert result.completed
    assert result.settled
    assert result.duration_s == pytest.approx(1.5)
    assert tally.frames["objects"] == 16
    assert len(tally.end_to_end_ms) >= 14
    assert all(0.0 < ms < 1000.0 for ms in tally.end_to_end_ms)
    assert result.modes["drive"] == pytest.approx(1.5, abs=0.02 + 1e-9)
    assert toy.latched == {"map", "route"}
    assert {m.phase for m in moments} == {"settling", "run-up", "run"}


def test_the_schedule_does_not_drift(scenario):
    with world() as (bus, toy):
        drive(scenario, bus, 1.5)
    captures = np.array([o.capture_ns for o in toy.objects])[-14:]
    steps = np.diff(captures) * 1e-9
    frames = np.round(steps / 0.1)
    # content is stamped with the time at which it was due, so that only the age's estimate can jitter
    assert abs((captures[-1] - captures[0]) * 1e-9 - 0.1 * frames.sum()) < 0.02


def test_nothing_moves_and_nobody_is_there_until_a_plan_came_through(scenario):
    busy = load_scenario("following")
    with world() as (bus, toy):
        drive(busy, bus, 0.5)
    counts = [len(o.value.id) for o in toy.objects]
    first = next(i for i, n in enumerate(counts) if n)
    assert first >= 1
    assert not any(counts[:first])
    assert all(counts[first:])
    # from then on everyone has moved on by velocity × time between any two frames
    a, b = toy.objects[first].value, toy.objects[first + 2].value
    frames = toy.objects[first + 2].seq - toy.objects[first].seq
    assert b.x - a.x == pytest.approx(a.vx * 0.1 * frames, abs=0.05)


def test_a_waiting_planner_is_counted_with_its_reason(scenario):
    with world() as (bus, toy):
        toy.mode = "waiting"
        live, _ = drive(scenario, bus, 0.6)
    assert live.result.modes["waiting"] == pytest.approx(0.6)
    assert live.result.first_drive_s is None
    assert live.result.reasons["waiting: the toy waits"] >= 25


def test_without_a_planner_the_run_ends_in_waiting_and_the_vehicle_brakes(scenario):
    with router() as endpoint, open_bus(BusSettings(connect=(endpoint,)), "ego", "rig") as bus:
        live, moments = drive(scenario, bus, 0.6, RigSettings(run_up_s=0.1, settle_s=0.2))
    assert not live.result.settled
    assert live.result.modes["waiting"] == pytest.approx(0.6)
    assert moments[-1].ego.speed < scenario.ego0.speed
    assert live.tally.latency_ms()["end_to_end"]["p50"] is None


def test_the_vehicle_drives_the_plan(scenario):
    with world() as (bus, toy):
        toy.speed = 3.0
        _, moments = drive(scenario, bus, 3.0)
    assert moments[-1].ego.speed == pytest.approx(3.0, abs=0.4)


def test_a_dead_service_ends_the_run_at_once_and_what_was_measured_stays(scenario):
    def check() -> None:
        if live.result.duration_s >= 0.4:
            raise LaunchError("service planner ended")

    with world() as (bus, _):
        live = LiveRun(bus, scenario, QUICK, Statuses(bus, ()))
        with pytest.raises(LaunchError):
            live.drive(5.0, check, lambda _: None)
    assert live.result.duration_s == pytest.approx(0.4)
    assert not live.result.completed
    assert live.measure.summary()["ego"]["distance_m"] > 0
    assert "rig" in live.result.counters


def test_plans_on_foreign_objects_do_not_settle_a_run(scenario):
    stop = threading.Event()
    with router() as endpoint:
        settings = BusSettings(connect=(endpoint,))
        with open_bus(settings, "ego", "rig") as bus, open_bus(settings, "ego", "stranger") as other:

            def speak() -> None:
                out, seq = other.publisher(PLAN), 0
                while not stop.wait(0.05):
                    seq += 1
                    plan = Plan(mode="waiting", reason="somebody else's")
                    out.put(plan, capture_ns=monotonic(), cause=Cause("somebodyelse", seq))

            thread = threading.Thread(target=speak)
            thread.start()
            try:
                live, _ = drive(scenario, bus, 0.2, RigSettings(run_up_s=0.1, settle_s=0.6))
            finally:
                stop.set()
                thread.join()
    assert not live.result.settled
