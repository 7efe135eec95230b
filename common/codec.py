"""MessagePack in and out: every message that cannot be used is refused by name.

A message is a header (one MessagePack map, the attachment) and a body (the payload). An array field travels as the
map `{"dtype": "<f8", "shape": [n, 60], "data": bytes}`. The body of `risk` alone is raw: `volume`, then `dominant`,
C order; its other fields stand in the header under `body`.

What is sent passes the same checks as what arrives: nothing non-finite or out of range leaves a service.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from typing import Annotated, Any, TypeVar, cast, get_args, get_origin, get_type_hints

import msgpack
import msgspec
import numpy as np

from common.messages import BLOCK, Array, Header, Message, Risk, Status
from common.topics import STATUS_OF, VEHICLE, VERSION_MAJOR, Topic

MAX_CONTAINERS = 200_000
"""Maps and arrays in one message, all depths together."""

MAX_ITEMS = 500_000
"""What they hold, entries of maps and elements of arrays together: a byte on the wire may cost a hundred in memory."""

MAX_ARRAY = 20_000
"""Elements of one MessagePack array: the lanes of the largest map. Numbers in arrays travel as binary."""

MAX_DIMENSION = 2**24
"""Largest length of an array along one dimension: an array without bytes must not claim millions of rows either."""

M = TypeVar("M", bound=Message)


class RefusedError(Exception):
    """A message that is not used.

    `reason` is the name of the counter that it raises; `detail` says where and why.
    """

    def __init__(self, reason: str, detail: str = "") -> None:
        super().__init__(f"{reason}: {detail}" if detail else reason)
        self.reason = reason
        self.detail = detail


def encode_header(topic: Topic, header: Header) -> bytes:
    """Pack a header.

    Raises:
        RefusedError: `header_too_large`.
    """
    packed = cast(bytes, msgpack.packb(msgspec.to_builtins(header)))
    if len(packed) > topic.max_header_bytes:
        raise RefusedError("header_too_large", f"{len(packed)} bytes, at most {topic.max_header_bytes}")
    return packed


def encode_body(topic: Topic, message: Message) -> tuple[bytes, dict[str, Any] | None]:
    """Pack a body; returns the payload and, for `risk`, the fields that belong into the header.

    Raises:
        RefusedError: the message breaks the contract of its own type (`type`, `shape`, `dtype`, `non_finite`,
            `range`, `content`, `too_large`).
    """
    check(message)
    _check_speaker(topic, message)
    if isinstance(message, Risk):
        fields = cast(dict[str, Any], msgspec.to_builtins(message, enc_hook=_describe_array))
        payload = b"".join((_contiguous(message.volume).data, _contiguous(message.dominant).data))
        body = {k: v for k, v in fields.items() if k != "dominant"}
    else:
        payload = cast(bytes, msgpack.packb(msgspec.to_builtins(message, enc_hook=_pack_array, builtin_types=(bytes,))))
        body = None
    if len(payload) > topic.max_bytes:
        raise RefusedError("too_large", f"{len(payload)} bytes, at most {topic.max_bytes}")
    return payload, body


def decode_header(topic: Topic, attachment: bytes | None) -> Header:
    """Read a header.

    Raises:
        RefusedError: `header_missing`, `header_too_large`, `header_malformed`, `schema`, `version`.
    """
    if attachment is None:
        raise RefusedError("header_missing")
    if len(attachment) > topic.max_header_bytes:
        raise RefusedError("header_too_large", f"{len(attachment)} bytes, at most {topic.max_header_bytes}")
    fields = _unpack(attachment, "header_malformed")
    try:
        header = msgspec.convert(fields, Header)
    except (msgspec.ValidationError, OverflowError) as e:
        raise RefusedError("header_malformed", str(e)) from None
    if header.schema != topic.name:
        raise RefusedError("schema", f"{header.schema!r} on {topic.suffix!r}")
    if header.version[0] != VERSION_MAJOR:
        raise RefusedError("version", f"{header.version[0]}.{header.version[1]}, this side speaks {VERSION_MAJOR}.x")
    return header


def decode_body(topic: Topic, header: Header, payload: bytes) -> Message:
    """Read a body whose header was accepted.

    Raises:
        RefusedError: `too_large`, `malformed`, `type`, `range`, `shape`, `dtype`, `non_finite`, `content`.
    """
    if len(payload) > topic.max_bytes:
        raise RefusedError("too_large", f"{len(payload)} bytes, at most {topic.max_bytes}")
    fields = _risk_fields(header, payload) if topic.message is Risk else _unpack(payload, "malformed")
    message = cast(Message, _converted(fields, topic.message, _read_array))
    _check_content(message)
    _check_speaker(topic, message)
    return message


def check(message: Message) -> None:
    """Check a message of our own: each field's type and range, each array against its `Array`, then the whole.

    Raises:
        RefusedError: `type`, `dtype`, `shape`, `non_finite`, `range`, `content`; the detail names the field.
    """
    _check_content(message)
    plain = msgspec.to_builtins(message, enc_hook=_leave_out_array)
    _converted(plain, type(message), lambda *_: _LEFT_OUT)


def _converted(fields: Any, kind: type, arrays: Callable[[type, Any], Any]) -> Any:
    try:
        return msgspec.convert(fields, kind, dec_hook=arrays)
    except (msgspec.ValidationError, OverflowError) as e:
        inner, text = e.__cause__, str(e)
        if isinstance(inner, _ArrayError):
            raise RefusedError(inner.reason, text) from None
        beyond = any(sign in text for sign in ("<=", ">=", "` >", "` <"))
        raise RefusedError("range" if beyond else "type", text) from None


def _check_speaker(topic: Topic, message: Message) -> None:
    # whose key it is, only he may write: what he says must not be taken for another's
    if not isinstance(message, Status) or message.service == topic.writer:
        return
    if topic.writer != VEHICLE or message.service in STATUS_OF:  # a vehicle may have a name of its own
        raise RefusedError("content", f"status of {message.service!r} on {topic.suffix!r}")


def _check_content(message: Message) -> None:
    _check_struct(message, type(message).__name__.lower())
    problem = message.problem()
    if problem:
        raise RefusedError("content", problem)


# --- arrays ---


def _contiguous(a: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    return np.ascontiguousarray(a)


def _pack_array(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        a = _contiguous(value)
        return {"dtype": a.dtype.str, "shape": list(a.shape), "data": a.tobytes()}
    if isinstance(value, np.generic):
        return value.item()
    raise TypeError(f"cannot send a {type(value).__name__}")


_LEFT_OUT = np.zeros(0)


def _leave_out_array(value: Any) -> Any:
    return {} if isinstance(value, np.ndarray) else _pack_array(value)


def _describe_array(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return {"dtype": value.dtype.str, "shape": list(value.shape)}
    return _pack_array(value)


_DTYPES = {"<f8", "<f4", "<f2", "<i8", "|u1"}


def _read_array(kind: type, value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return value
    if not isinstance(value, dict) or not {"dtype", "shape", "data"} <= value.keys():
        raise _ArrayError("type", "expected an array {dtype, shape, data}")
    return _from_bytes(value["dtype"], value["shape"], value["data"])


def _from_bytes(dtype: Any, shape: Any, data: Any) -> np.ndarray[Any, Any]:
    if not isinstance(dtype, str) or dtype not in _DTYPES:
        raise _ArrayError("dtype", _shown(dtype))
    if (
        not isinstance(shape, list)
        or len(shape) > 4
        or not all(type(n) is int and 0 <= n <= MAX_DIMENSION for n in shape)
    ):
        raise _ArrayError("shape", _shown(shape))
    if not isinstance(data, bytes | memoryview):
        raise _ArrayError("type", "array data must be binary")
    expected = math.prod(shape) * np.dtype(dtype).itemsize
    if expected != len(data):
        raise _ArrayError("shape", f"shape {shape} of {dtype} needs {expected} bytes, got {len(data)}")
    return np.frombuffer(data, dtype=dtype).reshape(shape)


def _shown(value: Any) -> str:
    """A value that arrived, for a reason: short, and never by `repr` of what may be nested a thousand deep."""
    if isinstance(value, list) and len(value) <= 4 and all(type(n) is int for n in value):
        return str(value)
    return repr(value[:40]) if isinstance(value, str | bytes) else type(value).__name__


class _ArrayError(ValueError):
    # msgspec wraps a ValueError of its hook into a ValidationError with the field's path and keeps it as the cause
    def __init__(self, reason: str, detail: str) -> None:
        super().__init__(detail)
        self.reason = reason


def _risk_fields(header: Header, payload: bytes) -> dict[str, Any]:
    body = header.body
    if body is None:
        raise RefusedError("header_malformed", "a risk header without `body`")
    grid, volume = body.get("grid"), body.get("volume")
    if not isinstance(grid, dict) or not isinstance(volume, dict):
        raise RefusedError("header_malformed", "`grid` and `volume` must be maps")
    dtype, shape = volume.get("dtype"), volume.get("shape")
    if not isinstance(dtype, str) or dtype not in ("<f2", "<f4"):
        raise RefusedError("dtype", f"volume {_shown(dtype)}")
    if not isinstance(shape, list) or len(shape) != 3 or not all(type(n) is int and 0 < n < 2**20 for n in shape):
        raise RefusedError("shape", f"volume {_shown(shape)}")
    size = math.prod(shape) * np.dtype(dtype).itemsize
    blocks = [shape[0], -(-shape[1] // BLOCK), -(-shape[2] // BLOCK)]
    if size + math.prod(blocks) != len(payload):
        raise RefusedError(
            "shape", f"volume {shape} of {dtype} needs {size + math.prod(blocks)} bytes, got {len(payload)}"
        )
    raw = memoryview(payload)
    return {
        **body,
        "volume": np.frombuffer(raw[:size], dtype=dtype).reshape(shape),
        "dominant": np.frombuffer(raw[size:], dtype=np.uint8).reshape(blocks),
    }


@functools.cache
def _array_fields(kind: type) -> dict[str, Array | None]:
    """Fields of a struct that hold an array (with its spec) or may hold structs (None)."""
    fields: dict[str, Array | None] = {}
    for name, hint in get_type_hints(kind, include_extras=True).items():
        spec = _array_spec(hint)
        if spec is not None or _holds_struct(hint):
            fields[name] = spec
    return fields


def _array_spec(hint: Any) -> Array | None:
    if get_origin(hint) is Annotated:
        return next((a for a in get_args(hint)[1:] if isinstance(a, Array)), None)
    return next(filter(None, (_array_spec(a) for a in get_args(hint))), None)


def _holds_struct(hint: Any) -> bool:
    if isinstance(hint, type) and issubclass(hint, msgspec.Struct):
        return bool(_array_fields(hint))
    return any(_holds_struct(a) for a in get_args(hint) if a is not hint)


def _check_struct(struct: Any, path: str) -> None:
    bound: dict[str, int] = {}
    for name, spec in _array_fields(cast(Any, type(struct))).items():
        value = getattr(struct, name)
        where = f"{path}.{name}"
        if value is None:
            continue
        if spec is not None:
            _check_array(value, spec, where, bound)
        elif isinstance(value, list):
            for i, item in enumerate(value):
                _check_struct(item, f"{where}[{i}]")
        else:
            _check_struct(value, where)


def _check_array(value: Any, spec: Array, where: str, bound: dict[str, int]) -> None:
    if not isinstance(value, np.ndarray) or value.dtype.str not in spec.dtypes:
        raise RefusedError(
            "dtype", f"{where}: {getattr(value, 'dtype', type(value))}, expected {' or '.join(spec.dtypes)}"
        )
    if value.ndim != len(spec.shape):
        raise RefusedError("shape", f"{where}: {value.shape}, expected {spec.shape}")
    for n, want in zip(value.shape, spec.shape, strict=True):
        if n != (want if isinstance(want, int) else bound.setdefault(want, n)):
            raise RefusedError("shape", f"{where}: {value.shape}, expected {spec.shape} with {bound}")
    if value.shape[0] < spec.least:
        raise RefusedError("shape", f"{where}: at least {spec.least} rows, got {value.shape[0]}")
    if value.size == 0 or (value.dtype.kind == "u" and spec.high == np.inf):
        return
    low, high = _extremes(value)
    if not (np.isfinite(low) and np.isfinite(high)):
        raise RefusedError("non_finite", where)
    if not (low >= spec.low and high <= spec.high):
        raise RefusedError("range", f"{where}: {low} … {high} outside {spec.low} … {spec.high}")


def _extremes(value: np.ndarray[Any, Any]) -> tuple[Any, Any]:
    """Minimum and maximum; NaN propagates.

    NumPy compares float16 one by one (9 ms for a risk volume). Without a sign and below infinity, half floats are
    ordered as their bit patterns are, which takes 0.1 ms.
    """
    if value.dtype.str == "<f2":
        bits = value.view("<u2")
        low, high = bits.min(), bits.max()
        if high < 0x7C00:
            return low.view("<f2"), high.view("<f2")
    return value.min(), value.max()


# --- MessagePack under limits ---


def _unpack(data: bytes, reason: str) -> Any:
    # a byte says whether it is a map; msgpack would copy all that stands behind a number before it says so
    if not (data[:1] in (b"\xde", b"\xdf") or b"\x80" <= data[:1] < b"\x90"):
        raise RefusedError(reason, "expected a map" if data else "nothing")
    containers = items = 0

    def counted(value: Any) -> Any:
        nonlocal containers, items
        containers += 1
        items += len(value)
        if containers > MAX_CONTAINERS:
            raise ValueError(f"more than {MAX_CONTAINERS} maps and arrays")
        if items > MAX_ITEMS:
            raise ValueError(f"more than {MAX_ITEMS} entries and elements")
        return value

    def no_extension(code: int, _: bytes) -> Any:
        raise ValueError(f"extension type {code}")

    try:
        unpacked = msgpack.unpackb(
            data,
            object_hook=counted,
            list_hook=counted,
            ext_hook=no_extension,
            strict_map_key=True,
            max_str_len=4096,
            # what claims more than its bytes could hold is refused before memory is taken for it
            max_array_len=min(MAX_ARRAY, len(data)),
            max_map_len=min(4096, len(data)),
            max_ext_len=0,
            max_bin_len=len(data),
        )
    except (ValueError, TypeError, OverflowError, RecursionError, msgpack.UnpackException) as e:
        raise RefusedError(reason, str(e) or type(e).__name__) from None
    return unpacked
