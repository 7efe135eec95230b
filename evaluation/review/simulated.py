"""A drive in simulated time, drawn into a recording as viz draws a live one.

The cores are asked as `evaluation.closed_loop` asks them; whatever passes between them is shown to viz at the simulated
time at which it arrives. Deterministic, so that reviews can be tested and figures drawn again.

    python -m evaluation.review.simulated NAME_OR_FILE OUT.rrd [--set KEY=VALUE]
"""

from __future__ import annotations

import argparse
import json
import sys
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, cast

import rerun as rr

from common import config
from common.messages import Cause, Closures, Ego, Map, Objects, Plan, Prediction, Risk, Route, Stamped, Status
from evaluation.closed_loop import Cores, DriveResult, Latency, drive
from rig import configuration
from rig.settings import RigSettings
from rig.sources import Scenario, ScenarioError, load_scenario
from viz.blueprint import blueprint
from viz.scene import Scene
from viz.settings import VizSettings

MS = 1_000_000
BOOT = "simulated"
BATCH_S = 3.0


@dataclass
class StraightToFile:
    """Rows of one file, none ever dropped: simulated time waits for the disk."""

    stream: rr.RecordingStream

    def log(self, path: str, *what: rr.AsComponents, static: bool = False) -> None:
        """Log one row at the time last set."""
        self.stream.log(path, *what, static=static)

    def set_time(self, frame: int, t: float) -> None:
        """Everything logged from here on stands at this frame, t seconds after the recording's begin."""
        self.stream.set_time("frame", sequence=frame)
        self.stream.set_time("t", duration=t)


@contextmanager
def rows_of(path: Path, name: str, tree: config.Tree) -> Iterator[StraightToFile]:
    """Open a recording with blueprint, name and configuration; it is finished on the way out."""
    batcher = rr.ChunkBatcherConfig(flush_tick=BATCH_S)  # rows share a chunk as they do in a live recording
    stream = rr.RecordingStream("forefield", recording_id=uuid.uuid4(), batcher_config=batcher)
    stream.set_sinks(rr.FileSink(path), default_blueprint=blueprint())
    stream.send_recording_name(name)
    stored = json.dumps(tree, sort_keys=True)
    stream.send_property("forefield", rr.AnyValues(scenario=name, configuration=stored))
    try:
        yield StraightToFile(stream)
    finally:
        stream.flush()
        stream.disconnect()


def record(scenario: Scenario, path: Path, tree: config.Tree | None = None, **drawn: Any) -> DriveResult:
    """Drive a scenario in simulated time and record it.

    Args:
        scenario: the world.
        path: the recording to write.
        tree: configuration, as `common.config.load` returns it.
        drawn: settings of viz that differ from the configured ones, such as `stack=False`.
    """
    tree = {} if tree is None else tree
    settings = config.section({**tree, "viz": {**tree.get("viz", {}), **drawn}}, "viz", VizSettings)
    name = f"{scenario.name}: {scenario.title}"
    latency = Latency()
    with rows_of(path, name, tree) as rows:
        run_up_s = config.section(tree, "rig", RigSettings).run_up_s
        taps = _Taps(Scene(rows, settings), scenario, latency, run_up_s)
        cores = Cores.of(tree)
        tapped = replace(
            cores,
            predictor=cast(Any, _Predictor(cores.predictor, taps)),
            riskfield=cast(Any, _RiskField(cores.riskfield, taps)),
            planner=cast(Any, _Planner(cores.planner, taps)),
        )
        return drive(scenario, tree, latency=latency, cores=tapped, watch=taps.watched)


