"""Interactive traffic from Eclipse SUMO, written as trajectory tables: `forefield generate traffic --out FILE`.

Drivers differ: car-following models (IDM, EIDM, Krauss), headways, accelerations, speeds and slow-downs without cause
are drawn for each of them, in ranges that reproduce the speeds and gaps of the open recordings. SUMO gives the middle
of the front bumper; tables hold the rectangle's centre. A teleport ends a track; what follows has another name.
"""

from __future__ import annotations

import gzip
import io
import math
import os
import shutil
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import numpy as np

from common.messages import FRAME_S
from evaluation.sumo_networks import Network, TrafficError, networks
from rig.sources.tables import COLUMNS

WARM_UP_S = 60.0
STEP_MAX_M = 4.5
"""A longer step of 0.1 s is a teleport [m]."""
TYPES = 48
"""Kinds of drivers drawn for each run."""
KINDS = {"passenger": "car", "truck": "truck", "bus": "bus", "motorcycle": "motorcycle", "bicycle": "bicycle"}


@dataclass(frozen=True)
class Generated:
    """What was written."""

    path: Path
    runs: int
    tracks: int
    rows: int
    teleports: int


def given_networks() -> list[Path]:
    """The networks below `$FOREFIELD_DATA/maps/sumo`; none where the variable is not set."""
    data = os.environ.get("FOREFIELD_DATA")
    return sorted((Path(data) / "maps" / "sumo").glob("*.net.xml")) if data else []


def generate(
    out: Path, *, seed: int, seconds: float, repeats: int = 1, progress: Callable[[str], None] = lambda _: None
) -> Generated:
    """Simulate `seconds` on every network, `repeats` times with other drivers, and write one table.

    Raises:
        TrafficError: SUMO is missing or fails.
    """
    try:
        import libsumo
    except ImportError:
        raise TrafficError("generated traffic needs Eclipse SUMO: pip install 'forefield[traffic]'") from None
    folder = Path(tempfile.mkdtemp(prefix="forefield-sumo-"))
    draft = out.with_name(f".{out.name}.{os.getpid()}")
    totals = np.zeros(3, dtype=np.int64)
    runs, begin = 0, time.monotonic()
    try:
        with _table(draft) as table:
            table.write(",".join(COLUMNS) + "\n")
            for repeat in range(repeats):
                for network in networks(folder, given_networks(), seed + repeat):
                    totals += _run(libsumo, network, folder, seed + 1000 * repeat, seconds, table, f"{repeat}")
                    runs += 1
                    spent = time.monotonic() - begin
                    progress(f"{network.name}: {runs} runs, {totals[0]} tracks, {totals[1]} rows, {spent:.0f} s")
        draft.replace(out)
    finally:
        shutil.rmtree(folder, ignore_errors=True)
        draft.unlink(missing_ok=True)
    return Generated(out, runs, int(totals[0]), int(totals[1]), int(totals[2]))


@contextmanager
def _table(path: Path) -> Iterator[IO[str]]:
    """A compressed text file without name and time in it: the same traffic gives the same bytes."""
    with (
        path.open("wb") as raw,
        gzip.GzipFile("", "wb", compresslevel=4, fileobj=raw, mtime=0) as packed,
        io.TextIOWrapper(packed, encoding="utf-8", newline="") as table,
    ):
        yield table


def _run(
    sumo: Any, network: Network, folder: Path, seed: int, seconds: float, table: IO[str], tag: str
) -> tuple[int, int, int]:
    # a string's hash differs between processes: its bytes do not
    rng = np.random.default_rng([seed, *network.name.encode()])
    routes = folder / f"{network.name}.rou.xml"
    routes.write_text(demand(network, rng, WARM_UP_S + seconds))
    sublane = rng.random() < 0.5
    options = [
        "sumo", "-n", str(network.path), "-r", str(routes), "--step-length", str(FRAME_S), "--seed", str(seed),
        "--no-warnings", "true", "--no-step-log", "true", "--time-to-teleport", "120", "--collision.action", "none",
        "--default.speeddev", "0.1", "--ignore-route-errors", "true", "--extrapolate-departpos", "true",
    ]  # fmt: skip
    # without sublanes SUMO's lane changes would be jumps
    options += ["--lateral-resolution", "0.6"] if sublane else ["--lanechange.duration", f"{rng.uniform(2.5, 5.0):.1f}"]
    try:
        sumo.start(options)
    except Exception as e:  # libsumo raises its own types
        raise TrafficError(f"{network.name}: {e}") from e
    rec = f"sumo_{network.name}_{tag}_{seed}"
    try:
        return _record(sumo, rec, rng, seconds, table)
    except sumo.TraCIException as e:
        raise TrafficError(f"{network.name}: {e}") from e
    finally:
        sumo.close()


