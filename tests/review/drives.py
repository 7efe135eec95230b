"""Recordings to review: drives in simulated time, made once for all tests of a session."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from tempfile import mkdtemp
from typing import Any

from rich.console import Console

from evaluation.review.command import review, write_page
from evaluation.review.simulated import record
from rig import configuration
from rig.sources import load_scenario

EVIL = "<script>alert(1)</script>"
"""A name of a scenario that a page must not take for markup."""


@dataclass(frozen=True)
class Made:
    """A recording, and what was measured of the drive while it was driven."""

    path: Path
    summary: dict[str, Any]
    modes: dict[str, float]


COARSE = (
    "riskfield.h=0.5",
    "riskfield.width=24",
    "riskfield.ahead=80",
    "planner.stations=48",
    "predictor.policy=map-first",
)
"""Cheap to compute; what a review reads is the same."""


@lru_cache(maxsize=4)
def made(name: str = "demo", seconds: float = 5.5, *settings: str) -> Made:
    """The first `seconds` of a built-in scenario, on a coarse grid."""
    folder = Path(mkdtemp(prefix="forefield-review-"))
    tree = configuration.load(None, [*COARSE, *settings])
    scenario = load_scenario(name, seed=0)
    scenario = replace(scenario, duration_s=min(seconds, scenario.duration_s))
    path = folder / "drive.rrd"
    result = record(scenario, path, tree, stack=False)
    return Made(path, result.summary, result.modes)


@lru_cache(maxsize=1)
def made_page() -> Path:
    """The page of that drive, under an evil name."""
    found = review(made().path)
    result = json.loads(json.dumps(found.result))
    result["summary"]["scenario"] = EVIL
    out = made().path.with_suffix(".html")
    write_page(replace(found, result=result), out, Console(quiet=True))
    return out
