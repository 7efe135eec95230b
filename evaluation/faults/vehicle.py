"""The vehicle of the fault runs: an endless straight road full of traffic, and our simulated vehicle that drives it.

It publishes `ego` at 50 Hz and `objects` at 10 Hz, takes the newest plan as any vehicle does (refusing and counting),
drives it, and notes at every tick what it drove: profile, stopping tail, or standing with neither.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from dataclasses import dataclass
from typing import Literal

import numpy as np

from common.bus import Bus
from common.messages import Cause, Plan
from common.topics import EGO, MAP, OBJECTS, PLAN, ROUTE
from evaluation.bench_scene import ROAD_M, BenchScene
from rig.settings import RigSettings
from rig.vehicle import SimulatedVehicle
from rig.world import ego_at

TICK_NS = 20_000_000
OBJECTS_EVERY = 5
START_X, END_X = 100.0, ROAD_M - 600.0
KEEP_TICKS = 50 * 60 * 10

Part = Literal["profile", "tail", "over", "none"]
"""What a plan asks for at a moment: its profile, its tail, to stand because it is over; none: there was no plan."""


@dataclass(frozen=True)
class Tick:
    """One tick of the drive."""

    t_ns: int
    x: float  # [m]
    speed: float  # [m/s]
    acceleration: float  # [m/s²]
    boot: str
    """Of the plan in force."""
    seq: int
    part: Part
    wanted_speed: float
    """What that plan asks for at this moment [m/s]; 0 without a plan."""


@dataclass(frozen=True)
class Accepted:
    """A plan that the vehicle took."""

    received_ns: int
    capture_ns: int
    boot: str
    seq: int
    cause: Cause | None
    mode: str
    valid_for: float  # [s]


class Vehicle:
    """Drives from a thread of its own until it is closed."""

    def __init__(self, bus: Bus, *, road_users: int = 32, seed: int = 0) -> None:
        self.bus = bus
        self.scene = BenchScene(road_users, seed, lead=False)
        self.body = SimulatedVehicle(ego_at(START_X, 0.0, 0.0, 0.0), RigSettings())
        self.ego_too = self.objects_too = True
        """Set to False to fall silent."""
        self.ticks: deque[Tick] = deque(maxlen=KEEP_TICKS)
        self.laps = 0
        """How often it was put back to the start of the road."""
        self.objects_put_ns: dict[int, int] = {}
        """When each `objects` message was captured, by its sequence number [ns]."""
        self.accepted: deque[Accepted] = deque(maxlen=20 * 60 * 10)
        """The plans it took, without their content."""
        self.late_ns = 0
        """How late its worst tick was [ns]."""
        self.error: BaseException | None = None
        self._plans = bus.inbox(PLAN)
        self._ego, self._objects = bus.publisher(EGO), bus.publisher(OBJECTS)
        self._map, self._route = bus.publisher(MAP), bus.publisher(ROUTE)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="vehicle", daemon=True)
        self._thread.start()

    def put_map(self) -> None:
        """Say what the road is like."""
        self._map.put(self.scene.map(), capture_ns=time.monotonic_ns())

    def put_route(self) -> None:
        """Say where to go."""
        self._route.put(self.scene.route(), capture_ns=time.monotonic_ns())

    def since(self, t_ns: int, until_ns: int = 2**62) -> list[Tick]:
        """Ticks in a span of time."""
        return [tick for tick in list(self.ticks) if t_ns <= tick.t_ns <= until_ns]

    def captured_ns(self, cause_seq: int) -> int:
        """When an `objects` message of ours was captured [ns]."""
        return self.objects_put_ns[cause_seq]

    def close(self) -> None:
        """Stop driving and publishing."""
        self._stop.set()
        self.bus.interrupt()
        self._thread.join(5.0)

    def _run(self) -> None:
        try:
            self._drive()
        except BaseException as e:  # told by the stack: a dead vehicle must not look like a silent system
            self.error = e
            raise

    def _drive(self) -> None:
        begin = time.monotonic_ns()
        k = 0
        while not self._stop.is_set():
            due = begin + k * TICK_NS
            while (left := due - time.monotonic_ns()) > 0:
                self.bus.wait(left * 1e-9)
                self._take()
                if self._stop.is_set():
                    return
            self._take()
            late = time.monotonic_ns() - due
            self.late_ns = max(self.late_ns, late)
            ego = self.body.step(TICK_NS * 1e-9, due - TICK_NS)
            if ego.x > END_X:
                self.laps += 1
                ego = ego_at(START_X, 0.0, 0.0, self.body.speed)
                self.body.place(ego)
            self._note(due)
            # as in `rig.live`: it carries the time at which it was due, so what we are late is part of its age
            if self.ego_too:
                self._ego.put(ego, capture_ns=due)
            if self.objects_too and k % OBJECTS_EVERY == 0:
                objects = self.scene.objects((due - begin) * 1e-9, ego.x)
                self.objects_put_ns[self._objects.put(objects, capture_ns=due).seq] = due
            k += 1 + late // TICK_NS  # ticks that are over are left out

    def _take(self) -> None:
        plan = self._plans.take()
        if plan is not None:
            value = plan.value
            self.accepted.append(
                Accepted(
                    plan.received_ns, plan.capture_ns, plan.boot, plan.seq, plan.cause, value.mode, value.valid_for
                )
            )
            self.body.receive(plan)

    def _note(self, now_ns: int) -> None:
        plan = self.body.plan
        body = self.body
        if plan is None:
            self.ticks.append(Tick(now_ns, body.x, body.speed, body.acceleration, "", -1, "none", 0.0))
            return
        tau = (now_ns - plan.capture_ns) * 1e-9
        part, wanted = asked(plan.value, tau)
        self.ticks.append(Tick(now_ns, body.x, body.speed, body.acceleration, plan.boot, plan.seq, part, wanted))


def asked(plan: Plan, tau: float) -> tuple[Part, float]:
    """What the contract lets one drive at plan time `tau` [s], and how fast [m/s]; read off the message itself."""
    if plan.profile is not None and len(plan.profile.t) and tau <= plan.valid_for:
        return "profile", float(np.interp(tau, plan.profile.t, plan.profile.speed))
    if plan.tail is not None and len(plan.tail.t) and tau <= plan.tail.t[-1]:
        return "tail", float(np.interp(tau, plan.tail.t, plan.tail.speed))
    return "over", 0.0
