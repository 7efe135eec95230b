"""Reads a recorded bus: by its index, or to the tear where there is none; what it cannot read it names."""

from __future__ import annotations

import json
import struct
import zlib
from collections import Counter
from collections.abc import Collection, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any

from mcap.exceptions import McapError
from mcap.reader import SeekingReader
from mcap.records import Channel, Message, Metadata, Schema
from mcap.stream_reader import StreamReader

from common.codec import RefusedError
from common.topics import TOPICS, Delivery, Topic
from rig.bus_log.envelope import DROPPED, FORMAT, METADATA, Recorded, schema_name, unpack

_TORN: tuple[type[Exception], ...] = (McapError, EOFError, struct.error, zlib.error, ValueError, RuntimeError, OSError)
"""What the library raises where a file ends too early."""


class BusLogError(ValueError):
    """A file that is no recorded bus; the text says what it is."""


@dataclass
class BusLog:
    """A recorded bus. Open it with `BusLog.open`."""

    path: Path
    about: dict[str, str]
    """What the recorder said: format, vehicle, configuration and machine as JSON."""
    is_torn: bool
    """Its end is missing: the recorder was killed, or the disk was full."""
    unknown: dict[str, str] = field(default_factory=dict)
    """Channels that are not read, and why."""
    refused: Counter[str] = field(default_factory=Counter)
    """`topic:reason` → messages that are not what they should be."""

    @staticmethod
    def open(path: Path) -> BusLog:
        """Read what stands at the beginning and, if it is there, at the end.

        Raises:
            BusLogError: no such file, no MCAP, not of this bus, or of a format this side does not read.
        """
        try:
            with path.open("rb") as file:
                about = _about(path, file)
                torn = not _has_index(file)
        except OSError as e:
            raise BusLogError(f"{path}: {e.strerror}") from None
        if about.get("format") != FORMAT:
            raise BusLogError(f"{path}: format {about.get('format')!r}, this version reads {FORMAT!r}")
        return BusLog(path, about, torn)

    @property
    def configuration(self) -> dict[str, Any]:
        """The configuration that the recorder was given."""
        return dict(json.loads(self.about.get("configuration", "{}")))

    @property
    def machine(self) -> dict[str, str]:
        """Who recorded."""
        return dict(json.loads(self.about.get("machine", "{}")))

    @property
    def dropped(self) -> dict[str, int]:
        """Messages that the recorder heard and could not write, by topic; a torn file does not tell."""
        if self.is_torn:
            return {}
        with self.path.open("rb") as file:
            found = [m for m in SeekingReader(file).iter_metadata() if m.name == DROPPED]
        return {name: int(n) for metadata in found for name, n in metadata.metadata.items()}

    def span_ns(self) -> tuple[int, int]:
        """First and last log time [ns]; (0, 0) for an empty file."""
        if not self.is_torn:
            with self.path.open("rb") as file:
                summary = SeekingReader(file).get_summary()
            if summary is not None and summary.statistics is not None:
                return summary.statistics.message_start_time, summary.statistics.message_end_time
        times = [message.time_ns for message in self.messages()]
        return (min(times), max(times)) if times else (0, 0)

    def holds(self) -> set[str]:
        """Suffixes of the topics of which messages are there; by the index, where there is one."""
        if not self.is_torn:
            with self.path.open("rb") as file:
                summary = SeekingReader(file).get_summary()
            if summary is not None and summary.statistics is not None:
                counts = summary.statistics.channel_message_counts
                return {channel.topic for channel in summary.channels.values() if counts.get(channel.id)}
        return {message.topic.suffix for message in self.messages()}

    def messages(
        self, topics: Collection[Topic] | None = None, start_ns: int | None = None, end_ns: int | None = None
    ) -> Iterator[Recorded]:
        """Messages in the order of their log times; where the file is torn, those before the tear.

        Args:
            topics: which; None: all.
            start_ns: log time of the first [ns]; by the index, without reading what lies before.
            end_ns: log time after which there are none [ns].
        """
        wanted = {t.suffix for t in (TOPICS.values() if topics is None else topics)}
        with self.path.open("rb") as file:
            found = _torn_records(file) if self.is_torn else _indexed_records(file, wanted, start_ns, end_ns)
            for schema, channel, message in found:
                if (start_ns is not None and message.log_time < start_ns) or (
                    end_ns is not None and message.log_time > end_ns
                ):
                    continue
                topic = self._topic(schema, channel)
                if topic is None or topic.suffix not in wanted:
                    continue
                try:
                    attachment, payload = unpack(message.data)
                except RefusedError as e:
                    self.refused[f"{topic.suffix}:{e.reason}"] += 1
                    continue
                encoding = channel.metadata.get("encoding", topic.encoding)
                yield Recorded(topic, message.log_time, attachment, payload, encoding)

    def latched_before(self, start_ns: int, topics: Collection[Topic] | None = None) -> list[Recorded]:
        """The last message of each latched topic before a time: what a late joiner would have been given."""
        wanted = [t for t in (TOPICS.values() if topics is None else topics) if t.delivery is Delivery.LATCHED]
        last = {m.topic.suffix: m for m in self.messages(wanted, end_ns=start_ns - 1)}
        return list(last.values())

    def _topic(self, schema: Schema | None, channel: Channel) -> Topic | None:
        topic = TOPICS.get(channel.topic)
        if topic is None:
            self.unknown[channel.topic] = "no topic of this version"
            return None
        name = "none" if schema is None else schema.name
        if name != schema_name(topic):
            self.unknown[channel.topic] = f"schema {name}, this version reads {schema_name(topic)}"
            return None
        return topic


def _about(path: Path, file: IO[bytes]) -> dict[str, str]:
    file.seek(0)
    try:
        for record in StreamReader(file).records:
            if isinstance(record, Metadata) and record.name == METADATA:
                return dict(record.metadata)
            if isinstance(record, Message):
                break
    except _TORN as e:
        raise BusLogError(f"{path} is no MCAP file, or it ends at once: {type(e).__name__}") from None
    raise BusLogError(f"{path} is an MCAP file, but no bus that `forefield record` wrote")


def _has_index(file: IO[bytes]) -> bool:
    file.seek(0)
    try:
        return SeekingReader(file).get_summary() is not None
    except _TORN:
        return False


Found = tuple[Schema | None, Channel, Message]


def _indexed_records(file: IO[bytes], wanted: set[str], start_ns: int | None, end_ns: int | None) -> Iterator[Found]:
    reader = SeekingReader(file)
    summary = reader.get_summary()
    known = set() if summary is None else {c.topic for c in summary.channels.values()}
    # channels of other versions are asked for too, so that they can be named
    topics = [name for name in known if name in wanted or name not in TOPICS]
    until_ns = None if end_ns is None else end_ns + 1
    yield from reader.iter_messages(topics, starting_at=start_ns, ending_before=until_ns)


def _torn_records(file: IO[bytes]) -> Iterator[Found]:
    schemas: dict[int, Schema] = {}
    channels: dict[int, Channel] = {}
    try:
        for record in StreamReader(file).records:
            if isinstance(record, Schema):
                schemas[record.id] = record
            elif isinstance(record, Channel):
                channels[record.id] = record
            elif isinstance(record, Message):
                channel = channels[record.channel_id]
                yield schemas.get(channel.schema_id), channel, record
    except _TORN:
        return
