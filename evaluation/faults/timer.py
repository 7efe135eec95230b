"""A bare 20 Hz timer in a process of its own: tells a starved machine from a slow planner.

`python -P -m evaluation.faults.timer` writes the monotonic time [ns] of every tick, one a line, until it is ended.
"""

from __future__ import annotations

import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np

from common.messages import I64
from rig.launcher import start

PERIOD_NS = 50_000_000


class Timer:
    """The ticks of a timer that runs beside. Made by `timer`."""

    def __init__(self, ticks_file: int) -> None:
        self._file = ticks_file

    def ticks(self) -> I64:
        """When it ticked so far [ns]."""
        with open(f"/proc/self/fd/{self._file}", encoding="ascii") as f:  # noqa: PTH123 - a descriptor
            lines = f.read().split("\n")
        return np.array([int(line) for line in lines[:-1]], dtype=np.int64)

    def worst_ms(self, since_ns: int = 0, until_ns: int = 2**62) -> float:
        """The longest time between two ticks, of those that touch a span of time [ms]; NaN before the second tick."""
        ticks = self.ticks()
        inside = (ticks[1:] >= since_ns) & (ticks[:-1] <= until_ns)
        gaps = np.diff(ticks)[inside]
        return float(gaps.max() * 1e-6) if len(gaps) else float("nan")


@contextmanager
def timer() -> Iterator[Timer]:
    """Run one; it is gone when the `with` ends."""
    with tempfile.TemporaryFile() as configuration, tempfile.TemporaryFile() as ticks:
        child = start("timer", ("evaluation.faults.timer",), configuration, ticks)
        try:
            yield Timer(ticks.fileno())
        finally:
            child.process.kill()
            child.process.wait()


def main() -> None:
    """Tick on absolute deadlines; a late tick does not move the next."""
    begin = time.monotonic_ns()
    k = 0
    while True:
        k += 1
        now = time.monotonic_ns()
        k = max(k, (now - begin) // PERIOD_NS)  # what was missed is not made up for
        time.sleep(max(begin + k * PERIOD_NS - now, 0) * 1e-9)
        sys.stdout.write(f"{time.monotonic_ns()}\n")
        sys.stdout.flush()


if __name__ == "__main__":
    main()
