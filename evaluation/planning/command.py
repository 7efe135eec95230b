"""`forefield eval planning`: choose, drive, summarise, with progress and the time still to go."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Protocol

from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.table import Table

from common import config
from common.config import ConfigError, Tree
from evaluation.planning import report, volume
from evaluation.planning.checkpoint import Checkpoint, identity
from evaluation.planning.choosing import choices, loaded, replaced_vehicles
from evaluation.planning.drivers import check
from evaluation.planning.engines import outcomes
from evaluation.planning.tasks import Task
from evaluation.planning.traffic import Kind
from evaluation.sumo_networks import TrafficError
from rig.settings import RigSettings

KEEP_EVERY_S = 30.0
"""A long run writes down what it has as often as this."""
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
    tracks: Sequence[str] = (),
    per_table: int = 10,
    sumo_km: float = 0.0,
    planners: Sequence[str] = ("default",),
    traffic: Kind | None = None,
    jobs: int = 1,
    cluster: str = "",
    seed: int = 0,
    console: Console | None = None,
    command: str = "",
    checkpoint: Path | None = None,
    keep: Callable[[dict[str, Any]], None] = lambda result: None,
) -> dict[str, Any]:
    """Drive everything and return the result as JSON wants it; `keep` gets what there is so far now and then.

    What stands in the file `checkpoint` is not driven again, and what is done is added to it.

    Raises:
        ConfigError: what is asked for cannot be: unknown planners, a folder without scenarios, no cluster; a checkpoint
            of another run.
    """
    console = console or Console(stderr=True)
    for planner in planners:
        check(planner)
    asked = [o for o, there in (("--scenarios", sources), ("--variants", variants), ("--tracks", tracks)) if there]
    asked += ["--sumo"] if sumo_km else []
    if len(asked) > 1:
        raise ConfigError(f"{' and '.join(asked)}: one of them at a time")
    planners = list(dict.fromkeys(planners))
    began = time.monotonic()
    what = (
        "sumo" if sumo_km else f"{'tracks' if tracks else 'variants' if variants else 'scenarios'}, {traffic} traffic"
    )
    done = Checkpoint(checkpoint, identity(tree, seed, what))
    if sumo_km:
        scenarios = _in_sumo(tree, planners, sumo_km, seed, jobs, done, console)
        return _result(command, seed, {}, scenarios, began)
    not_loaded: dict[str, str] = {}
    rig = config.section(tree, "rig", RigSettings)
    if tracks:
        worlds = replaced_vehicles(tracks, per_table, seed, rig, not_loaded.__setitem__)
        worlds = [w.with_traffic(traffic) for w in worlds]
    else:
        worlds = loaded(choices(sources, variants, seed), traffic, rig, not_loaded.__setitem__)
    for name, why in not_loaded.items():
        console.print(f"[red]not loaded[/] {name}: {escape(why)}", soft_wrap=True, highlight=False)
    if not worlds:
        raise ConfigError(f"none of the {len(not_loaded)} scenarios can be loaded")
    tasks = [
        Task(w.choice.name, w.choice.family, w.scenario, tuple(planners), tree, w.traffic, w.recorded_s) for w in worlds
    ]
    known = [done.of(task.name, planners) for task in tasks]
    found = {i: entries for i, entries in enumerate(known) if len(entries) == len(planners)}
    left = [i for i in range(len(tasks)) if i not in found]
    if found:
        console.print(f"{len(found)} of {len(tasks)} scenarios stand in {checkpoint}", highlight=False, soft_wrap=True)

    def result() -> dict[str, Any]:
        scenarios: dict[str, Entries] = {p: {} for p in planners}
        for i in sorted(found):
            for planner, entry in found[i].items():
                scenarios[planner][tasks[i].name] = entry
        return _result(command, seed, not_loaded, scenarios, began)

    kept = began
    with _progress(console, len(left)) as tell:
        for k, outcome in outcomes([tasks[i] for i in left], jobs=jobs, cluster=cluster):
            i = left[k]
            found[i] = outcome
            done.add(tasks[i].name, outcome)
            for planner, entry in outcome.items():
                wrong = report.wrong(entry)
                if wrong:
                    console.print(
                        f"{tasks[i].name} ({planner}): {wrong}", highlight=False, markup=False, soft_wrap=True
                    )
            tell(tasks[i].name)
            if time.monotonic() - kept >= KEEP_EVERY_S:
                kept = time.monotonic()
                keep(result())
    return result()


Entries = dict[str, dict[str, Any]]


def _result(
    command: str, seed: int, not_loaded: dict[str, str], scenarios: dict[str, Entries], began: float
) -> dict[str, Any]:
    return {
        "command": command,
        "seed": seed,
        "summary": {p: report.summary(entries) for p, entries in scenarios.items()},
        "not_loaded": not_loaded,
        "wall_s": round(time.monotonic() - began, 1),
        "scenarios": {p: {n: report.plain(e) for n, e in entries.items()} for p, entries in scenarios.items()},
    }


def _in_sumo(
    tree: Tree, planners: list[str], km: float, seed: int, jobs: int, done: Checkpoint, console: Console
) -> dict[str, Entries]:
    began, before = time.monotonic(), 0.0

    def tell(name: str, driven: float, new: bool) -> None:
        nonlocal before
        if not new:
            before = driven
            return
        share = (time.monotonic() - began) / max(driven - before, 1e-3)
        text = f"{driven:.2f}/{km:g} km, about {share * max(km - driven, 0.0):.0f} s left: {name}"
        console.print(text, highlight=False, markup=False)

    try:
        return volume.measure(tree, planners, km, seed, tell, jobs=jobs, done=done)
    except TrafficError as e:
        raise ConfigError(str(e)) from None


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
