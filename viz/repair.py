"""Mends a recording whose writer was killed: what is torn at the end is cut off, and the index is written.

A recording is a head of 12 bytes and messages, each behind its kind and length (two 64-bit numbers, little-endian):
the first that is longer than the file is the tear. What stands before it is sent once more through a file sink, which
writes the index (footer). It takes little memory, however long the recording.
"""

from __future__ import annotations

import struct
import tempfile
import warnings
from dataclasses import dataclass
from pathlib import Path

import rerun as rr
from rerun.chunk import RrdReader

from viz.blueprint import blueprint

HEAD = 12
MESSAGE = struct.Struct("<QQ")
KINDS = (1, 2, 3)
"""Store, rows, blueprint: what is recorded; the index is of another kind."""


class RepairError(ValueError):
    """A file that cannot be mended; the text says why."""


@dataclass(frozen=True)
class Mended:
    """What was done."""

    was_whole: bool
    rows: int = 0
    lost_bytes: int = 0
    """Length of what was cut off."""


def is_whole(path: Path) -> bool:
    """Whether a recording was finished: it has its index, which is written last.

    Raises:
        RepairError: it is no Rerun recording.
    """
    try:
        with path.open("rb") as f:
            head = f.read(HEAD)
    except OSError as e:
        raise RepairError(f"{path}: {e.strerror}") from None
    if len(head) < HEAD or head[:4] != b"RRF2":
        raise RepairError(f"{path} is no Rerun recording (.rrd)")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # that there is no index is what we ask
        try:
            RrdReader(path).store()  # reads the index alone
        except (RuntimeError, ValueError):
            return False
    return True


def repair(path: Path, out: Path) -> Mended:
    """Write the mended recording to `out`, which may be `path` itself; it is replaced whole or not at all.

    Raises:
        RepairError: nothing of it can be read, or `out` cannot be written.
    """
    if is_whole(path):
        if out != path:
            _replace(path.read_bytes(), out)
        return Mended(True)
    try:
        with tempfile.TemporaryDirectory(dir=out.absolute().parent, prefix=".repair-") as folder:
            cut, whole = Path(folder) / "cut.rrd", Path(folder) / "whole.rrd"
            end = sound_bytes(path)
            _copy(path, cut, end)
            rows = _again(path, cut, whole)
            if not is_whole(whole):
                raise RepairError(f"{path}: what could be read of it does not make a recording")
            lost = path.stat().st_size - end
            whole.replace(out)
    except OSError as e:
        raise RepairError(f"{out}: {e.strerror}") from None
    except (RuntimeError, ValueError) as e:
        raise e if isinstance(e, RepairError) else RepairError(f"{path}: nothing of it can be read: {e}") from None
    return Mended(False, rows, lost)


def sound_bytes(path: Path) -> int:
    """How much of a recording holds whole messages [bytes]."""
    size = path.stat().st_size
    end = HEAD
    with path.open("rb") as f:
        while end + MESSAGE.size <= size:
            f.seek(end)
            kind, length = MESSAGE.unpack(f.read(MESSAGE.size))
            if kind not in KINDS or end + MESSAGE.size + length > size:
                break  # the index, or the tear
            end += MESSAGE.size + length
    return min(end, size)


def _copy(path: Path, out: Path, n: int) -> None:
    with path.open("rb") as source, out.open("wb") as target:
        while n > 0 and (block := source.read(min(n, 1 << 24))):
            target.write(block)
            n -= len(block)


def _again(path: Path, cut: Path, whole: Path) -> int:
    """Every chunk of `cut` once more, into a file that gets its index; returns the rows."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # that the index is missing is why we are here
        reader = RrdReader(cut)
        stores = reader.recordings()
    if not stores:
        raise RepairError(f"{path}: it ends before anything was recorded")
    rows = 0
    for store in stores:
        rec = rr.RecordingStream(store.application_id, recording_id=store.recording_id)
        rec.set_sinks(rr.FileSink(whole), default_blueprint=blueprint())
        for chunk in reader.stream(store=store):
            rows += chunk.num_rows
            rec.send_chunks(chunk)
        rec.flush(timeout_sec=600.0)
        rec.disconnect()
    return rows


def _replace(content: bytes, out: Path) -> None:
    draft = out.with_name(f".{out.name}.draft")
    draft.write_bytes(content)
    draft.replace(out)
