"""What is sent comes back; what breaks the contract is refused by name and names its field."""

from __future__ import annotations

from typing import Any

import msgpack
import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from common import codec, topics
from common import messages as m
from common.codec import RefusedError
from common.health import Health
from tests import samples


def header(topic: topics.Topic, **changes: Any) -> m.Header:
    fields: dict[str, Any] = {
        "schema": topic.name, "version": (1, 0), "source": "test", "boot": "0123456789abcdef", "seq": 3,
        "capture_ns": 1, "sent_ns": 2, "age_ns": 1, "work_ns": 5, "cause": m.Cause("b" * 8, 7),
    }  # fmt: skip
    return m.Header(**{**fields, **changes})


def sent(name: str) -> tuple[topics.Topic, m.Message, bytes, bytes]:
    topic, message = topics.TOPICS[name], samples.ALL[name]()
    payload, body = codec.encode_body(topic, message)
    return topic, message, codec.encode_header(topic, header(topic, body=body)), payload


def equal(a: Any, b: Any) -> bool:
    if isinstance(a, np.ndarray):
        return a.dtype == b.dtype and a.shape == b.shape and bool(np.array_equal(a, b))
    if isinstance(a, msgspec.Struct):
        return type(a) is type(b) and all(equal(getattr(a, f), getattr(b, f)) for f in a.__struct_fields__)
    if isinstance(a, list | tuple):
        return len(a) == len(b) and all(equal(x, y) for x, y in zip(a, b, strict=True))
    return bool(a == b)


@pytest.mark.parametrize("name", samples.ALL)
def test_what_is_sent_comes_back(name: str) -> None:
    topic, message, attachment, payload = sent(name)
    received = codec.decode_body(topic, codec.decode_header(topic, attachment), payload)
    assert equal(message, received)


@pytest.mark.parametrize("name", [n for n in samples.ALL if n != "risk"])
def test_a_body_is_one_messagepack_map_any_library_reads(name: str) -> None:
    _, message, attachment, payload = sent(name)
    assert set(msgpack.unpackb(payload)) == set(message.__struct_fields__)
    assert msgpack.unpackb(attachment)["schema"] == topics.TOPICS[name].name


def test_the_risk_body_is_the_raw_volume_then_dominant() -> None:
    _, message, attachment, payload = sent("risk")
    assert isinstance(message, m.Risk)
    assert payload == message.volume.tobytes() + message.dominant.tobytes()
    assert msgpack.unpackb(attachment)["body"]["volume"] == {"dtype": "<f2", "shape": list(message.volume.shape)}


def refusal(name: str, change: Any) -> RefusedError:
    topic, _, attachment, payload = sent(name)
    fields = msgpack.unpackb(payload)
    change(fields)
    with pytest.raises(RefusedError) as caught:
        codec.decode_body(topic, codec.decode_header(topic, attachment), msgpack.packb(fields))
    return caught.value


@pytest.mark.parametrize(
    ("name", "change", "reason", "field"),
    [
        ("ego", lambda f: f.update(x=float("nan")), "range", "x"),
        ("ego", lambda f: f.update(vx=1e38), "range", "vx"),
        ("ego", lambda f: f.update(length="long"), "type", "length"),
        ("ego", lambda f: f.pop("y"), "type", "y"),
        ("objects", lambda f: f["x"].update(data=np.array([1.0, np.nan, 2.0]).tobytes()), "non_finite", "x"),
        ("objects", lambda f: f["vx"].update(data=np.array([1.0, np.inf, 2.0]).tobytes()), "non_finite", "vx"),
        ("objects", lambda f: f["length"].update(data=np.array([1.0, -1.0, 2.0]).tobytes()), "range", "length"),
        ("objects", lambda f: f["y"].update(shape=[4]), "shape", "y"),
        ("objects", lambda f: f["y"].update(shape=[2**31, 2**31]), "shape", "y"),
        ("objects", lambda f: f["y"].update(shape=[-3]), "shape", "y"),
        ("objects", lambda f: f["y"].update(dtype="|O"), "dtype", "y"),
        ("objects", lambda f: f["y"].update(dtype="<f4", shape=[6]), "dtype", "y"),
        ("objects", lambda f: f["y"].update(shape=[2], data=bytes(16)), "shape", "y"),
        ("objects", lambda f: f.update(y=[1.0, 2.0, 3.0]), "type", "y"),
        ("objects", lambda f: f["id"].update(data=np.array([1, 1, 2]).tobytes()), "content", "id"),
        ("map", lambda f: f["lanes"][1]["left"].update(data=np.full((26, 2), np.inf).tobytes()), "non_finite", "[1]"),
        ("map", lambda f: f["lanes"][0].update(left_type="wall"), "type", "left_type"),
        ("map", lambda f: f["lanes"][0]["centre"].update(shape=[1, 2], data=bytes(16)), "shape", "centre"),
        ("plan", lambda f: f["tail"]["speed"].update(data=np.ones(41).tobytes()), "content", "tail"),
        ("plan", lambda f: f.update(mode="fly"), "type", "mode"),
    ],
)  # fmt: skip
def test_a_broken_field_is_refused_by_reason_and_by_name(name: str, change: Any, reason: str, field: str) -> None:
    error = refusal(name, change)
    assert error.reason == reason
    assert field in error.detail


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, 1e38, -1e38])
@pytest.mark.parametrize("name", [n for n in samples.ALL if n != "risk"])
def test_no_float_array_takes_a_value_that_is_not_finite_and_in_range(name: str, bad: float) -> None:
    topic, _, attachment, payload = sent(name)
    known = codec.decode_header(topic, attachment)
    found = 0
    for path in _float_arrays(msgpack.unpackb(payload)):
        fields = msgpack.unpackb(payload)
        where: Any = fields
        for step in path:
            where = where[step]
        values = np.frombuffer(where["data"], where["dtype"]).copy()
        values[-1] = bad
        where["data"] = values.tobytes()
        with pytest.raises(RefusedError) as caught:
            codec.decode_body(topic, known, msgpack.packb(fields))
        assert caught.value.reason in ("non_finite", "range")
        assert str(path[-1]) in caught.value.detail
        found += 1
    assert found > 0 or name in ("ego", "closures", "status/planner")


