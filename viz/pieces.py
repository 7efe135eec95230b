"""The files of one recording: named in order, cut by size and time, the oldest removed when a budget is spent.

`viz.record` names a file or a folder:

- `drive.rrd`: the first piece has this very name and overwrites what was there, the next are `drive.0002.rrd`,
  `drive.0003.rrd`, … as far as these names are free. Only pieces that this process wrote are ever removed.
- a folder (it exists, or the name ends in `/`): pieces are `forefield-20260131T120000Z-0001.rrd`, by the time at which
  the process began. Nothing is ever overwritten, and the budget is the folder's: what earlier processes left there
  under such names counts and is removed first.
"""

from __future__ import annotations

import os
import re
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path

MIB = 2**20
_OURS = re.compile(r"forefield-\d{8}T\d{6}Z(-\d+)?-\d{4,}\.rrd")


class NoRoomError(OSError):
    """Nothing more can be written without breaking the budget or filling the disk."""


@dataclass(frozen=True)
class Limits:
    """How much may be kept; 0 stands for no limit."""

    piece_bytes: int
    """A piece of this size is finished and the next begun."""
    piece_s: float
    """So is one that is this old [s]."""
    budget_bytes: int
    """All pieces together; the oldest is removed first."""
    reserve_bytes: int
    """This much of the disk stays free, whoever fills it."""


@dataclass
class Pieces:
    """Names the pieces of one recording and keeps them within their limits."""

    target: Path
    limits: Limits
    _folder: bool = False
    _prefix: str = ""
    _count: int = 0
    _written: list[Path] = field(default_factory=list)

    @staticmethod
    def of(record: str, limits: Limits, now: datetime | None = None) -> Pieces:
        """Pieces for the setting `viz.record`; a folder's are named by `now`."""
        target = Path(record)
        is_folder = target.is_dir() or record.endswith("/")
        prefix = f"forefield-{(now or datetime.now(UTC)):%Y%m%dT%H%M%SZ}"
        pieces = Pieces(target, limits, is_folder, prefix)
        if is_folder and target.is_dir():  # another process of the same second: its names are taken
            for other in range(2, 1000):
                if not any(target.glob(f"{pieces._prefix}-0*.rrd")):
                    break
                pieces._prefix = f"{prefix}-{other}"
        return pieces

    @property
    def folder(self) -> Path:
        """Where the pieces lie."""
        return self.target if self._folder else self.target.parent

    def begin(self) -> Path:
        """Make room and name the next piece.

        Raises:
            NoRoomError: there is no room even after every older piece was removed.
            OSError: the folder cannot be read or made.
        """
        if self._folder:
            self.folder.mkdir(parents=True, exist_ok=True)
        self.make_room(coming=self.limits.piece_bytes)
        self._count += 1
        if self._folder:
            path = self.folder / f"{self._prefix}-{self._count:04d}.rrd"
        elif self._count == 1:
            path = self.target
        else:
            while (path := self._numbered()).exists():  # an earlier run's
                self._count += 1
        self._written.append(path)
        return path

    def _numbered(self) -> Path:
        return self.target.with_name(f"{self.target.stem}.{self._count:04d}{self.target.suffix}")

    def unused(self, path: Path) -> None:
        """The piece named last could not be begun: its name is free again."""
        if self._written and self._written[-1] == path:
            self._written.pop()
            self._count -= 1

    def is_full(self, path: Path, age_s: float) -> bool:
        """Whether a piece is large or old enough to be finished."""
        limits = self.limits
        if limits.piece_s and age_s >= limits.piece_s:
            return True
        return bool(limits.piece_bytes) and size(path) >= limits.piece_bytes

    def kept(self) -> list[Path]:
        """Every piece that the budget counts, the oldest first."""
        if not self._folder:
            return [path for path in self._written if path.is_file()]
        try:
            found = [path for path in self.folder.iterdir() if _OURS.fullmatch(path.name)]
        except OSError:
            return []
        return sorted(found, key=_order)

    def make_room(self, current: Path | None = None, coming: int = 0) -> list[Path]:
        """Remove the oldest pieces until budget and reserve are kept; returns what was removed.

        Args:
            current: the piece being written; it is never removed.
            coming: bytes that are about to be written.

        Raises:
            NoRoomError: nothing is left to remove.
        """
        removed = []
        while why := self._lacking(coming):
            oldest = next((path for path in self.kept() if path != current), None)
            if oldest is None:
                raise NoRoomError(why)
            try:
                oldest.unlink(missing_ok=True)
            except OSError as e:
                raise NoRoomError(f"{why}, and {oldest.name} cannot be removed: {e.strerror}") from None
            removed.append(oldest)
            if oldest in self._written:
                self._written.remove(oldest)
        return removed

    def _lacking(self, coming: int) -> str:
        """What is too little; empty: there is room."""
        limits = self.limits
        kept = self.kept()
        if limits.budget_bytes and kept:
            used = sum(size(path) for path in kept)
            if used + min(coming, limits.budget_bytes) > limits.budget_bytes:
                return f"{used / MIB:.0f} MiB recorded, the budget is {limits.budget_bytes / MIB:.0f} MiB"
        free = _free(self.folder)
        if free < limits.reserve_bytes:
            return f"{free / MIB:.0f} MiB free, {limits.reserve_bytes / MIB:.0f} MiB are to stay so (viz.reserve_mib)"
        return ""


def _order(path: Path) -> tuple[str, int]:
    prefix, _, number = path.stem.rpartition("-")
    return prefix, int(number)


def size(path: Path) -> int:
    """Bytes of a file; 0 if it is not there."""
    try:
        return path.stat().st_size
    except OSError:
        return 0


def _free(folder: Path) -> int:
    try:
        disk = os.statvfs(folder)
    except OSError as e:
        raise NoRoomError(f"{folder}: {e.strerror}") from None
    return disk.f_bavail * disk.f_frsize
