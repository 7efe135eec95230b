"""Does the pipeline's period follow its slowest stage rather than the sum of the stages? `forefield bench pipeline`.

**Pipeline**: router and the three services as their own processes, viz off. Objects are fed as fast as they are
accepted: a new frame is sent once the predictor is through with the last one, as long as no more than three frames, one
for each stage, are under way; a frame is under way until a plan that rests on it is received. What a busy stage must
skip meanwhile is counted. The ego comes at 50 Hz as always. The *period* is the time between receipts of successive
plans on new risk, so it includes codec and transport. The planner steps when new risk arrives (and 50 to 70 ms after
its last step otherwise), so its own clock does not bound it.

**One process**: the same cores on the same scene, called one after another, nothing encoded and nothing sent; blocks of
both alternate within one run, so that both see the same machine. `stages_ms` are the medians of its stages and
`sum_of_stages_ms` their sum: the period that the same work would have without parallel processes, at its cheapest.
`pipeline_work_ms` are the same stages inside the pipeline, as their status says (arrival → put: with waiting, decoding,
encoding; the median of their last messages). `modes` are those of the plans that were measured.
"""

from __future__ import annotations

import os
import platform
import time
from collections import Counter
from collections.abc import Callable
from typing import Any

import numpy as np
from rich.table import Table

from common import config
from common.bus import Bus, BusSettings, open_bus
from common.config import Tree
from common.messages import Cause, Map, Message, Objects, Prediction, Risk, Route, Stamped
from common.risk import RiskParameters
from common.topics import EGO, MAP, OBJECTS, PLAN, PREDICTION, ROUTE
from evaluation.bench_scene import BenchScene
from rig.launcher import SERVICES, Crew, LaunchError
from rig.session import running
from rig.settings import RigSettings
from rig.statuses import Statuses
from rig.tally import Tally, quantiles
from services.planner.core import Planner
from services.planner.settings import PlannerSettings
from services.predictor.core import Predictor
from services.predictor.learned import load_learned
from services.predictor.settings import PredictorSettings
from services.riskfield.core import RiskField
from services.riskfield.settings import RiskfieldSettings

IN_FLIGHT = 3
"""Frames under way at once: one for each stage; more would only wait."""
FRAMES = ("objects", "prediction", "risk")
ROUNDS = 5
WARM_FRAMES = 40
STALL_S = 0.5
"""No plan for this long: the frames under way are taken for lost [s]."""
EGO_NS = 20_000_000
"""Between two messages of the ego [ns]."""
MAX_STALLS = 20
"""So many in one block: there is no pipeline to measure."""
REST_S = 0.6
"""Between the blocks, until the services have nothing left that is fresh and have said how they are [s]."""


