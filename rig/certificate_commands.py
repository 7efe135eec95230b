"""The command of the secured profile: certs."""

from __future__ import annotations

import datetime
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from common.access import ROUTER
from common.config import ConfigError
from rig.exits import exits


def register(app: typer.Typer) -> None:
    """Add the command to the program."""
    app.command("certs")(certs)


def certs(
    out: Annotated[Path, typer.Argument(help="Folder to write into.", show_default=False)],
    vehicle: Annotated[str, typer.Option("--vehicle", help="Name of the vehicle, part of every name.")] = "ego",
    days: Annotated[int, typer.Option("--days", help="How long they are valid.", min=1, max=3650)] = 30,
    host: Annotated[
        list[str] | None,
        typer.Option("--host", help="Name or address by which the router is reached; may be repeated.", metavar="HOST"),
    ] = None,
    ca: Annotated[
        Path | None,
        typer.Option("--ca", help="Sign with this authority (OUT/ca of an earlier call).", metavar="FOLDER"),
    ] = None,
    owner: Annotated[
        int | None,
        typer.Option(
            "--owner", help="Give the files to this user id; 10001 is that of the images.", min=0, metavar="UID"
        ),
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Replace what stands there.")] = False,
) -> None:
    """Make a bench's certificate authority and a certificate for each process of one vehicle."""
    with exits():
        try:
            from rig import certificates
        except ModuleNotFoundError:
            raise ConfigError("certificates need the package cryptography: pip install 'forefield[rig]'") from None
        made = certificates.make(
            out, vehicle, datetime.timedelta(days=days), hosts=host or (), ca=ca, owner=owner, force=force
        )
        table = Table(title=f"Certificates of vehicle {escape(vehicle)}")
        table.add_column("folder", overflow="fold")
        table.add_column("common name", no_wrap=True)
        table.add_column("expires", no_wrap=True)
        for one in made:
            table.add_row(escape(str(one.folder)), escape(one.common_name), f"{one.expires:%Y-%m-%d %H:%M} UTC")
        console = Console()
        console.print(table)
        if ca is None:
            console.print(
                f"{out / 'ca' / 'key.pem'} signs all of them: keep it off the vehicle.", markup=False, soft_wrap=True
            )
        console.print(
            f"The router takes its folder: python -m common.router --secure {out / ROUTER}; every other process names\n"
            "the three files of its own in [bus.tls] and connects to tls/…; in containers compose.secure.yaml does it.",
            markup=False,
            soft_wrap=True,
        )