def _float_arrays(value: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    if isinstance(value, dict):
        if {"dtype", "data"} <= value.keys():
            return [path] if "f" in value["dtype"] and len(value["data"]) else []
        return [p for k, v in value.items() for p in _float_arrays(v, (*path, k))]
    if isinstance(value, list):
        return [p for k, v in enumerate(value) for p in _float_arrays(v, (*path, k))]
    return []


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda h: h.update(schema="risk"), "schema"),
        (lambda h: h.update(version=[2, 0]), "version"),
        (lambda h: h.update(version=[0, 9]), "version"),
        (lambda h: h.update(version="1.0"), "header_malformed"),
        (lambda h: h.pop("boot"), "header_malformed"),
        (lambda h: h.update(seq=-1), "header_malformed"),
        (lambda h: h.update(age_ns=2**63), "header_malformed"),
        (lambda h: h.update(filler="x" * 5000), "header_too_large"),
    ],
)
def test_a_broken_header_is_refused_before_the_body_is_read(change: Any, reason: str) -> None:
    topic, _, attachment, _ = sent("objects")
    fields = msgpack.unpackb(attachment)
    change(fields)
    with pytest.raises(RefusedError) as caught:
        codec.decode_header(topic, msgpack.packb(fields))
    assert caught.value.reason == reason


def test_a_newer_minor_version_with_unknown_fields_is_understood() -> None:
    topic, _, attachment, payload = sent("ego")
    fields, head = msgpack.unpackb(payload), msgpack.unpackb(attachment)
    fields["mood"], head["version"] = "cheerful", [1, 7]
    received = codec.decode_body(topic, codec.decode_header(topic, msgpack.packb(head)), msgpack.packb(fields))
    assert equal(received, samples.ego())


def test_a_message_without_header_is_refused() -> None:
    with pytest.raises(RefusedError, match="header_missing"):
        codec.decode_header(topics.EGO, None)


@pytest.mark.parametrize("name", samples.ALL)
def test_every_topic_has_a_largest_size(name: str) -> None:
    topic, _, attachment, _ = sent(name)
    with pytest.raises(RefusedError) as caught:
        codec.decode_body(topic, codec.decode_header(topic, attachment), bytes(topic.max_bytes + 1))
    assert caught.value.reason == "too_large"


@pytest.mark.parametrize(
    "bomb",
    [
        b"\xdf\xff\xff\xff\xff", b"\xdd\xff\xff\xff\xff", b"\xc6\xff\xff\xff\xff", b"\x91" * 100_000,
        b"\x81\xa1a" * 50_000, b"\xdc\xff\xff" + b"\x80" * 65535, b"\xc7\x08\x01" + bytes(8), b"\xc1", b"", b"\x01",
        b"\xdc\xff\xff" + (b"\xdc\x00\xff" + b"\x80" * 255) * 2000,
    ],
    ids=["map32", "array32", "bin32", "deep arrays", "deep maps", "empty maps", "extension", "never used", "empty",
         "a number", "half a million maps"],
)  # fmt: skip
def test_bombs_are_refused_as_malformed(bomb: bytes) -> None:
    topic, _, attachment, _ = sent("map")
    with pytest.raises(RefusedError) as caught:
        codec.decode_body(topic, codec.decode_header(topic, attachment), bomb)
    assert caught.value.reason == "malformed"


@settings(max_examples=150)
@given(st.sampled_from(sorted(samples.ALL)), st.binary(max_size=300), st.integers(0, 2**32), st.integers(1, 4))
def test_mutated_messages_are_read_or_refused_and_nothing_else(name: str, junk: bytes, where: int, cut: int) -> None:
    topic, _, attachment, payload = sent(name)
    for mutated_header, mutated in (
        (attachment, _mutate(payload, junk, where, cut)),
        (_mutate(attachment, junk, where, cut), payload),
        (junk, payload),
        (attachment, junk),
    ):
        try:
            codec.decode_body(topic, codec.decode_header(topic, mutated_header), mutated)
        except RefusedError as e:
            assert e.reason.isidentifier()


