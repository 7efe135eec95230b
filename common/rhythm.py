"""When a loop steps next: a period after its last step, but not just before the trigger that is about to come.

```
due = now + period
due = expected + grace      if the next trigger is expected within `grace` of that
due = again                 if the step itself asked to be made again earlier
```
The next trigger is expected one nominal interval after the last. One that comes steps at once, whatever is due.
"""

from __future__ import annotations


class Rhythm:
    """The rhythm of one loop; all times in ns on one monotonic clock.

    Args:
        period_ns: between two steps without a trigger.
        interval_ns: nominally between two triggers; None: they come as they come.
        grace_ns: a trigger that is late by no more than this is waited for.
    """

    def __init__(self, period_ns: int, interval_ns: int | None, grace_ns: int) -> None:
        self._period_ns = period_ns
        self._interval_ns = interval_ns
        self._grace_ns = grace_ns
        self._triggered_ns: int | None = None

    def due_ns(self, now_ns: int, triggered: bool) -> int:
        """When the next step is due after one that began now, counted from now and not from when that one was due.

        So a late turn is not followed by a burst.
        """
        if triggered:
            self._triggered_ns = now_ns
        due = now_ns + self._period_ns
        if self._triggered_ns is not None and self._interval_ns is not None:
            expected = self._triggered_ns + self._interval_ns
            if abs(expected - due) <= self._grace_ns:
                return expected + self._grace_ns
        return due


def sooner_ns(due_ns: int, again_ns: int | None, now_ns: int) -> int:
    """When a step is due that was asked for again at a moment; a moment that is over asks for nothing."""
    return due_ns if again_ns is None or again_ns <= now_ns else min(due_ns, again_ns)
