"""Health is one thing: the status message, the heartbeat file and the metrics are views of it.

Every input carries three flags: `alive` (something arrived within its time), `rate_ok` and `valid` (the last one was
accepted). A new input starts with all three down: it fails closed.
"""

from __future__ import annotations

import bisect
import threading
from collections import Counter, deque
from itertools import accumulate

import numpy as np

from common.clock import Clock
from common.lag import Lag
from common.messages import InputHealth, State, Status
from common.topics import Topic

RATE_WINDOW = 20
WORK_WINDOW = 600
WORK_BUCKETS_S = (0.001, 0.002, 0.005, 0.01, 0.015, 0.02, 0.03, 0.04, 0.05, 0.075, 0.1, 0.15, 0.2, 0.3, 0.5, 1.0)
"""Upper ends of the buckets in which the work of all messages is counted [s]."""
DEADLINE = "deadline:missed"
"""Counter of results that came later than a period after they were due."""
DETAIL_LENGTH = 1000
"""Characters of each detail that a status tells: the words of an exception have no end."""
STALL_S = 2.5
"""A loop that has not turned for this long gets no heartbeat [s]."""


class InputMonitor:
    """Arrivals of one input. The bus tells it what arrives; it never looks at a clock itself."""

    def __init__(self, topic: Topic) -> None:
        self._topic = topic
        self._arrivals: deque[int] = deque(maxlen=RATE_WINDOW)
        self._capture_ns: int | None = None
        self._valid = False
        self._received = 0
        self._used = 0

    def arrived(self, now_ns: int) -> None:
        """Something arrived, whatever it is."""
        self._arrivals.append(now_ns)
        self._received += 1

    def accepted(self, capture_ns: int) -> None:
        """The newest message was good."""
        self._valid, self._capture_ns = True, capture_ns
        self._used += 1

    def refused(self) -> None:
        """The newest message was not used."""
        self._valid = False

    def superseded(self) -> None:
        """A message that was accepted gave way to a newer one before it was used."""
        self._used -= 1

    def view(self, now_ns: int) -> InputHealth:
        """State of this input at `now_ns`."""
        times = list(self._arrivals)
        age = None if self._capture_ns is None else (now_ns - self._capture_ns) * 1e-9
        if self._topic.rate_hz is None:
            return InputHealth(
                alive=self._received > 0,
                rate_ok=True,
                valid=self._valid,
                age_s=age,
                received=self._received,
                used=self._used,
            )
        low, high = self._topic.rate_hz
        span = (times[-1] - times[0]) * 1e-9 if len(times) > 1 else 0.0
        rate = (len(times) - 1) / span if span > 0 else 0.0
        silent = (now_ns - times[-1]) * 1e-9 if times else np.inf
        alive = bool(silent <= max(3.0 / low, self._topic.max_age_s or 0.0))
        return InputHealth(
            alive=alive,
            rate_ok=alive and low * 0.8 <= rate <= high * 1.25,
            valid=self._valid,
            age_s=age,
            rate_hz=rate,
            received=self._received,
            used=self._used,
        )


class Health:
    """What one service knows about itself. Thread-safe: the loop writes, the status thread reads."""

    def __init__(self, service: str, clock: Clock) -> None:
        self.service = service
        self.counters: Counter[str] = Counter()
        self.detail: dict[str, str] = {}
        self._clock = clock
        self._started_ns = clock()
        self._turned_ns = self._started_ns
        self._inputs: dict[str, InputMonitor] = {}
        self._state: State = "starting"
        self._reason = "starting"
        self._work: deque[float] = deque(maxlen=WORK_WINDOW)
        self._work_counts = [0] * (len(WORK_BUCKETS_S) + 1)
        self._work_sum_s = 0.0
        self._lag = Lag()
        self._lock = threading.Lock()

    def input(self, topic: Topic) -> InputMonitor:
        """The monitor of one input."""
        with self._lock:
            return self._inputs.setdefault(topic.suffix, InputMonitor(topic))

    def count(self, name: str, n: int = 1) -> None:
        """Raise the counter `topic:reason` by n."""
        with self._lock:
            self.counters[name] += n

    def say(self, state: State, reason: str) -> bool:
        """Set the state and its reason; returns whether that is news."""
        with self._lock:
            news = (state, reason) != (self._state, self._reason)
            self._state, self._reason = state, reason
            return news

    def turned(self) -> None:
        """The loop made a turn."""
        self._turned_ns = self._clock()
        with self._lock:
            self._lag.turned(self._turned_ns)

    def late(self, by_ns: int) -> None:
        """A result was sent so long after it was due that its deadline was missed [ns]."""
        with self._lock:
            self.counters[DEADLINE] += 1
            self._lag.late(self._clock(), by_ns)

    def worked(self, work_ns: int) -> None:
        """One message took this long from arrival to put [ns]."""
        with self._lock:
            self._work.append(work_ns * 1e-6)
            self._work_counts[bisect.bisect_left(WORK_BUCKETS_S, work_ns * 1e-9)] += 1
            self._work_sum_s += work_ns * 1e-9

    @property
    def state(self) -> State:
        """What was said last; that a working service lags is added to its status."""
        return self._state

    @property
    def reason(self) -> str:
        """And why."""
        return self._reason

    @property
    def turning(self) -> bool:
        """Whether the loop turns, or the service is still starting."""
        return self._state == "starting" or (self._clock() - self._turned_ns) * 1e-9 < STALL_S

    def work_histogram(self) -> tuple[list[tuple[str, float]], float]:
        """Work of all messages since the start: (upper end [s], how many up to it), last `+Inf`; and the sum [s]."""
        with self._lock:
            ends = [*map(str, WORK_BUCKETS_S), "+Inf"]
            return [(e, float(n)) for e, n in zip(ends, accumulate(self._work_counts), strict=True)], self._work_sum_s

    def status(self) -> Status:
        """The status message of this moment; what lags is `degraded`, whatever was said."""
        now = self._clock()
        with self._lock:
            work = np.array(self._work)
            inputs = {name: monitor.view(now) for name, monitor in self._inputs.items()}
            lag = self._lag.words(now) if self._state in ("waiting", "ready", "degraded") else ""
            p50, p95, p99, top = np.percentile(work, [50, 95, 99, 100]) if len(work) else (0.0,) * 4
            return Status(
                service=self.service,
                state="degraded" if lag else self._state,
                reason=(f"{lag}; {self._reason}" if lag else self._reason)[:1000],
                uptime_s=(now - self._started_ns) * 1e-9,
                inputs=inputs,
                counters=dict(self.counters),
                work_ms={"p50": float(p50), "p95": float(p95), "p99": float(p99), "max": float(top)},
                detail={name: text[:DETAIL_LENGTH] for name, text in dict(self.detail).items()},
            )
