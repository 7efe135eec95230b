"""What each named manoeuvre must look like: one criterion each, judged from the world."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from evaluation.planning.recorder import Recorder
from rig.world import Scenario

Criterion = Callable[[Scenario, Recorder, dict[str, Any]], str]
"""Returns what is wrong, empty: nothing."""
CRITERIA: dict[str, Criterion] = {}


def judge(family: str, scenario: Scenario, record: Recorder, entry: dict[str, Any]) -> str:
    """What is wrong with a drive through this manoeuvre; empty: it passes."""
    if entry["collision_at_fault"]:
        return "a collision at fault"
    if entry["off_road"]:
        return f"{entry['off_road_m']} m off the road"
    check = CRITERIA.get(family)
    return check(scenario, record, entry) if check is not None else ("" if entry["goal"] else "the goal is not reached")
