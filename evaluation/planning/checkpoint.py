"""What is done of a long run, kept line by line, so that a run that was killed goes on where it was.

A JSON-lines file: the first line says what the run is (settings, seed, the code that drives), each further one is a
drive: its name, who drove, what was measured. A last line that was torn off by the kill is dropped.
"""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

from common.config import ConfigError, Tree
from rig.report import finite

SCHEMA = "forefield.eval_planning.checkpoint.v1"
DRIVES = (
    "common",
    "services",
    "evaluation/planning",
    "rig/sources",
    "rig/vehicle.py",
    "rig/measure.py",
    "rig/world.py",
)
"""The code that decides what comes of a drive."""


def identity(tree: Tree, seed: int, what: str) -> dict[str, Any]:
    """What a run is: two of the same identity may be one run in pieces."""
    return {"schema": SCHEMA, "what": what, "seed": seed, "settings": json.loads(json.dumps(tree)), "code": _code()}


def _code() -> str:
    root, found = Path(__file__).parents[2], hashlib.sha256()
    for part in DRIVES:
        files = sorted((root / part).rglob("*.py")) if (root / part).is_dir() else [root / part]
        for file in files:
            found.update(file.relative_to(root).as_posix().encode() + b"\0" + file.read_bytes())
    return found.hexdigest()[:16]


class Checkpoint:
    """Drives that are done, by name and planner; new ones are added at once."""

    def __init__(self, path: Path | None, run: dict[str, Any]) -> None:
        """Read what there is; `path` None: nothing is kept.

        Raises:
            ConfigError: the file is of another run, or none of ours.
        """
        self._path = path
        self._done: dict[tuple[str, str], dict[str, Any]] = {}
        if path is None:
            return
        if not path.exists() or not path.stat().st_size:
            path.write_text(json.dumps(run) + "\n")
            return
        text = path.read_bytes()
        whole, newline, torn = text.rpartition(b"\n")
        if torn:
            path.write_bytes(whole + newline)
        try:
            first, *rest = [json.loads(line) for line in whole.splitlines()]
        except ValueError:
            raise ConfigError(f"--checkpoint {path}: no checkpoint of this command") from None
        self._same(path, first, run)
        for line in rest:
            self._done[line["name"], line["planner"]] = line["entry"]

    @staticmethod
    def _same(path: Path, first: Any, run: dict[str, Any]) -> None:
        if not isinstance(first, dict) or first.get("schema") != SCHEMA:
            raise ConfigError(f"--checkpoint {path}: no checkpoint of this command")
        for key, told in (("what", "other scenarios"), ("seed", "another seed"), ("settings", "other settings")):
            if first.get(key) != run[key]:
                raise ConfigError(f"--checkpoint {path}: it is of {told} ({first.get(key)!r:.60}); name another file")
        if first.get("code") != run["code"]:
            raise ConfigError(f"--checkpoint {path}: what drives has changed since; begin anew with another file")

    def of(self, name: str, planners: tuple[str, ...] | list[str]) -> dict[str, dict[str, Any]]:
        """What is known of a scenario."""
        return {p: self._done[name, p] for p in planners if (name, p) in self._done}

    def add(self, name: str, found: dict[str, dict[str, Any]]) -> None:
        """Note the drives of a scenario."""
        if self._path is None:
            return
        with self._path.open("a") as file:
            for planner, entry in found.items():
                line = finite({"name": name, "planner": planner, "entry": entry})
                file.write(json.dumps(line, allow_nan=False) + "\n")
