"""Every slow-down and stop of a drive, and why: the one definition, for a run as it is driven and for its recording.

The reason of an intervention is the one in force while most of the speed was lost.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from common.messages import F64, Decision, Plan
from rig.comfort import GRID_S

DROP_MPS = 1.0  # m/s, a slow-down worth explaining …
DROP_WITHIN_S = 2.0  # s, … within this
STOP_MPS = 0.1  # m/s, slower is a stop …
MOVING_MPS = 0.5  # m/s, … for one who moved at least this fast


@dataclass(frozen=True)
class Reason:
    """Why the vehicle drives as it does, as the plan in force says."""

    mode: str
    sentence: str
    source_id: int | None = None
    term: str | None = None
    slice_s: float | None = None

    @staticmethod
    def of(mode: str, reason: str, decision: Decision | None) -> Reason:
        """What decided; in a mode other than `drive` the mode's own reason."""
        if decision is None:
            return Reason(mode, reason)
        sentence = decision.sentence if mode == "drive" else reason
        return Reason(mode, sentence, decision.source_id, decision.term, decision.slice_s)


SILENCE = Reason("waiting", "no plan")
"""Nobody said anything."""


def reason_of(plan: Plan | None) -> Reason | None:
    """The reason that a plan gives; None without one."""
    return None if plan is None else Reason.of(plan.mode, plan.reason, plan.decision)


@dataclass(frozen=True)
class Intervention:
    """One slow-down or stop. Times count as those given to `interventions` [s]; speeds in m/s."""

    t: float
    until: float
    kind: str
    """`slow` or `stop`."""
    speed_from: float
    speed_to: float
    reason: Reason
    since: float
    """When this reason was first in force within it."""

    def as_dict(self) -> dict[str, Any]:
        """As a run's report and a review tell it."""
        why = self.reason
        return {
            "t": round(self.t, 2),
            "kind": self.kind,
            "source_id": why.source_id,
            "term": why.term,
            "slice_s": why.slice_s,
            "speed_from": round(self.speed_from, 2),
            "speed_to": round(self.speed_to, 2),
            "until": round(self.until, 2),
            "since": round(self.since, 2),
            "mode": why.mode,
            "sentence": why.sentence,
        }


def interventions(
    t: F64, v: F64, times: npt.ArrayLike, reasons: Sequence[Reason | None]
) -> list[Intervention]:  # fmt: skip
    """Every slow-down of a drive, explained.

    Args:
        t: grid of time, GRID_S apart [s].
        v: driven speed there [m/s].
        times: when each state of the drive was observed, increasing [s].
        reasons: the reason in force at each of them.
    """
    seen = np.asarray(times, dtype=np.float64)
    return [_explained(t, v, seen, reasons, *episode) for episode in slow_downs(t, v)]


def _explained(t: F64, v: F64, times: F64, reasons: Sequence[Reason | None], i0: int, i1: int) -> Intervention:
    lost: dict[tuple[str, int | None, str | None], float] = {}
    first: dict[tuple[str, int | None, str | None], tuple[float, Reason]] = {}
    for i in range(i0, i1):
        reason = reasons[int(np.searchsorted(times, t[i] + 1e-9, side="right")) - 1] or SILENCE
        key = (reason.mode, reason.source_id, reason.term)
        lost[key] = lost.get(key, 0.0) + max(0.0, float(v[i] - v[i + 1]))
        first.setdefault(key, (float(t[i]), reason))
    since, why = first[max(lost, key=lambda k: lost[k])]
    return Intervention(
        t=float(t[i0]),
        until=float(t[i1]),
        kind="stop" if v[i1] < STOP_MPS else "slow",
        speed_from=float(v[i0]),
        speed_to=float(v[i1]),
        reason=why,
        since=since,
    )


def slow_downs(t: F64, v: F64) -> list[tuple[int, int]]:
    """First and last index of every slow-down: a drop of ≥ 1 m/s within 2 s, or coming to a stop.

    It starts at the highest speed of the 2 s before the drop shows, and lasts until the speed has risen by 0.3 m/s
    over its lowest or has not fallen for 2 s.
    """
    window = round(DROP_WITHIN_S / GRID_S)
    found: list[tuple[int, int]] = []
    start, moved = 0, False  # earliest index that may start the next one; has moved since the last stop
    i = 0
    while i < len(v):
        low = max(start, i - window)
        top = low + int(np.argmax(v[low : i + 1][::-1]))
        top = i - (top - low)  # the last of equal maxima
        moved = moved or v[i] > MOVING_MPS
        stops = moved and v[i] < STOP_MPS
        if v[top] - v[i] < DROP_MPS and not stops:
            i += 1
            continue
        if stops and v[top] - v[i] < DROP_MPS:
            top = start + int(np.flatnonzero(v[start : i + 1] >= MOVING_MPS)[-1]) if moved else top
        end = i
        for k in range(i, len(v)):
            if v[k] < v[end] - 1e-3:
                end = k
            if v[k] > v[end] + 0.3 or k - end >= window:
                break
        found.append((top, end))
        start, i = end, end + 1
        moved = bool(v[end] > MOVING_MPS)
    return [(a, b) for a, b in found if b > a]
