"""A process of another version: `python -m tests.contract.other_version ENDPOINT MAJOR MINOR`.

It answers objects with a prediction, as the toy service does, and prints what it counted. A newer minor version knows
an optional field more in bodies and headers, an older one lacks what this one has added to headers.
"""

from __future__ import annotations

import json
import sys
import time
from dataclasses import replace

import msgpack
import msgspec

from common import bus, codec, topics
from common import messages as m
from common.bus import BusSettings, open_bus
from common.clock import monotonic
from tests import samples


def become(major: int, minor: int) -> tuple[topics.Topic, topics.Topic]:
    """Speak that version; returns `objects` and `prediction` as it knows them."""
    newer, older = minor > topics.VERSION_MINOR, minor < topics.VERSION_MINOR
    encode = codec.encode_header

    def encode_header(topic: topics.Topic, header: m.Header) -> bytes:
        fields = msgpack.unpackb(encode(topic, header))
        if newer:
            fields["of_tomorrow"] = {"weather": "rain"}
        if older:
            del fields["step"]  # since 1.1
        return msgpack.packb(fields)

    codec.encode_header = encode_header
    codec.VERSION_MAJOR = bus.VERSION_MAJOR = major
    bus.VERSION_MINOR = minor
    if not newer:
        return topics.OBJECTS, topics.PREDICTION
    field = [("weather", str, "dry")]

    def next_version(kind: type) -> type:
        return msgspec.defstruct(kind.__name__, field, bases=(kind,), frozen=True, kw_only=True)

    return (
        replace(topics.OBJECTS, message=next_version(m.Objects)),
        replace(topics.PREDICTION, message=next_version(m.Prediction)),
    )


def main(endpoint: str, major: int, minor: int) -> None:
    """Answer until killed."""
    objects, prediction = become(major, minor)
    with open_bus(BusSettings(connect=(endpoint,)), "versions", "predictor") as other:
        inbox, out = other.inbox(objects), other.publisher(prediction)
        answers, told = 0, 0.0
        while True:
            other.wait(0.05)
            heard = inbox.take()
            if heard is not None:
                assert getattr(heard.value, "weather", "dry") == "dry"
                made = samples.prediction(x0=heard.value.x, y0=heard.value.y)
                fields = msgspec.structs.asdict(made)
                if hasattr(heard.value, "weather"):
                    fields["weather"] = "rain"
                out.put(prediction.message(**fields), capture_ns=heard.capture_ns, cause=heard.descent())
                answers += 1
            if time.monotonic() - told > 0.1:
                told = time.monotonic()
                if major != topics.VERSION_MAJOR:  # nobody will ask it anything that it understands
                    out.put(samples.prediction(), capture_ns=monotonic())
                print(json.dumps({"answers": answers, "counters": other.counters}), flush=True)


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]), int(sys.argv[3]))
