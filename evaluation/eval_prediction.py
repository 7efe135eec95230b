"""How good predictions are: `forefield eval prediction --tracks FILES | --scenarios FILES`.

Every method predicts the same windows. Methods that are networks come from one folder of weights; `policy_…` compose
methods as the service does. Without a map every object counts as off the lanes.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from rich.table import Table

from common.messages import F64, FRAME_S, HISTORY_FRAMES, Map, Method, Objects
from common.risk import RiskParameters
from evaluation import prediction_scores as scoring
from evaluation.ridge import Ridge
from evaluation.trajectory_windows import Recorded, Recording, Windows, gate_is_open, joined, recordings, windows
from rig.settings import RigSettings
from rig.sources import load_scenario
from rig.world import Scenario, Track
from services.predictor.blend import lane_path_network_speed
from services.predictor.history import Frames
from services.predictor.kinematic import Motion, State, constant_velocity, ctra, estimate
from services.predictor.lanes import LaneIndex
from services.predictor.learned import motion_of
from services.predictor.map_based import map_based
from services.predictor.selection import DRIVES_ON_LANES, POLICIES, Known, kinematic_method
from services.predictor.settings import Policy, PredictorSettings
from services.predictor.weight_files import SHARE, SHIPPED, Loaded, WeightsError, load, read_card

POLICY_METHODS: dict[str, Policy] = {
    "policy_paper": "paper",
    "policy_learned_first": "learned-first",
    "policy_learned_on_lanes": "learned-on-lanes",
    "policy_map_first": "map-first",
    "policy_kinematic": "kinematic",
}
ROWS = 2048
PLAIN_STEPS = 5
"""`constant_velocity` is the mean of so many steps; `constant_velocity_gated` is the service's own."""


def unseen(what: str, done: int, whole: int) -> None:
    """Tell nobody."""


@dataclass(frozen=True)
class Case:
    """Windows of one file, and its map if there is one."""

    data: Windows
    map: Map | None


def track_cases(
    files: Sequence[Path], risk: RiskParameters, stride: int, progress: Callable[[str, int, int], None] = unseen
) -> list[Case]:
    """Windows of trajectory tables; all are read before the first is worked on.

    `progress` gets what is being done, how much of it is done, and how much there is.
    """
    found = []
    for k, f in enumerate(files):
        progress("read", k, len(files))
        found.append(recordings(f))
    return [
        Case(windows(r, risk, stride=stride, progress=partial(progress, f"windows of {f.name}")), None)
        for f, r in zip(files, found, strict=True)
    ]


def scenario_cases(
    files: Sequence[str],
    risk: RiskParameters,
    settings: RigSettings,
    stride: int,
    progress: Callable[[str, int, int], None] = unseen,
) -> list[Case]:
    """Windows of scenarios with their maps; the recorded driver in the ego's place is one of the objects."""
    cases = []
    for k, f in enumerate(files):
        world = load_scenario(f, settings=settings)
        cases.append(Case(windows([as_recording(world)], risk, stride=stride), world.map))
        progress("windows of scenarios", k + 1, len(files))
    return cases


def as_recording(world: Scenario) -> Recording:
    """A scenario's recorded traffic; its site is the place that the name begins with."""
    tracks = [*world.tracks, *((world.human,) if world.human is not None else ())]
    return Recording(world.name, world.name.split("-")[0], tuple(_recorded(t) for t in tracks))


def _recorded(t: Track) -> Recorded:
    return Recorded(str(t.id), int(t.cls), t.length, t.width, t.frame0, t.x, t.y, t.heading)


@dataclass(frozen=True)
class Models:
    """What `--weights` holds."""

    networks: Mapping[str, Loaded]
    ridge: Ridge | None
    default: str

    @staticmethod
    def of(folder: Path) -> Models:
        """Load all networks of a folder.

        Raises:
            WeightsError: one of them is refused.
        """
        card = read_card(folder)
        networks = {name: load(folder, name) for name in card["networks"]}
        entry = card.get("ridge")
        return Models(networks, Ridge.load(folder, entry) if entry else None, str(card["default"]))


