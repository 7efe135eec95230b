"""What stands: rows that hold until the next one, however long ago they were logged.

A piece of a recording is read by itself, and a viewer that was frozen has missed rows: both need again what was said
once, such as the map. Everything static stands, every state does, and so does what lies under one of `STANDS`.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

import rerun as rr

STANDS = (
    "about",
    "why",
    "health",
    "world/map",
    "world/closed",
    "world/route",
    "world/ego/body",
    "world/ego/name",
    "world/ego/nose",
    "world/ego/legend",
    "account/ego/size",
    "account/scale",
)
"""Entities, each with everything below it, that are logged when they change and not for every frame."""

Row = tuple[str, tuple[rr.AsComponents, ...], bool]


@dataclass
class Standing:
    """The last row of each thing that stands."""

    _rows: dict[tuple[str, bool, tuple[type, ...]], Row] = field(default_factory=dict)

    def note(self, path: str, what: tuple[rr.AsComponents, ...], static: bool) -> None:
        """Remember a row if it stands."""
        if static or any(isinstance(w, rr.StateChange) for w in what) or stands(path):
            key = (path, static, tuple(type(w) for w in what))
            self._rows.pop(key, None)  # the newest stands last
            self._rows[key] = (path, what, static)

    def rows(self) -> Iterator[Row]:
        """Everything that stands, in the order in which it was said."""
        yield from list(self._rows.values())


def stands(path: str) -> bool:
    """Whether an entity is logged only when it changes."""
    return any(path == top or path.startswith(f"{top}/") for top in STANDS)
