"""Frames, latencies and periods of a run, read off the headers of what passes by.

End to end is taken on the rig's own clock: from its put of `objects` to its receipt of the first plan with that cause.
"New risk" means a new cause: several plans may rest on one risk, and only the first of them counts for the period.
"""

from __future__ import annotations

import functools
import threading
from collections import Counter
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from common.bus import Bus
from common.messages import Cause, Header
from common.topics import PLAN, PREDICTION, RISK, Topic

STAGES = {"prediction": "predictor", "risk": "riskfield", "plan": "planner"}
_MS = 1e-6


@dataclass
class Tally:
    """Told of every header by Zenoh threads and of every `objects` by the rig; counts from `begin` on."""

    boot: str
    """Of the rig: only its own `objects` count."""
    frames: Counter[str] = field(default_factory=Counter)
    work_ms: dict[str, list[float]] = field(default_factory=lambda: {stage: [] for stage in STAGES.values()})
    end_to_end_ms: list[float] = field(default_factory=list)
    arrivals: dict[str, list[int]] = field(default_factory=lambda: {topic: [] for topic in STAGES})
    """Arrival of the first message of each topic with a new cause [ns]."""
    counting: bool = False
    newest: dict[str, int] = field(default_factory=dict)
    """Sequence number of the newest cause seen, by topic."""
    _put_ns: dict[int, int] = field(default_factory=dict)
    _lock: threading.Lock = field(default_factory=threading.Lock)

    def listen(self, bus: Bus, topics: tuple[Topic, ...] = (PREDICTION, RISK, PLAN)) -> None:
        """Read the headers of prediction, risk and plan."""
        for topic in topics:
            bus.watch(topic, functools.partial(self.saw, topic.suffix))

    def begin(self) -> None:
        """From here on it counts, from nothing."""
        with self._lock:
            self.counting = True
            self._put_ns.clear()
            self.frames.clear()
            self.end_to_end_ms.clear()
            self.work_ms = {stage: [] for stage in self.work_ms}
            self.arrivals = {topic: [] for topic in self.arrivals}

    def put(self, cause: Cause, now_ns: int) -> None:
        """The rig sent `objects` at `now_ns`."""
        with self._lock:
            if self.counting:
                self._put_ns[cause.seq] = now_ns
                self.frames["objects"] += 1

    def saw(self, topic: str, header: Header, now_ns: int) -> None:
        """A header of prediction, risk or plan arrived at `now_ns`."""
        with self._lock:
            seq = header.cause.seq if header.cause is not None and header.cause.boot == self.boot else -1
            new = seq > self.newest.get(topic, -1)
            self.newest[topic] = max(seq, self.newest.get(topic, -1))
            if not self.counting:
                return
            self.frames[topic] += 1
            self.work_ms[STAGES[topic]].append(header.work_ns * _MS)
            sent = self._put_ns.get(seq)
            if new and sent is not None:
                self.arrivals[topic].append(now_ns)
                if topic == "plan":
                    self.end_to_end_ms.append((now_ns - sent) * _MS)

    def latency_ms(self) -> dict[str, dict[str, float | None]]:
        """Quantiles of each stage's work and of the way end to end [ms]."""
        with self._lock:
            return {
                **{stage: quantiles(values) for stage, values in self.work_ms.items()},
                "end_to_end": quantiles(self.end_to_end_ms),
            }

    def period_ms(self, topic: str = "plan") -> dict[str, float | None]:
        """Time between messages that rest on a new cause [ms]."""
        with self._lock:
            return quantiles(np.diff(self.arrivals[topic]) * _MS, (50, 99))

    def last_end_to_end_ms(self) -> float | None:
        """The newest end-to-end latency [ms]."""
        with self._lock:
            return self.end_to_end_ms[-1] if self.end_to_end_ms else None


def quantiles(values: Any, which: tuple[int, ...] = (50, 95, 99, 100)) -> dict[str, float | None]:
    """`{p50, p95, p99, max}` of some values; each None when there are no values."""
    names = ["max" if q == 100 else f"p{q}" for q in which]
    if not len(values):
        return dict.fromkeys(names)
    found = np.percentile(np.asarray(values, dtype=np.float64), which)
    return {name: round(float(x), 3) for name, x in zip(names, found, strict=True)}
