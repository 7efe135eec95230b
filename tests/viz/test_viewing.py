"""`forefield view` finds what is to be shown, says what is missing, and serves the web viewer over a real process."""

from __future__ import annotations

import contextlib
import signal
import socket
import subprocess
import sys
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import parse_qs, urlparse

import pytest

pytest.importorskip("rerun")

import common
from common.bus import free_port
from common.config import ConfigError
from rig.viewing import viewing
from tests.processes import group, remains
from tests.viz import synthetic
from tests.viz.reading import record
from tests.waiting import until
from viz.blueprint import blueprint
from viz.settings import VizSettings
from viz.sinks import recording

ROOT = Path(common.__file__).parent.parent


def answers(port: int) -> bool:
    try:
        socket.create_connection(("127.0.0.1", port), timeout=1).close()
    except OSError:
        return False
    return True


def page(url: str) -> bytes:
    with urllib.request.urlopen(url, timeout=5) as reply:
        return reply.read()


@pytest.mark.parametrize(
    ("files", "live", "connect", "said"),
    [
        ([], False, "127.0.0.1:1", "either a recording"),
        ([Path("a.rrd")], True, "127.0.0.1:1", "either a recording"),
        ([Path("/nowhere/a.rrd")], False, "", "no such recording"),
        ([], True, "127.0.0.1:1", "nobody serves"),
        ([], True, "localhost", "HOST:PORT"),
    ],
)
def test_what_cannot_be_shown_is_named(files, live, connect, said):
    with pytest.raises(ConfigError, match=said):
        viewing(files, live=live, connect=connect, web=False)


def test_pieces_of_a_drive_are_shown_together(tmp_path):
    pieces = [tmp_path / "a.rrd", tmp_path / "b.rrd"]
    for piece in pieces:
        piece.touch()
    shown = viewing(pieces, live=False, connect="", web=False)
    assert shown.command[-2:] == [str(p) for p in pieces] and not shown.url


@contextlib.contextmanager
def served(*arguments: str) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """`forefield view` and the address it prints; whatever happens to the test, nothing of it stays."""
    with group([sys.executable, "-m", "rig.command", "view", *arguments], cwd=ROOT, stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        yield process, until(process.stdout.readline, within_s=60, what="an address").strip()


@pytest.mark.parametrize("live", [False, True])
def test_the_web_viewer_is_served_on_loopback_with_an_address_that_finds_the_data(tmp_path, live):
    drive = synthetic.Drive(rows=64, columns=32, h=1.25)
    port = free_port()
    settings = VizSettings(serve=port)
    with recording(settings, "live", blueprint()):
        arguments = (
            ["--live", "--connect", f"127.0.0.1:{port}"] if live else [str(record(tmp_path / "a.rrd", drive, 2))]
        )
        with served("--web", *arguments) as (_, url):
            where = urlparse(url)
            assert where.hostname == "127.0.0.1" and where.port is not None
            until(lambda: answers(where.port), within_s=60, every_s=0.1, what="the web server")
            assert b"<html" in page(f"http://127.0.0.1:{where.port}/").lower()
            (source,) = parse_qs(where.query)["url"]
            data = urlparse(source.replace("rerun+http", "http"))
            assert data.path == "/proxy" and data.port is not None
            until(lambda: answers(data.port), within_s=60, every_s=0.1, what="the data")
            assert (data.port == port) is live


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGKILL])
def test_whatever_ends_the_command_ends_its_viewer_too(tmp_path, number):
    drive = record(tmp_path / "a.rrd", synthetic.Drive(rows=64, columns=32, h=1.25), 2)
    with served("--web", str(drive)) as (process, url):
        port = urlparse(url).port
        assert port is not None
        until(lambda: answers(port), within_s=60, every_s=0.1, what="the web server")
        assert remains(process)
        process.send_signal(number)
        assert process.wait(60) == -number
        until(lambda: not remains(process), what="the end of all of it")
        assert not answers(port)
