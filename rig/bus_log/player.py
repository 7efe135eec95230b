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
from common.messages import Header
from common.topics import Topic
from rig.bus_log.envelope import Recorded
from rig.bus_log.reader import BusLog

LISTEN_S = 1.0
"""How long to listen for other writers before the first message [s]; what moves comes far more often."""
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


class TakenError(RuntimeError):
    """Somebody else began to write what is replayed; the text says who and what."""


class Player:
    """Replays one recording; `yields`: it stops when somebody else writes one of its topics."""

    def __init__(self, log: BusLog, bus: Bus, topics: Collection[Topic], *, yields: bool = False) -> None:
        self.sent: Counter[str] = Counter()
        self.refused: Counter[str] = Counter()
        """`topic:reason` → messages whose header cannot be read: they are not sent."""
        self._log, self._bus, self._topics = log, bus, topics
        self._publishers: dict[str, Publisher] = {t.suffix: bus.publisher(t) for t in topics}
        self._boots: defaultdict[str, str] = defaultdict(lambda: secrets.token_hex(8))
        self._mine: set[str] = set()
        self.others: dict[Topic, str] = {}
        """Topics that somebody else was heard to write, and his name; they need not show a token for that."""
        for topic in topics if yields else ():
            bus.watch(topic, self._ear(topic))

    def _ear(self, topic: Topic) -> Callable[[Header, int], None]:
        def hear(header: Header, _: int) -> None:
            if header.boot not in self._mine:
                self.others[topic] = header.source

        return hear

    def play(self, start_ns: int, end_ns: int, rate: float, show: Callable[[float], None] = lambda _: None) -> None:
        """Send everything between two log times.

        Args:
            start_ns: log time at which to begin [ns]; what was latched before is sent first.
            end_ns: log time at which to end [ns].
            rate: 2 is twice as fast.
            show: called with the seconds of the recording that were played.

        Raises:
            TakenError: somebody else writes one of the topics.
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
        if self.others:
            who = ", ".join(f"{topic.suffix} ({source})" for topic, source in self.others.items())
            raise TakenError(f"{who} is written by somebody else now, whom a replay could shut out: it was stopped")
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
        self._mine.add(header["boot"])
        header["sent_ns"] = now
        header["capture_ns"] = now - header["age_ns"]
        if header.get("cause"):
            header["cause"][0] = self._boots[header["cause"][0]]
        header["step"] = None  # its times are of clocks that are gone
        return bytes(msgpack.packb(header))
