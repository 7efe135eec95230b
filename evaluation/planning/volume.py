"""Kilometres in SUMO traffic: one vehicle after another is taken over and driven by our plan.

Each drive is played twice from the same seed: first SUMO drives the vehicle itself (the yardstick), then we do, moved
by `moveToXY`. The networks are those given in `$FOREFIELD_DATA/maps/sumo` and generated ones.
"""

from __future__ import annotations

import functools
import importlib.util
import math
import shutil
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from common.config import Tree
from common.geometry import Polyline
from common.messages import FRAME_S, Ego, Goal, Route
from evaluation.generate_traffic import demand, given_networks
from evaluation.planning.checkpoint import Checkpoint
from evaluation.planning.drivers import driver
from evaluation.planning.engines import in_order
from evaluation.planning.loop import drive
from evaluation.planning.measures import measured
from evaluation.planning.recorder import Recorder
from evaluation.planning.sumo_roads import SumoRoads
from evaluation.planning.sumo_traffic import SumoTraffic
from evaluation.planning.yardstick import Yardstick
from evaluation.sumo_networks import Network, TrafficError, networks
from rig.sources import routing
from rig.world import Scenario, ego_at

WARM_UP_S = 60.0
LONGEST_S = 60.0
"""One drive lasts no longer."""
SHORTEST_M = 120.0
"""Vehicles with less of their route before them are not taken over."""


@dataclass(frozen=True)
class Start:
    """Who is taken over, and where he wants to go."""

    name: str
    ego: Ego
    edges: list[str]


@dataclass(frozen=True)
class Piece:
    """One vehicle to take over: a piece of work that can be sent to another process."""

    name: str
    network: Network
    seed: int
    tree: Tree
    planners: tuple[str, ...]


def measure(
    tree: Tree,
    planners: list[str],
    km: float,
    seed: int,
    tell: Callable[[str, float, bool], None],
    *,
    jobs: int,
    done: Checkpoint,
) -> dict[str, dict[str, dict[str, Any]]]:
    """Drive at least `km` kilometres with each planner; entries by planner and drive.

    Which drives count depends on the seed alone, not on `jobs`. `tell` gets the drive's name, how many kilometres were
    driven so far by the planner who has the fewest, and whether that drive is new or stood in the checkpoint `done`.

    Raises:
        TrafficError: SUMO is missing or fails.
    """
    if importlib.util.find_spec("libsumo") is None:
        raise TrafficError("--sumo needs Eclipse SUMO: pip install 'forefield[traffic]'")
    found: dict[str, dict[str, dict[str, Any]]] = {p: {} for p in planners}
    folder = Path(tempfile.mkdtemp(prefix="forefield-sumo-"))
    try:
        places = networks(folder, given_networks(), seed)

        def piece(k: int) -> tuple[Piece, dict[str, dict[str, Any]]]:
            network = places[k % len(places)]
            work = Piece(f"{network.name}#{seed + k // len(places)}", network, seed + k, tree, tuple(planners))
            return work, done.of(work.name, planners)

        for k, (work, entries, new) in enumerate(in_order(piece, run, jobs)):
            for planner, entry in entries.items():
                found[planner][work.name] = entry
            if new:
                done.add(work.name, entries)
            driven = min(_km(found[p]) for p in planners)
            tell(work.name, driven, new)
            if driven >= km:
                break
            if k >= 5 * len(places) and driven == 0.0:
                raise TrafficError("nobody drives anywhere in these networks")
    finally:
        shutil.rmtree(folder, ignore_errors=True)
    return {p: {n: e for n, e in entries.items() if e} for p, entries in found.items()}


@functools.cache
def _roads(path: Path) -> SumoRoads:
    return SumoRoads.read(path)


def run(piece: Piece) -> dict[str, dict[str, Any]]:
    """Drive it with every planner; an empty entry: nobody could be taken over there."""
    import libsumo

    with tempfile.TemporaryDirectory(prefix="forefield-sumo-") as folder:
        entries = _one(libsumo, piece, _roads(piece.network.path), Path(folder))
    return entries or {p: {} for p in piece.planners}


def _km(entries: dict[str, dict[str, Any]]) -> float:
    return float(sum(e.get("distance_m", 0.0) for e in entries.values())) / 1000.0


def _one(sumo: Any, piece: Piece, roads: SumoRoads, folder: Path) -> dict[str, dict[str, Any]]:
    network, seed, tree, planners = piece.network, piece.seed, piece.tree, piece.planners
    with _running(sumo, network, folder, seed):
        start = _choose(sumo, roads, seed)
        if start is None:
            return {}
        yard = _as_sumo_drives(sumo, start)
    scenario = _scenario(network, roads, start, seed)
    if scenario is None:
        return {}
    found = {}
    for planner in planners:
        with _running(sumo, network, folder, seed):
            _take_over(sumo, start)
            traffic = SumoTraffic(sumo, roads, start.name, start.ego, set(start.edges))
            record = Recorder()
            try:
                result = drive(scenario, tree, cores=driver(planner, tree), traffic=traffic, watch=record)
                entry = measured(scenario, result, record, yard, "")
            except Exception as e:  # one strange drive must not end the others
                found[planner] = {"error": f"{type(e).__name__}: {e}"}
                continue
            found[planner] = {**entry, "traffic": "sumo"}
    return found


