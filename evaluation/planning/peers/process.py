"""A peer's process: one JSON line asked, one answered.

The peer's Python is named by `FOREFIELD_PEERS`; it needs the peers' packages and nothing of ours. Lines asked:

- `{"do": "start", "route": [[x, y] …], "lanes": [{"id", "left", "centre", "right", "successors"} …], "walls": [line …],
  "wall_width", "ego": {"length", "width", "wheelbase"}}`, answered by `{"name", "period_s"}`: how often it plans;
- `{"do": "plan", "ego": {"x", "y", "heading", "speed", "acceleration", "yaw_rate"}, "again": k or null, "wanted":
  speed, "others": [{"length", "width", "x": […], "y", "heading"} …], "closed": [line …]}`, `again`: the row of its
  last answer at which the ego is; others at every 0.1 s from now. Answered by `{"t", "x", "y", "heading", "speed",
  "acceleration", "curvature"}` of the ego's centre, or `{"none": why}`: there is nothing that it may drive.

`{"error": what}` answers anything that failed inside; every answer may say in `ms` how long it took.
"""

from __future__ import annotations

import contextlib
import json
import os
import select
import subprocess
import tempfile
import time
from pathlib import Path
from typing import Any

from common.config import ConfigError

VARIABLE = "FOREFIELD_PEERS"
INSTALL = (
    f"make an environment of its own and name its Python: python3.11 -m venv peers; peers/bin/pip install "
    f"commonroad-reactive-planner frenetix; export {VARIABLE}=$PWD/peers/bin/python "
    "(its parts `triangle` and `Polygon3` are not free for commercial use)"
)
PATIENCE_S = 120.0
"""Who does not answer for so long is taken for dead."""

Line = dict[str, Any]


class PeerError(RuntimeError):
    """A peer died, fell silent or answered what cannot be used."""


def python() -> str:
    """The peers' interpreter.

    Raises:
        ConfigError: there is none, and how to get one.
    """
    found = os.environ.get(VARIABLE, "")
    if not found:
        raise ConfigError(f"this planner needs its own Python: {INSTALL}")
    if not Path(found).is_file():
        raise ConfigError(f"{VARIABLE}={found} is no file: {INSTALL}")
    return found


class Process:
    """A running peer."""

    def __init__(self, command: list[str], patience_s: float = PATIENCE_S) -> None:
        self.command, self._patience_s = command, patience_s
        self._said = tempfile.TemporaryFile()  # noqa: SIM115 - as long as the process lives
        threads = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
        inherited = {k: v for k, v in os.environ.items() if not k.startswith("PYTHON")}
        self._process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=self._said, env={**inherited, **threads}
        )
        self._rest = b""

    def ask(self, line: Line) -> Line:
        """Its answer.

        Raises:
            PeerError: it died, fell silent, or answered no JSON object.
        """
        assert self._process.stdin is not None
        try:
            self._process.stdin.write(json.dumps(line).encode() + b"\n")
            self._process.stdin.flush()
        except OSError:
            raise PeerError(f"the peer died: {self._last_words()}") from None
        text = self._line()
        try:
            answer = json.loads(text)
        except ValueError:
            answer = None
        if not isinstance(answer, dict):
            raise PeerError(f"the peer answers no JSON object: {text[:80]!r}")
        return answer

    def _line(self) -> bytes:
        assert self._process.stdout is not None
        end = time.monotonic() + self._patience_s
        while b"\n" not in self._rest:
            ready, _, _ = select.select([self._process.stdout], [], [], max(0.0, end - time.monotonic()))
            if not ready:
                self.close()
                raise PeerError(f"the peer does not answer within {self._patience_s:g} s")
            more = os.read(self._process.stdout.fileno(), 1 << 16)
            if not more:
                raise PeerError(f"the peer died: {self._last_words()}")
            self._rest += more
        line, _, self._rest = self._rest.partition(b"\n")
        return line

    def _last_words(self) -> str:
        self.close()
        self._said.seek(0)
        lines = self._said.read().decode(errors="replace").strip().splitlines()
        return lines[-1][:200] if lines else f"exit code {self._process.returncode}"

    @property
    def alive(self) -> bool:
        """Whether it can be asked."""
        return self._process.poll() is None

    def close(self) -> None:
        """End it."""
        if self._process.poll() is None:
            self._process.kill()
        self._process.wait()
        for stream in (self._process.stdin, self._process.stdout):
            if stream is not None and not stream.closed:
                with contextlib.suppress(OSError):
                    stream.close()