def predictions(case: Case, models: Models, settings: PredictorSettings) -> dict[str, F64]:
    """Positions of every method, shape [n, 60, 2] each."""
    parts: dict[str, list[F64]] = {}
    for i in range(0, len(case.data), ROWS):
        data = case.data.take(np.arange(i, min(i + ROWS, len(case.data))))
        for name, motion in _predicted(data, case.map, models, settings).items():
            parts.setdefault(name, []).append(motion)
    return {name: np.concatenate(p) for name, p in parts.items()}


def as_service(data: Windows) -> tuple[Objects, Frames]:
    """Windows as the service would hold them: objects now and their histories."""
    n = len(data)
    objects = Objects(
        id=np.arange(n, dtype=np.int64),
        cls=data.cls,
        x=data.x[:, 0],
        y=data.y[:, 0],
        heading=data.heading[:, 0],
        vx=(data.x[:, 0] - data.x[:, 1]) / 0.1,
        vy=(data.y[:, 0] - data.y[:, 1]) / 0.1,
        length=data.length,
        width=data.width,
        mass=np.zeros(n),
    )
    known = np.ones((n, HISTORY_FRAMES), dtype=bool)
    return objects, Frames(data.x, data.y, data.heading, known, known)


def plain_state(data: Windows, state: State) -> State:
    """The usual definition of constant velocity: the mean velocity of the last five steps, of everyone."""
    span = FRAME_S * PLAIN_STEPS
    vx, vy = ((p[:, 0] - p[:, PLAIN_STEPS]) / span for p in (data.x, data.y))
    return replace(state, vx=vx, vy=vy)


def _predicted(data: Windows, map: Map | None, models: Models, settings: PredictorSettings) -> dict[str, F64]:
    objects, frames = as_service(data)
    state = estimate(objects, frames, settings.kinematic)
    motions: dict[str, Motion] = {
        "constant_velocity": constant_velocity(plain_state(data, state)),
        "constant_velocity_gated": constant_velocity(state),
        "ctra": ctra(state, settings.kinematic),
    }
    on_lane = np.zeros(len(data), dtype=bool)
    followed = motions["constant_velocity_gated"]
    if map is not None and map.lanes:
        index = LaneIndex.of(map)
        match = index.match(state, settings.map)
        on_lane = (match.lane >= 0) & DRIVES_ON_LANES[data.cls]
        if on_lane.any():
            part = map_based(state.take(on_lane), match.take(on_lane), index, settings.map, settings.kinematic)
            followed = _with(followed, part, on_lane)
        motions["map_based"] = followed
    for name, loaded in models.networks.items():
        motions[name] = motion_of(loaded, data.x, data.y, data.cls, data.length, data.signals, state)
    default = models.networks[models.default]
    speaks = np.isin(data.cls, [int(c) for c in default.classes])
    known = Known(on_lane, speaks, data.cls, kinematic_method(state, data.cls))
    by_method = {
        Method.CONSTANT_VELOCITY: motions["constant_velocity_gated"],
        Method.CTRA: motions["ctra"],
        Method.MAP_BASED: followed,
        Method.LSTM: motions[models.default],
    }
    if map is not None:
        learned = motions[models.default]
        if on_lane.any():
            part = lane_path_network_speed(state.take(on_lane), followed.take(on_lane), learned.take(on_lane))
            learned = _with(learned, part, on_lane)
        motions["lstm_on_lanes"] = learned
    on_lanes = {**by_method, Method.LSTM: motions.get("lstm_on_lanes", motions[models.default])}
    for name, policy in (*POLICY_METHODS.items(), ("policy_default", settings.policy)):
        parts = on_lanes if policy == "learned-on-lanes" else by_method
        motions[name] = _composed(POLICIES[policy](known), parts)
    positions = {name: np.stack((m.x, m.y), axis=-1) for name, m in motions.items()}
    if models.ridge is not None:
        positions["ridge"] = models.ridge.predict(data, state)
    return positions


