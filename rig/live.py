"""The closed loop in real time: the rig plays the world, the simulated vehicle drives what the services plan.

Three phases, each on a schedule of absolute deadlines (tick k is due at k / ego rate; a late one never moves the next):

1. *settle*: map, route, closures, the ego at the start of the run-up and an **empty** list of objects, until a plan
   rests on it. Maps are read and first calls made before anything moves. It ends after `settle_s` at the latest.
2. *run-up*: the world before time 0, `run_up_s` long: everyone comes straight at his first velocity, so that histories
   fill with motion that fits. The ego is not driven yet.
3. *run*: from time 0 the vehicle drives the newest plan; only this part is measured.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field

import msgspec
import numpy as np

from common.bus import Bus, Inbox
from common.messages import Ego, Objects, Plan, Stamped
from common.topics import CLOSURES, EGO, MAP, OBJECTS, PLAN, ROUTE
from rig.measure import Measure
from rig.settings import RigSettings
from rig.statuses import Statuses
from rig.tally import Tally
from rig.vehicle import SimulatedVehicle
from rig.world import Scenario

MODES = ("drive", "waiting", "safe_stop")
SETTLE_FRAMES = 3
"""So many causes must have come through before the run-up begins."""


@dataclass(frozen=True)
class Moment:
    """What there is to show at one moment of a run."""

    phase: str
    t: float
    duration_s: float
    ego: Ego
    plan: Plan | None
    end_to_end_ms: float | None


@dataclass
class LiveResult:
    """Everything measured of one run."""

    duration_s: float = 0.0
    modes: dict[str, float] = field(default_factory=lambda: dict.fromkeys(MODES, 0.0))
    first_drive_s: float | None = None
    modes_after_first_drive: dict[str, float] = field(default_factory=lambda: dict.fromkeys(MODES, 0.0))
    reasons: Counter[str] = field(default_factory=Counter)
    """Reasons of everything that was not `drive`, in ticks."""
    late_ms: list[float] = field(default_factory=list)
    """How late each tick of the rig itself was [ms]."""
    counters: dict[str, Counter[str]] = field(default_factory=dict)
    """`topic:reason` counters of the run, by receiver."""
    settled: bool = False
    completed: bool = False


class LiveRun:
    """One drive through one scenario on a bus where the services already listen."""

    def __init__(self, bus: Bus, scenario: Scenario, settings: RigSettings, statuses: Statuses) -> None:
        self.bus, self.scenario, self.settings = bus, scenario, settings
        self.measure = Measure(scenario)
        self.tally = Tally(bus.boot)
        self.tally.listen(bus)
        self.result = LiveResult()
        self.vehicle = SimulatedVehicle(scenario.ego0, settings)
        self._statuses = statuses
        self._plans: Inbox = bus.inbox(PLAN)
        self._plan: Stamped[Plan] | None = None
        self._ego, self._objects = bus.publisher(EGO), bus.publisher(OBJECTS)
        self._latched = {t.suffix: bus.publisher(t) for t in (MAP, ROUTE, CLOSURES)}
        self._closed: list[int] | None = None
        self._every = max(1, round(settings.ego_rate_hz / settings.objects_rate_hz))
        self._tick_ns = round(1e9 / settings.ego_rate_hz)

    def drive(self, duration_s: float, check: Callable[[], None], show: Callable[[Moment], None]) -> None:
        """Settle, run up, run.

        Args:
            duration_s: length of the run [s].
            check: called every tick; raises to end the run (a service died).
            show: called with what there is to see, every frame of objects.
        """
        now = time.monotonic_ns()
        if self.scenario.map is not None:
            self._latched["map"].put(self.scenario.map, capture_ns=now)
        self._latched["route"].put(self.scenario.route, capture_ns=now)
        self.bus.health.say("ready", f"plays {self.scenario.name}")
        self._settle(check, show)
        self._play(duration_s, check, show)

    # --- the phases ---

    def _settle(self, check: Callable[[], None], show: Callable[[Moment], None]) -> None:
        t = -self.settings.run_up_s
        ego, nobody = self.scenario.ego_before(t), _nobody(self.scenario.objects_at(0.0))
        causes: set[int] = set()
        start = time.monotonic_ns()
        for k in range(round(self.settings.settle_s * self.settings.ego_rate_hz)):
            due = start + k * self._tick_ns
            self._until(due)
            self._publish(k, t, due, ego, nobody)
            cause = None if self._plan is None else self._plan.cause
            if cause is not None and cause.boot == self.bus.boot:
                causes.add(cause.seq)
            self.result.settled = len(causes) >= SETTLE_FRAMES
            check()
            if k % self._every == 0:
                show(Moment("settling", t, 0.0, ego, self._value(), None))
            if self.result.settled:
                return

    def _play(self, duration_s: float, check: Callable[[], None], show: Callable[[Moment], None]) -> None:
        rate, result = self.settings.ego_rate_hz, self.result
        before = {}
        first, last = -round(self.settings.run_up_s * rate), round(duration_s * rate)
        dt = self._tick_ns * 1e-9
        start = time.monotonic_ns() - first * self._tick_ns
        ego = self.scenario.ego0
        try:
            for k in range(first, last + 1):
                t, due = k / rate, start + k * self._tick_ns
                self._until(due)
                if k == 0:
                    before = self._counters()
                    self.tally.begin()
                ego = self.scenario.ego_before(t) if k <= 0 else self.vehicle.step(dt, due - self._tick_ns)
                objects = self.scenario.objects_at(t)
                self._publish(k, t, due, ego, objects)
                if k >= 0:
                    self.measure.observe(t, ego, objects, self._value())
                    self._note(k, t, due, dt)
                check()
                if k % self._every == 0:
                    show(Moment("run-up" if k < 0 else "run", t, duration_s, ego, self._value(), self._latest_ms()))
                if k > 0 and self.measure.goal_t is not None and self.settings.end_at_goal:
                    break
            result.completed = True
        finally:
            after = self._counters()
            result.counters = {name: counts - before.get(name, Counter()) for name, counts in after.items()}

    # --- the parts of a tick ---

    def _until(self, due_ns: int) -> None:
        """Take plans and statuses as they come, until the tick is due."""
        while True:
            remaining = (due_ns - time.monotonic_ns()) * 1e-9
            if remaining <= 0.0:
                break
            self.bus.wait(remaining)
            self._receive()
        self._receive()

    def _receive(self) -> None:
        plan = self._plans.take()
        if plan is not None:
            self._plan = plan
            self.vehicle.receive(plan)
        self._statuses.update()

    def _publish(self, k: int, t: float, due_ns: int, ego: Ego, objects: Objects) -> None:
        """Everything carries the time at which it is due: what the rig is late is part of its age."""
        self._ego.put(ego, capture_ns=due_ns)
        self.bus.health.turned()
        if k % self._every:
            return
        closures = self.scenario.closures_at(t)
        if closures.ids != self._closed:
            self._closed = closures.ids
            self._latched["closures"].put(closures, capture_ns=due_ns)
        now = time.monotonic_ns()
        self.tally.put(self._objects.put(objects, capture_ns=due_ns), now)

    def _note(self, k: int, t: float, due_ns: int, dt: float) -> None:
        result = self.result
        result.duration_s = t
        self.bus.health.detail["run_s"] = f"{t:.3f}"  # who records can tell when the run began
        result.late_ms.append((time.monotonic_ns() - due_ns) * 1e-6)
        plan = self._value()
        mode = "waiting" if plan is None else plan.mode
        if mode == "drive" and result.first_drive_s is None:
            result.first_drive_s = t
        if k == 0:
            return
        result.modes[mode] += dt
        if result.first_drive_s is not None:
            result.modes_after_first_drive[mode] += dt
        if mode != "drive":
            result.reasons[f"{mode}: {'no plan is heard' if plan is None else plan.reason}"] += 1

    def _value(self) -> Plan | None:
        """The plan in force; None while the planner is silent."""
        fresh = self._plans.fresh(time.monotonic_ns())
        return None if fresh is None or self._plan is None else self._plan.value

    def _latest_ms(self) -> float | None:
        return self.tally.last_end_to_end_ms()

    def _counters(self) -> dict[str, Counter[str]]:
        return {"rig": Counter(self.bus.counters), **self._statuses.counters()}


def _nobody(objects: Objects) -> Objects:
    """The same message without anyone in it: a statement that nobody is there."""
    empty = {
        name: value[:0] for name, value in msgspec.structs.asdict(objects).items() if isinstance(value, np.ndarray)
    }
    return msgspec.structs.replace(objects, **empty)
