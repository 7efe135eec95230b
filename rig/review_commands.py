"""The commands after a drive: review, compare.

What they need beyond the bench (rerun-sdk, matplotlib, Jinja) is imported only by the command that needs it.
"""

from __future__ import annotations

import importlib.util
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.markup import escape

from common.config import ConfigError
from rig.exits import exits, say, writable, write
from rig.options import Json

NEEDS = ("rerun", "matplotlib", "jinja2")


def register(app: typer.Typer) -> None:
    """Add the commands to the program."""
    app.command("review")(review)
    app.command("compare")(compare)


def review(
    files: Annotated[
        list[Path],
        typer.Argument(
            help="A recording, as `forefield run --record` writes it, or all its pieces.", metavar="RUN.rrd …"
        ),
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
            html = files[0].with_suffix(".review.html")
        writable("--html", html)
        writable("--json", json_)
        console = Console()
        try:
            found = command.review(*sorted(set(files), key=_piece))
            if json_ is not None:
                write(json_, found.result)
            if html is not None:
                command.write_page(found, html, Console(stderr=True))
        except ReviewError as e:
            raise ConfigError(str(e)) from None
        console.print(command.table(found.result))
        for further in _further(files):
            say(f"[yellow]warning[/] {escape(str(further))} goes on with it: name all pieces to review them together")
        if html is not None:
            say(f"open the review in a browser:  {escape(str(html))}")


def _piece(path: Path) -> tuple[str, str]:
    """Pieces of one recording in their order: RUN.rrd, RUN.0002.rrd, …"""
    stem, dot, number = path.stem.rpartition(".")
    return (str(path.parent / stem), number) if dot and number.isdigit() else (str(path.parent / path.stem), "")


def _further(files: list[Path]) -> list[Path]:
    """The piece that follows those given, if it lies beside them."""
    last = sorted(files, key=_piece)[-1]
    base, number = _piece(last)
    following = Path(f"{base}.{int(number or 1) + 1:04d}{last.suffix}")
    return [following] if following.is_file() else []


def compare(
    a: Annotated[Path, typer.Argument(help="A recording.", metavar="A.rrd")],
    b: Annotated[Path, typer.Argument(help="Another one, of the same scenario.", metavar="B.rrd")],
    out: Annotated[
        Path | None, typer.Option("--out", help="Write both, side by side, for the viewer.", metavar="BOTH.rrd")
    ] = None,
    json_: Json = None,
) -> None:
    """What changed between two runs? A table, and one recording that shows both at once."""
    with exits():
        _needs("compare")
        from evaluation.review import both, command
        from evaluation.review import compare as comparison
        from evaluation.review.tables import ReviewError

        writable("--out", out)
        writable("--json", json_)
        if out is not None and out.suffix != ".rrd":
            raise ConfigError(f"--out {out}: the name of a Rerun recording ends in .rrd")
        if out is not None and out.absolute() in (a.absolute(), b.absolute()):
            raise ConfigError(f"--out {out}: is one of the recordings to compare; choose another name")
        try:
            reviews = command.review(a), command.review(b)
            found = comparison.compare(*reviews)
            if json_ is not None:
                write(json_, found)
            if out is not None:
                both.write(*reviews, found, out)
        except ReviewError as e:
            raise ConfigError(str(e)) from None
        if not found["same_scenario"]:
            said = " and ".join(repr(found["scenario"][k]) for k in "ab")
            say(f"[yellow]warning[/] {escape(said)} are different scenarios: what differs may be the road")
        for table in comparison.tables(found):
            Console().print(table)
        if out is not None:
            say(f"open both side by side:  forefield view {escape(str(out))}")


def _needs(name: str) -> None:
    missing = [module for module in NEEDS if importlib.util.find_spec(module) is None]
    if missing:
        raise ConfigError(f"{name} needs {', '.join(missing)}: pip install 'forefield[review]'")
