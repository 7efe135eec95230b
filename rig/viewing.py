"""What `forefield view` runs: Rerun's viewer on files, on a live server, natively or in a browser."""

from __future__ import annotations

import importlib.util
import os
import socket
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import quote

from common.bus import free_port
from common.config import ConfigError

LIVE = "127.0.0.1:9876"
"""Where `forefield run --live 9876` serves."""
REACH_S = 3.0


@dataclass(frozen=True)
class Viewing:
    """A command to become, and what to tell the person before."""

    command: list[str]
    url: str = ""
    """Address for a browser; empty: the viewer opens by itself."""


def viewing(files: Sequence[Path], *, live: bool, connect: str, web: bool, port: int = 0) -> Viewing:
    """Choose how to show recordings or what is served live.

    Args:
        files: recordings; several pieces of one drive are shown as one.
        live: show what is served at `connect` instead.
        connect: `HOST:PORT` of viz' server.
        web: in a browser, from a server on loopback.
        port: of that server; 0: a free one.

    Raises:
        ConfigError: neither or both are given, a file is missing, nobody serves, the viewer is not installed.
    """
    if live == bool(files):
        raise ConfigError("give either a recording (forefield view FILE.rrd) or --live")
    if importlib.util.find_spec("rerun") is None:
        raise ConfigError("the viewer comes with rerun-sdk: pip install 'forefield[viz]'")
    for file in files:
        if not file.is_file():
            raise ConfigError(f"{file}: no such recording; `forefield run --scenario demo --record {file}` makes one")
    rerun = viewer()
    if live:
        source = _reached(connect)
        if not web:
            return Viewing([*rerun, "--connect", source])
        port = port or free_port()
        return Viewing([*rerun, *_web(port), source], _url(port, source))
    if not web:
        return Viewing([*rerun, *map(str, files)])
    port, data = port or free_port(), free_port()
    source = f"rerun+http://127.0.0.1:{data}/proxy"
    return Viewing([*rerun, *_web(port), "--port", str(data), *map(str, files)], _url(port, source))


def viewer() -> list[str]:
    """The viewer's command.

    The program itself where the package has it: its Python launcher would run it as a child, which outlives a launcher
    that is ended by SIGTERM or SIGKILL.
    """
    chosen = os.environ.get("RERUN_CLI_PATH", "")  # as the launcher does
    package = importlib.util.find_spec("rerun_cli")
    bundled = None if package is None or package.origin is None else Path(package.origin).with_name("rerun")
    for program in (chosen, bundled):
        if program and Path(program).is_file():
            return [str(program)]
    return [sys.executable, "-m", "rerun"]


def _web(port: int) -> list[str]:
    return ["--serve-web", "--bind", "127.0.0.1", "--web-viewer-port", str(port), "--hide-welcome-screen"]


def _url(port: int, source: str) -> str:
    return f"http://127.0.0.1:{port}/?url={quote(source, safe='')}"


def _reached(connect: str) -> str:
    host, colon, port = connect.rpartition(":")
    if not colon or not port.isdigit():
        raise ConfigError(f"--connect {connect!r}: write HOST:PORT, such as {LIVE}")
    try:
        socket.create_connection((host, int(port)), timeout=REACH_S).close()
    except (OSError, OverflowError) as e:
        raise ConfigError(
            f"nobody serves at {connect} ({e}): start with `forefield run --live {port} …` or set viz.serve={port}"
        ) from None
    return f"rerun+http://{connect}/proxy"
