"""A recorded bus run driven again by the simulated-time loop, with the arrival times of the recording.

Stated latencies (`loop.Latency`) stand in for what happens on a bus: messages arrive some time after they were made,
and a service takes the newest of each kind when it begins. Here the times are those of a real run instead: each stage
begins when the service began, has in hand what had arrived there by then, and its output arrives when the next service
first had it. Only the world's messages (ego, objects, map, route, closures) come from the recording; predictions and
risks are the loop's own, so that its plans are those of the bus run only if every stage between hands on the same.
"""

from __future__ import annotations

import functools
import heapq
from dataclasses import dataclass, replace
from typing import Any

from common import codec
from common.config import Tree
from common.messages import Closures, Ego, Plan, Prediction, Risk, Stamped, StepInputs, Used
from evaluation.planning.drivers import Cores
from evaluation.planning.loop import Latency, _Run
from evaluation.planning.traffic import Replay
from rig.bus_log.reader import BusLog
from rig.world import Scenario

STAGES = {"prediction": "predictor", "risk": "riskfield", "plan": "planner"}
"""Who makes a topic."""
LAST = 9
"""Rank of a beginning: after everything that arrives at that moment."""


@dataclass(frozen=True)
class Step:
    """One step of a service."""

    stage: str
    seq: int
    inputs: StepInputs
    arrives_ns: int = 0
    """When its output was first had by the next stage, or else when this one began again."""


@dataclass(frozen=True)
class Run:
    """A recorded run: what the world said, who began when with what, and what was planned."""

    world: dict[tuple[str, int], Stamped[Any]]
    steps: list[Step]
    plans: dict[int, Plan]

    @staticmethod
    def of(log: BusLog) -> Run:
        """Read it.

        Raises:
            ValueError: a service ran more than once, or the messages do not name what their steps had.
        """
        world: dict[tuple[str, int], Stamped[Any]] = {}
        steps, plans = [], {}
        boots: dict[str, str] = {}
        for message in log.messages():
            topic, header = message.topic.suffix, message.header()
            if topic not in ("ego", "objects", "map", "route", "closures", *STAGES):
                continue
            if boots.setdefault(topic, header.boot) != header.boot:
                raise ValueError(f"{log.path}: who makes `{topic}` was started twice")
            if topic not in STAGES or topic == "plan":
                value: Any = codec.decode_body(message.topic, header, message.payload)
            if topic not in STAGES:
                world[topic, header.seq] = Stamped(value, 0, 0, header.cause, header.source, header.boot, header.seq)
                continue
            if header.step is None:
                raise ValueError(f"{log.path}: `{topic}` does not say what its steps had")
            steps.append(Step(STAGES[topic], header.seq, header.step))
            if topic == "plan":
                plans[header.seq] = value
        return Run(world, _arrivals(steps), plans)


def _arrivals(steps: list[Step]) -> list[Step]:
    """The steps in the order in which they began, with the time at which each output arrived."""
    first: dict[tuple[str, int], int] = {}
    again: dict[tuple[str, int], int] = {}
    for step in steps:
        for used in step.inputs.used:
            key = (STAGES.get(used.topic, ""), used.seq)
            first[key] = min(first.get(key, step.inputs.now_ns), step.inputs.now_ns)
        again[step.stage, step.seq - 1] = step.inputs.now_ns
    ends = max(s.inputs.now_ns for s in steps) + 1_000_000
    timed = []
    for s in steps:
        key = (s.stage, s.seq)
        timed.append(replace(s, arrives_ns=min(first.get(key, ends), again.get(key, ends), ends)))
    return sorted(timed, key=lambda s: s.inputs.now_ns)


def replayed(run: Run, tree: Tree, *, risks_late: int = 0) -> dict[int, Plan]:
    """The plans of the loop by the recording's `seq`; `risks_late`: the planner has each risk so many later."""
    return _Replay(run, tree, risks_late).plans()


class _Heard:
    """In place of the vehicle: hears the plans."""

    plan = None

    def __init__(self) -> None:
        self.heard: list[Plan] = []

    def receive(self, plan: Stamped[Plan]) -> None:
        self.heard.append(plan.value)


class _Replay(_Run):
    """The loop; its world and its times are those of a recording."""

    def __init__(self, run: Run, tree: Tree, risks_late: int) -> None:
        self._made: dict[tuple[str, int], Stamped[Any]] = {}
        self._at_work: dict[str, Step] = {}
        self._beginning = ""
        first = {topic: message.value for (topic, _), message in reversed(run.world.items())}
        scenario = Scenario(
            name="recorded", title="a recorded bus run", source="recorded", duration_s=0.0, map=first["map"],
            route=first["route"], ego0=first["ego"],
        )  # fmt: skip
        super().__init__(scenario, tree, Latency(), Cores.of(tree), Replay(scenario), None)
        self._recorded, self._late, self._vehicle = run, risks_late, _Heard()
        self.vehicle = self._vehicle  # type: ignore[assignment]

    def plans(self) -> dict[int, Plan]:
        """Everything in the order in which it happened."""
        for step in self._recorded.steps:
            self._at(step.inputs.now_ns, LAST, functools.partial(self._begin, step))
        while self._queue:
            now, _, _, call = heapq.heappop(self._queue)
            call(now)
        seqs = [s.seq for s in self._recorded.steps if s.stage == "planner"]
        return dict(zip(seqs, self._vehicle.heard, strict=True))

    def _begin(self, step: Step, now: int) -> None:
        """A stage takes what it has in hand."""
        view = {used.topic: self._seen(used, now) for used in step.inputs.used}
        self.ego, self.objects = view.get("ego"), view.get("objects", self.objects)
        self.map, self.route = view.get("map"), view.get("route")  # type: ignore[assignment]
        self.closures = view["closures"].value if "closures" in view else Closures()
        self._prediction, self._risk = view.get("prediction"), view.get("risk")
        self._at_work[step.stage], self.delay[step.stage] = step, step.arrives_ns - now
        self.waiting[step.stage] = True
        self._beginning = step.stage
        {"predictor": self._predict, "riskfield": self._evaluate, "planner": self._plan}[step.stage](now)
        self._beginning = ""

    def _seen(self, used: Used, now: int) -> Stamped[Any]:
        found = self._recorded.world.get((used.topic, used.seq))
        if found is None:
            late = self._late if used.topic == "risk" else 0
            found = self._made[used.topic, max(used.seq - late, 0)]
        return replace(found, capture_ns=used.capture_ns, received_ns=now)

    # What the loop makes is kept by its `seq`, and nothing begins but when it began in the recording.

    @property
    def prediction(self) -> Stamped[Prediction] | None:
        return self._prediction

    @prediction.setter
    def prediction(self, value: Stamped[Prediction] | None) -> None:
        self._prediction = value
        if value is not None:
            self._made["prediction", self._at_work["predictor"].seq] = value

    @property
    def risk(self) -> Stamped[Risk] | None:
        return self._risk

    @risk.setter
    def risk(self, value: Stamped[Risk] | None) -> None:
        self._risk = value
        if value is not None:
            self._made["risk", self._at_work["riskfield"].seq] = value

    def _predict(self, now: int) -> None:
        if self._beginning == "predictor":
            super()._predict(now)

    def _evaluate(self, now: int) -> None:
        if self._beginning == "riskfield":
            super()._evaluate(now)

    def _plan(self, now: int) -> None:
        if self._beginning == "planner":
            super()._plan(now)

    def _move(self, now: int) -> Ego:
        return self.scenario.ego0  # the recording moves the ego
