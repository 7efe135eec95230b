"""What a peer's script runs on its own Python: answers to JSON lines, with nothing but the standard library.

`driver.py` says what the lines hold. Whatever the peer prints goes to its standard error, so that it disturbs nobody.
"""

from __future__ import annotations

import json
import os
import sys
import time
from collections.abc import Callable
from typing import Any, Protocol

Line = dict[str, Any]


class NoTrajectoryError(Exception):
    """The planner found nothing that it may drive; the message says why, in words that can be counted."""


class PeerPlanner(Protocol):
    """One drive's planner."""

    name: str
    period_s: float

    def plan(self, asked: Line) -> Line:
        """A trajectory of the rectangle's centre.

        Raises:
            NoTrajectoryError: there is none.
        """
        ...


def serve(make: Callable[[Line], PeerPlanner]) -> None:
    """Answer until the input ends; `make` builds a planner from the line that starts a drive."""
    replies = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)
    planner: PeerPlanner | None = None
    for line in sys.stdin:
        asked = json.loads(line)
        began = time.perf_counter()
        try:
            if asked["do"] == "start":
                planner = make(asked)
                answer: Line = {"name": planner.name, "period_s": planner.period_s}
            else:
                assert planner is not None
                answer = planner.plan(asked)
        except NoTrajectoryError as e:
            answer = {"none": str(e)}
        except Exception as e:  # whatever goes wrong in a peer is told, and the next cycle may be better
            answer = {"error": f"{type(e).__name__}: {e}"}
        answer["ms"] = 1e3 * (time.perf_counter() - began)
        replies.write(json.dumps(answer) + "\n")
        replies.flush()