@dataclass
class _Taps:
    """What passes between the cores, shown to viz once each."""

    scene: Scene
    scenario: Scenario
    latency: Latency
    run_up_s: float
    _shown: dict[str, int] = field(default_factory=dict)
    _closed: Closures | None = None
    _origin_ns: int | None = None
    _now_ns: int = 0

    def new(self, topic: str, stamped: Stamped[Any]) -> bool:
        """Whether this message was not shown yet."""
        if self._shown.get(topic) == stamped.capture_ns:
            return False
        self._shown[topic] = stamped.capture_ns
        return True

    def ego(self, stamped: Stamped[Ego] | None) -> None:
        if stamped is not None and self.new("ego", stamped):
            self._now_ns = stamped.capture_ns
            self.scene.ego(stamped)

    def closures(self, closures: Closures | None) -> None:
        if closures is not None and (self._closed is None or closures.ids != self._closed.ids):
            self._closed = closures
            self.scene.closures(Stamped(closures, self._now_ns, self._now_ns))

    def watched(self, t: float, ego: Ego, objects: Objects, plan: Plan | None) -> None:
        """The vehicle 50 times a second; at time 0 it says that the run begins."""
        now = round(t * 1e9) + self.origin_ns
        if t == 0.0:
            said = Status(
                service="rig",
                state="ready",
                reason=f"plays {self.scenario.name}",
                uptime_s=0.0,
                detail={"run_s": "0.000"},
            )
            self.scene.status(Stamped(said, now, now))
        self.ego(Stamped(ego, now, now, boot=BOOT))

    @property
    def origin_ns(self) -> int:
        """Time 0 of the run."""
        assert self._origin_ns is not None
        return self._origin_ns


@dataclass(frozen=True)
class _Predictor:
    inner: Any
    taps: _Taps

    def step(self, objects: Stamped[Objects], ego: Stamped[Ego] | None, map: Map | None) -> Prediction:
        taps = self.taps
        if taps._origin_ns is None:  # the first objects come `run_up_s` before time 0
            taps._origin_ns = objects.capture_ns + round(taps.run_up_s * 1e9)
            if map is not None:
                taps.scene.map(Stamped(map, objects.capture_ns, objects.capture_ns))
            taps.scene.route(Stamped(taps.scenario.route, objects.capture_ns, objects.capture_ns))
        taps.ego(ego)
        taps.closures(taps.scenario.closures_at((objects.capture_ns - taps.origin_ns) * 1e-9))
        taps.scene.objects(replace(objects, seq=_seq(objects.cause)))
        return self.inner.step(objects, ego, map)  # type: ignore[no-any-return]


@dataclass(frozen=True)
class _RiskField:
    inner: Any
    taps: _Taps

    def step(
        self,
        prediction: Stamped[Prediction],
        ego: Stamped[Ego],
        map: Map | None,
        closures: Closures | None,
        t_offset: float,
    ) -> Risk:
        if self.taps.new("prediction", prediction):
            self.taps.scene.prediction(replace(prediction, work_ns=round(self.taps.latency.predictor * MS)))
        return self.inner.step(prediction, ego, map, closures, t_offset)  # type: ignore[no-any-return]


@dataclass(frozen=True)
class _Planner:
    inner: Any
    taps: _Taps

    def step(
        self,
        ego: Stamped[Ego] | None,
        risk: Stamped[Risk] | None,
        map: Stamped[Map] | None,
        route: Stamped[Route] | None,
        now_ns: int,
    ) -> Plan:
        taps, latency = self.taps, self.taps.latency
        taps.ego(ego)
        if risk is not None and taps.new("risk", risk):
            taps.scene.risk(replace(risk, work_ns=round(latency.riskfield * MS)))
        plan: Plan = self.inner.step(ego, risk, map, route, now_ns)
        work = round(latency.planner * MS)
        capture = now_ns if ego is None else ego.capture_ns
        cause = None if risk is None else risk.cause
        taps.scene.plan(Stamped(plan, capture, now_ns + work, cause, "planner", BOOT, work_ns=work))
        return plan


def _seq(cause: Cause | None) -> int:
    return 0 if cause is None else cause.seq


def main(argv: list[str] | None = None) -> int:
    """Record one scenario in simulated time; 2 for bad input."""
    parser = argparse.ArgumentParser(prog="python -m evaluation.review.simulated", description=main.__doc__)
    parser.add_argument("scenario", help="built-in name, CommonRoad file or name, table")
    parser.add_argument("out", type=Path, help="recording to write (.rrd)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", type=Path, default=None)
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", dest="settings")
    options = parser.parse_args(argv)
    try:
        tree = configuration.load(None, options.settings)
        scenario = load_scenario(options.scenario, seed=options.seed, settings=config.section(tree, "rig", RigSettings))
        result = record(scenario, options.out, tree)
    except (ScenarioError, config.ConfigError, OSError) as e:
        print(e, file=sys.stderr)
        return 2
    if options.json is not None:
        options.json.write_text(json.dumps(result.as_dict(), indent=1), "utf-8")
    for found in result.summary["interventions"]:
        print(f"{found['t']:6.2f} {found['kind']} {found['speed_from']} → {found['speed_to']}: {found['sentence']}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
