"""The commands of the field's proof and pictures: eval hazards, figures.

What they need beyond the bench (matplotlib) is imported only by the command that needs it.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from common import config
from common.config import ConfigError
from rig import configuration
from rig.exits import exits, writable, write
from rig.options import Config, Json, Sets, evaluations


def register(app: typer.Typer) -> None:
    """Add the commands to the program."""
    evaluations(app).command("hazards")(eval_hazards)
    app.command("figures")(figures)


def eval_hazards(
    json_: Json = None,
    plot: Annotated[Path | None, typer.Option("--plot", help="Draw the comparison there.", metavar="OUT.png")] = None,
    seed: Annotated[int, typer.Option("--seed", help="Of the random variants.", min=0)] = 1,
    count: Annotated[int, typer.Option("--count", help="How many random variants.", min=24)] = 408,
    traffic: Annotated[
        bool, typer.Option("--traffic/--no-traffic", help="Count alarms in recorded traffic too ($FOREFIELD_DATA).")
    ] = True,
    tune: Annotated[bool, typer.Option("--tune", help="Tune every threshold again first.")] = False,
    jobs: Annotated[
        int, typer.Option("--jobs", help="Processes; 0: one for each core, at most 4. The result is the same.", min=0)
    ] = 0,
    config_: Config = None,
    set_: Sets = None,
) -> None:
    """Does it see danger? The field's alarms beside times to collision, on named and random situations."""
    from evaluation.hazards import command

    with exits():
        configuration.load(config_, set_ or [])  # names what cannot be used
        told = config.load(config_, set_ or [])  # defaults left out: the alarm has its own
        writable("--json", json_)
        writable("--plot", plot)
        result = command.run(
            told, seed=seed, count=count, tune=tune, with_traffic=traffic, jobs=jobs, console=Console(stderr=True)
        )
        if json_ is not None:
            write(json_, result)
        if plot is not None:
            command.draw(result, plot)
        for part in command.tables(result):
            Console().print(part)


def figures(
    out: Annotated[Path, typer.Option("--out", help="Folder for the files; made if need be.", metavar="DIR")],
    only: Annotated[list[str] | None, typer.Option("--only", help="Only this one; may be repeated.")] = None,
    svg: Annotated[bool, typer.Option("--svg", help="SVG instead of PNG.")] = False,
) -> None:
    """Draw the paper's figures of the field from our own."""
    from evaluation.figures import command

    with exits():
        if out.exists() and not out.is_dir():
            raise ConfigError(f"--out {out}: is a file, give a folder")
        try:
            written = command.write(out, only or (), svg=svg)
        except OSError as e:
            raise ConfigError(f"--out {out}: {e.strerror}") from None
        for path in written:
            Console().print(str(path), soft_wrap=True, highlight=False, markup=False)