def _record(sumo: Any, rec: str, rng: np.random.Generator, seconds: float, table: IO[str]) -> tuple[int, int, int]:
    names: dict[str, tuple[str, str, float, float]] = {}
    last: dict[str, tuple[int, float, float]] = {}
    parts: dict[str, int] = {}
    seen, rows, teleports = set(), 0, 0
    vehicle = sumo.vehicle
    for step in range(round((WARM_UP_S + seconds) / FRAME_S)):
        sumo.simulationStep()
        ids = vehicle.getIDList()
        if step % 10 == 0:
            _hesitate(vehicle, ids, rng)
        frame = step - round(WARM_UP_S / FRAME_S)
        if frame < 0:
            continue
        for i in ids:
            if i not in names:
                kind = KINDS.get(vehicle.getVehicleClass(i), "car")
                names[i] = (i, kind, vehicle.getLength(i), vehicle.getWidth(i))
            _, kind, length, width = names[i]
            x, y = vehicle.getPosition(i)
            heading = math.pi / 2 - math.radians(vehicle.getAngle(i))
            cx, cy = x - length / 2 * math.cos(heading), y - length / 2 * math.sin(heading)
            before = last.get(i)
            if before is not None and (
                before[0] != frame - 1 or math.hypot(cx - before[1], cy - before[2]) > STEP_MAX_M
            ):
                parts[i] = parts.get(i, 0) + 1
                teleports += 1
            last[i] = (frame, cx, cy)
            name = f"{i}.{parts[i]}" if i in parts else i
            seen.add(name)
            v = vehicle.getSpeed(i)
            table.write(
                f"{rec},{name},{kind},{frame},{frame * FRAME_S:.1f},{cx:.3f},{cy:.3f},{v * math.cos(heading):.3f},"
                f"{v * math.sin(heading):.3f},{math.remainder(heading, 2 * math.pi):.4f},{length:.2f},{width:.2f}\n"
            )
            rows += 1
    return len(seen), rows, teleports


def _hesitate(vehicle: Any, ids: tuple[str, ...], rng: np.random.Generator) -> None:
    """Some drivers slow down for a while without a cause that others could see."""
    for i in ids:
        if rng.random() < 0.015:
            vehicle.slowDown(i, vehicle.getSpeed(i) * rng.uniform(0.3, 0.9), rng.uniform(1.5, 4.0))


def demand(network: Network, rng: np.random.Generator, seconds: float) -> str:
    """Drivers and flows between the ends of the network."""
    import sumolib

    net = sumolib.net.readNet(str(network.path))
    edges = [e for e in net.getEdges() if not e.getFunction() and e.allows("passenger")]
    enter = [e for e in edges if not e.getIncoming()] or [e for e in edges if e.is_fringe()]
    leave = [e for e in edges if not e.getOutgoing()] or [e for e in edges if e.is_fringe()]
    if not enter or not leave:
        raise TrafficError(f"{network.name}: no road leads in or out")
    trips: list[tuple[float, str]] = []
    for o, origin in enumerate(enter):
        targets = [t for t in leave if t is not origin and net.getShortestPath(origin, t)[0]]
        if not targets:
            continue
        share = rng.dirichlet(np.ones(len(targets)) * 2.0)
        busy = network.per_hour * rng.uniform(0.6, 1.3) * (origin.getLaneNumber() / 4.0 if network.fast else 1.0)
        for j, depart in enumerate(np.sort(rng.uniform(0.0, seconds, rng.poisson(busy / 3600.0 * seconds)))):
            target = targets[int(rng.choice(len(targets), p=share))]
            trip = (
                f'<trip id="f{o}.{j}" type="d{int(rng.integers(TYPES))}" depart="{depart:.1f}" '
                f'from="{origin.getID()}" to="{target.getID()}" departLane="best" departSpeed="desired"/>'
            )
            trips.append((float(depart), trip))
    kinds = [_driver(k, rng, network.fast) for k in range(TYPES)]
    return "\n".join(["<routes>", *kinds, *(text for _, text in sorted(trips)), "</routes>"])


def _driver(k: int, rng: np.random.Generator, fast: bool) -> str:
    """One kind of driver and vehicle."""
    heavy = k % 12 == 0
    model = rng.choice(["IDM", "EIDM", "Krauss"], p=[0.4, 0.3, 0.3])
    length = rng.uniform(8.0, 14.0) if heavy else float(np.clip(rng.normal(4.6, 0.4), 3.6, 5.6))
    width = 2.5 if heavy else rng.uniform(1.7, 2.1)
    gap, tau = rng.uniform(1.2, 3.5), rng.uniform(0.7, 2.0)
    accel = rng.uniform(0.7, 1.4) if heavy else rng.uniform(1.0, 2.8)
    factor = float(np.clip(rng.normal(0.95 if heavy else 1.02, 0.13), 0.65, 1.35))
    return (
        f'<vType id="d{k}" vClass="{"truck" if heavy else "passenger"}" carFollowModel="{model}" '
        f'length="{length:.2f}" width="{width:.2f}" minGap="{gap:.2f}" tau="{tau:.2f}" accel="{accel:.2f}" '
        f'decel="{rng.uniform(1.6, 3.6):.2f}" emergencyDecel="8" sigma="{rng.uniform(0.2, 0.8):.2f}" '
        f'speedFactor="{factor:.3f}" maxSpeed="{25 if heavy else 45}" lcSpeedGain="{rng.uniform(0.5, 3.0):.2f}" '
        f'lcAssertive="{rng.uniform(0.7, 2.0):.2f}" lcKeepRight="{0.0 if fast else rng.uniform(0.0, 1.0):.2f}" '
        f'minGapLat="0.4" latAlignment="{rng.choice(["center", "arbitrary", "right"])}" jmTimegapMinor="{gap:.2f}"/>'
    )