def _with(base: Motion, part: Motion, rows: scoring.Bool) -> Motion:
    merged = Motion(base.x.copy(), base.y.copy(), base.heading.copy(), base.speed.copy())
    for name in ("x", "y", "heading", "speed"):
        getattr(merged, name)[rows] = getattr(part, name)
    return merged


def _composed(method: np.ndarray[Any, np.dtype[np.uint8]], by_method: Mapping[Method, Motion]) -> Motion:
    result = by_method[Method.CONSTANT_VELOCITY]
    for m, motion in by_method.items():
        rows = method == m
        if rows.any():
            result = _with(result, motion.take(rows), rows)
    return result


def evaluate(
    cases: Sequence[Case],
    models: Models,
    settings: PredictorSettings,
    *,
    repeats: int = 1000,
    progress: Callable[[str, int, int], None] = unseen,
) -> dict[str, Any]:
    """Scores of every method, pooled, by site and by recording: the JSON of the command."""
    torch.set_num_threads(1)
    found: list[tuple[Windows, dict[str, F64]]] = []
    for k, case in enumerate(cases):
        if len(case.data):
            positions = predictions(case, models, settings)
            found.append((case.data, {m: scoring.errors(p, case.data) for m, p in positions.items()}))
        progress("predictions", k + 1, len(cases))
    if not found:
        raise ValueError("no window of 30 frames of history and 60 of future")
    methods = [m for m in found[0][1] if all(m in e for _, e in found)]
    data = joined([d for d, _ in found])
    error = {m: np.concatenate([e[m] for _, e in found]) for m in methods}
    sites = sorted(set(data.sites))
    site = np.array(data.sites)[data.recording]
    used = [i for i in range(len(data.names)) if (data.recording == i).any()]
    return {
        "schema": "forefield.eval_prediction.v1",
        "windows": len(data),
        "recordings": len(used),
        "horizons": list(scoring.HORIZONS),
        "default_network": models.default,
        "policy_default": settings.policy,
        "results": _results(error, data, np.ones(len(data), dtype=bool), repeats),
        "sites": {s: _results(error, data, site == s, repeats) for s in sites},
        "spread": {
            s: within_spread(error, data, rows, models)
            for s, rows in (("pooled", np.ones(len(data), dtype=bool)), *((s, site == s) for s in sites))
        },
        "per_recording": {
            name: _results(error, data, data.recording == i, min(repeats, 200))
            for i, name in zip(used, _distinct(data, used), strict=True)
        },
    }


def within_spread(
    error: Mapping[str, F64], data: Windows, rows: scoring.Bool, models: Models
) -> dict[str, dict[str, dict[str, float]]]:
    """How many positions lie within the spread that a network's card tells, of those that it speaks for and that move.

    By network and horizon: the spread [m], the share within it, and the number of windows.
    """
    result: dict[str, dict[str, dict[str, float]]] = {}
    for name, loaded in models.networks.items():
        speaks = rows & np.isin(data.cls, [int(c) for c in loaded.classes]) & gate_is_open(data)
        if loaded.spread is not None and speaks.any():
            away = error[name][speaks, :, 1]
            result[name] = {
                str(k): {
                    "spread": float(loaded.spread[k - 1]),
                    "within": float((away[:, h] <= loaded.spread[k - 1]).mean()),
                    "n": len(away),
                }
                for h, k in enumerate(scoring.HORIZONS)
            }
    return result


def _distinct(data: Windows, used: Sequence[int]) -> list[str]:
    """Names of recordings, with their site where two sites have the same."""
    names = [data.names[i] for i in used]
    return [f"{data.sites[i]}/{n}" if names.count(n) > 1 else n for i, n in zip(used, names, strict=True)]


