"""A pytest plugin that makes one service's environment.

`FOREFIELD_TEST_ONLY=planner pytest -p tests.only tests/planner`

Packages of the other extras and the other services cannot be imported, as if they were not installed.
"""

from __future__ import annotations

import importlib.abc
import importlib.machinery
import os
import sys
from collections.abc import Sequence
from types import ModuleType

HEAVY = {"predictor": {"torch"}, "riskfield": {"warp"}, "planner": {"warp"}, "viz": {"rerun", "pyarrow"},
         "rig": {"typer", "rich", "commonroad", "commonroad_io", "shapely", "lxml"}}  # fmt: skip
OURS = {"predictor": {"services.predictor"}, "riskfield": {"services.riskfield"}, "planner": {"services.planner"},
        "viz": {"viz"}, "rig": {"rig", "evaluation"}}  # fmt: skip


class Blocker(importlib.abc.MetaPathFinder):
    """Refuses what belongs to others."""

    def __init__(self, only: str) -> None:
        mine = HEAVY[only] | OURS[only]
        self.refused = {m for table in (HEAVY, OURS) for ms in table.values() for m in ms} - mine

    def find_spec(
        self, name: str, path: Sequence[str] | None = None, target: ModuleType | None = None
    ) -> importlib.machinery.ModuleSpec | None:
        if any(name == m or name.startswith(m + ".") for m in self.refused):
            raise ModuleNotFoundError(f"No module named {name!r} (blocked: not of this service)", name=name)
        return None


def block(only: str) -> None:
    """Block everything that is not of `only`; nothing of it may have been imported before."""
    blocker = Blocker(only)
    early = [m for m in sys.modules if any(m == r or m.startswith(r + ".") for r in blocker.refused)]
    assert not early, f"imported too early to block: {early}"
    sys.meta_path.insert(0, blocker)


if os.environ.get("FOREFIELD_TEST_ONLY"):
    block(os.environ["FOREFIELD_TEST_ONLY"])
