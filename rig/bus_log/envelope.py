"""How a message of the bus stands in an MCAP file.

Each topic is a channel named by its suffix. A record's data is one MessagePack map, `{"attachment": bin or nil,
"payload": bin}`: header and body exactly as they travelled, readable by any MessagePack library. The channel's metadata
holds the Zenoh encoding and the key; its schema is named `forefield.<schema>.v<major>`, with the documentation of the
message as its text. Log times are nanoseconds of the recorder's wall clock, counted on by its monotonic clock, so that
they never jump; `sequence` is the header's.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import msgpack

from common import codec
from common.codec import RefusedError
from common.messages import Header
from common.topics import TOPICS, VERSION_MAJOR, Topic

MESSAGE_ENCODING = "msgpack"
METADATA = "forefield"
"""Name of the metadata record: format, vehicle, configuration, machine."""
DROPPED = "forefield-dropped"
"""Name of the metadata record at the end: topic → messages that could not be written."""
FORMAT = "1"


@dataclass(frozen=True)
class Recorded:
    """A message of the bus as it was recorded."""

    topic: Topic
    time_ns: int
    """When it arrived at the recorder: wall clock [ns]."""
    attachment: bytes | None
    payload: bytes
    encoding: str

    def header(self) -> Header:
        """Read the header.

        Raises:
            RefusedError: as `codec.decode_header`.
        """
        return codec.decode_header(self.topic, self.attachment)


def schema_name(topic: Topic) -> str:
    """Name of a topic's MCAP schema."""
    return f"forefield.{topic.name}.v{VERSION_MAJOR}"


def pack(attachment: bytes | None, payload: bytes) -> bytes:
    """The data of one record."""
    return bytes(msgpack.packb({"attachment": attachment, "payload": payload}))


def unpack(data: bytes) -> tuple[bytes | None, bytes]:
    """Attachment and payload of one record.

    Raises:
        RefusedError: `envelope`: it is not what `pack` makes.
    """
    try:
        fields: Any = msgpack.unpackb(data, max_bin_len=len(data))
        attachment, payload = fields["attachment"], fields["payload"]
    except (ValueError, TypeError, KeyError, msgpack.UnpackException) as e:
        raise RefusedError("envelope", f"{type(e).__name__}: {e}") from None
    if not isinstance(payload, bytes) or not isinstance(attachment, bytes | None):
        raise RefusedError("envelope", "attachment and payload must be binary")
    return attachment, payload


def topics_named(names: str) -> tuple[Topic, ...]:
    """Topics of a list such as `ego,objects,status`; `status` stands for every service's.

    Raises:
        ValueError: an unknown name.
    """
    found: list[Topic] = []
    for name in filter(None, (n.strip() for n in names.split(","))):
        these = [t for t in TOPICS.values() if name in (t.suffix, t.name)]
        if not these:
            raise ValueError(f"no topic {name!r}; known: {', '.join(TOPICS)}")
        found += [t for t in these if t not in found]
    return tuple(found)
