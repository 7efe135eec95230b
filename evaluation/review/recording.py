"""What a recording holds, typed: states, road users, predictions, plans, statuses and the road.

Times are seconds of the recording, as its viewer counts them on `t`; `map` frame, SI units.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from common.messages import F32, F64, I64, U8, Status
from evaluation.review.tables import ReviewError, numbers, read, split, strings, times
from viz import account
from viz.account import Said

WANTED = ["/account/**", "/plot/**", "/world", "/world/map/**", "/world/route/**", "/__properties/**"]
STAGES = ("predictor", "riskfield", "planner", "end_to_end")


@dataclass(frozen=True)
class States:
    """The ego along time: n states."""

    t: F64
    x: F64
    y: F64
    heading: F64  # [rad]
    vx: F64
    vy: F64
    acceleration: F64
    yaw_rate: F64

    @property
    def speed(self) -> F64:
        """Signed speed along the heading [m/s]."""
        return np.asarray(self.vx * np.cos(self.heading) + self.vy * np.sin(self.heading))

    def part(self, chosen: Any) -> States:
        """Some of the states."""
        return States(**{name: values[chosen] for name, values in vars(self).items()})


@dataclass(frozen=True)
class Seen:
    """Everyone perceived at one moment."""

    t: float
    id: I64
    cls: U8
    x: F64
    y: F64
    heading: F32
    vx: F32
    vy: F32
    length: F32
    width: F32


@dataclass(frozen=True)
class Foreseen:
    """Where everyone perceived at `t` is predicted to go: displacement after each horizon, [n, horizons] [m]."""

    t: float
    id: I64
    method: U8
    dx: F32
    dy: F32


@dataclass(frozen=True)
class Spoken:
    """One plan's words."""

    t: float
    """The ego state that it rests on [s]."""
    received: float
    """When it arrived [s]."""
    work_ms: float
    highest_risk: float
    """On its path, over all slices [E_max]; NaN: unknown."""
    said: Said


@dataclass(frozen=True)
class Line:
    """A line of the road [n, 2]."""

    kind: str
    points: F64


@dataclass(frozen=True)
class Recording:
    """A recording, but for its pictures of the field (`pictures.py` reads those it needs)."""

    paths: tuple[Path, ...]
    """Its pieces, in the order of time."""
    name: str
    configuration: dict[str, Any]
    ego: States
    size: tuple[float, float]
    """Length and width of the ego [m]."""
    seen: list[Seen]
    foreseen: list[Foreseen]
    plans: list[Spoken]
    statuses: dict[str, list[tuple[float, Status]]]
    latency_ms: dict[str, tuple[F64, F64]]
    """Stage → times [s] and latencies [ms]."""
    limit: tuple[F64, F64]
    """Speed limit: times [s] and values [m/s]."""
    e_max: float
    full_scale: float
    """Brightest risk drawn, in the volume's own units."""
    origin: tuple[float, float]
    """Point of the `map` frame that is drawn at (0, 0) [m]."""
    road: list[Line] = field(default_factory=list)

    @property
    def path(self) -> Path:
        """Its first piece."""
        return self.paths[0]

    @property
    def run_began(self) -> float:
        """Time 0 of the run, as the rig told [s]; without a rig the begin of the recording."""
        told = [row for said in self.statuses.values() for row in said]
        began = [t - float(s.detail["run_s"]) for t, s in told if "run_s" in s.detail]
        return max(min(began), 0.0) if began else 0.0


def load(*paths: Path) -> Recording:
    """Read a recording, all its pieces together.

    Raises:
        ReviewError: not a recording of Forefield, one of another version, or damaged.
    """
    for piece in paths:
        _check_version(piece, read([piece], ["/account", "/__properties/**"]))
    path, tables = paths[0], read(paths, WANTED)
    if "/account/ego" not in tables:
        raise ReviewError(f"{path}: no ego was heard while it was recorded: there is no drive to review")
    try:
        return _typed(paths, tables)
    except (msgspec.MsgspecError, KeyError, IndexError, ValueError, TypeError) as e:
        raise ReviewError(f"{path}: its account cannot be understood: {e}") from None


def _check_version(path: Path, tables: dict[str, Any]) -> None:
    if "/account" not in tables:
        ours = "/__properties/forefield" in tables
        raise ReviewError(
            f"{path}: {'recorded before reviews were possible; record the drive again' if ours else 'not a recording of Forefield'}"  # noqa: E501
        )
    names = strings(tables["/account"], "Account:schema")
    version = tuple(int(v) for v in split(tables["/account"], "Account:version")[-1]) if names else ()
    if not names or names[-1] != account.SCHEMA or len(version) != 2:
        raise ReviewError(f"{path}: not a recording of Forefield")
    if version[0] != account.VERSION[0]:
        written = ".".join(str(v) for v in version)
        told = "update Forefield" if version[0] > account.VERSION[0] else "record the drive again"
        raise ReviewError(f"{path}: its account is of version {written}, this reads {account.VERSION[0]}.x: {told}")


