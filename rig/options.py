"""Options that several commands share, and the group `eval`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

Config = Annotated[Path | None, typer.Option("--config", help="Configuration file (TOML).", metavar="FILE")]
Sets = Annotated[
    list[str] | None,
    typer.Option("--set", help="One setting, such as planner.max_speed=15; may be repeated.", metavar="KEY=VALUE"),
]
Json = Annotated[Path | None, typer.Option("--json", help="Write the result there.", metavar="OUT.json")]


def evaluations(app: typer.Typer) -> typer.Typer:
    """The group `eval`, to which several files add commands; made if there is none yet."""
    group = next((g.typer_instance for g in app.registered_groups if g.name == "eval"), None)
    if group is None:
        group = typer.Typer(help="Measurements: prediction, planning, danger seen in time.", no_args_is_help=True)
        app.add_typer(group, name="eval")
    return group
