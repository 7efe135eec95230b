"""A listener on the bus: when each plan and status came, of which boot and number, resting on what.

It hears every message in Zenoh's thread, before anything else is done with it, and refuses none: what a vehicle makes
of them is `vehicle.py`. All clocks are this machine's monotonic one.
"""

from __future__ import annotations

import threading
import time
from collections import defaultdict
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import msgpack
import numpy as np

from common import codec
from common.bus import Bus, Raw
from common.codec import RefusedError
from common.messages import F64, Cause, Status
from common.topics import PLAN, STATUS_OF, Topic
from evaluation.faults.result import FaultError
from rig.launcher import SERVICES, UP

MISSED_MS = 150.0
"""A plan is missed when none comes for longer than this [ms]."""
HEAD_BYTES = 4096
"""Mode and reason stand in the first bytes of a plan."""

T = TypeVar("T")


def until(condition: Callable[[], T | None], within_s: float, what: str, *, every_s: float = 0.005) -> T:
    """Wait for the first truthy value of a condition.

    Raises:
        FaultError: it did not come.
    """
    end = time.monotonic() + within_s
    while True:
        value = condition()
        if value:
            return value
        if time.monotonic() > end:
            raise FaultError(f"{what} did not come within {within_s:g} s")
        time.sleep(every_s)


@dataclass(frozen=True)
class Heard:
    """One message: its header, and of a plan or a status what it says."""

    topic: str
    arrived_ns: int
    boot: str
    seq: int
    sent_ns: int
    capture_ns: int
    cause: Cause | None
    work_ns: int
    """From the arrival of what it was made from to its sending [ns]."""
    mode: str = ""
    """Mode of a plan, state of a status."""
    reason: str = ""
    status: Status | None = None


class Watch:
    """Listens to `plan`, the services' status, and the headers of other topics if asked."""

    def __init__(self, bus: Bus, others: tuple[Topic, ...] = ()) -> None:
        self._heard: dict[str, list[Heard]] = defaultdict(list)
        self._lock = threading.Lock()
        self._last_status: dict[str, Heard] = {}
        self.keep_raw: Callable[[Raw], None] | None = None
        """Told every plan as it travels."""
        bus.tap(PLAN, self._plan)
        for name in (*SERVICES, "viz"):
            bus.tap(STATUS_OF[name], self._status)
        for topic in others:
            bus.tap(topic, self._other)

    # --- what was heard ---

    def heard(self, topic: str = "plan", since_ns: int = 0, until_ns: int = 2**62) -> list[Heard]:
        """Messages of a topic that arrived in a span of time, in order."""
        found = []
        with self._lock:
            for h in reversed(self._heard[topic]):  # what is asked for is mostly new
                if h.arrived_ns < since_ns:
                    break
                if h.arrived_ns <= until_ns:
                    found.append(h)
        return found[::-1]

    def last(self, topic: str = "plan") -> Heard | None:
        """The newest of a topic."""
        with self._lock:
            return self._heard[topic][-1] if self._heard[topic] else None

    def status(self, service: str) -> Heard | None:
        """What a service last said about itself."""
        return self._last_status.get(service)

    def gaps_ms(self, since_ns: int, until_ns: int | None = None, topic: str = "plan") -> F64:
        """Times between successive arrivals [ms] that lie in a span or reach into it, silence at its ends included."""
        end = time.monotonic_ns() if until_ns is None else until_ns
        before = [h.arrived_ns for h in self.heard(topic, 0, since_ns)][-1:] or [since_ns]
        times = [*before, *(h.arrived_ns for h in self.heard(topic, since_ns + 1, end)), end]
        gaps: F64 = np.diff(np.array(times, dtype=np.float64)) * 1e-6
        # the last "gap" is only time that went by so far: it counts where it is already a miss
        return gaps if gaps[-1] > MISSED_MS else gaps[:-1]

    def missed(self, since_ns: int, until_ns: int | None = None) -> int:
        """How often no plan came for longer than 150 ms."""
        return int((self.gaps_ms(since_ns, until_ns) > MISSED_MS).sum())

    # --- waiting ---

    def first(
        self, topic: str, since_ns: int, within_s: float, what: str, wanted: Callable[[Heard], bool] = lambda h: True
    ) -> Heard:
        """The first message of a topic that arrived after a moment and is wanted; waits for it.

        Raises:
            FaultError: it did not come.
        """
        return until(
            lambda: next((h for h in self.heard(topic, since_ns) if wanted(h)), None), within_s, what
        )  # fmt: skip

    def mode(self, mode: str, since_ns: int, within_s: float) -> Heard:
        """The first plan of a mode after a moment; waits for it."""
        return self.first("plan", since_ns, within_s, f"a plan that says {mode}", lambda h: h.mode == mode)

    def up(self, service: str, since_ns: int, within_s: float, not_boot: str = "") -> Heard:
        """The first status, of another boot than that, in which a service says that it is up; waits for it."""
        return self.first(
            f"status/{service}", since_ns, within_s, f"{service} up", lambda h: h.mode in UP and h.boot != not_boot
        )

    # --- in Zenoh's threads ---

    def _plan(self, raw: Raw) -> None:
        with suppress(RefusedError):
            said = _head(raw.payload, ("mode", "reason"))
            self._note(raw, mode=said.get("mode", ""), reason=said.get("reason", ""))
        if self.keep_raw is not None:
            self.keep_raw(raw)

    def _status(self, raw: Raw) -> None:
        with suppress(RefusedError):
            header = codec.decode_header(raw.topic, raw.attachment)
            body = codec.decode_body(raw.topic, header, raw.payload)
            assert isinstance(body, Status)
            heard = self._note(raw, mode=body.state, reason=body.reason)
            self._last_status[body.service] = replace(heard, status=body)

    def _other(self, raw: Raw) -> None:
        with suppress(RefusedError):
            self._note(raw)

    def _note(self, raw: Raw, mode: str = "", reason: str = "") -> Heard:
        h = codec.decode_header(raw.topic, raw.attachment)
        topic = raw.topic.suffix
        heard = Heard(
            topic, raw.received_ns, h.boot, h.seq, h.sent_ns, h.capture_ns, h.cause, h.work_ns, mode, reason
        )  # fmt: skip
        with self._lock:
            self._heard[topic].append(heard)
        return heard


def _head(payload: bytes, names: tuple[str, ...]) -> dict[str, Any]:
    """The first few fields of a MessagePack map, without reading the rest."""
    unpacker = msgpack.Unpacker(max_buffer_size=HEAD_BYTES)
    unpacker.feed(payload[:HEAD_BYTES])
    found: dict[str, Any] = {}
    with suppress(Exception):  # a plan that cannot be read is the vehicle's to refuse
        for _ in range(unpacker.read_map_header()):
            key, value = unpacker.unpack(), unpacker.unpack()
            if key in names:
                found[key] = value
            if len(found) == len(names):
                break
    return found