def _mutate(data: bytes, junk: bytes, where: int, cut: int) -> bytes:
    at = where % (len(data) + 1)
    return data[:at] + junk + data[at + cut :]


@pytest.mark.parametrize(
    "message",
    [samples.objects(x=np.array([1.0, np.nan, 2.0])), samples.objects(x=np.zeros(2)),
     samples.objects(x=np.zeros(3, np.float32)), samples.risk(slice_times=[0.0] * 13),
     samples.risk(dominant=np.zeros((13, 2, 2), np.uint8))],
)  # fmt: skip
def test_nothing_that_breaks_the_contract_is_sent(message: m.Message) -> None:
    topic = next(t for t in topics.TOPICS.values() if t.message is type(message))
    with pytest.raises(RefusedError):
        codec.encode_body(topic, message)


def test_a_risk_body_of_the_wrong_size_is_refused() -> None:
    topic, _, attachment, payload = sent("risk")
    for broken in (payload[:-1], payload + b"\0", b""):
        with pytest.raises(RefusedError) as caught:
            codec.decode_body(topic, codec.decode_header(topic, attachment), broken)
        assert caught.value.reason == "shape"


def test_a_risk_volume_with_a_nan_is_refused() -> None:
    topic, message, attachment, payload = sent("risk")
    assert isinstance(message, m.Risk)
    volume = message.volume.copy()
    volume[3, 2, 1] = np.nan
    with pytest.raises(RefusedError) as caught:
        codec.decode_body(topic, codec.decode_header(topic, attachment), volume.tobytes() + payload[volume.nbytes :])
    assert caught.value.reason == "non_finite"


def test_headers_stay_within_their_limit() -> None:
    slots = [m.Slot(10**6 + i, "potential", 1) for i in range(255)]
    topic = topics.RISK
    _, body = codec.encode_body(topic, samples.risk(slots=slots))
    assert len(codec.encode_header(topic, header(topic, body=body))) <= 8 * 1024


def test_an_array_without_bytes_may_not_claim_millions_of_rows() -> None:
    for frames, reason in ((2**31, "shape"), (20_000_000, "shape"), (1_000, "content")):
        topic, _, attachment, _ = sent("prediction")
        payload, _ = codec.encode_body(topic, samples.prediction(0))
        fields = msgpack.unpackb(payload)
        for name in ("past_x", "past_y"):
            fields[name]["shape"] = [0, frames]
        with pytest.raises(RefusedError) as caught:
            codec.decode_body(topic, codec.decode_header(topic, attachment), msgpack.packb(fields))
        assert caught.value.reason == reason


@pytest.mark.parametrize(
    "field", ["x", "y", "heading", "vx", "vy", "acceleration", "yaw_rate", "length", "width", "wheelbase"]
)
@pytest.mark.parametrize("value", [np.nan, np.inf, -1e9, "fast"])
def test_no_number_leaves_that_would_not_be_let_in(field: str, value: object) -> None:
    broken = samples.ego(**{field: value})
    with pytest.raises(codec.RefusedError, match=r"range|type") as sent:
        codec.encode_body(topics.EGO, broken)
    payload = msgpack.packb(msgspec.to_builtins(broken))
    with pytest.raises(codec.RefusedError) as arrived:
        codec.decode_body(topics.EGO, header(topics.EGO), payload)
    assert sent.value.reason == arrived.value.reason


@pytest.mark.parametrize(
    "changes", [{"reason": "x" * 1001}, {"valid_for": -0.1}, {"desired_speed": np.nan}, {"mode": "fly"}]
)
def test_no_plan_leaves_that_its_vehicle_would_refuse(changes: dict[str, Any]) -> None:
    with pytest.raises(codec.RefusedError):
        codec.check(samples.plan(**changes))


def test_a_status_is_sent_however_long_the_words_of_an_exception_are() -> None:
    health = Health("planner", lambda: 0)
    health.detail["last_error"] = "x" * 1_000_000
    health.say("degraded", "y" * 1_000_000)
    payload, _ = codec.encode_body(topics.STATUS_OF["planner"], health.status())
    assert len(payload) < 4096


@pytest.mark.parametrize("topic", topics.STATUS_OF.values(), ids=lambda t: t.suffix)
@pytest.mark.parametrize("name", [*topics.STATUS_OF, "rig"])
def test_nobody_is_taken_for_another_by_his_status(topic: topics.Topic, name: str) -> None:
    status = samples.status(name)
    own = name == topic.writer or (topic.writer == "vehicle" and name == "rig")
    payload = msgpack.packb(msgspec.to_builtins(status))
    if own:
        assert codec.encode_body(topic, status)[0] == payload
        assert equal(codec.decode_body(topic, header(topic), payload), status)
        return
    for say in (lambda: codec.encode_body(topic, status), lambda: codec.decode_body(topic, header(topic), payload)):
        with pytest.raises(RefusedError, match="content"):
            say()
