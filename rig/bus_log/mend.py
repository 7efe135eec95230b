"""Mends a recorded bus whose recorder was killed: every whole message once more, with an index."""

from __future__ import annotations

from pathlib import Path

from mcap.writer import CompressionType, Writer

from common.codec import RefusedError
from common.topics import MIB
from rig.bus_log.envelope import MESSAGE_ENCODING, METADATA, pack, schema_name
from rig.bus_log.reader import BusLog

CHUNK_BYTES = 16 * MIB
"""What is compressed, and read, at once: more is smaller, less is found faster."""


def mend(path: Path, out: Path) -> int | None:
    """Write the mended file to `out`, which may be `path`; returns its messages, None: it was whole.

    Raises:
        BusLogError: it is no recorded bus.
        OSError: `out` cannot be written.
    """
    log = BusLog.open(path)
    if not log.is_torn and out == path:
        return None
    n = compact(path, out)
    return n if log.is_torn else None


def compact(path: Path, out: Path) -> int:
    """Write every whole message to `out` in large chunks; returns how many there are.

    Raises:
        BusLogError: it is no recorded bus.
        OSError: `out` cannot be written.
    """
    draft = out.with_name(f".{out.name}.draft")
    try:
        n = _copy(BusLog.open(path), draft)
        draft.replace(out)
    finally:
        draft.unlink(missing_ok=True)
    return n


def _copy(log: BusLog, out: Path) -> int:
    n, channels = 0, dict[str, int]()
    with out.open("wb") as file:
        writer = Writer(file, chunk_size=CHUNK_BYTES, compression=CompressionType.ZSTD)
        writer.start(profile="", library="forefield")
        writer.add_metadata(METADATA, log.about)
        for message in log.messages():
            topic = message.topic
            if topic.suffix not in channels:
                schema = writer.register_schema(schema_name(topic), "text", (topic.message.__doc__ or "").encode())
                about = {"encoding": message.encoding}
                channels[topic.suffix] = writer.register_channel(topic.suffix, MESSAGE_ENCODING, schema, about)
            try:
                seq = message.header().seq & 0xFFFFFFFF
            except RefusedError:
                seq = 0
            data = pack(message.attachment, message.payload)
            writer.add_message(channels[topic.suffix], message.time_ns, data, message.time_ns, seq)
            n += 1
        writer.finish()  # type: ignore[no-untyped-call]
    return n
