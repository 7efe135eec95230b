"""Ablation: the field cut into slices against the field at every time: what slicing saves, and what it changes.

    python -m evaluation.planning.space_time [NAME_OR_FILE ...] [--every 5] [--json OUT]

The default reads slices of 0.5 s, and where it cannot tell, the higher of two neighbours. Here scenarios are driven in
closed loop with it, and every few cycles the same cycle is planned again, from the same memory, on the field at every
0.1 s: that is every time at which the planner's rollout looks (61 slices; nothing is left between them). Told are the
computing times of both, how often both choose the same path, and by how much desired speeds differ.
"""

from __future__ import annotations

import argparse
import copy
import json
import sys
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from common import config
from common.config import ConfigError, Tree
from common.geometry import Polyline
from common.messages import F64, Closures, Ego, Map, Plan, Prediction, Risk, Route, Stamped
from common.risk import RiskParameters
from evaluation.planning.drivers import Cores, Field
from evaluation.planning.loop import drive
from evaluation.planning.reactive import traffic
from rig.settings import RigSettings
from rig.sources import ScenarioError, builtin_scenarios, load_scenario
from rig.sources.generated import REPLAYED
from services.planner.core import Planner
from services.riskfield.core import RiskField
from services.riskfield.settings import RiskfieldSettings

T = TypeVar("T")
NAMES = ("following", "cut_in", "crossing_pedestrian", "unprotected_left", "slow_pedestrian", "truck_adjacent")
FINE_S = 0.1
SAME_M = 0.3
"""Paths that are nowhere farther apart than this, as far as both are known, are the same."""
CLOSE_MPS = 0.5


@dataclass(frozen=True)
class Pair:
    """One cycle planned twice."""

    field_ms: tuple[float, float]
    """Sliced, full."""
    plan_ms: tuple[float, float]
    same_path: bool
    same_mode: bool
    speed: tuple[float, float]
    """Desired speeds, sliced and full [m/s]."""


class _Fields:
    """Makes the volume in force, and remembers of what, so that it can be made again with other slices."""

    def __init__(self, inner: Field, fine: Field) -> None:
        self._inner, self._fine = inner, fine
        self._made: deque[tuple[Risk, tuple[Any, ...], float]] = deque(maxlen=4)

    def step(
        self, prediction: Stamped[Prediction], ego: Stamped[Ego], map: Map | None, closures: Closures, t_offset: float
    ) -> Risk:
        inputs = (prediction, ego, map, closures, t_offset)
        risk, ms = _timed(lambda: self._inner.step(*inputs))
        self._made.append((risk, inputs, ms))
        return risk

    def again(self, risk: Risk) -> tuple[Risk, tuple[float, float]]:
        """The same moment at every 0.1 s, and how long each took."""
        inputs, ms = next((i, ms) for made, i, ms in self._made if made is risk)
        fine, fine_ms = _timed(lambda: self._fine.step(*inputs))
        return fine, (ms, fine_ms)


class _Twice:
    """Plans on the volume in force, and every so often on the full one too, from the same memory."""

    def __init__(self, planner: Planner, fields: _Fields, every: int) -> None:
        self._planner, self._fields, self._every, self._n = planner, fields, every, 0
        self.pairs: list[Pair] = []

    def step(
        self, ego: Stamped[Ego] | None, risk: Stamped[Risk] | None, map: Stamped[Map] | None,
        route: Stamped[Route] | None, now_ns: int,
    ) -> Plan:  # fmt: skip
        self._n += 1
        other = copy.copy(self._planner) if risk is not None and self._n % self._every == 0 else None
        plan, ms = _timed(lambda: self._planner.step(ego, risk, map, route, now_ns))
        if other is not None and risk is not None and plan.mode == "drive":
            fine, field_ms = self._fields.again(risk.value)
            full, full_ms = _timed(lambda: other.step(ego, replace(risk, value=fine), map, route, now_ns))
            self.pairs.append(
                Pair(
                    field_ms, (ms, full_ms), _apart(plan, full) <= SAME_M, plan.mode == full.mode,
                    (plan.desired_speed, full.desired_speed),
                )
            )  # fmt: skip
        return plan


def _timed(call: Callable[[], T]) -> tuple[T, float]:
    began = time.process_time()
    value = call()
    return value, 1e3 * (time.process_time() - began)


def _apart(a: Plan, b: Plan) -> float:
    """Largest distance from the shorter of two chosen paths to the other [m]."""
    if a.candidates is None or b.candidates is None or min(a.chosen, b.chosen) < 0:
        return np.inf
    p, q = (np.stack((k.candidates.x[k.chosen], k.candidates.y[k.chosen]), axis=-1) for k in (a, b))  # type: ignore[union-attr]
    return min(_reach(p, q), _reach(q, p))


