"""`forefield eval hazards`: compare the alarms, write JSON and picture, or tune the thresholds again."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import msgspec
from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.table import Table

from common.config import ConfigError, Tree
from evaluation.hazards import report
from evaluation.hazards.watch import Cores
from evaluation.hazards.work import Work, usable_cores

TUNED_FILE = Path(__file__).with_name("tuned.json")
"""Where `--tune` writes, and what every run reads."""


def run(
    tree: Tree, *, seed: int, count: int, tune: bool, with_traffic: bool, jobs: int, console: Console
) -> dict[str, Any]:
    """The result as JSON wants it; progress goes to the console.

    Raises:
        ConfigError: the seed is the one that thresholds were tuned on, or they were tuned on other situations.
    """
    cores = Cores.of(tree)
    if seed == report.TUNING_SEED:
        raise ConfigError(f"--seed {seed}: thresholds were tuned on this one; choose another")
    with _progress(console) as progress:
        work = Work(jobs or usable_cores(), progress)
        if tune:
            found = report.tuned_again(cores, work)
            TUNED_FILE.write_bytes(msgspec.json.format(msgspec.json.encode(found), indent=1) + b"\n")
        tuned = report.stored()
        return report.measure(seed=seed, count=count, tuned=tuned, cores=cores, with_traffic=with_traffic, work=work)


def tables(result: dict[str, Any]) -> list[Table]:
    """The comparison, recorded traffic, and where the field was wrong, for the terminal."""
    found = [report.table(result), report.misses(result)]
    if result["traffic"] is not None:
        found.insert(1, report.traffic_table(result["traffic"]))
    return found


def draw(result: dict[str, Any], path: Path) -> None:
    """The comparison as a picture."""
    from evaluation.hazards.plot import plot

    plot(result, path)


def _progress(console: Console) -> Progress:
    """How far we are and how long it will still take; quiet where there is no terminal."""
    return Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TextColumn("still"),
        TimeRemainingColumn(),
        console=console,
        disable=not console.is_terminal,
    )
