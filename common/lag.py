"""Lag: a service that is too slow says so in its state; a counter that only an expert reads is not enough."""

from __future__ import annotations

from collections import deque

WINDOW_NS = 1_000_000_000
"""What was late is told for this long [ns]."""
STOOD_NS = 500_000_000
"""A loop that has not turned for this long lags [ns]; it turns at least five times a second."""


class Lag:
    """Results that came too late, and a loop that does not turn."""

    def __init__(self) -> None:
        self._late: deque[tuple[int, int]] = deque(maxlen=256)
        self._turned_ns: int | None = None

    def turned(self, now_ns: int) -> None:
        """The loop made a turn."""
        self._turned_ns = now_ns

    def late(self, now_ns: int, by_ns: int) -> None:
        """A result was sent that had been due so long before."""
        self._late.append((now_ns, by_ns))

    def words(self, now_ns: int) -> str:
        """What lags now, in a sentence; empty: nothing."""
        said = []
        recent = [by for at, by in self._late if now_ns - at <= WINDOW_NS]
        if recent:
            results = "1 result" if len(recent) == 1 else f"{len(recent)} results"
            said.append(f"late: {results} in the last second, by up to {max(recent) * 1e-6:.0f} ms")
        stood = 0 if self._turned_ns is None else now_ns - self._turned_ns
        if stood > STOOD_NS:
            said.append(f"the loop has not turned for {stood * 1e-9:.1f} s")
        return "; ".join(said)