def _reach(p: F64, q: F64) -> float:
    line = Polyline.of(q).resampled(0.1).points
    return float(np.hypot(*np.moveaxis(p[:, None] - line[None], -1, 0)).min(axis=1).max())


def compared(tree: Tree, names: list[str], every: int) -> dict[str, list[Pair]]:
    """Every `every`-th cycle of each scenario, planned on slices and on the full field.

    Raises:
        ConfigError, ScenarioError: what is asked for cannot be.
    """
    rig, settings = config.section(tree, "rig", RigSettings), config.section(tree, "riskfield", RiskfieldSettings)
    horizon = settings.slice_s * (settings.slices - 1)
    section = {**tree.get("riskfield", {}), "slice_s": FINE_S, "slices": round(horizon / FINE_S) + 1}
    fine_settings = config.section({**tree, "riskfield": section}, "riskfield", RiskfieldSettings)
    fine = RiskField(fine_settings, config.section(tree, "risk", RiskParameters), settings.device)
    fine.warm_up()
    found = {}
    for name in names:
        scenario = load_scenario(name, settings=rig)
        cores = Cores.of(tree)
        fields = _Fields(cores.riskfield, fine)
        planner = _Twice(cores.planner, fields, every)
        reactive = name in builtin_scenarios() and name not in REPLAYED
        others = traffic(scenario, "reactive" if reactive else "replay")
        drive(scenario, tree, cores=Cores(cores.predictor, fields, planner), traffic=others)  # type: ignore[arg-type]
        found[scenario.name] = planner.pairs
    return found


def summary(pairs: list[Pair]) -> dict[str, Any]:
    """Of many cycles: medians of the computing times, and how far both agree."""
    if not pairs:
        return {"cycles": 0}
    off = np.array([p.speed[0] - p.speed[1] for p in pairs])
    field, plan = np.array([p.field_ms for p in pairs]), np.array([p.plan_ms for p in pairs])
    return {
        "cycles": len(pairs),
        "same_path": round(float(np.mean([p.same_path for p in pairs])), 3),
        "same_mode": round(float(np.mean([p.same_mode for p in pairs])), 3),
        "speed_within_0.5": round(float(np.mean(np.abs(off) <= CLOSE_MPS)), 3),
        "sliced_slower_mean": round(float(-off.mean()), 3),
        "sliced_faster_p95": round(float(np.percentile(off, 95)), 3),
        "field_ms": [round(float(k), 2) for k in np.median(field, axis=0)],
        "plan_ms": [round(float(k), 2) for k in np.median(plan, axis=0)],
    }


def markdown(found: dict[str, list[Pair]]) -> str:
    """A table for a document."""
    lines = [
        "| scenario | cycles | same path | speed within 0.5 m/s | slower by slicing, mean | faster, p95 "
        "| field ms, sliced / full | planner ms, sliced / full |",
        f"|---{'|---:' * 7}|",
    ]
    for name, pairs in [*found.items(), ("all", [p for k in found.values() for p in k])]:
        s = summary(pairs)
        if s["cycles"]:
            lines.append(
                f"| {name} | {s['cycles']} | {s['same_path']:.0%} | {s['speed_within_0.5']:.0%} "
                f"| {s['sliced_slower_mean']:.2f} | {s['sliced_faster_p95']:.2f} "
                f"| {s['field_ms'][0]:.1f} / {s['field_ms'][1]:.1f} | {s['plan_ms'][0]:.1f} / {s['plan_ms'][1]:.1f} |"
            )
    return "\n".join(lines)


def main(argv: list[str] | None = None) -> int:
    """Drive, compare, print a table; exit 2 for bad input."""
    parser = argparse.ArgumentParser(
        prog="python -m evaluation.planning.space_time", description=(__doc__ or "").split("\n")[0]
    )
    parser.add_argument("scenarios", nargs="*", help="built-in names or files; default: six built-in ones")
    parser.add_argument("--every", type=int, default=5, help="every so many cycles")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", dest="settings")
    parser.add_argument("--json", type=Path, default=None)
    options = parser.parse_args(argv)
    try:
        found = compared(config.load(None, options.settings), options.scenarios or list(NAMES), max(options.every, 1))
    except (ScenarioError, ConfigError) as e:
        print(e, file=sys.stderr)
        return 2
    print(markdown(found))
    if options.json is not None:
        both = {**{n: summary(p) for n, p in found.items()}, "all": summary([p for k in found.values() for p in k])}
        options.json.write_text(json.dumps(both, indent=1), "utf-8")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