def _typed(paths: tuple[Path, ...], tables: dict[str, Any]) -> Recording:
    about = tables.get("/__properties/forefield")
    world = tables.get("/world")
    origin = (0.0, 0.0)
    if world is not None and "map_x_at_origin" in world.schema.names:
        origin = (
            float(split(world, "map_x_at_origin")[-1][0]),
            float(split(world, "map_y_at_origin")[-1][0]),
        )
    size = tables.get("/account/ego/size")
    scale = tables.get("/account/scale")
    return Recording(
        paths=paths,
        name=strings(about, "scenario")[-1] if about is not None else "live",
        configuration=json.loads(strings(about, "configuration")[-1] or "{}") if about is not None else {},
        ego=_ego(tables["/account/ego"]),
        size=(4.5, 1.8)
        if size is None
        else (float(split(size, "Size:length")[-1][0]), float(split(size, "Size:width")[-1][0])),
        seen=_seen(tables.get("/account/objects")),
        foreseen=_foreseen(tables.get("/account/prediction")),
        plans=_plans(tables.get("/account/plan")),
        statuses={
            entity.rpartition("/")[2]: _statuses(table)
            for entity, table in tables.items()
            if entity.startswith("/account/status/")
        },
        latency_ms={stage: _series(tables.get(f"/plot/latency/{stage}")) for stage in STAGES},
        limit=_series(tables.get("/plot/speed/limit")),
        e_max=1.0 if scale is None else float(split(scale, "Scale:e_max")[-1][0]),
        full_scale=1.5 if scale is None else float(split(scale, "Scale:full_scale")[-1][0]),
        origin=origin,
        road=_road(tables, origin),
    )


def _ego(table: Any) -> States:
    values, offsets = numbers(table, "Ego:state")
    if np.any(np.diff(offsets) != 7):
        raise ValueError("the ego's state is not seven numbers")
    t = times(table)
    order = np.append(True, np.diff(t) > 0)  # a state told twice counts once
    return States(t[order], *np.ascontiguousarray(values.reshape(-1, 7)[order].T))


def _seen(table: Any) -> list[Seen]:
    if table is None:
        return []
    columns = ("id", "cls", "x", "y", "heading", "vx", "vy", "length", "width")
    parts = [split(table, f"Objects:{name}") for name in columns]
    return [Seen(float(t), *row) for t, *row in zip(times(table), *parts, strict=True)]


def _foreseen(table: Any) -> list[Foreseen]:
    if table is None:
        return []
    h = len(account.HORIZONS_S)
    parts = [split(table, f"Prediction:{name}") for name in ("id", "method", "dx", "dy")]
    return [
        Foreseen(float(t), i, m, dx.reshape(len(i), h), dy.reshape(len(i), h))
        for t, i, m, dx, dy in zip(times(table), *parts, strict=True)
    ]


def _plans(table: Any) -> list[Spoken]:
    if table is None:
        return []
    found = []
    decoder = msgspec.json.Decoder(Said)
    for t, text, values in zip(times(table), strings(table, "Plan:said"), split(table, "Plan:numbers"), strict=True):
        if text and len(values) == 3:
            received, work_ms, highest = (float(v) for v in values)
            found.append(Spoken(float(t), received, work_ms, highest, decoder.decode(text)))
    return sorted(found, key=lambda p: p.received)


def _statuses(table: Any) -> list[tuple[float, Status]]:
    decoder = msgspec.json.Decoder(Status)
    texts = strings(table, "Status:said")
    return [(float(t), decoder.decode(text)) for t, text in zip(times(table), texts, strict=True) if text]


def _series(table: Any) -> tuple[F64, F64]:
    if table is None or "t" not in table.schema.names:
        return np.zeros(0), np.zeros(0)
    values, offsets = numbers(table, "Scalars:scalars")
    has = np.diff(offsets) > 0
    return times(table)[has], np.asarray(values[offsets[:-1][has]], dtype=np.float64)


def _road(tables: dict[str, Any], origin: tuple[float, float]) -> list[Line]:
    lines = []
    for entity, table in tables.items():
        above, _, kind = entity.rpartition("/")
        if not above.startswith("/world/map") and entity != "/world/route/goal":
            continue
        if "LineStrips3D:strips" not in table.schema.names:
            continue
        for strip in table.column("LineStrips3D:strips").to_pylist()[-1] or []:
            points = np.array(strip, dtype=np.float64)[:, :2] + origin
            if len(points) > 1:
                lines.append(Line(kind, points))
    return lines
