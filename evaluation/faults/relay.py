"""A seeded relay: everything between vehicle and services goes through it, and not all of it arrives as it should.

Each service lives under a vehicle name of its own, so that nobody hears another directly; the relay carries messages
from name to name as they are, header and all. Latched topics and statuses pass unharmed.
"""

from __future__ import annotations

import heapq
import itertools
import threading
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass

import numpy as np

from common import topics
from common.bus import Bus, BusSettings, Publisher, Raw, open_bus
from common.topics import STATUS_OF, Topic
from evaluation.faults.stack import VEHICLE
from rig.launcher import SERVICES

NAME_OF = {service: f"behind-{service}" for service in SERVICES}
"""Under which vehicle's name a service lives."""
HARMED: tuple[tuple[Topic, str, str], ...] = (
    *((topics.EGO, VEHICLE, NAME_OF[s]) for s in SERVICES),
    (topics.OBJECTS, VEHICLE, NAME_OF["predictor"]),
    (topics.PREDICTION, NAME_OF["predictor"], NAME_OF["riskfield"]),
    (topics.RISK, NAME_OF["riskfield"], NAME_OF["planner"]),
    (topics.PLAN, NAME_OF["planner"], VEHICLE),
)
SPARED: tuple[tuple[Topic, str, str], ...] = (
    *((t, VEHICLE, NAME_OF[s]) for t in (topics.MAP, topics.ROUTE) for s in SERVICES),
    *((STATUS_OF[s], NAME_OF[s], VEHICLE) for s in SERVICES),
)


@dataclass(frozen=True)
class Harm:
    """What happens to messages on their way."""

    loss: float = 0.0
    duplicates: float = 0.0
    delay_s: tuple[float, float] = (0.0, 0.0)
    """From … to, each message its own: what is sent later may arrive sooner [s]."""


class Relay:
    """Carries, loses, repeats and delays. Made by `relay`."""

    def __init__(self, buses: dict[str, Bus], seed: int) -> None:
        self.harm = Harm()
        self.counts: Counter[str] = Counter()
        """`carried`, `lost`, `duplicated`, `delayed`, `overtaken`."""
        self._rng = np.random.default_rng(seed)
        self._queue: list[tuple[float, int, Publisher, Raw]] = []
        self._number = itertools.count()
        self._wake = threading.Condition()
        self._closing = False
        self._last: dict[tuple[str, str], int] = {}
        for harmed, routes in ((True, HARMED), (False, SPARED)):
            for topic, source, target in routes:
                out = buses[target].publisher(topic)
                buses[source].tap(topic, self._hear(out, f"{topic.suffix} {target}", harmed))
        self._thread = threading.Thread(target=self._deliver, name="relay", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Carry nothing more."""
        with self._wake:
            self._closing = True
            self._wake.notify()
        self._thread.join(5.0)

    def _hear(self, out: Publisher, route: str, harmed: bool):  # type: ignore[no-untyped-def]
        def hear(raw: Raw) -> None:
            with self._wake:
                harm = self.harm if harmed else Harm()
                lost, again = self._rng.random(2)
                if lost < harm.loss:
                    self.counts["lost"] += 1
                    return
                for _ in range(2 if again < harm.duplicates else 1):
                    delay = float(self._rng.uniform(*harm.delay_s))
                    number = next(self._number)
                    if harmed:
                        self._count(route, number, delay)
                    heapq.heappush(self._queue, (time.monotonic() + delay, number, out, raw))
                self.counts["duplicated"] += again < harm.duplicates
                self._wake.notify()

        return hear

    def _count(self, route: str, number: int, delay: float) -> None:
        self.counts["carried"] += 1
        self.counts["delayed"] += delay > 0.0
        due = round((time.monotonic() + delay) * 1e9)
        self.counts["overtaken"] += due < self._last.get((route, ""), 0)
        self._last[route, ""] = max(due, self._last.get((route, ""), 0))

    def _deliver(self) -> None:
        while True:
            with self._wake:
                while not self._closing and (not self._queue or self._queue[0][0] > time.monotonic()):
                    self._wake.wait(self._queue[0][0] - time.monotonic() if self._queue else None)
                if self._closing:
                    return
                _, _, out, raw = heapq.heappop(self._queue)
            out.put_raw(raw.attachment, raw.payload, raw.encoding)


@contextmanager
def relay(endpoint: str, seed: int) -> Iterator[tuple[Relay, dict[str, Bus]]]:
    """A relay on a router, and its buses by vehicle name, on which one may listen too."""
    settings = BusSettings(connect=(endpoint,))
    with ExitStack() as stack:
        names = (VEHICLE, *NAME_OF.values())
        buses = {name: stack.enter_context(open_bus(settings, name, "relay", wait_s=30.0)) for name in names}
        made = Relay(buses, seed)
        try:
            yield made, buses
        finally:
            made.close()
