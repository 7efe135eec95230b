"""How old something is, without ever comparing the wall clocks of two machines.

Every header says how old its content was when it was sent (`age_ns`) and when that was on the sender's monotonic
clock (`sent_ns`). For each (source, boot) a receiver keeps the 30 s minimum of (own monotonic − `sent_ns`): clock
offset plus the shortest transit seen. The excess over it is time spent in transit and queues, and is added to the
age. A constant base delay cannot be seen this way.
"""

from __future__ import annotations

from collections import deque

WINDOW_NS = 30_000_000_000
MAX_SENDERS = 256


class TransitClock:
    """Keeps the smallest (receipt − sent) of each sender over the last 30 s."""

    def __init__(self) -> None:
        self._seen: dict[tuple[str, str], deque[tuple[int, int]]] = {}

    def excess_ns(self, source: str, boot: str, sent_ns: int, received_ns: int) -> int:
        """Time a message spent in transit beyond the sender's recent minimum [ns], ≥ 0.

        Args:
            source: who sent it.
            boot: the sender's process start.
            sent_ns: when, on the sender's monotonic clock [ns].
            received_ns: when it arrived, on ours [ns].
        """
        sender = (source, boot)
        lows = self._seen.pop(sender, None)
        if lows is None:
            lows = deque()
            while len(self._seen) >= MAX_SENDERS:
                self._seen.pop(next(iter(self._seen)))
        self._seen[sender] = lows  # last in the order of use
        difference = received_ns - sent_ns
        while lows and lows[-1][1] >= difference:
            lows.pop()
        lows.append((received_ns, difference))
        while lows[0][0] < received_ns - WINDOW_NS:
            lows.popleft()
        return difference - lows[0][1]
