"""The command that measures the planner: bench planner."""

from __future__ import annotations

from typing import Annotated

import typer
from rich.console import Console

from rig import configuration
from rig.exits import exits, writable, write
from rig.options import Config, Json, Sets


def register(bench: typer.Typer) -> None:
    """Add the command to the benchmarks."""
    bench.command("planner")(bench_planner)


def bench_planner(
    json_: Json = None,
    objects: Annotated[int, typer.Option("--objects", help="Road users in the scene.", min=0, max=1024)] = 32,
    rounds: Annotated[int, typer.Option("--rounds", help="Runs of each rival.", min=3)] = 60,
    cycles: Annotated[int, typer.Option("--cycles", help="Whole cycles to measure.", min=10)] = 200,
    config_: Config = None,
    set_: Sets = None,
) -> None:
    """How fast is the planner? 256 candidates beside a NumPy gather and frenetix if installed, and the whole cycle."""
    from evaluation import bench_planner as measuring

    with exits():
        tree = configuration.load(config_, set_ or [])
        writable("--json", json_)
        result = measuring.measure(tree, objects=objects, rounds=rounds, cycles=cycles)
        if json_ is not None:
            write(json_, result)
        Console().print(measuring.table(result), highlight=False)
