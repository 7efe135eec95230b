"""Speed of the planner: `forefield bench planner`.

In one run, one thread, taking turns, medians:

- `ours_ms`: the footprint of 256 candidate motions of 60 points looked up in the slice in force at each, bilinearly,
  and its maximum taken; `numpy_ms`: the same work as a NumPy gather, with the same result;
- `evaluated_ms`: what the default planner does with 256 candidates, 32 paths at 8 target speeds: looked up in every
  slice, rolled out with the driven controller up to the first check that fails (contact, stopping distance, speed
  law, comfort);
- `frenetix_ms`: 256 trajectories of frenetix (C++), generated, checked for feasibility and costed; it looks up no risk.
  LGPL-3.0-or-later: it is no dependency of this project, and is measured only where the user has installed it;
- the whole cycle of the service's core, as it steps 20 times a second.
"""

from __future__ import annotations

import importlib.util
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt

from common.config import Tree
from common.messages import Cause, Ego, Map, Risk, Route, Stamped
from common.risk import RiskParameters
from evaluation.bench_scene import BenchScene
from services.planner.bezier import Paths, Start, Target, build_paths, frenet_start
from services.planner.core import Planner, start_of
from services.planner.footprint import Footprint, path_risk, timed_risk
from services.planner.reference import ReferenceLine
from services.planner.rollout import Field, Tier, judge
from services.planner.settings import PlannerSettings
from services.planner.speed import Cap
from services.planner.volume import Volume
from services.predictor.core import Predictor
from services.predictor.settings import PredictorSettings
from services.riskfield.core import RiskField
from services.riskfield.settings import RiskfieldSettings

F32 = npt.NDArray[np.float32]
F64 = npt.NDArray[np.float64]

PATHS, SPEEDS, POINTS = 32, 8, 60
FRAME_NS = 100_000_000
START_NS = 10**9