@contextmanager
def _running(sumo: Any, network: Network, folder: Path, seed: int) -> Iterator[None]:
    """SUMO with traffic that has warmed up, the same each time for a seed."""
    rng = np.random.default_rng([seed, *network.name.encode()])
    file = folder / f"{network.name}.rou.xml"
    file.write_text(demand(network, rng, WARM_UP_S + LONGEST_S))
    sumo.start(
        [
            "sumo", "-n", str(network.path), "-r", str(file), "--step-length", str(FRAME_S), "--seed", str(seed),
            "--no-warnings", "true", "--no-step-log", "true", "--time-to-teleport", "-1", "--collision.action", "none",
            "--default.speeddev", "0.1", "--ignore-route-errors", "true", "--extrapolate-departpos", "true",
            "--lateral-resolution", "0.8",
        ]
    )  # fmt: skip
    try:
        for _ in range(round(WARM_UP_S / FRAME_S)):
            sumo.simulationStep()
        yield
    finally:
        sumo.close()


def _pose(sumo: Any, name: str) -> Ego:
    v = sumo.vehicle
    x, y = v.getPosition(name)
    heading = math.pi / 2 - math.radians(v.getAngle(name))
    length, width = v.getLength(name), v.getWidth(name)
    half = length / 2
    size = (length, width, 0.6 * length)
    return ego_at(x - half * math.cos(heading), y - half * math.sin(heading), heading, v.getSpeed(name), size=size)


def _choose(sumo: Any, roads: SumoRoads, seed: int) -> Start | None:
    """A car on a usual lane, with a way before it."""
    v = sumo.vehicle
    fit = []
    for name in sorted(v.getIDList()):
        lane = v.getLaneID(name)
        if v.getVehicleClass(name) != "passenger" or lane not in roads.ids or lane.startswith(":"):
            continue
        route, index = list(v.getRoute(name)), v.getRouteIndex(name)
        left = sum(sumo.lane.getLength(f"{e}_0") for e in route[index:]) - v.getLanePosition(name)
        if left >= SHORTEST_M and v.getLanePosition(name) > v.getLength(name) + 1.0:
            fit.append((name, route[index:]))
    if not fit:
        return None
    name, edges = fit[int(np.random.default_rng([seed, 5]).integers(len(fit)))]
    return Start(name, _pose(sumo, name), edges)


def _as_sumo_drives(sumo: Any, start: Start) -> Yardstick:
    far, last = [0.0], (start.ego.x, start.ego.y)
    for _ in range(round(LONGEST_S / FRAME_S)):
        sumo.simulationStep()
        if start.name not in sumo.vehicle.getIDList():
            break
        ego = _pose(sumo, start.name)
        far.append(far[-1] + math.hypot(ego.x - last[0], ego.y - last[1]))
        last = (ego.x, ego.y)
    times, s = np.arange(len(far)) * FRAME_S, np.array(far)
    return Yardstick("sumo", float(times[-1]), lambda t: float(np.interp(t, times, s)))


def _take_over(sumo: Any, start: Start) -> None:
    v = sumo.vehicle
    v.setSpeedMode(start.name, 0)
    v.setLaneChangeMode(start.name, 0)


def _scenario(network: Network, roads: SumoRoads, start: Start, seed: int) -> Scenario | None:
    """The drive to the end of the vehicle's own route, as far as lanes lead there; None: they do not."""
    index = routing.Roads.of(roads.map)
    e = start.ego
    starts = [k for k in index.at(e.x, e.y, e.heading) if k[1] in roads.edges.get(start.edges[0], [])]
    path = None
    for last in range(len(start.edges) - 1, -1, -1):
        goals = set(roads.edges.get(start.edges[last], []))
        path = routing.lane_sequence(index, starts, goals) if starts and goals else None
        if path is not None:
            break
    if path is None:
        return None
    onward = path + routing.following(index, path[-1], routing.BEYOND_M)[1:]
    line = Polyline.of(routing.reference(index, onward, e.x, e.y, e.speed))
    here = float(line.project(np.array([e.x, e.y]))[0])
    end = float(line.project(index.lines[path[-1]].points[-1])[0]) - 5.0
    if end - here < SHORTEST_M / 2:
        return None
    x, y = line.at(end)
    more = line.at(line.length + np.arange(1.0, max(2.0, end + routing.BEYOND_M - line.length + 1.0)))
    limits = [roads.map.lanes[i - 1].speed_limit for i in path]
    return Scenario(
        name=f"{network.name}#{seed}",
        title=f"SUMO traffic on {network.name}",
        source="sumo",
        duration_s=LONGEST_S,
        map=roads.map,
        route=Route(
            reference=np.ascontiguousarray(np.vstack((line.points, more))),
            goal=Goal(x=float(x), y=float(y), radius=4.0),
            lane_ids=onward,
            speed_limit=max(limits),
            lane_width=3.2,
        ),
        ego0=e,
    )
