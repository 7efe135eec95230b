"""A valid message of any type, made from its type alone, and every place in it where a floating-point number stands.

Nothing here names a field that the contract could drop or gain: a field that is added to `common.messages` is filled,
and attacked, by itself.
"""

from __future__ import annotations

import types
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Annotated, Any, Literal, Union, cast, get_args, get_origin, get_type_hints

import msgspec
import numpy as np

from common.messages import BLOCK, Array, Header, Message, Plan, Risk, Status
from common.topics import VERSION_MAJOR, VERSION_MINOR, Topic

Path = tuple[str | int, ...]
_ELEMENTS = 3
_NEAR = 20.0
"""Numbers are drawn from this far around 0, within what is allowed."""


def specimen(kind: type, rng: np.random.Generator) -> Any:
    """A valid value of a struct, optional fields filled in."""
    return _whole(kind, _struct(kind, rng))


def of(topic: Topic, rng: np.random.Generator) -> Any:
    """A valid message of a topic."""
    message = specimen(topic.message, rng)
    if isinstance(message, Status):  # who speaks is what the topic says
        message = msgspec.structs.replace(message, service=topic.suffix.rpartition("/")[2])
    return message


def header(topic: Topic, body: dict[str, Any] | None, *, boot: str, seq: int, now_ns: int) -> Header:
    """A header as a sender of today writes it."""
    return Header(
        schema=topic.name, version=(VERSION_MAJOR, VERSION_MINOR), source="fuzz", boot=boot, seq=seq,
        capture_ns=now_ns, sent_ns=now_ns, age_ns=0, body=body,
    )  # fmt: skip


def plain(message: Message) -> tuple[dict[str, Any], bytes | None]:
    """A message as plain maps and lists, not checked, and for `risk` its raw body."""
    fields = cast(
        dict[str, Any],
        msgspec.to_builtins(message, enc_hook=_describe if type(message) is Risk else _pack, builtin_types=(bytes,)),
    )
    if not isinstance(message, Risk):
        return fields, None
    fields.pop("dominant")
    return fields, message.volume.tobytes() + message.dominant.tobytes()


@dataclass(frozen=True)
class FloatPlace:
    """Where a floating-point number stands in a message; in an array: its first element."""

    path: Path
    dtype: str
    """Of an array; empty: a number by itself."""

    @property
    def name(self) -> str:
        """The field's own name."""
        return next(str(p) for p in reversed(self.path) if isinstance(p, str))


def float_places(kind: type, message: Any, path: Path = ()) -> Iterator[FloatPlace]:
    """Every place of a filled message that holds a floating-point number, by its type and not by its value."""
    for name, hint in get_type_hints(kind, include_extras=True).items():
        yield from _places(hint, getattr(message, name), (*path, name))


def _places(hint: Any, value: Any, path: Path) -> Iterator[FloatPlace]:
    metas, base = _bare(hint)
    if any(isinstance(m, Array) for m in metas):
        if value is not None and value.dtype.kind == "f" and value.size:
            yield FloatPlace(path, value.dtype.str)
    elif base is float:
        yield FloatPlace(path, "")
    elif isinstance(value, msgspec.Struct):
        yield from float_places(type(value), value, path)
    elif isinstance(value, dict):
        for key, item in value.items():
            yield from _places(get_args(base)[1], item, (*path, key))
    elif isinstance(value, list | tuple):
        inner = get_args(base)
        for i, item in enumerate(value):
            yield from _places(inner[0] if len(inner) != len(value) else inner[i], item, (*path, i))


def _bare(hint: Any) -> tuple[list[Any], Any]:
    """Annotations and type of a hint, without `None`."""
    metas: list[Any] = []
    while True:
        if get_origin(hint) is Annotated:
            metas += get_args(hint)[1:]
            hint = get_args(hint)[0]
        elif get_origin(hint) in (Union, types.UnionType):
            hint = next(a for a in get_args(hint) if a is not type(None))
        else:
            return metas, hint


def _struct(kind: type, rng: np.random.Generator) -> dict[str, Any]:
    sizes: dict[str, int] = {}
    return {name: _value(h, rng, sizes) for name, h in get_type_hints(kind, include_extras=True).items()}


def _value(hint: Any, rng: np.random.Generator, sizes: dict[str, int]) -> Any:
    metas, base = _bare(hint)
    array = next((m for m in metas if isinstance(m, Array)), None)
    if array is not None:
        shape = [n if isinstance(n, int) else sizes.setdefault(n, max(_ELEMENTS, array.least)) for n in array.shape]
        return _array(array, shape, rng)
    meta = next((m for m in metas if isinstance(m, msgspec.Meta)), msgspec.Meta())
    origin = get_origin(base)
    if origin is Literal:
        return get_args(base)[0]
    if origin is list:
        return [_value(get_args(base)[0], rng, sizes) for _ in range(max(2, meta.min_length or 0))]
    if origin is tuple:
        return tuple(_value(a, rng, sizes) for a in get_args(base))
    if origin is dict:
        return {k: _value(get_args(base)[1], rng, sizes) for k in ("first", "second")}
    if isinstance(base, type) and issubclass(base, msgspec.Struct):
        return specimen(base, rng)
    if base is bool:
        return True
    if base is int:
        return int(rng.integers(max(int(meta.ge or 0), 0), min(int(meta.le or 40), 40)))
    if base is float:
        return float(_between(meta.ge if meta.ge is not None else meta.gt, meta.le, rng, ()))
    return "x" * max(meta.min_length or 0, 4) if base is str else None


def _array(array: Array, shape: list[int], rng: np.random.Generator) -> np.ndarray[Any, Any]:
    dtype = np.dtype(array.dtypes[0])
    if dtype.kind != "f":
        whole = rng.integers(int(max(array.low, 0)), int(min(array.high, 200)) + 1, tuple(shape))
        return np.asarray(whole, dtype=dtype)
    return np.asarray(_between(array.low, array.high, rng, tuple(shape)), dtype=dtype)


def _between(low: float | None, high: float | None, rng: np.random.Generator, shape: tuple[int, ...]) -> Any:
    low = max(-_NEAR if low is None else low, -_NEAR)
    high = min(_NEAR if high is None else high, _NEAR)
    return rng.uniform(low + 0.3 * (high - low), high, shape)


def _whole(kind: type, fields: dict[str, Any]) -> Any:
    """What types alone do not tell: ids differ, times increase, a volume has its grid's shape, a tail ends at rest."""
    for name, value in fields.items():
        if isinstance(value, np.ndarray) and value.ndim == 1:
            if name == "id":
                fields[name] = np.arange(len(value), dtype=value.dtype)
            elif name == "t":
                fields[name] = np.arange(len(value), dtype=value.dtype) * 0.1
    if kind is Risk:
        times = fields["slice_times"] = sorted({round(t, 3) for t in fields["slice_times"]})
        shape = (len(times), fields["grid"].rows, fields["grid"].columns)
        blocks = (shape[0], -(-shape[1] // BLOCK), -(-shape[2] // BLOCK))
        fields["volume"] = np.resize(fields["volume"], shape)
        fields["dominant"] = np.resize(fields["dominant"], blocks)
    if kind is Plan:
        speed = fields["tail"].speed.copy()
        speed[-1] = 0.0
        fields["tail"] = msgspec.structs.replace(fields["tail"], speed=speed)
    return kind(**fields)


def _pack(value: Any) -> Any:
    return {"dtype": value.dtype.str, "shape": list(value.shape), "data": value.tobytes()}


def _describe(value: Any) -> Any:
    return {"dtype": value.dtype.str, "shape": list(value.shape)}
