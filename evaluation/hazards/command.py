"""`forefield eval hazards`: compare the alarms, write JSON and picture, or tune the thresholds again."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import msgspec
from rich.console import Console
from rich.status import Status
from rich.table import Table

from common.config import ConfigError, Tree
from evaluation.hazards import report
from evaluation.hazards.watch import Cores

TUNED_FILE = Path(__file__).with_name("tuned.json")
"""Where `--tune` writes, and what every run reads."""


def run(tree: Tree, *, seed: int, count: int, tune: bool, with_traffic: bool, console: Console) -> dict[str, Any]:
    """The result as JSON wants it.

    Raises:
        ConfigError: the seed is the one that thresholds were tuned on, or they were tuned on other situations.
    """
    cores = Cores.of(tree)
    with _saying(console) as say:
        if tune:
            found = report.tuned_again(cores, say)
            TUNED_FILE.write_bytes(msgspec.json.format(msgspec.json.encode(found), indent=1) + b"\n")
        tuned = report.stored()
        if seed == tuned.seed:
            raise ConfigError(f"--seed {seed}: thresholds were tuned on this one; choose another")
        return report.measure(seed=seed, count=count, tuned=tuned, cores=cores, with_traffic=with_traffic, say=say)


def tables(result: dict[str, Any]) -> list[Table]:
    """The comparison and where the field was wrong, for the terminal."""
    return [report.table(result), report.misses(result)]


def draw(result: dict[str, Any], path: Path) -> None:
    """The comparison as a picture."""
    from evaluation.hazards.plot import plot

    plot(result, path)


@contextmanager
def _saying(console: Console) -> Iterator[report.Say]:
    """A function that shows how far we are; quiet where there is no terminal."""
    if not console.is_terminal:
        yield lambda _: None
        return
    with Status("situations", console=console) as status:
        yield status.update
