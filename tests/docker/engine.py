"""Docker Compose on a real engine, for tests."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
from dataclasses import dataclass, field
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
SERVICES = {"router", "predictor", "riskfield", "planner", "viz", "rig"}

needs_engine = [
    pytest.mark.docker,
    pytest.mark.skipif(
        shutil.which("docker") is None
        or subprocess.run(["docker", "info"], capture_output=True, check=False).returncode,
        reason="no Docker engine",
    ),
]


@dataclass
class Project:
    """One stack: its name, its compose files, and the variables they read."""

    name: str
    files: tuple[str, ...] = ("compose.yaml",)
    environment: dict[str, str] = field(default_factory=dict)

    def compose(self, *arguments: str, timeout: float = 1200) -> str:
        """Run `docker compose` on it; returns its output, fails if it fails."""
        done = self._run(arguments, timeout)
        assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-4000:]
        return done.stdout

    def logs(self, service: str) -> list[str]:
        """Lines of a service's log, without the codes that Compose puts before each."""
        done = self._run(("logs", "--no-color", "--no-log-prefix", service), 60)
        return [line.removeprefix("\x1b[2K") for line in done.stdout.splitlines()]

    def _run(self, arguments: tuple[str, ...], timeout: float) -> subprocess.CompletedProcess[str]:
        files = [word for name in self.files for word in ("-f", name)]
        return subprocess.run(
            ["docker", "compose", "-p", self.name, *files, *arguments],
            cwd=ROOT, capture_output=True, text=True, timeout=timeout, check=False,
            env={**os.environ, "SCENARIO": "following", **self.environment},
        )  # fmt: skip

    def up(self) -> None:
        """Build, start, wait until all are healthy."""
        self.compose("build")
        self.compose("up", "--detach", "--wait", "--wait-timeout", "180")

    def down(self) -> None:
        """Remove everything that belongs to it."""
        self.compose("down", "--volumes")

    def health(self) -> dict[str, str]:
        """What each container's healthcheck says."""
        lines = self.compose("ps", "--all", "--format", "json").splitlines()
        return {row["Service"]: row["Health"] for row in map(json.loads, lines)}

    def python(self, service: str, code: str) -> str:
        """What a line of Python prints inside a running container."""
        return self.compose("exec", service, "python", "-c", code)
