"""The closed loop in simulated time: planner, simulated vehicle and measures in one process, no bus.

Deterministic. Every stage takes its stated latency: what it makes from inputs taken at t is there at t + latency, and
it takes nothing new before. Inputs are latest-only, as on the bus; the planner starts when new
risk arrives and at the latest 50 ms after its last start. Before time 0 there is a run-up in which everyone moves
straight at his first velocity, so that histories fill and a plan is in force when the vehicle starts to drive.
"""

from __future__ import annotations

import heapq
import itertools
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, TypeVar

import numpy as np

from common import config
from common.messages import Cause, Closures, Ego, Map, Objects, Plan, Prediction, Risk, Route, Stamped
from evaluation.planning.drivers import Alone, Cores
from evaluation.planning.traffic import Replay, Traffic
from rig.measure import Measure
from rig.settings import RigSettings
from rig.sources import Scenario
from rig.vehicle import SimulatedVehicle

MS = 1_000_000  # ns
OBJECTS_NS, PLANNER_NS = 100 * MS, 50 * MS
ORIGIN_NS = 10_000 * MS  # the clock at time 0 of the run; never 0 or negative
BOOT = "simulated"

T = TypeVar("T")
Watch = Callable[[float, Ego, Objects, Plan | None], None]


@dataclass(frozen=True)
class Latency:
    """How long each stage takes, transport included [ms]."""

    predictor: float = 10.0
    riskfield: float = 30.0
    planner: float = 20.0


@dataclass
class DriveResult:
    """What one drive was like."""

    scenario: str
    duration_s: float = 0.0
    wall_s: float = 0.0
    summary: dict[str, Any] = field(default_factory=dict)
    modes: dict[str, float] = field(default_factory=lambda: {"drive": 0.0, "waiting": 0.0, "safe_stop": 0.0})
    reasons: Counter[str] = field(default_factory=Counter)
    """Reasons of all plans that were not `drive`."""
    plans: list[dict[str, Any]] = field(default_factory=list)
    """Each plan: t, mode, reason, the ego's speed, the desired speed, what decided."""
    work_ms: dict[str, list[float]] = field(default_factory=dict)
    """Computing time of every call, by stage; it does not enter simulated time."""
    warnings: tuple[str, ...] = ()

    def share(self, mode: str) -> float:
        """Share of the driven time in a mode."""
        return self.modes[mode] / max(sum(self.modes.values()), 1e-9)

    def as_dict(self, *, plans: bool = False) -> dict[str, Any]:
        """Everything as plain values."""
        work = {
            k: {"p50": round(float(np.percentile(v, 50)), 2), "p99": round(float(np.percentile(v, 99)), 2)}
            for k, v in self.work_ms.items()
        }
        return {
            "scenario": self.scenario,
            "duration_s": round(self.duration_s, 3),
            "wall_s": round(self.wall_s, 2),
            "modes": {k: round(v, 3) for k, v in self.modes.items()},
            "reasons": dict(self.reasons),
            **self.summary,
            "work_ms": work,
            "warnings": list(self.warnings),
            **({"plans": self.plans} if plans else {}),
        }


def drive(
    scenario: Scenario,
    tree: config.Tree | None = None,
    *,
    latency: Latency | None = None,
    cores: Cores | Alone | None = None,
    traffic: Traffic | None = None,
    watch: Watch | None = None,
) -> DriveResult:
    """Drive through a scenario and measure it.

    Args:
        scenario: The world.
        tree: A configuration as `common.config.load` returns it.
        latency: Of each stage.
        cores: Who plans; default: the planner of the configuration.
        traffic: How the others move; default: as recorded.
        watch: Sees every state (t, ego, objects, plan).
    """
    tree = {} if tree is None else tree
    run = _Run(scenario, tree, latency or Latency(), cores or Cores.of(tree), traffic or Replay(scenario), watch)
    return run.go()


