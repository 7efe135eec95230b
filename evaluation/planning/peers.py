"""Other people's planners on the same scenarios, where they are installed; never a dependency of ours."""

from __future__ import annotations

from evaluation.planning.drivers import Alone

MODULES: dict[str, str] = {}
"""Planner's name and the module without which it is not there."""


def driver(name: str) -> Alone:
    """A peer, fresh for one drive."""
    raise KeyError(name)
