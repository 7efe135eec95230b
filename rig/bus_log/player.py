"""Puts a recorded bus back on a bus, in its own rhythm or another.

Bodies go out as they were recorded. Headers keep seq, age, work and cause; what is of the moment is renewed, since
receivers would otherwise rightly refuse it as old or as repeated: each process start gets a new boot id, the same for
all its messages, and sending times are those of this replay, on this process' monotonic clock.
"""

from __future__ import annotations

import secrets
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Collection, Iterable
from typing import Any

import msgpack

from common.bus import Bus, Publisher
from common.clock import monotonic
from common.codec import RefusedError
from common.topics import Topic
from rig.bus_log.envelope import Recorded
from rig.bus_log.reader import BusLog

LATCHED_S = 0.2
"""What stands is put so long before what moves [s]."""


def taken(topics: Iterable[Topic], alive: Collection[str]) -> list[Topic]:
    """Topics that somebody on the bus writes now.

    A receiver keeps to the process start that it heard last: a replayed message would take the place of the living
    writer, whose own messages are then refused (`old_boot`) until it starts again.

    Args:
        topics: what is to be replayed.
        alive: services whose liveliness token is seen (`Bus.alive`).
    """
    return [topic for topic in topics if topic.writer in alive]


class Player:
    """Replays one recording."""

    def __init__(self, log: BusLog, bus: Bus, topics: Collection[Topic]) -> None:
        self.sent: Counter[str] = Counter()
        self.refused: Counter[str] = Counter()
        """`topic:reason` → messages whose header cannot be read: they are not sent."""
        self._log, self._bus, self._topics = log, bus, topics
        self._publishers: dict[str, Publisher] = {t.suffix: bus.publisher(t) for t in topics}
        self._boots: defaultdict[str, str] = defaultdict(lambda: secrets.token_hex(8))

    def play(self, start_ns: int, end_ns: int, rate: float, show: Callable[[float], None] = lambda _: None) -> None:
        """Send everything between two log times.

        Args:
            start_ns: log time at which to begin [ns]; what was latched before is sent first.
            end_ns: log time at which to end [ns].
            rate: 2 is twice as fast.
            show: called with the seconds of the recording that were played.
        """
        for message in self._log.latched_before(start_ns, self._topics):
            self._send(message)
        if self.sent:
            time.sleep(LATCHED_S)
        begun = monotonic()
        for message in self._log.messages(self._topics, start_ns, end_ns):
            due = begun + round((message.time_ns - start_ns) / rate)
            wait_s = (due - monotonic()) * 1e-9
            if wait_s > 0:
                time.sleep(wait_s)
            self._send(message)
            show((message.time_ns - start_ns) * 1e-9)

    def _send(self, message: Recorded) -> None:
        suffix = message.topic.suffix
        try:
            message.header()  # of a version that receivers understand
        except RefusedError as e:
            self.refused[f"{suffix}:{e.reason}"] += 1
            return
        assert message.attachment is not None
        self._publishers[suffix].put_raw(self._renewed(message.attachment), message.payload, message.encoding)
        self.sent[suffix] += 1

    def _renewed(self, attachment: bytes) -> bytes:
        # as a plain map: fields of a newer minor version travel on
        header: dict[str, Any] = msgpack.unpackb(attachment)
        now = monotonic()
        header["boot"] = self._boots[header["boot"]]
        header["sent_ns"] = now
        header["capture_ns"] = now - header["age_ns"]
        if header.get("cause"):
            header["cause"][0] = self._boots[header["cause"][0]]
        header["step"] = None  # its times are of clocks that are gone
        return bytes(msgpack.packb(header))
