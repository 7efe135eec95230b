"""What was drawn at chosen moments: fields, path, predicted poses. Read in one pass, keeping only those rows.

Coordinates are those of the drawing: the `map` frame less the recording's origin.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from common.messages import F64, U8
from evaluation.review.tables import TIME, chunks

_ENTITIES = {
    "/world/risk/now": "now",
    "/slice/risk": "slice",
    "/slice/objects": "boxes",
    "/slice/ego": "ego",
    "/world/plan/profile": "profile",
    "/world/plan/tail": "tail",
    "/world/plan/candidates": "candidates",
    "/world/plan/decided": "decided",
}
_ANCHOR = "/world/plan/profile"
"""Drawn with every plan that is drawn."""


@dataclass(frozen=True)
class Field:
    """One slice as drawn: levels [row from the far left, column forward], 255 at the brightest."""

    levels: U8
    corner: tuple[float, float]
    heading: float
    cell: float


@dataclass(frozen=True)
class Boxes:
    """Rectangles: centres [n, 2], half sizes [n, 2], headings [n]."""

    centre: F64
    half: F64
    heading: F64


@dataclass(frozen=True)
class Moment:
    """What was drawn at one moment `t` of the recording."""

    t: float
    now: Field | None = None
    slice: Field | None = None
    boxes: Boxes | None = None
    ego: F64 | None = None  # outline of the ego in the slice [5, 2]
    profile: F64 | None = None
    tail: F64 | None = None
    candidates: list[F64] = field(default_factory=list)
    decided: tuple[float, float] | None = None


def drawn_at(paths: Sequence[Path]) -> F64:
    """When plans were drawn, increasing [s] of the recording.

    Raises:
        ReviewError: see `tables.chunks`.
    """
    at = [_ns(c.to_record_batch()) for p in paths for c in chunks(p, [_ANCHOR]) if not c.is_static]
    return np.unique(np.concatenate(at)) * 1e-9 if at else np.zeros(0)


def moments(paths: Sequence[Path], wanted: Sequence[float]) -> list[Moment]:
    """What stood in the picture at each wanted time of the recording [s].

    Raises:
        ReviewError: see `tables.chunks`.
    """
    if not len(wanted):
        return []
    ns = np.rint(np.asarray(wanted, dtype=np.float64) * 1e9).astype(np.int64) + 1000  # less than any two rows apart
    best: list[dict[str, tuple[int, Any]]] = [{} for _ in wanted]
    for chunk in itertools.chain.from_iterable(chunks(path, list(_ENTITIES)) for path in paths):
        if chunk.is_static:
            continue
        name, batch = _ENTITIES[chunk.entity_path], chunk.to_record_batch()
        at = _ns(batch)
        for k, t in enumerate(ns):
            upto = np.flatnonzero(at <= t)
            if not len(upto):
                continue
            i = int(upto[np.argmax(at[upto])])
            if name not in best[k] or at[i] >= best[k][name][0]:
                best[k][name] = (int(at[i]), _value(name, batch, i))
    return [
        Moment(float(t), **{name: v for name, (_, v) in rows.items() if v is not None})
        for t, rows in zip(wanted, best, strict=True)
    ]


def _ns(batch: Any) -> np.ndarray:
    return np.asarray(batch.column(TIME).cast("int64").to_numpy(zero_copy_only=False))


def _value(name: str, batch: Any, i: int) -> Any:
    if name in ("now", "slice"):
        return _field(batch, i)
    if name == "boxes":
        return _boxes(batch, i)
    if name == "decided":
        points = _cell(batch, "Points3D:positions", i)
        return (float(points[0][0]), float(points[0][1])) if points else None
    strips = [np.asarray(strip, dtype=np.float64)[:, :2] for strip in _cell(batch, "LineStrips3D:strips", i) if strip]
    if name == "candidates":
        return strips
    return strips[0] if strips else None


def _cell(batch: Any, column: str, i: int) -> list[Any]:
    return (batch.column(column)[i].as_py() or []) if column in batch.schema.names else []


def _field(batch: Any, i: int) -> Field | None:
    form = _cell(batch, "GridMap:format", i)
    if not form:
        return None
    data = batch.column("GridMap:data")[i].values[0].values.to_numpy(zero_copy_only=False)
    levels = np.asarray(data, dtype=np.uint8).reshape(form[0]["height"], form[0]["width"])
    x, y, _ = _cell(batch, "GridMap:translation", i)[0]
    _, _, qz, qw = _cell(batch, "GridMap:quaternion", i)[0]
    return Field(levels, (x, y), 2.0 * float(np.arctan2(qz, qw)), float(_cell(batch, "GridMap:cell_size", i)[0]))


def _boxes(batch: Any, i: int) -> Boxes | None:
    centres = np.array(_cell(batch, "Boxes3D:centers", i), dtype=np.float64).reshape(-1, 3)
    halves = np.array(_cell(batch, "Boxes3D:half_sizes", i), dtype=np.float64).reshape(-1, 3)
    turns = np.array(_cell(batch, "Boxes3D:quaternions", i), dtype=np.float64).reshape(-1, 4)
    if not len(centres) or len(turns) != len(centres):
        return None
    return Boxes(centres[:, :2], halves[:, :2], 2.0 * np.arctan2(turns[:, 2], turns[:, 3]))
