"""Writes what travels on the bus into an MCAP file, without ever holding up the bus.

Zenoh's threads put what they hear into a queue that is bounded by bytes; one thread writes. What finds no room, or
cannot be written, is dropped and counted by topic; the counts stand at the file's end. A disk that is nearly full
pauses the recording until there is room again.
"""

from __future__ import annotations

import json
import logging
import os
import queue
import threading
import time
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType

from mcap.writer import CompressionType, Writer

from common import codec
from common.bus import Bus, Raw
from common.clock import monotonic
from common.codec import RefusedError
from common.config import Tree
from common.topics import MIB, Topic, key
from rig.bus_log.envelope import DROPPED, FORMAT, MESSAGE_ENCODING, METADATA, pack, schema_name
from rig.bus_log.machine import machine

log = logging.getLogger("forefield")

QUEUE_BYTES = 256 * MIB
"""What may wait to be written: some ten seconds of risk volumes."""
RESERVE_BYTES = 256 * MIB
"""This much of the disk stays free."""
FLUSH_S = 0.5
"""A chunk is closed after this long, so that a crash loses no more [s] …"""
CHUNK_BYTES = 2 * MIB
"""… or when it is of this size."""
CLOSE_S = 10.0
"""What waits is still written for this long when the recording ends; a disk too slow for that loses the rest [s]."""


class Recorder:
    """Hears topics of a bus and writes them; use it in a `with`."""

    def __init__(
        self, bus: Bus, topics: Sequence[Topic], path: Path, tree: Tree, *, reserve_bytes: int = RESERVE_BYTES
    ) -> None:
        self._dropped: Counter[str] = Counter()
        self.written: Counter[str] = Counter()
        self.trouble = ""
        """Why nothing is written now; empty: it is."""
        self._chunk: Counter[str] = Counter()
        self._chunk_bytes = 0
        self._deadline: float | None = None
        self._queue: queue.SimpleQueue[Raw | None] = queue.SimpleQueue()
        self._waiting = 0
        self._broken = False
        self._lock = threading.Lock()
        self._path, self._reserve = path, reserve_bytes
        self._file = path.open("wb")
        self._writer = Writer(self._file, chunk_size=2**62, compression=CompressionType.ZSTD)  # we say when
        self._wall_ns = time.time_ns() - monotonic()
        self._writer.start(profile="", library="forefield")
        self._writer.add_metadata(
            METADATA,
            {
                "format": FORMAT,
                "vehicle": bus.vehicle,
                "configuration": json.dumps(tree, sort_keys=True),
                "machine": json.dumps(machine()),
            },
        )
        self._channels = {topic.suffix: self._channel(bus.vehicle, topic) for topic in topics}
        self._thread = threading.Thread(target=self._write, daemon=True, name="bus-log")
        self._thread.start()
        for topic in topics:
            bus.tap(topic, self.hear)

    def hear(self, message: Raw) -> None:
        """Take a message, or count it as dropped; called from the bus' threads."""
        size = _bytes(message)
        with self._lock:
            fits = self._waiting + size <= QUEUE_BYTES
            if fits:
                self._waiting += size
        if fits:
            self._queue.put(message)
        else:
            self._drop(message)

    @property
    def dropped(self) -> Counter[str]:
        """Messages that are not in the file, by topic."""
        with self._lock:
            return Counter(self._dropped)

    @property
    def size(self) -> int:
        """Bytes in the file."""
        return self._path.stat().st_size if self._path.exists() else 0

    def close(self) -> None:
        """Write what waits, as far as the disk is fast enough, then counts and index."""
        self._deadline = time.monotonic() + CLOSE_S
        self._queue.put(None)
        self._thread.join()
        self._flush()
        try:
            if not self._broken:
                self._writer.add_metadata(DROPPED, {name: str(n) for name, n in self.dropped.items()})
                self._writer.finish()  # type: ignore[no-untyped-call]
        except OSError as e:
            self.trouble = f"{self._path}: the index was not written: {e.strerror}"
        finally:
            self._file.close()

    def __enter__(self) -> Recorder:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.close()

    def _channel(self, vehicle: str, topic: Topic) -> int:
        schema = self._writer.register_schema(schema_name(topic), "text", (topic.message.__doc__ or "").encode())
        about = {"encoding": topic.encoding, "key": key(vehicle, topic)}
        return self._writer.register_channel(topic.suffix, MESSAGE_ENCODING, schema, about)

    def _write(self) -> None:
        flushed = time.monotonic()
        while True:
            try:
                message = self._queue.get(timeout=FLUSH_S)
                if message is None:
                    return
                with self._lock:
                    self._waiting -= _bytes(message)
                if self._broken or self._is_over() or not self._has_room():
                    self._drop(message)
                else:
                    self._put(message)
            except queue.Empty:
                pass
            if time.monotonic() - flushed >= FLUSH_S:
                flushed = time.monotonic()
                self._flush()

    def _put(self, message: Raw) -> None:
        suffix = message.topic.suffix
        at = message.received_ns + self._wall_ns
        try:
            data = pack(message.attachment, message.payload)
            self._writer.add_message(self._channels[suffix], at, data, at, _sequence(message))
            self.written[suffix] += 1
            self._chunk[suffix] += 1
            self._chunk_bytes += len(data)
            self._say("")
        except OSError as e:
            self._drop(message)
            self._break(e)
        if self._chunk_bytes >= CHUNK_BYTES:
            self._flush()

    def _drop(self, message: Raw) -> None:
        with self._lock:  # the bus' threads count too
            self._dropped[message.topic.suffix] += 1

    def _flush(self) -> None:
        if not self._broken:
            try:
                self._writer.flush()  # type: ignore[no-untyped-call]
                self._chunk.clear()
                self._chunk_bytes = 0
            except OSError as e:
                self._break(e)

    def _is_over(self) -> bool:
        """Whether the recording has ended and the disk has not kept up."""
        if self._deadline is None or time.monotonic() <= self._deadline:
            return False
        self._say(f"{self._path}: the disk is too slow: what still waited {CLOSE_S:g} s after the end is left out")
        return True

    def _break(self, error: OSError) -> None:
        # half a chunk stands in the file: neither it nor what follows could be read
        self._broken = True
        with self._lock:
            self.written.subtract(self._chunk)
            self._dropped.update(self._chunk)
        self._chunk.clear()
        self._say(f"{self._path}: {error.strerror}; `forefield repair` saves what was written before")

    def _has_room(self) -> bool:
        disk = os.statvfs(self._path.absolute().parent)
        free = disk.f_bavail * disk.f_frsize
        if free >= self._reserve:
            return True
        self._say(f"{free // MIB} MiB free on the disk, {self._reserve // MIB} MiB are to stay so")
        return False

    def _say(self, trouble: str) -> None:
        if trouble != self.trouble and trouble:
            log.warning("not recording: %s", trouble)
        self.trouble = trouble


def _bytes(message: Raw) -> int:
    return len(message.payload) + len(message.attachment or b"")


def _sequence(message: Raw) -> int:
    try:
        return codec.decode_header(message.topic, message.attachment).seq & 0xFFFFFFFF
    except RefusedError:
        return 0
