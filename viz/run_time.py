"""When something is shown: frame number and seconds of the run, from the times at which contents were true.

A frame begins with each `objects` message; risk and prediction belong to the frame whose objects caused them,
everything else to the frame in which it was captured. Without objects, a frame begins every tenth of a second.
"""

from __future__ import annotations

from bisect import bisect_right
from dataclasses import dataclass
from typing import Any

from common.messages import FRAME_S, Cause, Stamped

FRAME_NS = round(FRAME_S * 1e9)
TOLERANCE_NS = 1_000_000
"""Two receivers' idea of one capture may differ by the jitter of the bus."""
REMEMBERED = 512
"""Frames and `objects` messages that are known by their times: far more than topics allow a message to be late."""


@dataclass(frozen=True)
class When:
    """A place on both timelines."""

    frame: int
    t: float
    """Seconds since the first ego or objects."""


class RunTime:
    """Places messages on the timelines; times are on the receiver's monotonic clock."""

    def __init__(self) -> None:
        self._begin_ns: int | None = None
        self._starts: list[int] = []  # of the last frames
        self._before = 0  # frames before those
        self._captured: dict[tuple[str, int], int] = {}
        self._received: dict[tuple[str, int], int] = {}

    @property
    def started(self) -> bool:
        """Whether anything that moves was seen yet."""
        return self._begin_ns is not None

    def begin(self, stamped: Stamped[Any]) -> When:
        """Place an `objects` message: it begins a frame, unless one began within half a frame."""
        capture = stamped.capture_ns
        if not self._starts or capture >= self._starts[-1] + FRAME_NS // 2:
            self._append(capture)
        key = (stamped.boot, stamped.seq)
        self._captured[key], self._received[key] = capture, stamped.received_ns
        for old in (self._captured, self._received):
            while len(old) > REMEMBERED:
                del old[next(iter(old))]
        return self.at(capture)

    def start(self, ns: int) -> None:
        """Something that moves was captured at `ns`: the run begins, if it has not."""
        if not self._starts:
            self._append(ns)

    def of(self, stamped: Stamped[Any]) -> When:
        """Place what descends from `objects` where these were captured; without a known cause by its own capture."""
        cause = stamped.cause
        known = None if cause is None else self._captured.get((cause.boot, cause.seq))
        return self.at(stamped.capture_ns if known is None else known)

    def at(self, ns: int) -> When:
        """Place a time [ns]; before the run begins everything lies at its start.

        What is older than the last `REMEMBERED` frames lies in the first of them.
        """
        if self._begin_ns is None:
            return When(0, 0.0)
        silent = max(ns - self._starts[-1] - FRAME_NS // 2 - 1, 0) // FRAME_NS  # frames without objects
        if silent > REMEMBERED:  # those before the last ones are only counted
            self._before += len(self._starts) + silent - REMEMBERED - 1
            self._starts = [self._starts[-1] + FRAME_NS * (silent - REMEMBERED)]
        while ns > self._starts[-1] + FRAME_NS * 3 // 2:
            self._append(self._starts[-1] + FRAME_NS)
        frame = self._before + max(bisect_right(self._starts, ns + TOLERANCE_NS) - 1, 0)
        return When(frame, max((ns - self._begin_ns) * 1e-9, 0.0))

    def _append(self, ns: int) -> None:
        if self._begin_ns is None:
            self._begin_ns = ns
        self._starts.append(ns)
        if len(self._starts) > REMEMBERED:
            del self._starts[0]
            self._before += 1

    def since_objects_ms(self, cause: Cause | None, received_ns: int) -> float | None:
        """Time from our receipt of the causing objects to `received_ns` [ms]; None if they are not known."""
        start = None if cause is None else self._received.get((cause.boot, cause.seq))
        return None if start is None else (received_ns - start) * 1e-6
