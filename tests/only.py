"""A pytest plugin that makes one service's environment.

`FOREFIELD_TEST_ONLY=planner pytest -p tests.only tests/planner`

Packages of the other extras and the other services cannot be imported, as if they were not installed. What is proven
here is that nothing else is needed: properties are tried on a few examples, and what is marked `long` is left out, for
both run in full in the tests' usual environment.
"""

from __future__ import annotations

import importlib.abc
import importlib.machinery
import os
import sys
from collections.abc import Sequence
from types import ModuleType

import pytest
from hypothesis import settings

EXAMPLES = 10
"""Of each property."""
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


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Leave out what is long and make properties short."""
    config.hook.pytest_deselected(items=[item for item in items if item.get_closest_marker("long")])
    items[:] = [item for item in items if not item.get_closest_marker("long")]
    for item in items:
        test = getattr(item, "obj", None)
        if getattr(test, "is_hypothesis_test", False):
            full = test._hypothesis_internal_use_settings
            test._hypothesis_internal_use_settings = settings(full, max_examples=min(EXAMPLES, full.max_examples))


if os.environ.get("FOREFIELD_TEST_ONLY"):
    block(os.environ["FOREFIELD_TEST_ONLY"])
