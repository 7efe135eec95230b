"""Messages that nobody should send: random bytes, good ones damaged, good ones with one value at an edge, and bombs.

Everything follows from a seed. What is sent is bytes, header and body, as they would travel.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal, cast

import msgpack
import numpy as np

from common import codec
from common.messages import Risk
from common.topics import Topic
from evaluation.faults import specimens

Kind = Literal["valid", "random", "mutated", "edge"]
SHARES: dict[Kind, float] = {"valid": 0.1, "random": 0.2, "mutated": 0.35, "edge": 0.35}
RESTARTS = 0.01
"""Share of messages that come from a sender who has just been started again."""
EDGES: tuple[Any, ...] = (
    math.nan, math.inf, -math.inf, -0.0, 0.0, 5e-324, 1e-300, 1e38, -1e38, 1e300, 1.0, -1.0, 0, 1, -1, 255, 256, 2**31,
    2**32, 2**62, 2**63 - 1, 2**63, 2**64 - 1, -(2**31), -(2**63), "", "x", "x" * 65, "x" * 4096, "x" * 5000,
    "drive", b"", b"\x00", b"\xff" * 100, None, True, False, [], {}, [None], [[]], {"a": 1}, [0] * 30_000,
    {"dtype": "|O", "shape": [1], "data": bytes(8)}, {"dtype": "<f8", "shape": [2**31], "data": b""},
    {"dtype": "<f8", "shape": [0], "data": b""}, {"dtype": "<f8", "shape": [1], "data": b"\xff" * 8},
    {"dtype": "<f4", "shape": [0, 2], "data": b""}, {"dtype": "|u1", "shape": [1], "data": b"\xff"},
    {"dtype": "<f8", "shape": [2, 2], "data": bytes(32)},
)  # fmt: skip


@dataclass(frozen=True)
class Attack:
    """One message."""

    kind: str
    attachment: bytes | None
    payload: bytes


class Fuzzer:
    """Endless messages for one topic."""

    def __init__(self, topic: Topic, seed: int, samples: Sequence[tuple[bytes, bytes]] = ()) -> None:
        """Args: topic; seed; samples: good messages (header, body) from real processes, to damage beside made ones."""
        self.topic = topic
        self._rng = np.random.default_rng([seed, *topic.suffix.encode()])
        made = [encoded(topic, specimens.of(topic, self._rng)) for _ in range(4)]
        weights = [1.0] * 4 + [min(1.0, 2e4 / max(len(payload), 1)) for _, payload in samples]
        self._samples = [*made, *samples]
        self._weights = np.array(weights) / sum(weights)
        self._boot, self._seq = "", 0

    def next(self, now_ns: int, kind: Kind | None = None) -> Attack:
        """The next message, sent now."""
        rng = self._rng
        if not self._boot or rng.random() < RESTARTS:
            self._boot, self._seq = rng.bytes(8).hex(), 0
        self._seq += 1
        kind = kind or rng.choice(list(SHARES), p=list(SHARES.values()))
        head, payload = self._samples[rng.choice(len(self._samples), p=self._weights)]
        fields = msgpack.unpackb(head)
        fields |= {"boot": self._boot, "seq": self._seq, "capture_ns": now_ns, "sent_ns": now_ns, "age_ns": 0}
        attachment: bytes | None = msgpack.packb(fields)
        at_header = rng.random() < (0.5 if self.topic.message is Risk else 0.25)
        if kind == "random":
            junk = rng.bytes(int(2 ** rng.uniform(0, 11)))
            attachment, payload = (junk, payload) if at_header else (attachment, junk)
            if rng.random() < 0.02:
                attachment = None
        elif kind == "mutated":
            assert attachment is not None
            attachment, payload = (
                (self._damaged(attachment), payload) if at_header else (attachment, self._damaged(payload))
            )
        elif kind == "edge":
            if at_header:
                attachment = self._edged(fields)
            elif self.topic.message is Risk:
                payload = self._cells(payload)
            else:
                payload = self._edged(msgpack.unpackb(payload))
        return Attack(str(kind), attachment, payload)

    def _damaged(self, data: bytes) -> bytes:
        rng, out = self._rng, bytearray(data)
        for _ in range(rng.integers(1, 5)):
            at = int(rng.integers(0, len(out) + 1))
            match rng.integers(0, 5):
                case 0 if out:
                    out[at % len(out)] ^= 1 << int(rng.integers(0, 8))
                case 1 if out:
                    out[at % len(out)] = int(rng.choice([0x00, 0x7F, 0x80, 0x90, 0xC0, 0xC6, 0xCB, 0xDD, 0xDF, 0xFF]))
                case 2:
                    out[at:at] = rng.bytes(int(rng.integers(1, 20)))
                case 3:
                    del out[at : at + int(rng.integers(1, 40))]
                case _:
                    out[at:at] = out[at : at + int(rng.integers(1, 200))]
        return bytes(out)

    def _edged(self, fields: dict[str, Any]) -> bytes:
        """One value replaced, dropped or added, anywhere in it."""
        rng = self._rng
        at: Any = fields
        inside: Any = fields
        while isinstance(inside, dict | list) and inside and (inside is fields or rng.random() < 0.75):
            at = inside
            key: Any = (
                list(inside)[rng.integers(len(inside))] if isinstance(inside, dict) else rng.integers(len(inside))
            )
            inside = inside[key]
        edge = EDGES[rng.integers(len(EDGES))]
        if isinstance(inside, bytes) and len(inside) % 8 == 0 and inside and rng.random() < 0.7:  # numbers of an array
            numbers = np.frombuffer(inside, "<f8").copy()
            numbers[rng.integers(len(numbers))] = rng.choice([math.nan, math.inf, -math.inf, 5e-324, -0.0, 1e38, -1e38])
            edge = numbers.tobytes()
        action = rng.random()
        if isinstance(at, dict) and action < 0.08:
            at.pop(key)
        elif isinstance(at, dict) and action < 0.16:
            at["unknown"] = edge
        else:
            at[key] = edge
        return bytes(msgpack.packb(fields))

    def _cells(self, payload: bytes) -> bytes:
        cells = np.frombuffer(payload[: len(payload) // 2 * 2], "<f2").copy()
        cells[self._rng.integers(0, len(cells), 5)] = self._rng.choice([math.nan, math.inf, -1.0, -0.0, 6e-8, 65504.0])
        return cells.tobytes() + payload[len(cells) * 2 :]


def encoded(topic: Topic, message: Any) -> tuple[bytes, bytes]:
    """Header and body of a good message."""
    payload, body = codec.encode_body(topic, message)
    return codec.encode_header(topic, specimens.header(topic, body, boot="0" * 16, seq=0, now_ns=0)), payload


def bombs(topic: Topic, boot: str = "b" * 16, now_ns: int = 0) -> list[Attack]:
    """Messages that are small and claim to be large, deep, or of a type that runs code."""
    good_head, good_body = encoded(topic, specimens.of(topic, np.random.default_rng(0)))
    fields = msgpack.unpackb(good_head) | {"boot": boot, "capture_ns": now_ns, "sent_ns": now_ns}
    room = topic.max_bytes

    # under a field of the message: what has a name that nobody knows is skipped, as a newer version's fields are
    field: bytes = b"\x81" + msgpack.packb(cast(Any, topic.message).__struct_fields__[0])

    def filled(one: bytes, inner: int = 15) -> bytes:
        """Arrays of arrays of `inner` times the same, as many as there is room for."""
        block = b"\xdc" + inner.to_bytes(2, "big") + one * inner
        n = min(max((room - 100) // len(block), 1), 20_000)
        return field + b"\xdc" + n.to_bytes(2, "big") + block * n

    raw = {
        "4 G map": b"\xdf\xff\xff\xff\xff", "4 G array": b"\xdd\xff\xff\xff\xff", "4 G bytes": b"\xc6\xff\xff\xff\xff",
        "4 G string": b"\xdb\xff\xff\xff\xff", "4 G extension": b"\xc9\xff\xff\xff\xff\x05",
        "depth 100 000, arrays": b"\x91" * 100_000, "depth 100 000, maps": b"\x81\xa1a" * 100_000,
        "depth 1 010, arrays": field + b"\x91" * 1010 + b"\x90",
        "nested claims of 20 000": b"\xdc\x4e\x20" * 1000, "nested claims of maps": b"\xde\x0f\xff" * 1000,
        "empty maps": filled(b"\x80", 15), "empty arrays": filled(b"\x90", 15), "nothings": filled(b"\xc0", 20_000),
        "short strings": filled(b"\xa3abc", 20_000), "numbers": filled(b"\xcb" + bytes(8), 20_000),
        "maps of one": filled(b"\x81\xa1a\xc0", 15), "zeros to the limit": bytes(room),
        "one large binary": field + b"\xc6" + (room - 20).to_bytes(4, "big") + bytes(room - 20),
        "too large": bytes(room + 1),
    }  # fmt: skip
    found = []
    for name, data in raw.items():
        found.append(Attack(name, None, data))
        if len(data) <= topic.max_header_bytes:
            found.append(Attack(f"{name}, header", data, good_body))
    for name, value in _arrays().items():
        if topic.message is Risk:
            head = {**fields, "body": {**fields["body"], "volume": value}}
            found.append(Attack(name, msgpack.packb(head), good_body))
            continue
        body = msgpack.unpackb(good_body)
        array = _first_array(body)
        if array is not None:
            array.update(value)
            found.append(Attack(name, None, msgpack.packb(body)))
    out = []
    for i, bomb in enumerate(found):
        head = msgpack.packb({**fields, "seq": i + 1})
        attachment = bomb.attachment if bomb.attachment is not None else head
        out.append(Attack(bomb.kind, attachment, bomb.payload))
    return out


def _arrays() -> dict[str, dict[str, Any]]:
    shapes: list[Any] = [
        [2**31], [2**31, 2**31], [2**62, 4], [2**24], [0, 2**31], [-1], [3] * 5, [3.0], [], ["3"], 2**31,
    ]  # fmt: skip
    dtypes: list[Any] = ["|O", "O", "object", "<U1000000", "V8", "<M8[ns]", "f8,f8", "<f16", "", 8, None, ["<f8"]]
    return {
        **{f"shape {s}": {"dtype": "<f2", "shape": s, "data": bytes(8)} for s in shapes},
        **{f"dtype {d!r}": {"dtype": d, "shape": [1], "data": bytes(8)} for d in dtypes},
    }


def _first_array(value: Any) -> dict[str, Any] | None:
    if isinstance(value, dict):
        if {"dtype", "shape", "data"} <= value.keys():
            return value
        value = list(value.values())
    if isinstance(value, list):
        return next((a for a in map(_first_array, value) if a is not None), None)
    return None