class _Run:
    """One drive: a queue of events in simulated time."""

    def __init__(
        self,
        scenario: Scenario,
        tree: config.Tree,
        latency: Latency,
        cores: Cores | Alone,
        traffic: Traffic,
        watch: Watch | None,
    ) -> None:
        self.scenario, self.cores, self.traffic, self.watch = scenario, cores, traffic, watch
        self.settings = config.section(tree, "rig", RigSettings)
        self.delay = {k: round(v * MS) for k, v in vars(latency).items()}
        self.vehicle = SimulatedVehicle(scenario.ego0, self.settings)
        self.measure = Measure(scenario)
        self.result = DriveResult(scenario.name, warnings=scenario.warnings)
        self.map = None if scenario.map is None else self._stamp(scenario.map, ORIGIN_NS - 2000 * MS)
        self.route: Stamped[Route] = self._stamp(scenario.route, ORIGIN_NS - 2000 * MS)
        self.closures: Closures = traffic.closures_at(0.0)
        self.ego: Stamped[Ego] | None = None
        self.objects: Stamped[Objects] | None = None
        self.prediction: Stamped[Prediction] | None = None
        self.risk: Stamped[Risk] | None = None
        self.busy = {"predictor": 0, "riskfield": 0, "planner": 0}  # until when [ns]
        self.waiting: dict[str, bool] = {"predictor": False, "riskfield": False}
        self.planned_ns = 0
        self.seq = 0
        self._order = itertools.count()
        self._queue: list[tuple[int, int, int, Callable[[int], None]]] = []
        self._moved_ns = ORIGIN_NS

    def _stamp(
        self, value: T, capture_ns: int, received_ns: int | None = None, cause: Cause | None = None
    ) -> Stamped[T]:
        return Stamped(value, capture_ns, capture_ns if received_ns is None else received_ns, cause, boot=BOOT)

    def _at(self, when_ns: int, rank: int, call: Callable[[int], None]) -> None:
        heapq.heappush(self._queue, (when_ns, rank, next(self._order), call))

    def go(self) -> DriveResult:
        began = time.perf_counter()
        first = ORIGIN_NS - round(self.settings.run_up_s * 10) * OBJECTS_NS
        last = ORIGIN_NS + round(self.scenario.duration_s * 1000) * MS
        self._at(first, 0, self._tick)
        self._at(first, 1, self._see)
        self._at(first + self.delay["planner"], 5, self._plan)
        while self._queue:
            now, _, _, call = heapq.heappop(self._queue)
            if now > last or (self.settings.end_at_goal and self.measure.goal_t is not None):
                break
            call(now)
        self.result.duration_s = max(0.0, (self._moved_ns - ORIGIN_NS) * 1e-9)
        self.result.summary = self.measure.summary()
        self.result.wall_s = time.perf_counter() - began
        return self.result

    # --- the world: the vehicle 50 times a second, perception 10 times ---

    def _move(self, now: int) -> Ego:
        """Bring the vehicle to `now`; before time 0 it comes straight at its first velocity."""
        t = (now - ORIGIN_NS) * 1e-9
        if now <= ORIGIN_NS:
            return self.scenario.ego_before(t)
        ego = self.vehicle.step((now - self._moved_ns) * 1e-9, self._moved_ns)
        mode = "waiting" if self.vehicle.plan is None else self.vehicle.plan.value.mode
        self.result.modes[mode] += (now - self._moved_ns) * 1e-9
        self._moved_ns = now
        return ego

    def _tick(self, now: int) -> None:
        ego = self._move(now)
        self.ego = self._stamp(ego, now)
        t = (now - ORIGIN_NS) * 1e-9
        if t >= 0.0:
            self.traffic.advance(t, ego)
            objects = self.traffic.objects_at(t)
            plan = None if self.vehicle.plan is None else self.vehicle.plan.value
            self.measure.observe(t, ego, objects, plan)
            if self.watch is not None:
                self.watch(t, ego, objects, plan)
        self._at(now + round(1000 / self.settings.ego_rate_hz) * MS, 0, self._tick)

    def _see(self, now: int) -> None:
        t = (now - ORIGIN_NS) * 1e-9
        self.seq += 1
        self.objects = self._stamp(self.traffic.objects_at(t), now, cause=Cause(BOOT, self.seq))
        self.closures = self.traffic.closures_at(t)
        self.waiting["predictor"] = True
        self._predict(now)
        self._at(now + OBJECTS_NS, 1, self._see)

    # --- the stages ---

    def _timed(self, stage: str, call: Callable[[], T]) -> T:
        began = time.perf_counter()
        value = call()
        self.result.work_ms.setdefault(stage, []).append((time.perf_counter() - began) * 1e3)
        return value

    @property
    def _world(self) -> Map | None:
        return None if self.map is None else self.map.value

    def _predict(self, now: int) -> None:
        objects, cores = self.objects, self.cores
        if not isinstance(cores, Cores):
            return
        if now < self.busy["predictor"] or not self.waiting["predictor"] or objects is None:
            return
        self.waiting["predictor"] = False
        done = self.busy["predictor"] = now + self.delay["predictor"]
        prediction = self._timed("predictor", lambda: cores.predictor.step(objects, self.ego, self._world))

        def arrive(then: int) -> None:
            self.prediction = self._stamp(prediction, objects.capture_ns, then, objects.cause)
            self.waiting["riskfield"] = True
            self._evaluate(then)
            self._predict(then)

        self._at(done, 2, arrive)

    def _evaluate(self, now: int) -> None:
        prediction, ego, cores = self.prediction, self.ego, self.cores
        assert isinstance(cores, Cores)
        if now < self.busy["riskfield"] or not self.waiting["riskfield"] or prediction is None or ego is None:
            return
        self.waiting["riskfield"] = False
        done = self.busy["riskfield"] = now + self.delay["riskfield"]
        risk = self._timed("riskfield", lambda: cores.riskfield.step(prediction, ego, self._world, self.closures, 0.0))

        def arrive(then: int) -> None:
            self.risk = self._stamp(risk, prediction.capture_ns, then, prediction.cause)
            if then >= self.busy["planner"]:
                self._plan(then)
            self._evaluate(then)

        self._at(done, 3, arrive)

    def _plan(self, now: int) -> None:
        if now < self.busy["planner"] or (now == self.planned_ns and now > 0):
            return
        ego, risk = self.ego, self.risk
        self.planned_ns = now
        done = self.busy["planner"] = now + self.delay["planner"]
        plan = self._timed("planner", lambda: self._decide(ego, risk, now))
        took = getattr(self.cores, "took_ms", None)
        if took is not None:
            self.result.work_ms["planner"][-1] = took
        capture = now if ego is None else ego.capture_ns
        speed = 0.0 if ego is None else ego.value.speed
        self._note(plan, (capture - ORIGIN_NS) * 1e-9, speed)

        def arrive(then: int) -> None:
            if then > ORIGIN_NS:
                self._move(then)
            self.vehicle.receive(self._stamp(plan, capture, then, None if risk is None else risk.cause))
            # risk that came meanwhile is taken at once
            if self.risk is not risk:
                self._plan(then)

        def due(then: int) -> None:
            if self.planned_ns == now:
                self._plan(then)

        self._at(done, 4, arrive)
        self._at(max(now + PLANNER_NS, done), 5, due)

    def _decide(self, ego: Stamped[Ego] | None, risk: Stamped[Risk] | None, now: int) -> Plan:
        if isinstance(self.cores, Cores):
            return self.cores.planner.step(ego, risk, self.map, self.route, now)
        if ego is None or self.objects is None:
            return Plan(mode="waiting", reason="nothing seen yet")
        return self.cores.plan(ego, self.objects, self._world, self.route.value, self.closures)

    def _note(self, plan: Plan, t: float, speed: float) -> None:
        if t >= 0.0 and plan.mode != "drive":
            self.result.reasons[f"{plan.mode}: {plan.reason}"] += 1
        self.result.plans.append(
            {
                "t": round(t, 3),
                "mode": plan.mode,
                "reason": plan.reason,
                "speed": round(speed, 3),
                "desired_speed": round(plan.desired_speed, 3),
                "decision": "" if plan.decision is None else plan.decision.sentence,
                "term": None if plan.decision is None else plan.decision.term,
                "source_id": None if plan.decision is None else plan.decision.source_id,
            }
        )
