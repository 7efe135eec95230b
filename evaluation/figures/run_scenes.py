"""Drives for the run figures: whole runs of our own system in simulated time, and what it saw and decided."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any, cast

import numpy as np

from common.geometry import Polyline
from common.messages import F64, Ego, Grid, Objects, Plan, Risk
from evaluation.closed_loop import Cores, drive
from rig import configuration
from rig.sources import Scenario, load_scenario


@dataclass(frozen=True)
class FieldThen:
    """The field of the moment at which a prediction was made."""

    capture_ns: int
    grid: Grid
    m: F64  # [row, column] [E_max]


@dataclass(frozen=True)
class Step:
    """What was true at one moment of the run."""

    t: float
    ego: Ego
    objects: Objects
    plan: Plan | None
    field: FieldThen | None


@dataclass
class Run:
    """A drive, ten moments a second."""

    scenario: Scenario
    steps: list[Step] = field(default_factory=list)

    @property
    def t(self) -> F64:
        """[n] [s]."""
        return np.array([s.t for s in self.steps])

    @property
    def speed(self) -> F64:
        """[n] [m/s]."""
        return np.array([s.ego.speed for s in self.steps])

    def along(self) -> tuple[F64, F64]:
        """The ego along the reference line and to its left, [n] [m]."""
        line = Polyline.of(self.scenario.route.reference)
        return line.project(np.array([(s.ego.x, s.ego.y) for s in self.steps]))

    def of(self, identity: int) -> tuple[F64, F64]:
        """One road user in the same coordinates, NaN where it was not seen."""
        line = Polyline.of(self.scenario.route.reference)
        at = np.full((len(self.steps), 2), np.nan)
        for k, step in enumerate(self.steps):
            found = np.flatnonzero(step.objects.id == identity)
            if len(found):
                s, d = line.project(np.array([(step.objects.x[found[0]], step.objects.y[found[0]])]))
                at[k] = s[0], d[0]
        return at[:, 0], at[:, 1]

    @property
    def only_other(self) -> int:
        """The id of the one road user in it."""
        ids = {int(i) for step in self.steps for i in step.objects.id}
        if len(ids) != 1:
            raise ValueError(f"{self.scenario.name}: {len(ids)} road users, one is expected")
        return ids.pop()


def run(name: str) -> Run:
    """Drive a built-in scenario with the default settings."""
    tree = configuration.load(None, [])
    scenario = load_scenario(name, seed=0)
    made = Run(scenario)
    cores = Cores.of(tree)
    tap = _Tap(cores.riskfield)

    def watch(t: float, ego: Ego, objects: Objects, plan: Plan | None) -> None:
        if abs(t * 10 - round(t * 10)) < 1e-6:
            made.steps.append(Step(t, ego, objects, plan, tap.latest))

    drive(scenario, tree, cores=replace(cores, riskfield=cast(Any, tap)), watch=watch)
    return made


@dataclass
class _Tap:
    """The riskfield, its latest first slice kept."""

    inner: Any
    latest: FieldThen | None = None

    def step(self, prediction: Any, ego: Any, map: Any, closures: Any, t_offset: float) -> Risk:
        risk: Risk = self.inner.step(prediction, ego, map, closures, t_offset)
        m = np.asarray(risk.volume[0], dtype=np.float64) / risk.e_max
        self.latest = FieldThen(prediction.capture_ns, risk.grid, m)
        return risk