def measure(tree: Tree, *, objects: int = 32, frames: int = 300) -> dict[str, Any]:
    """Run both, block by block.

    Args:
        tree: the resolved configuration.
        objects: road users in the scene.
        frames: plans to measure in the pipeline; the one process makes half as many.

    Raises:
        LaunchError: the services did not come up or did not stay up.
    """
    scene = BenchScene(objects)
    rig = config.section(tree, "rig", RigSettings)
    tree = {**tree, "viz": {**tree["viz"], "record": "", "serve": 0}}
    alone = _OneProcess(scene, tree)
    with (
        running(tree, SERVICES) as (tree_up, crew),
        open_bus(config.section(tree_up, "bus", BusSettings), config.vehicle(tree_up), "rig") as bus,
    ):
        assert crew is not None
        statuses = Statuses(bus, SERVICES)
        feed = _Feed(bus, scene, crew)
        crew.wait_ready(statuses, rig.ready_timeout_s)
        feed.block(WARM_FRAMES)
        feed.tally.begin()
        feed.block(WARM_FRAMES)
        feed.forget()
        alone.block(WARM_FRAMES, feed.time_s)
        alone.clear()
        feed.tally.begin()
        _rest(bus, statuses)
        before = _overwritten(statuses)
        for _ in range(ROUNDS):
            feed.block(-(-frames // ROUNDS))
            _rest(bus, statuses)
            alone.block(max(4, frames // (2 * ROUNDS)), feed.time_s)
        _rest(bus, statuses)
        skipped = _overwritten(statuses) - before
        work = {name: s.value.work_ms["p50"] for name, s in statuses.latest().items()}
    return _result(feed, alone, objects, skipped, work, tree)


def _overwritten(statuses: Statuses) -> int:
    """Frames that a service had to skip so far."""
    return sum(c[f"{topic}:overwritten"] for c in statuses.counters().values() for topic in FRAMES)


def _rest(bus: Bus, statuses: Statuses) -> None:
    until = time.monotonic() + REST_S
    while time.monotonic() < until:
        bus.wait(until - time.monotonic())
        statuses.update()


def _result(
    feed: _Feed, alone: _OneProcess, objects: int, skipped: int, work: dict[str, float], tree: Tree
) -> dict[str, Any]:
    stages = {name: round(float(np.median(values)), 3) for name, values in alone.times_ms.items()}
    total = sum(stages.values())
    period = float(np.median(feed.periods_ms))
    return {
        "period_ms": round(period, 3),
        "sum_of_stages_ms": round(total, 3),
        "ratio_period_to_sum": round(period / total, 4),
        "end_to_end_ms": {k: v for k, v in feed.tally.latency_ms()["end_to_end"].items() if k in ("p50", "p99")},
        "stages_ms": stages,
        "stages_mean_ms": {name: round(float(np.mean(values)), 3) for name, values in alone.times_ms.items()},
        "one_process_cycle_ms": round(float(np.median(alone.cycles_ms)), 3),
        "pipeline_work_ms": {name: round(ms, 3) for name, ms in work.items()},
        "period_of_ms": {"plan": quantiles(feed.periods_ms, (50, 99))},
        "frames": {"pipeline": len(feed.periods_ms), "one_process": len(alone.cycles_ms), "skipped": skipped},
        "stalls": feed.stalls,
        "in_flight": IN_FLIGHT,
        "objects": objects,
        "modes": {"pipeline": dict(feed.modes), "one_process": alone.modes},
        "machine": {
            "cpu": platform.processor() or platform.machine(),
            "cores": len(os.sched_getaffinity(0)),
            "device": alone.device,
        },
        "configuration": tree,
    }


class _Feed:
    """Feeds the pipeline and times what comes out."""

    def __init__(self, bus: Bus, scene: BenchScene, crew: Crew) -> None:
        self._bus, self._scene, self._crew = bus, scene, crew
        self._ego, self._objects = bus.publisher(EGO), bus.publisher(OBJECTS)
        self.tally = Tally(bus.boot)
        self.tally.listen(bus, (PREDICTION, PLAN))  # not `risk`: its volume would pass through the router once more
        bus.watch(PREDICTION, lambda *_: bus.interrupt())
        self._plans = bus.inbox(PLAN)
        self.modes: Counter[str] = Counter()
        self._start_ns = time.monotonic_ns()
        bus.publisher(MAP).put(scene.map(), capture_ns=self._start_ns)
        bus.publisher(ROUTE).put(scene.route(), capture_ns=self._start_ns)
        self._last = -1
        self._ego_ns = 0
        self.periods_ms: list[float] = []
        self.stalls = 0

    def time_s(self) -> float:
        """Time of the scene: it moves on in real time."""
        return (time.monotonic_ns() - self._start_ns) * 1e-9

    def block(self, plans: int) -> None:
        """Feed until so many plans on new risk came back; the first of a block ends no period."""
        before = len(self.tally.arrivals["plan"])
        goal, progress, heard = self._last + 1, time.monotonic(), self._seen()
        received = stalls = 0
        while received <= plans:
            seen = self._seen()
            if seen > heard:
                received, heard, progress = received + (seen >= goal), seen, time.monotonic()
            elif time.monotonic() - progress > STALL_S:
                self._crew.check()
                stalls, progress = stalls + 1, time.monotonic()
                if stalls > MAX_STALLS:
                    raise LaunchError(f"no plan on new risk for {stalls * STALL_S:g} s: are the stages too slow here?")
                self._put()
            if time.monotonic_ns() - self._ego_ns >= EGO_NS:
                self._put_ego()
            plan = self._plans.take()
            if plan is not None and plan.cause is not None and plan.cause.seq >= goal:
                self.modes[plan.value.mode] += 1
            if self._last - max(self._seen(), goal - 1) < IN_FLIGHT and self._accepted(goal):
                self._put()
            self._bus.wait((self._ego_ns + EGO_NS - time.monotonic_ns()) * 1e-9)
        with_new = self.tally.arrivals["plan"][before:]
        self.periods_ms += list(np.diff(with_new) * 1e-6)
        self.stalls += stalls

    def forget(self) -> None:
        """Start counting anew."""
        self.periods_ms.clear()
        self.modes.clear()
        self.stalls = 0

    def _accepted(self, goal: int) -> bool:
        """The predictor is through with the last frame."""
        return max(self.tally.newest.get("prediction", -1), goal - 1) >= self._last

    def _seen(self) -> int:
        return self.tally.newest.get("plan", -1)

    def _put_ego(self) -> None:
        self._ego_ns = time.monotonic_ns()
        self._ego.put(self._scene.ego(self.time_s()), capture_ns=self._ego_ns)

    def _put(self) -> None:
        objects = self._scene.objects(self.time_s())
        now = time.monotonic_ns()
        cause = self._objects.put(objects, capture_ns=now)
        self.tally.put(cause, now)
        self._last = cause.seq


class _OneProcess:
    """The same cores, one after another, here."""

    def __init__(self, scene: BenchScene, tree: Tree) -> None:
        risk = config.section(tree, "risk", RiskParameters)
        riskfield = config.section(tree, "riskfield", RiskfieldSettings)
        self._scene = scene
        settings = config.section(tree, "predictor", PredictorSettings)
        self._predictor = Predictor(settings, risk, load_learned(settings, risk)[0])
        self._riskfield = RiskField(riskfield, risk, riskfield.device)
        self._riskfield.warm_up()
        self.device = self._riskfield.device
        self._planner = Planner(config.section(tree, "planner", PlannerSettings))
        now = time.monotonic_ns()
        self._map: Stamped[Map] = Stamped(scene.map(), now, now)
        self._route: Stamped[Route] = Stamped(scene.route(), now, now)
        self._seq = 0
        self.clear()

    def clear(self) -> None:
        """Forget what was measured."""
        self.times_ms: dict[str, list[float]] = {name: [] for name in SERVICES}
        self.cycles_ms: list[float] = []
        self.modes: dict[str, int] = {}

    def block(self, frames: int, time_s: Callable[[], float]) -> None:
        """Make so many plans."""
        for _ in range(frames):
            t, capture = time_s(), time.monotonic_ns()
            self._seq += 1
            cause = Cause("one-process", self._seq)
            ego = _stamp(self._scene.ego(t), capture, cause)
            objects: Stamped[Objects] = _stamp(self._scene.objects(t), capture, cause)
            t0 = time.perf_counter_ns()
            prediction: Prediction = self._predictor.step(objects, ego, self._map.value)
            t1 = time.perf_counter_ns()
            risk: Risk = self._riskfield.step(_stamp(prediction, capture, cause), ego, self._map.value, None)
            t2 = time.perf_counter_ns()
            plan = self._planner.step(
                ego, _stamp(risk, capture, cause), self._map, self._route, time.monotonic_ns()
            )  # fmt: skip
            t3 = time.perf_counter_ns()
            for name, ns in zip(SERVICES, (t1 - t0, t2 - t1, t3 - t2), strict=True):
                self.times_ms[name].append(ns * 1e-6)
            self.cycles_ms.append((t3 - t0) * 1e-6)
            self.modes[plan.mode] = self.modes.get(plan.mode, 0) + 1


def _stamp(value: Any, capture_ns: int, cause: Cause) -> Stamped[Any]:
    assert isinstance(value, Message)
    return Stamped(value, capture_ns, time.monotonic_ns(), cause, "bench", cause.boot, cause.seq)


def table(r: dict[str, Any]) -> Table:
    """The result as a table."""
    out = Table(title=f"Pipeline with {r['objects']} road users, {r['machine']['device']}", title_justify="left")
    out.add_column("")
    out.add_column("median ms", justify="right")
    out.add_column("mean ms", justify="right")
    for name in SERVICES:
        out.add_row(f"{name}, alone in one process", f"{r['stages_ms'][name]:.2f}", f"{r['stages_mean_ms'][name]:.2f}")
    out.add_row("sum of the stages", f"{r['sum_of_stages_ms']:.2f}", end_section=True)
    for name in SERVICES:
        out.add_row(f"{name}, in the pipeline (arrival to put)", f"{r['pipeline_work_ms'][name]:.2f}")
    out.add_row("[bold]period of the pipeline[/]", f"[bold]{r['period_ms']:.2f}[/]")
    out.add_row("period / sum", f"{r['ratio_period_to_sum']:.2f}")
    e2e = r["end_to_end_ms"]
    out.add_row("end to end, saturated (99 %)", f"{e2e['p50']:.1f} ({e2e['p99']:.1f})")
    driving = r["modes"]["pipeline"].get("drive", 0) / max(sum(r["modes"]["pipeline"].values()), 1)
    if driving < 0.9:
        out.caption = f"only {driving:.0%} of the plans drive: this machine is too busy or too slow for this scene"
    return out
