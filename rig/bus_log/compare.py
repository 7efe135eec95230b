"""Whether a repeated message is the recorded one, and if not, where it first differs."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import msgspec
import numpy as np

from common.messages import Message, Plan, Prediction, Risk

SAME = 1e-6
"""Largest difference on the machine that recorded, in each field's own unit."""
ELSEWHERE = 2e-3
"""Largest difference of risks [E_max] and predictions [m, rad, m/s] on another: its arithmetic rounds differently."""
LOOSE_FIELDS = {
    Prediction: ("id", "cls", "x0", "y0", "length", "width", "mass", "x", "y", "heading", "speed", "method"),
    Risk: ("grid", "slice_times", "t_offset", "e_max", "volume"),
    Plan: ("mode", "planner"),
}
"""What must agree on another machine. Which of two equal sources a block names, or which of two equal paths is taken,
may turn on the last digit."""


@dataclass(frozen=True)
class Difference:
    """The first field that differs."""

    field: str
    recorded: str
    repeated: str


def difference(recorded: Message, repeated: Message, *, same_machine: bool) -> Difference | None:
    """The first difference between two messages of one type; None: they agree.

    Args:
        recorded: as it was recorded.
        repeated: as it came out now.
        same_machine: whether every field must agree to `SAME`, or the important ones to `ELSEWHERE`.
    """
    name = type(recorded).__name__.lower()
    if type(recorded) is not type(repeated):
        return Difference(name, type(recorded).__name__, type(repeated).__name__)
    tolerance = SAME if same_machine else ELSEWHERE
    if isinstance(recorded, Risk):
        tolerance *= recorded.e_max
    fields = recorded.__struct_fields__ if same_machine else LOOSE_FIELDS[type(recorded)]
    for field in fields:
        found = _differs(getattr(recorded, field), getattr(repeated, field), f"{name}.{field}", tolerance)
        if found is not None:
            return found
    return None


def _differs(a: Any, b: Any, path: str, tolerance: float) -> Difference | None:
    if isinstance(a, np.ndarray) and isinstance(b, np.ndarray):
        return _arrays(a, b, path, tolerance)
    if isinstance(a, msgspec.Struct) and type(a) is type(b):
        pairs = [(f".{f}", getattr(a, f), getattr(b, f)) for f in a.__struct_fields__]
    elif isinstance(a, list | tuple) and isinstance(b, list | tuple) and len(a) == len(b):
        pairs = [(f"[{i}]", x, y) for i, (x, y) in enumerate(zip(a, b, strict=True))]
    elif _number(a) and _number(b):
        return None if abs(a - b) <= tolerance else Difference(path, repr(a), repr(b))
    else:
        return None if type(a) is type(b) and a == b else Difference(path, _short(a), _short(b))
    return next(filter(None, (_differs(x, y, path + at, tolerance) for at, x, y in pairs)), None)


def _arrays(a: np.ndarray, b: np.ndarray, path: str, tolerance: float) -> Difference | None:
    if a.shape != b.shape or a.dtype != b.dtype:
        return Difference(path, f"{a.dtype} {a.shape}", f"{b.dtype} {b.shape}")
    if a.dtype.kind != "f":
        off = a != b
    elif a.dtype == np.float16:  # half floats are compared as they are; their own step may be the larger one
        near = np.abs(a.astype(np.float32) - b.astype(np.float32))
        off = ~(near <= np.maximum(tolerance, np.spacing(np.maximum(a, b)).astype(np.float32) * (tolerance > SAME)))
    else:
        off = ~(np.abs(a - b) <= tolerance)
    if not off.any():
        return None
    at = tuple(int(i) for i in np.argwhere(off)[0])
    where = f"{path}[{', '.join(map(str, at))}]"
    return Difference(where, f"{a[at]!s} (as {int(off.sum())} of {off.size} differ)", str(b[at]))


def _number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 200 else text[:197] + "..."
