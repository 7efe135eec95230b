"""The commands after a drive: review, compare.

What they need beyond the bench (rerun-sdk, matplotlib, Jinja) is imported only by the command that needs it.
"""

from __future__ import annotations

import importlib.util
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from common.config import ConfigError
from rig.exits import exits, say, writable, write

NEEDS = ("rerun", "matplotlib", "jinja2")
Json = Annotated[Path | None, typer.Option("--json", help="Write the result there.", metavar="OUT.json")]


def register(app: typer.Typer) -> None:
    """Add the commands to the program."""
    app.command("review")(review)


def review(
    file: Annotated[
        Path, typer.Argument(help="A recording, as `forefield run --record` writes it.", metavar="RUN.rrd")
    ],
    html: Annotated[
        Path | None,
        typer.Option(
            "--html", help="Write the page there; default, without --json: RUN.review.html.", metavar="OUT.html"
        ),
    ] = None,
    json_: Json = None,
) -> None:
    """Why did it slow down? Reads a recording back and writes one page that answers."""
    with exits():
        _needs("review")
        from evaluation.review import command
        from evaluation.review.tables import ReviewError

        if html is None and json_ is None:
            html = file.with_suffix(".review.html")
        writable("--html", html)
        writable("--json", json_)
        console = Console()
        try:
            found = command.review(file)
            if json_ is not None:
                write(json_, found.result)
            if html is not None:
                command.write_page(found, html, Console(stderr=True))
        except ReviewError as e:
            raise ConfigError(str(e)) from None
        console.print(command.table(found.result))
        if html is not None:
            say(f"open the review in a browser:  {html}")


def _needs(name: str) -> None:
    missing = [module for module in NEEDS if importlib.util.find_spec(module) is None]
    if missing:
        raise ConfigError(f"{name} needs {', '.join(missing)}: pip install 'forefield[review]'")
