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

        The newest piece stays, since it may still be written; so the budget is never a reason to fail here: whatever
        the next piece takes beyond it is made room for as it grows, when the one before it is finished.

        Raises:
            NoRoomError: too little of the disk is free, or what is in the way cannot be removed.
            OSError: the folder cannot be read or made.
        """
        if self._folder:
            self.folder.mkdir(parents=True, exist_ok=True)
        newest = self._newest()
        self._keep_budget(newest, coming=self.limits.piece_bytes)
        self._keep_reserve(newest)
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

    def make_room(self, current: Path | None = None) -> list[Path]:
        """Remove the oldest pieces until budget and reserve are kept; returns what was removed.

        Args:
            current: the piece being written; it is never removed.

        Raises:
            NoRoomError: what may be removed does not suffice.
        """
        removed = self._keep_budget(current)
        if why := self._over_budget(0):
            raise NoRoomError(why)
        return removed + self._keep_reserve(current)

    def _newest(self) -> Path | None:
        written = [path for path in self._written if path.is_file()]
        return next(reversed(written or self.kept()), None)

    def _keep_budget(self, current: Path | None, coming: int = 0) -> list[Path]:
        """Remove what may be removed until the budget is kept, with `coming` more bytes, or nothing is left."""
        removed = []
        while (why := self._over_budget(coming)) and (oldest := self._oldest(current)):
            self._remove(oldest, why)
            removed.append(oldest)
        return removed

    def _keep_reserve(self, current: Path | None) -> list[Path]:
        """Remove the oldest until the reserve is free; nothing is sacrificed that does not help.

        Raises:
            NoRoomError: all that may be removed is too little, or removing one freed nothing.
        """
        removed = []
        while (free := _free(self.folder)) < (reserve := self.limits.reserve_bytes):
            why = f"{free / MIB:.0f} MiB free, {reserve / MIB:.0f} MiB are to stay so (viz.reserve_mib)"
            removable = sum(size(path) for path in self.kept() if path != current)
            oldest = self._oldest(current)
            if oldest is None or free + removable < reserve:
                raise NoRoomError(why)
            self._remove(oldest, why)
            removed.append(oldest)
            if _free(self.folder) <= free:  # still open somewhere, or others take what is freed
                raise NoRoomError(f"{why}, and removing {oldest.name} freed nothing")
        return removed

    def _oldest(self, current: Path | None) -> Path | None:
        return next((path for path in self.kept() if path != current), None)

    def _remove(self, path: Path, why: str) -> None:
        try:
            path.unlink(missing_ok=True)
        except OSError as e:
            raise NoRoomError(f"{why}, and {path.name} cannot be removed: {e.strerror}") from None
        if path in self._written:
            self._written.remove(path)

    def _over_budget(self, coming: int) -> str:
        """How the budget is exceeded with `coming` more bytes; empty: it is kept."""
        budget = self.limits.budget_bytes
        used = sum(size(path) for path in self.kept()) if budget else 0
        if not used or used + min(coming, budget) <= budget:
            return ""
        return f"{used / MIB:.0f} MiB recorded, the budget is {budget / MIB:.0f} MiB"


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
