"""One scenario driven by some planners: a piece of work that can be sent to another process or machine."""

from __future__ import annotations

import math
import os
from dataclasses import dataclass
from typing import Any

from common.config import Tree
from evaluation.planning.drivers import Alone, Cores, driver
from evaluation.planning.idm_driver import IdmDriver
from evaluation.planning.loop import DriveResult, drive
from evaluation.planning.measures import measured
from evaluation.planning.reactive import traffic
from evaluation.planning.recorder import Recorder
from evaluation.planning.traffic import Kind
from evaluation.planning.yardstick import yardstick
from rig.world import Scenario


@dataclass(frozen=True)
class Task:
    """Everything one drive needs, the world itself included."""

    name: str
    family: str
    scenario: Scenario
    planners: tuple[str, ...]
    tree: Tree
    traffic: Kind
    recorded_s: float = math.inf
    """From then on the others' motion is made up [s]."""


def run(task: Task) -> dict[str, dict[str, Any]]:
    """Drive it with every planner; an error inside is told under `error`, and the others go on."""
    _one_thread()
    found: dict[str, dict[str, Any]] = {}
    driven: dict[str, tuple[DriveResult, Recorder]] = {}
    failed: dict[str, dict[str, int]] = {}
    for planner in task.planners:
        try:
            who = driver(planner, task.tree)
            driven[planner] = _drive(task, who)
            failed[planner] = dict(getattr(who, "failures", {}))
        except Exception as e:  # whatever a strange world does, the other worlds are still to be driven
            found[planner] = {"error": f"{type(e).__name__}: {e}"}
    try:
        yard = yardstick(task.scenario, lambda: driven.get("idm") or _drive(task, IdmDriver()))
    except Exception as e:
        return {p: {"error": f"the yardstick failed: {type(e).__name__}: {e}"} for p in task.planners}
    for planner, (result, record) in driven.items():
        try:
            entry = measured(task.scenario, result, record, yard, task.family)
            found[planner] = {**entry, "traffic": task.traffic, "failed_cycles": failed.get(planner, {})}
        except Exception as e:
            found[planner] = {"error": f"not measured: {type(e).__name__}: {e}"}
    return found


def _drive(task: Task, who: Cores | Alone) -> tuple[DriveResult, Recorder]:
    record = Recorder()
    others = traffic(task.scenario, task.traffic, task.recorded_s)
    return drive(task.scenario, task.tree, cores=who, traffic=others, watch=record), record


def _one_thread() -> None:
    """Many processes with many threads each are slower than with one."""
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(name, "1")
