"""The commands of recordings: view, repair, record, replay.

What they need beyond the bench (rerun-sdk, mcap) is imported only by the command that needs it.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.markup import escape

from common.config import ConfigError
from rig import viewing
from rig.exits import exits, say, writable


def register(app: typer.Typer) -> None:
    """Add the commands to the program."""
    app.command()(view)
    app.command()(repair)


def view(
    files: Annotated[list[Path] | None, typer.Argument(help="Recordings (.rrd); pieces of one drive together.")] = None,
    live: Annotated[bool, typer.Option("--live", help="Show what a running viz serves (run --live PORT).")] = False,
    connect: Annotated[str, typer.Option("--connect", help="Where it serves.", metavar="HOST:PORT")] = viewing.LIVE,
    web: Annotated[bool, typer.Option("--web", help="In a browser: serve the web viewer, print its address.")] = False,
    port: Annotated[int, typer.Option("--port", help="For --web; 0: a free one.", min=0, max=65535)] = 0,
) -> None:
    """Open recordings, or a running system, in the Rerun viewer."""
    with exits():
        found = viewing.viewing(files or (), live=live, connect=connect, web=web, port=port)
        if found.url:
            say("open this in a browser on this machine; Ctrl-C ends it:")
            print(found.url)
        sys.stdout.flush()
        sys.stderr.flush()
        os.execv(found.command[0], found.command)


def repair(
    file: Annotated[Path, typer.Argument(help="A recording that was cut off by a crash (.rrd or .mcap).")],
    out: Annotated[
        Path | None, typer.Option("--out", help="Write there; default: replace FILE.", metavar="OUT")
    ] = None,
) -> None:
    """Mend a recording whose writer was killed: cut off what is torn, write the index."""
    with exits():
        if not file.is_file():
            raise ConfigError(f"{file}: no such recording")
        target = out or file
        writable("--out", target)
        from viz.repair import RepairError
        from viz.repair import repair as mend

        try:
            done = mend(file, target)
        except RepairError as e:
            raise ConfigError(str(e)) from None
        if done.was_whole:
            say(f"{escape(str(file))} is whole: nothing to mend")
        else:
            say(f"{done.rows} rows kept, {done.lost_bytes} bytes at the end were torn")
        Console().print(str(target), soft_wrap=True, highlight=False, markup=False)