def _results(error: Mapping[str, F64], data: Windows, rows: scoring.Bool, repeats: int) -> dict[str, Any]:
    chosen = data.take(rows)
    groups = scoring.groups(chosen)
    reference = error["constant_velocity"][rows]
    return {
        method: {
            name: scoring.scores(e[rows], reference, chosen, members, repeats=repeats)
            for name, members in groups.items()
        }
        for method, e in error.items()
    }


def table(result: Mapping[str, Any], group: str = "vehicle_moving", site: str = "") -> Table:
    """ADE and FDE of every method in one group, with the ratio to constant velocity at 6 s."""
    results = result["sites"][site] if site else result["results"]
    n = next(iter(results.values()))[group]["60"]["n"]
    out = Table(title=f"{group}, {site or 'pooled'}: {n} windows")
    out.add_column("method", no_wrap=True)
    for t in ("2 s", "4 s", "6 s"):
        out.add_column(f"ADE/FDE {t} [m]", justify="right", no_wrap=True)
    out.add_column("ratio 6 s", justify="right", no_wrap=True)
    out.add_column("95 % (FDE)", justify="right", no_wrap=True)
    out.add_column("miss", justify="right")
    for method, groups in results.items() if n else ():
        score = groups[group]
        last = score["60"]
        cells = [f"{score[str(k)]['ade']:.2f}/{score[str(k)]['fde']:.2f}" for k in scoring.HORIZONS]
        ratio = f"{last['ade_ratio']:.3f}/{last['fde_ratio']:.3f}" if last["ade_ratio"] is not None else ""
        ci = last["fde_ratio_ci"]
        out.add_row(method, *cells, ratio, f"{ci[0]:.2f}-{ci[1]:.2f}" if ci else "", f"{last['miss']:.2f}")
    return out


def spread_table(result: Mapping[str, Any]) -> Table:
    """How many positions lie within the spread of the default network."""
    name = result["default_network"]
    out = Table(title=f"{name}: share of positions within its spread, {SHARE:.1%} where it was measured")
    for column in ("site", "windows", *(f"{k / 10:g} s" for k in scoring.HORIZONS)):
        out.add_column(column, no_wrap=True)
    for site, networks in result["spread"].items():
        if name in networks:
            by = [networks[name][str(k)] for k in scoring.HORIZONS]
            out.add_row(site, str(by[0]["n"]), *(f"{b['within']:.0%} in {b['spread']:.1f} m" for b in by))
    return out


def plot(result: Mapping[str, Any], path: Path, group: str = "vehicle_moving") -> None:
    """FDE over time, relative to constant velocity, by method; one panel a site and one for all."""
    import matplotlib as mpl

    mpl.use("agg")
    from matplotlib import pyplot as plt

    panels = {"pooled": result["results"], **result["sites"]}
    figure, axes = plt.subplots(1, len(panels), figsize=(3.4 * len(panels) + 1.5, 3.6), squeeze=False, sharey=True)
    for axis, (name, results) in zip(axes[0], panels.items(), strict=True):
        for method, groups in results.items():
            if groups[group]["60"]["fde_ratio"] is not None:
                ratios = [groups[group][str(k)]["fde_ratio"] for k in scoring.HORIZONS]
                axis.plot([k / 10 for k in scoring.HORIZONS], ratios, marker="o", ms=3, label=method)
        axis.set_title(name, fontsize=9)
        axis.set_xlabel("seconds ahead")
    axes[0][0].set_ylabel("FDE / constant velocity's")
    axes[0][-1].legend(fontsize=6, loc="center left", bbox_to_anchor=(1.0, 0.5))
    figure.suptitle(group, fontsize=10)
    figure.savefig(path, dpi=130, bbox_inches="tight")
    plt.close(figure)


def models_of(folder: Path | None) -> Models:
    """The shipped weights, or those of a folder.

    Raises:
        WeightsError: they are refused.
    """
    if folder is not None and not folder.is_dir():
        raise WeightsError(f"{folder}: no such folder of weights")
    return Models.of(SHIPPED if folder is None else folder)
