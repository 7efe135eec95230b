"""The command of planning in closed loop: eval planning."""

from __future__ import annotations

import shlex
import sys
from pathlib import Path
from typing import Annotated, Literal

import typer
from rich.console import Console

from common.config import ConfigError
from rig import configuration
from rig.exits import exits, writable, write
from rig.options import Config, Json, Sets, evaluations

WIDTH = 170
"""Narrower tables would cut the figures off."""


def register(app: typer.Typer) -> None:
    """Add the command to the program."""
    evaluations(app).command("planning")(eval_planning)


def eval_planning(
    scenarios: Annotated[
        list[str] | None,
        typer.Option(
            "--scenarios",
            help="Names, files (.xml, .csv[.gz][#REC[:TRACK]]) or folders; default: every built-in one.",
            metavar="DIR|FILES|NAMES …",
            show_default=False,
        ),
    ] = None,
    more: Annotated[list[str] | None, typer.Argument(help="More scenarios.", show_default=False)] = None,
    variants: Annotated[int, typer.Option("--variants", help="So many random variants of the named ones.", min=0)] = 0,
    tracks: Annotated[
        list[str] | None,
        typer.Option(
            "--tracks",
            help="Trajectory tables: recorded vehicles are replaced by the ego, one after another.",
            metavar="FILE",
            show_default=False,
        ),
    ] = None,
    per_table: Annotated[int, typer.Option("--per-table", help="Vehicles of each table.", min=1)] = 10,
    sumo: Annotated[float, typer.Option("--sumo", help="Drive so many kilometres in SUMO.", metavar="KM", min=0)] = 0.0,
    planner: Annotated[
        list[str] | None,
        typer.Option(
            "--planner",
            help="default, paper, current-only, idm, commonroad-reactive, frenetix; may be repeated.",
            show_default="default",
        ),
    ] = None,
    predictor: Annotated[
        str | None, typer.Option("--predictor", help="Policy of the predictor: paper, learned-first, …")
    ] = None,
    traffic: Annotated[
        Literal["replay", "reactive"] | None,
        typer.Option("--traffic", help="How the others move; default: reactive, but for the two crossings."),
    ] = None,
    jobs: Annotated[int, typer.Option("--jobs", help="Processes on this machine.", min=1, max=256)] = 1,
    cluster: Annotated[
        str, typer.Option("--cluster", help="A Dask scheduler that computes the drives.", metavar="ADDRESS")
    ] = "",
    checkpoint: Annotated[
        Path | None,
        typer.Option(
            "--checkpoint",
            help="Keep every finished drive there; with the same command a run that was stopped goes on.",
            metavar="FILE.jsonl",
        ),
    ] = None,
    seed: Annotated[int, typer.Option("--seed", help="Varies named scenarios; draws the variants.", min=0)] = 0,
    json_: Json = None,
    html: Annotated[Path | None, typer.Option("--html", help="Write tables as one page.", metavar="OUT.html")] = None,
    markdown: Annotated[
        Path | None, typer.Option("--markdown", help="Write the summary and what went wrong.", metavar="OUT.md")
    ] = None,
    config_: Config = None,
    set_: Sets = None,
) -> None:
    """Does it drive well? Closed loop in simulated time, without the bus, beside other planners."""
    from evaluation.planning import command, report

    with exits():
        settings = list(set_ or [])
        if predictor is not None:
            settings.append(f"predictor.policy={predictor}")
        tree = configuration.load(config_, settings)
        writable("--json", json_)
        writable("--checkpoint", checkpoint)
        writable("--html", html)
        writable("--markdown", markdown)
        if cluster and jobs > 1:
            raise ConfigError("--jobs is for this machine, --cluster for others: one of them")
        result = command.run(
            tree,
            sources=[*(scenarios or []), *(more or [])],
            variants=variants,
            tracks=tracks or [],
            per_table=per_table,
            sumo_km=sumo,
            planners=planner or ["default"],
            traffic=traffic,
            jobs=jobs,
            cluster=cluster,
            seed=seed,
            checkpoint=checkpoint,
            console=Console(stderr=True),
            command=shlex.join(["forefield", *sys.argv[1:]]),
            keep=lambda result: write(json_, result) if json_ is not None else None,
        )
        if json_ is not None:
            write(json_, result)
        if html is not None:
            html.write_text(report.page(result), encoding="utf-8")
        if markdown is not None:
            markdown.write_text(report.markdown(result), encoding="utf-8")
        console = Console(width=None if sys.stdout.isatty() else WIDTH)
        for part in command.tables(result):
            console.print(part)
        if any(s["errors"] for s in result["summary"].values()):
            raise typer.Exit(1)
