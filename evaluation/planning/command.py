"""`forefield eval planning`: choose, drive, summarise, with progress and the time still to go."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any, Protocol

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.table import Table

from common import config
from common.config import ConfigError, Tree
from evaluation.planning import report
from evaluation.planning.choosing import choices, loaded
from evaluation.planning.drivers import known
from evaluation.planning.engines import outcomes
from evaluation.planning.tasks import Task
from evaluation.planning.traffic import Kind
from rig.settings import RigSettings

TELL_EVERY_S = 20.0
"""Where there is no terminal, a line as often as this."""


class Tell(Protocol):
    """Says how far the work is."""

    def __call__(self, text: str) -> None:
        """One more is done."""


def run(
    tree: Tree,
    *,
    sources: Sequence[str] = (),
    variants: int = 0,
    planners: Sequence[str] = ("default",),
    traffic: Kind | None = None,
    jobs: int = 1,
    cluster: str = "",
    seed: int = 0,
    console: Console | None = None,
    command: str = "",
) -> dict[str, Any]:
    """Drive everything and return the result as JSON wants it.

    Raises:
        ConfigError: what is asked for cannot be: unknown planners, a folder without scenarios, no cluster.
    """
    console = console or Console(stderr=True)
    unknown = [p for p in planners if p not in known()]
    if unknown:
        raise ConfigError(f"--planner {unknown[0]!r}: there are {', '.join(known())}")
    if sources and variants:
        raise ConfigError("--variants draws from the named scenarios: leave --scenarios out")
    chosen = choices(sources, variants, seed)
    not_loaded: dict[str, str] = {}
    worlds = loaded(chosen, traffic, config.section(tree, "rig", RigSettings), not_loaded.__setitem__)
    for name, why in not_loaded.items():
        console.print(f"[red]not loaded[/] {name}: {why}", soft_wrap=True, highlight=False)
    if not worlds:
        raise ConfigError(f"none of the {len(chosen)} scenarios can be loaded")
    tasks = [
        Task(w.choice.name, w.choice.family, w.scenario, tuple(dict.fromkeys(planners)), tree, w.traffic)
        for w in worlds
    ]
    began = time.monotonic()
    found: list[dict[str, dict[str, Any]]] = [{} for _ in tasks]
    with _progress(console, len(tasks)) as tell:
        for i, outcome in outcomes(tasks, jobs=jobs, cluster=cluster):
            found[i] = outcome
            for planner, entry in outcome.items():
                wrong = report.wrong(entry)
                if wrong:
                    console.print(
                        f"{tasks[i].name} ({planner}): {wrong}", highlight=False, markup=False, soft_wrap=True
                    )
            tell(tasks[i].name)
    scenarios: dict[str, dict[str, Any]] = {p: {} for p in dict.fromkeys(planners)}
    for task, outcome in zip(tasks, found, strict=True):
        for planner, entry in outcome.items():
            scenarios[planner][task.name] = entry
    return {
        "command": command,
        "seed": seed,
        "summary": {p: report.summary(entries) for p, entries in scenarios.items()},
        "not_loaded": not_loaded,
        "wall_s": round(time.monotonic() - began, 1),
        "scenarios": {p: {n: report.plain(e) for n, e in entries.items()} for p, entries in scenarios.items()},
    }


def tables(result: dict[str, Any]) -> list[Table]:
    """The summary, then each drive where they are few, otherwise those with something to explain."""
    parts = [report.summary_table(result)]
    for planner, entries in result["scenarios"].items():
        table = report.drives_table(planner, entries, only_failures=len(entries) > 60)
        if table is not None:
            parts.append(table)
    return parts


@contextmanager
def _progress(console: Console, total: int) -> Iterator[Tell]:
    if not console.is_terminal:
        began = told = time.monotonic()
        done = 0

        def line(text: str) -> None:
            nonlocal done, told
            done += 1
            now = time.monotonic()
            if now - told >= TELL_EVERY_S or done == total:
                told = now
                left = (now - began) / done * (total - done)
                console.print(
                    f"{done}/{total} scenarios, about {left:.0f} s left: {text}", highlight=False, markup=False
                )

        yield line
        return
    columns = (
        TextColumn("driving"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), TextColumn("left"),
        TimeRemainingColumn(), TextColumn("{task.description}"),
    )  # fmt: skip
    with Progress(*columns, console=console) as bar:
        task = bar.add_task("", total=total)

        def tell(text: str) -> None:
            bar.update(task, advance=1, description=text)

        yield tell
