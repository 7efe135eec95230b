"""The injectable monotonic clock: cores never ask what time it is, shells ask this."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

Clock = Callable[[], int]
"""Returns monotonic time [ns]."""

monotonic: Clock = time.monotonic_ns


@dataclass
class ManualClock:
    """A clock that moves only when told, for tests and simulated time."""

    now_ns: int = 0

    def __call__(self) -> int:
        """Time [ns]."""
        return self.now_ns

    def advance(self, seconds: float) -> None:
        """Move on by `seconds`."""
        self.now_ns += round(seconds * 1e9)