def measure(tree: Tree | None = None, *, objects: int = 32, rounds: int = 60, cycles: int = 200) -> dict[str, Any]:
    """Times in milliseconds; `tree` is a configuration, of which `[planner]` and `[risk]` count."""
    from common import config

    settings = config.section(tree or {}, "planner", PlannerSettings)
    road, route, frames = _frames(tree or {}, objects, max(cycles // 2, 2))
    ego, risk = frames[len(frames) // 2]
    jobs: dict[str, Callable[[], object]] = {}
    volume = Volume.of(risk.value, risk.capture_ns, ego.capture_ns)
    paths, start = _paths(route.value, ego.value, settings)
    footprint = Footprint.of(ego.value, settings.footprint_spacing, settings.flank_margin)
    jobs["evaluated"] = _evaluated(paths, start, volume, footprint, settings)
    jobs["ours"], jobs["numpy"] = _look_ups(paths, volume, footprint)
    rival, why = _frenetix(ego.value)
    if rival is not None:
        jobs["frenetix"] = rival
    ms = _interleaved(jobs, rounds)
    cycle = _cycles(settings, road, route, frames)
    return {
        "schema": "forefield.bench_planner.v1",
        "candidates": PATHS * SPEEDS,
        "objects": objects,
        "ours_ms": ms["ours"],
        "numpy_ms": ms["numpy"],
        "ratio_vs_numpy": ms["numpy"] / ms["ours"],
        "evaluated_ms": ms["evaluated"],
        "frenetix_ms": ms.get("frenetix"),
        "frenetix": why,
        "cycle_ms_p50": float(np.percentile(cycle, 50)),
        "cycle_ms_p99": float(np.percentile(cycle, 99)),
        "cycle_ms_mean": float(np.mean(cycle)),
        "cycles": len(cycle),
        "rounds": rounds,
    }


def table(result: dict[str, Any]) -> str:
    """The figures as lines of text."""
    rival = f"{result['frenetix_ms']:.2f} ms" if result["frenetix_ms"] is not None else result["frenetix"]
    return "\n".join(
        (
            f"{result['candidates']} candidates looked up          {result['ours_ms']:.2f} ms",
            f"NumPy gather, the same           {result['numpy_ms']:.2f} ms"
            f" ({result['ratio_vs_numpy']:.1f} times as long)",
            f"looked up in all slices, checked {result['evaluated_ms']:.2f} ms",
            f"frenetix, as many                {rival}",
            f"whole cycle p50 / p99            {result['cycle_ms_p50']:.1f} / {result['cycle_ms_p99']:.1f} ms",
        )
    )


def _frames(
    tree: Tree, objects: int, count: int
) -> tuple[Stamped[Map], Stamped[Route], list[tuple[Stamped[Ego], Stamped[Risk]]]]:
    """Ego and risk of successive frames, made by the other two cores; the ego drives 10 m/s whatever is planned."""
    from common import config

    parameters = config.section(tree, "risk", RiskParameters)
    predictor = Predictor(PredictorSettings(policy="kinematic"), parameters, None)
    field = RiskField(config.section(tree, "riskfield", RiskfieldSettings), parameters, "cpu")
    scene, frames = BenchScene(objects), []
    road = scene.map()
    for k in range(count):
        now = START_NS + k * FRAME_NS
        ego = Stamped(scene.ego(0.1 * k), now, now)
        seen = Stamped(scene.objects(0.1 * k), now, now, Cause("bench", k + 1))
        predicted = Stamped(predictor.step(seen, ego, road), now, now, seen.cause)
        risk = field.step(predicted, ego, road, None, 0.0)
        frames.append((ego, Stamped(risk, now, now, seen.cause)))
    return Stamped(road, START_NS, START_NS), Stamped(scene.route(), START_NS, START_NS), frames


def _paths(route: Route, ego: Ego, settings: PlannerSettings) -> tuple[Paths, Start]:
    reference, start = ReferenceLine.of(route.reference), start_of(ego, settings.max_curvature)
    frenet = frenet_start(reference, start, None)
    horizon = settings.horizon_s * (start.speed + 5.0)
    step = horizon / (settings.stations - 1)
    s = np.asarray(frenet[0] + 0.5 * step * np.arange(3 * settings.stations), dtype=np.float64)
    zero = np.zeros_like(s)
    offsets = np.linspace(-3.5, 3.5, PATHS // 2)
    targets = [Target(f"{o:+.2f}", np.full_like(s, o), zero, zero) for o in offsets for _ in range(2)]
    lengths = np.tile([3.5 * start.speed, 5.0 * start.speed], PATHS // 2)
    paths = build_paths(
        reference,
        s,
        frenet,
        targets,
        lengths,
        step=step,
        points=settings.stations,
        max_curvature=settings.max_curvature,
    )
    return paths, start


def _evaluated(
    paths: Paths, start: Start, volume: Volume, footprint: Footprint, settings: PlannerSettings
) -> Callable[[], object]:
    cap = Cap(np.full(paths.x.shape, 14.0), np.zeros(paths.x.shape, dtype=np.intp))
    path = np.repeat(np.arange(PATHS), SPEEDS)
    target, hold = np.tile(np.linspace(0.0, 14.0, SPEEDS), PATHS), np.full(PATHS * SPEEDS, np.inf)
    comfort, s_max = Tier.all(settings)[0], np.full(PATHS, 14.0)

    def once() -> object:
        risk = path_risk(volume, footprint, paths.x, paths.y, paths.heading, paths.step)
        field = Field.of(risk, volume, cap, paths.end, s_max, paths.step, settings, paths.curvature)
        return judge(field, start, path, target, hold, comfort, settings)

    return once


def _look_ups(
    paths: Paths, volume: Volume, footprint: Footprint
) -> tuple[Callable[[], F32 | F64], Callable[[], F32 | F64]]:
    """The highest risk of 256 motions at constant speeds, by the kernel and by a NumPy gather."""
    t: F64 = np.asarray(0.1 * np.arange(POINTS), dtype=np.float64)
    distance = np.tile(np.linspace(0.0, 14.0, SPEEDS), PATHS)[:, None] * t[None]
    f = np.minimum(distance / paths.step, paths.x.shape[1] - 1.001)
    i, w = f.astype(np.intp), f % 1.0
    row = np.repeat(np.arange(PATHS), SPEEDS)[:, None]

    def along(a: Any) -> Any:
        return a[row, i] + w * (a[row, i + 1] - a[row, i])

    x, y, heading = along(paths.x), along(paths.y), along(paths.heading)
    g, m, ahead = volume.risk.grid, volume.risk.volume.astype(np.float32), footprint.ahead.astype(np.float32)
    slices = (volume.first + volume.slice_at(t))[None, :, None]

    def once() -> F32 | F64:
        fx, fy = footprint.at(x, y, heading)
        fi, fj = volume.coordinates(fx, fy)
        known = (fi >= 0) & (fi <= g.rows) & (fj >= 0) & (fj <= g.columns)
        fi, fj = np.clip(fi - 0.5, 0.0, g.rows - 1.001), np.clip(fj - 0.5, 0.0, g.columns - 1.001)
        ii, jj = fi.astype(np.intp), fj.astype(np.intp)
        wi, wj = (fi - ii).astype(np.float32), (fj - jj).astype(np.float32)
        low = m[slices, ii, jj] * (1 - wj) + m[slices, ii, jj + 1] * wj
        high = m[slices, ii + 1, jj] * (1 - wj) + m[slices, ii + 1, jj + 1] * wj
        risk = np.where(known, low * (1 - wi) + high * wi, np.float32(0.0))
        return np.asarray((risk - ahead).max(axis=(1, 2)))

    return lambda: timed_risk(volume, footprint, x, y, heading, t)[0].max(axis=1), once


def _frenetix(ego: Ego) -> tuple[Callable[[], object] | None, str]:
    """As many trajectories of frenetix on a straight road, with its feasibility checks and four of its costs."""
    if importlib.util.find_spec("frenetix") is None:
        return None, "not installed (pip install frenetix; LGPL-3.0-or-later, no dependency of ours)"
    import frenetix  # type: ignore[import-not-found,unused-ignore]
    import frenetix.trajectory_functions as functions  # type: ignore[import-not-found,unused-ignore]
    from frenetix.trajectory_functions import cost_functions as costs  # type: ignore[import-not-found,unused-ignore]
    from frenetix.trajectory_functions import (
        feasability_functions as checks,  # type: ignore[import-not-found,unused-ignore]
    )

    line = np.column_stack((np.arange(-50.0, 300.0, 1.0), np.zeros(350)))
    road = frenetix.CoordinateSystemWrapper(line)
    handler = frenetix.TrajectoryHandler(dt=0.1)
    for check in (
        checks.CheckYawRateConstraint(0.6, ego.wheelbase, False),
        checks.CheckAccelerationConstraint(7.0, 8.0, False),
        checks.CheckCurvatureConstraint(0.6, ego.wheelbase, False),
        checks.CheckCurvatureRateConstraint(ego.wheelbase, 0.6, False),
    ):
        handler.add_feasability_function(check)
    for cost in (
        costs.CalculateAccelerationCost("acceleration", 1.0),
        costs.CalculateJerkCost("jerk", 1.0),
        costs.CalculateDistanceToReferencePathCost("distance_to_reference_path", 1.0),
        costs.CalculateLateralJerkCost("lateral_jerk", 1.0),
    ):
        handler.add_cost_function(cost)
    handler.add_function(functions.FillCoordinates(False, 0.0, road, 6.0))
    offsets, speeds = np.linspace(-3.5, 3.5, PATHS), np.linspace(0.5, 14.0, SPEEDS)
    matrix = np.array(
        [[0.0, 6.0, 50.0, ego.speed, 0.0, v, 0.0, 0.0, 0.0, 0.0, d, 0.0, 0.0] for d in offsets for v in speeds]
    )

    def once() -> object:
        handler.reset_Trajectories()
        handler.generate_trajectories(matrix, False)
        handler.evaluate_all_current_functions(False)
        return handler.get_feasible_count()

    found = once()
    return once, f"version installed by the user; {found} of {len(matrix)} feasible"


def _cycles(
    settings: PlannerSettings,
    road: Stamped[Map],
    route: Stamped[Route],
    frames: list[tuple[Stamped[Ego], Stamped[Risk]]],
) -> list[float]:
    """Each frame's risk is planned upon twice, 50 ms apart, as in the service [ms]."""
    planner, times = Planner(settings), []
    planner.warm_up()
    for k, (ego, risk) in enumerate(frames):
        for late in (0, FRAME_NS // 2):
            later = Stamped(ego.value, ego.capture_ns + late, ego.capture_ns + late)
            begin = time.perf_counter()
            planner.step(later, risk, road, route, later.capture_ns + 20_000_000)
            if k >= 2:
                times.append((time.perf_counter() - begin) * 1e3)
    return times or [float("nan")]


def _interleaved(jobs: dict[str, Callable[[], object]], rounds: int) -> dict[str, float]:
    """Median of each job [ms]; jobs take turns, so that a busy machine disturbs all alike."""
    times: dict[str, list[float]] = {name: [] for name in jobs}
    for k in range(rounds + 3):
        for name, job in jobs.items():
            begin = time.perf_counter()
            job()
            if k >= 3:
                times[name].append((time.perf_counter() - begin) * 1e3)
    return {name: float(np.median(t)) for name, t in times.items()}
