"""What every command shares: exit codes, one line that says what to do, results as files."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import typer
from rich.console import Console
from rich.markup import escape

from common.bus import NoRouterError
from common.config import ConfigError
from rig import report
from rig.launcher import LaunchError
from rig.stopping import StopRequest, stoppable
from rig.world import ScenarioError


@contextmanager
def exits(*, asked: bool = False) -> Iterator[None]:
    """Turn what may happen into exit codes and one line that says what to do; `asked`: being stopped is no failure."""
    try:
        with stoppable():
            yield
    except (ConfigError, ScenarioError) as e:
        say(f"[red]error[/] {escape(str(e))}")
        raise typer.Exit(2) from None
    except (LaunchError, NoRouterError) as e:
        say(f"[red]failed[/] {escape(str(e))}")
        raise typer.Exit(1) from None
    except StopRequest as e:
        say("stopped" if asked else f"stopped by {e}")
        raise typer.Exit(0 if asked else 128 + e.number) from None


def say(text: str) -> None:
    """One line for the person at the terminal (stderr)."""
    Console(stderr=True, soft_wrap=True, highlight=False).print(text)


def writable(option: str, path: Path | None) -> None:
    """Refuse a result file that cannot be written before the work begins."""
    if path is None:
        return
    if path.is_dir() or not path.absolute().parent.is_dir():
        raise ConfigError(f"{option} {path}: {'is a folder' if path.is_dir() else 'there is no such folder'}")
    if not os.access(path if path.exists() else path.absolute().parent, os.W_OK):
        raise ConfigError(f"{option} {path}: not writable")


def write(path: Path, result: dict[str, Any]) -> None:
    """Whole or not at all."""
    draft = path.with_name(f".{path.name}.{os.getpid()}")
    draft.write_text(json.dumps(report.finite(result), indent=1, allow_nan=False) + "\n")
    draft.replace(path)
