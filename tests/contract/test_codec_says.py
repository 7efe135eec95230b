"""Every refusal of the codec says the same words: the counter's name, the field, and what was wrong with it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import msgpack
import numpy as np
import pytest

from common import codec, topics
from common import messages as m
from common.codec import RefusedError
from tests import samples
from tests.contract.test_codec import equal, header, sent

Change = Callable[[dict[str, Any]], object]


@pytest.fixture(autouse=True)
def _fresh() -> Iterator[None]:
    codec._array_fields.cache_clear()  # what is read from the types is read again
    yield
    codec._array_fields.cache_clear()


def words(call: Callable[[], object]) -> str:
    with pytest.raises(RefusedError) as caught:
        call()
    error = caught.value
    assert str(error) == (f"{error.reason}: {error.detail}" if error.detail else error.reason)
    return str(error)


def decoded(name: str, body: Change | None = None, head: Change | None = None) -> m.Message:
    topic, _, attachment, payload = sent(name)
    if head is not None:
        fields = msgpack.unpackb(attachment)
        head(fields)
        attachment = msgpack.packb(fields)
    if body is not None:
        fields = msgpack.unpackb(payload)
        body(fields)
        payload = msgpack.packb(fields)
    return codec.decode_body(topic, codec.decode_header(topic, attachment), payload)


def volume(**changes: object) -> Change:
    return lambda h: h["body"]["volume"].update(changes)


BODIES: list[tuple[str, Change, str]] = [
    ("objects", lambda f: f["y"].update(dtype="|O"), "dtype: '|O' - at `$.y`"),
    ("objects", lambda f: f["y"].update(dtype="x" * 50), f"dtype: '{'x' * 40}' - at `$.y`"),
    ("objects", lambda f: f["y"].update(dtype=b"<f8"), "dtype: b'<f8' - at `$.y`"),
    ("objects", lambda f: f["y"].update(dtype=["<f8"]), "dtype: list - at `$.y`"),
    ("objects", lambda f: f["y"].update(shape=[-1]), "shape: [-1] - at `$.y`"),
    ("objects", lambda f: f["y"].update(shape=[0, 1, 2, -3]), "shape: [0, 1, 2, -3] - at `$.y`"),
    ("objects", lambda f: f["y"].update(shape=[0, 1, 2, 3, 4]), "shape: list - at `$.y`"),
    ("objects", lambda f: f["y"].update(shape=[1.0]), "shape: list - at `$.y`"),
    ("objects", lambda f: f["y"].update(shape="3"), "shape: '3' - at `$.y`"),
    ("objects", lambda f: f["y"].update(shape=3), "shape: int - at `$.y`"),
    ("objects", lambda f: f["y"].update(shape=[True]), "shape: list - at `$.y`"),
    ("objects", lambda f: f["y"].update(shape=[2**24 + 1], data=b""), "shape: [16777217] - at `$.y`"),
    ("objects", lambda f: f["y"].update(shape=[2**24], data=b""),
     "shape: shape [16777216] of <f8 needs 134217728 bytes, got 0 - at `$.y`"),
    ("objects", lambda f: f["y"].update(shape=[1, 1, 1, 3]), "shape: objects.y: (1, 1, 1, 3), expected ('n',)"),
    ("objects", lambda f: f["y"].update(data="text"), "type: array data must be binary - at `$.y`"),
    ("objects", lambda f: f["y"].pop("data"), "type: expected an array {dtype, shape, data} - at `$.y`"),
    ("objects", lambda f: f.update(y=3), "type: expected an array {dtype, shape, data} - at `$.y`"),
    ("objects", lambda f: f["y"].update(dtype="<f4", shape=[6]),
     "dtype: objects.y: float32, expected <f8"),
    ("objects", lambda f: f["y"].update(shape=[2], data=bytes(16)),
     "shape: objects.y: (2,), expected ('n',) with {'n': 3}"),
    ("objects", lambda f: f["cls"].update(data=b"\x00\x07\x00"), "range: objects.cls: 0 … 7 outside 0 … 6"),
    ("objects", lambda f: f["mass"].update(data=np.array([0.0, -0.5, 1e6]).tobytes()),
     "range: objects.mass: -0.5 … 1000000.0 outside 0 … 1000000.0"),
    ("objects", lambda f: f["mass"].update(data=np.array([0.0, np.inf, 1e6]).tobytes()), "non_finite: objects.mass"),
    ("objects", lambda f: f["id"].update(data=np.array([4, 1, 4]).tobytes()), "content: the same id twice"),
    ("map", lambda f: f["lanes"][0]["left"].update(shape=[1, 2], data=bytes(16)),
     "shape: map.lanes[0].left: at least 2 rows, got 1"),
    ("map", lambda f: f["lanes"][1]["right"].update(data=np.full((26, 2), np.nan).tobytes()),
     "non_finite: map.lanes[1].right"),
    ("map", lambda f: f["lanes"][0]["left"].update(shape=[52, 1]),
     "shape: map.lanes[0].left: (52, 1), expected ('l', 2) with {'c': 26, 'l': 52}"),
    ("plan", lambda f: f["profile"]["speed"].update(data=np.full(31, -1.0).tobytes()),
     "range: plan.profile.speed: -1.0 … -1.0 outside 0 … 150.0"),
    ("plan", lambda f: f["candidates"]["x"].update(data=np.full((2, 5), np.nan).tobytes()),
     "non_finite: plan.candidates.x"),
    ("plan", lambda f: f["slice_risk"]["risk"].update(data=np.full(13, -np.inf).tobytes()),
     "non_finite: plan.slice_risk.risk"),
    ("ego", lambda f: f.update(x=float("inf")), "range: Expected `float` <= 100000000.0 - at `$.x`"),
    ("ego", lambda f: f.update(length=0.0), "range: Expected `float` > 0.0 - at `$.length`"),
    ("ego", lambda f: f.update(vx=None), "type: Expected `float`, got `null` - at `$.vx`"),
    ("status/planner", lambda f: f["work_ms"].update(p50=float("nan")),
     "range: Expected `float` >= -1000000000000.0 - at `$.work_ms[...]`"),
]  # fmt: skip


@pytest.mark.parametrize(("name", "change", "said"), BODIES)
def test_a_refused_body_names_field_and_fault(name: str, change: Change, said: str) -> None:
    assert words(lambda: decoded(name, change)) == said


HEADERS: list[tuple[str, Change, str]] = [
    ("ego", lambda h: h.update(schema="risk"), "schema: 'risk' on 'ego'"),
    ("ego", lambda h: h.update(version=[3, 9]), "version: 3.9, this side speaks 1.x"),
    ("ego", lambda h: h.update(seq=-1), "header_malformed: Expected `int` >= 0 - at `$.seq`"),
    ("risk", lambda h: h.pop("body"), "header_malformed: a risk header without `body`"),
    ("risk", lambda h: h["body"].update(grid=3), "header_malformed: `grid` and `volume` must be maps"),
    ("risk", lambda h: h["body"].update(volume=[]), "header_malformed: `grid` and `volume` must be maps"),
    ("risk", volume(dtype="<f8"), "dtype: volume '<f8'"),
    ("risk", volume(dtype=["<f4"]), "dtype: volume list"),
    ("risk", volume(shape=[13, 40]), "shape: volume [13, 40]"),
    ("risk", volume(shape={"a": 1}), "shape: volume dict"),
    ("risk", volume(shape=[13, 40, 0]), "shape: volume [13, 40, 0]"),
    ("risk", volume(shape=[13, 40, 2**20]), "shape: volume [13, 40, 1048576]"),
    ("risk", volume(shape=[13, 40, 24.0]), "shape: volume list"),
    ("risk", volume(shape=[13, 40, 2**20 - 1]),
     "shape: volume [13, 40, 1048575] of <f2 needs 1124596720 bytes, got 25740"),
    ("risk", volume(shape=[1, 1, 1]), "shape: volume [1, 1, 1] of <f2 needs 3 bytes, got 25740"),
    ("risk", lambda h: h["body"]["grid"].update(x=float("nan")),
     "range: Expected `float` >= -100000000.0 - at `$.grid.x`"),
]  # fmt: skip


@pytest.mark.parametrize(("name", "change", "said"), HEADERS)
def test_a_refused_header_names_field_and_fault(name: str, change: Change, said: str) -> None:
    assert words(lambda: decoded(name, head=change)) == said


def test_sizes_are_allowed_up_to_their_limit_and_not_a_byte_more() -> None:
    topic, message, attachment, payload = sent("ego")
    just = replace(topic, max_bytes=len(payload), max_header_bytes=len(attachment))
    assert equal(codec.decode_body(just, codec.decode_header(just, attachment), payload), message)
    assert codec.encode_body(just, message) == (payload, None)
    assert codec.encode_header(just, header(just)) == attachment
    small = replace(topic, max_bytes=len(payload) - 1, max_header_bytes=len(attachment) - 1)
    body = f"too_large: {len(payload)} bytes, at most {len(payload) - 1}"
    head = f"header_too_large: {len(attachment)} bytes, at most {len(attachment) - 1}"
    assert words(lambda: codec.encode_body(small, message)) == body
    assert words(lambda: codec.decode_body(small, header(small), payload)) == body
    assert words(lambda: codec.encode_header(small, header(small))) == head
    assert words(lambda: codec.decode_header(small, attachment)) == head


def test_a_message_without_a_detail_says_its_reason_alone() -> None:
    assert words(lambda: codec.decode_header(topics.EGO, None)) == "header_missing"
    assert str(RefusedError("stale")) == "stale"


def test_what_is_sent_is_checked_and_named_like_what_arrives() -> None:
    for message, said in (
        (samples.objects(x=[1.0, 2.0, 3.0]), "dtype: objects.x: <class 'list'>, expected <f8"),
        (samples.risk(volume=np.zeros((13, 40, 24))), "dtype: risk.volume: float64, expected <f2 or <f4"),
        (samples.prediction(x=np.zeros((3, 59))), "shape: prediction.x: (3, 59), expected ('n', 60) with {'n': 3}"),
        (samples.objects(y=np.full(3, 1e8 + 1)),
         "range: objects.y: 100000001.0 … 100000001.0 outside -100000000.0 … 100000000.0"),
        (samples.plan(profile=None), "content: a drive plan without profile or tail"),
    ):  # fmt: skip
        assert words(lambda message=message: codec.check(message)) == said
    codec.check(samples.objects(y=np.full(3, 1e8), mass=np.full(3, 1e6)))  # the limits themselves are allowed


def test_a_value_that_messagepack_does_not_know_is_an_error_that_names_its_type() -> None:
    with pytest.raises(TypeError, match=r"^cannot send a slice$"):
        codec.encode_body(topics.EGO, samples.ego(x=slice(3)))
    payload, _ = codec.encode_body(topics.CLOSURES, m.Closures(ids=[np.int64(7)]))  # type: ignore[list-item]
    assert msgpack.unpackb(payload) == {"ids": [7]}
    _, body = codec.encode_body(topics.RISK, samples.risk(t_offset=np.float32(0.5)))
    assert body is not None and body["t_offset"] == 0.5 and set(body) == set(m.Risk.__struct_fields__) - {"dominant"}


def test_a_number_too_large_for_any_type_is_out_of_range() -> None:
    assert words(lambda: decoded("closures", lambda f: f.update(ids=[2**63]))).startswith("range: ")


def test_risk_volumes_of_one_cell_and_of_both_types_are_read() -> None:
    for dtype in (np.float16, np.float32):
        risk = samples.risk(4, 4, 1, volume=np.full((1, 4, 4), 0.5, dtype), dominant=np.full((1, 1, 1), 255, np.uint8))
        payload, body = codec.encode_body(topics.RISK, risk)
        head = codec.decode_header(topics.RISK, codec.encode_header(topics.RISK, header(topics.RISK, body=body)))
        assert equal(codec.decode_body(topics.RISK, head, payload), risk)
    head = header(topics.RISK, body={"grid": {}, "volume": {"dtype": "<f2", "shape": [1, 1, 1]}})
    assert words(lambda: codec.decode_body(topics.RISK, head, bytes(3))).startswith("type: ")  # its size is right


def test_missing_arrays_do_not_hide_what_stands_behind_them() -> None:
    plan = samples.plan(mode="safe_stop", profile=None, candidates=None, tail=samples.plan().tail)
    codec.check(plan)
    bad = samples.plan(
        profile=None, mode="safe_stop", slice_risk=m.SliceRisk(t=np.zeros(2), risk=np.zeros(2), x=np.zeros(2),
                                                               y=np.array([0.0, np.nan])),
    )  # fmt: skip
    assert words(lambda: codec.check(bad)) == "non_finite: plan.slice_risk.y"


# --- bombs ---


def said_of(body: bytes) -> str:
    topic, _, attachment, _ = sent("map")
    return words(lambda: codec.decode_body(topic, codec.decode_header(topic, attachment), body))


def nested(arrays: int, elements: int) -> bytes:
    one = b"\xdc" + elements.to_bytes(2, "big") + b"\xc0" * elements
    return b"\x81\xa1a\xdc" + arrays.to_bytes(2, "big") + one * arrays


def closures_with(more: object) -> m.Message:
    return codec.decode_body(topics.CLOSURES, header(topics.CLOSURES), msgpack.packb({"ids": [9], "more": more}))


def test_containers_are_counted_all_depths_together(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(codec, "MAX_CONTAINERS", 7)
    assert closures_with([[], {}, {}, []]) == samples.closures()  # and `more`, `ids`, the message itself
    assert words(lambda: closures_with([[], {}, {}, [], []])) == "malformed: more than 7 maps and arrays"


def test_what_containers_hold_is_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(codec, "MAX_ITEMS", 11)
    assert closures_with([0, 0, 0, 0, 0, {"a": 0, "b": 0}]) == samples.closures()  # 6 + 2, one id, two fields
    assert words(lambda: closures_with([0, 0, 0, 0, 0, {"a": 0, "b": 0, "c": 0}])) == (
        "malformed: more than 11 entries and elements"
    )


@pytest.mark.parametrize(("arrays", "elements"), [(26, 20_000), (2, 20_001), (20_000, 30)])
def test_millions_of_small_values_are_refused(arrays: int, elements: int) -> None:
    assert said_of(nested(arrays, elements)).startswith("malformed: ")


def test_no_array_claims_more_elements_than_bytes() -> None:
    for claim in (b"\xdc\x4e\x20" * 1000, b"\xde\x0f\xff" * 1000):
        assert "exceeds max_" in said_of(b"\x81\xa1a" + claim[:3]) and said_of(claim).startswith("malformed: ")


@pytest.mark.parametrize("depth", [100, 1000, 1005, 1010, 1015, 1020, 1030, 100_000])
@pytest.mark.parametrize("part", ["dtype", "shape", "data"])
def test_however_deep_a_value_is_nested_no_recursion_error_escapes(depth: int, part: str) -> None:
    parts = {"dtype": msgpack.packb("<f8"), "shape": msgpack.packb([3]), "data": msgpack.packb(bytes(24))}
    parts[part] = b"\x91" * depth + b"\x90"
    body = b"\x81\xa1x\x83" + b"".join(msgpack.packb(k) + v for k, v in parts.items())
    topic, _, attachment, _ = sent("objects")
    words(lambda: codec.decode_body(topic, codec.decode_header(topic, attachment), body))
    fields = msgpack.unpackb(sent("risk")[2])
    fields["body"] = {"grid": {}, "volume": {k: v for k, v in (("dtype", "<f2"), ("shape", 3)) if k != part}}
    head = msgpack.packb(fields).replace(msgpack.packb("volume") + b"\x82", msgpack.packb("volume") + b"\x83")
    head = head.replace(msgpack.packb("volume") + b"\x81", msgpack.packb("volume") + b"\x82")
    if part != "data":
        head += msgpack.packb(part) + b"\x91" * depth + b"\x90"
    words(lambda: codec.decode_body(topics.RISK, codec.decode_header(topics.RISK, head), b""))


def test_extension_types_and_keys_that_are_no_names_are_refused() -> None:
    assert said_of(b"\x81\xa1a\xd4\x05\x00").startswith("malformed: ")
    assert said_of(b"\x81\xa1a\xc7\x00\x05") == "malformed: extension type 5"
    assert "int is not allowed for map key" in said_of(b"\x81\x01\x02")
    for data in (b"\x91\x01", b"\x01", b"\x7f", b"\xdd\x00\x00\x00\x00", b"\xc0", b"\xa1x", b"\xe0"):
        assert said_of(data) == "malformed: expected a map"
    assert said_of(b"") == "malformed: nothing"


def test_maps_of_every_length_of_header_are_maps() -> None:
    for data in (b"\x80", b"\x8f" + b"".join(b"\xa1" + bytes([97 + i]) + b"\x01" for i in range(15)),
                 b"\xde\x00\x00", b"\xdf\x00\x00\x00\x00"):  # fmt: skip
        assert codec.decode_body(topics.MAP, header(topics.MAP), data) == m.Map()
    assert said_of(b"\x80" + bytes(1000)).startswith("malformed: ")


def test_strings_and_maps_have_a_largest_length() -> None:
    assert isinstance(decoded("closures", lambda f: f.update(more="x" * 4096)), m.Closures)
    assert "4097 exceeds max_str_len" in words(lambda: decoded("closures", lambda f: f.update(more="x" * 4097)))
    assert isinstance(decoded("map", lambda f: f.update(more={str(i): 0 for i in range(4096)})), m.Map)
    assert "4097 exceeds max_map_len" in words(
        lambda: decoded("map", lambda f: f.update(more={str(i): 0 for i in range(4097)}))
    )
    assert isinstance(decoded("map", lambda f: f.update(more=[0] * 20_000)), m.Map)
    assert "20001 exceeds max_array_len" in words(lambda: decoded("map", lambda f: f.update(more=[0] * 20_001)))
