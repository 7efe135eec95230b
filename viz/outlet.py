"""Where rows go: the recording's file, piece by piece, and the server for live viewers, each by a stream of its own.

Rerun's streams queue what their sink does not take and block when that queue is full (some 100 MB in each of its
stages): one stream for both would let a frozen viewer hold up the file, and then everything. So each outlet has its
own, and a thread that flushes it: if a flush does not come through within `STUCK_S`, the outlet takes no more rows
until it does; what it did not take is counted. The queue is therefore bounded, and drawing never waits.
"""

from __future__ import annotations

import logging
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import rerun as rr
import rerun.blueprint as rrb

from viz.pieces import MIB, Pieces, size

log = logging.getLogger("forefield")

APPLICATION = "forefield"
STUCK_S = 1.0
"""A flush that takes longer shows that the sink is stuck [s]."""
LEAVE_S = 10.0
"""A file that takes nothing for so long is left, and another begun [s]."""
START_S = 5.0
"""How long the first piece is waited for [s]."""
RETRY_S = 2.0
"""How long a file that could not be written is left alone [s]."""
LOOK_S = 1.0
"""How often size and room are looked at [s]."""
CLOSE_S = 8.0
"""How long finishing the file may take when the process ends [s]."""
NEVER_S = 3600.0

Begin = Callable[[rr.RecordingStream], None]
"""Logs what a stream begins with."""


class Outlet(ABC):
    """One stream of rows. `log` and `tend` belong to the drawing thread."""

    def __init__(self, name: str, recording_id: str, flush_s: float, blueprint: rrb.Blueprint) -> None:
        self.name = name
        self.dropped = 0
        """Rows that were not taken."""
        self.rec: rr.RecordingStream | None = None
        self._recording_id = recording_id
        self._blueprint = blueprint
        self._stuck = False
        self._missed = False
        self._failed = ""
        self._taken_s = 0.0
        self._ending = threading.Event()
        self._flusher = threading.Thread(target=self._flush, args=(flush_s,), daemon=True, name=f"flush-{name}")

    def start(self) -> None:
        """Open the stream and begin to flush it."""
        self._taken_s = time.monotonic()
        self._open()
        self._flusher.start()

    @property
    def trouble(self) -> str:
        """Why rows are not taken; empty: they are."""
        return f"{self.name}: does not take what is drawn" if self._stuck else ""

    def ready(self) -> rr.RecordingStream | None:
        """The stream if it takes rows now; otherwise the row is counted as dropped."""
        if self.rec is None or self._stuck:
            self.dropped += 1
            self._missed = True
            return None
        return self.rec

    @abstractmethod
    def tend(self, now_s: float) -> None:
        """Look after the stream: open again, cut, make room."""

    def renewed(self) -> bool:
        """Whether the stream takes rows again, or anew, and needs what stands; True once."""
        if self._missed and self.rec is not None and not self._stuck:
            self._missed = False
            return True
        return False

    def close(self) -> None:
        """Flush and finish; bounded in time."""
        self._ending.set()
        if self.rec is not None:
            _finish(self.rec, self.name).join(CLOSE_S)
            self.rec = None

    @abstractmethod
    def _open(self) -> None: ...

    def _stream(self, sink: rr.FileSink | rr.GrpcServerSink) -> rr.RecordingStream:
        # chunks are made by our own flushes
        batches = rr.ChunkBatcherConfig(flush_tick=NEVER_S)
        rec = rr.RecordingStream(APPLICATION, recording_id=self._recording_id, batcher_config=batches)
        rec.disable_timeline("log_time")  # when it was drawn tells nobody anything
        rec.set_sinks(sink, default_blueprint=self._blueprint)
        return rec

    def _flush(self, flush_s: float) -> None:
        while not self._ending.wait(flush_s):
            rec = self.rec
            if rec is None:
                continue
            try:
                rec.flush(timeout_sec=STUCK_S)
                stuck, failed = False, ""
            except RuntimeError as e:
                stuck = "timed out" in str(e)
                failed = "" if stuck else str(e)
            if rec is self.rec:
                if stuck and not self._stuck:
                    log.warning("%s does not take what is drawn: rows are dropped and counted", self.name)
                self._stuck, self._failed = stuck, failed
                if not stuck:
                    self._taken_s = time.monotonic()


class Server(Outlet):
    """A server for live viewers; it lives as long as the process."""

    def __init__(
        self, recording_id: str, flush_s: float, blueprint: rrb.Blueprint, where: tuple[str, int], memory: str,
        begin: Begin,
    ) -> None:  # fmt: skip
        super().__init__("live", recording_id, flush_s, blueprint)
        self._where, self._memory, self._begin = where, memory, begin

    def tend(self, now_s: float) -> None:
        """Nothing: viewers come and go by themselves."""

    def _open(self) -> None:
        self.rec = self._stream(rr.GrpcServerSink(*self._where, server_memory_limit=self._memory))
        self._begin(self.rec)


@dataclass
class _Opening:
    """A piece that is being begun."""

    path: Path
    rec: rr.RecordingStream | None = None
    error: str = ""
    done: threading.Event = field(default_factory=threading.Event)


class Files(Outlet):
    """The recording's file, piece by piece; without room there is none until there is room again."""

    def __init__(
        self, recording_id: str, flush_s: float, blueprint: rrb.Blueprint, pieces: Pieces, footer: bool, begin: Begin
    ) -> None:
        super().__init__("recording", recording_id, flush_s, blueprint)
        self.pieces = pieces
        self.path: Path | None = None
        self.begun = 0
        self._footer, self._begin = footer, begin
        self._opened_s = self._looked_s = 0.0
        self._why = ""
        self._opening: _Opening | None = None
        self._finishing: list[threading.Thread] = []
        self.detail: dict[str, str] = {}
        """For the status: what is written, and how much is kept."""

    @property
    def trouble(self) -> str:
        """Why nothing is recorded; empty: it is."""
        return f"not recording: {self._why}" if self._why else super().trouble

    def tend(self, now_s: float) -> None:
        """Cut a full piece, make room, leave a file that fails, try again where there was none."""
        self._adopt()
        if self._opening is not None:
            return
        if self.rec is None:
            if now_s - self._looked_s >= RETRY_S:
                self._open()
        elif self._failed or now_s - self._taken_s >= LEAVE_S:
            self._leave(f"{self.path} cannot be written ({self._failed or 'nothing is taken'}): is the disk full?")
        elif now_s - self._looked_s >= LOOK_S and not self._stuck:
            self._looked_s = now_s
            self._count()
            self._look(now_s)

    def _look(self, now_s: float) -> None:
        assert self.path is not None
        if not self.path.exists():
            self._leave(f"{self.path} was removed")
            self._open()
        elif self.pieces.is_full(self.path, now_s - self._opened_s):
            self._open()  # rows go into the old piece until the new one is there
        else:
            try:
                for removed in self.pieces.make_room(self.path):
                    log.info("removed %s: the oldest", removed)
            except OSError as e:
                self._leave(str(e))

    def start(self) -> None:
        """Open the first piece; waits for it, so that nothing is missed."""
        super().start()
        if self._opening is not None:
            self._opening.done.wait(START_S)
            self._adopt()

    def close(self) -> None:
        """Finish every piece; bounded in time."""
        end = time.monotonic() + CLOSE_S
        if self._opening is not None:  # a piece that was just begun ends as whole as the others
            self._opening.done.wait(START_S)
            self._adopt()
        super().close()
        for thread in self._finishing:
            thread.join(max(end - time.monotonic(), 0.0))

    def _open(self) -> None:
        """Begin a piece in a thread of its own, since a disk that hangs would hold up the drawing."""
        self._looked_s = time.monotonic()
        try:
            path = self.pieces.begin()
        except OSError as e:
            if self.rec is not None:  # full, and no room for another
                self._leave(_plain(e))
            self._say(_plain(e))
            return
        self._opening = opening = _Opening(path)

        def begin() -> None:
            try:
                rec = self._stream(rr.FileSink(path, write_footer=self._footer))
                self._begin(rec)
                opening.rec = rec
            except (OSError, RuntimeError, ValueError) as e:
                opening.error = _plain(e)
            opening.done.set()

        threading.Thread(target=begin, daemon=True, name="open-recording").start()

    def _adopt(self) -> None:
        """Go over to the piece that was opened, if it is ready."""
        opening = self._opening
        if opening is None or not opening.done.is_set():
            return
        self._opening = None
        self._finishing = [thread for thread in self._finishing if thread.is_alive()]
        if self.rec is not None:
            self._finishing.append(_finish(self.rec, self.name))
            self.rec = None
        if opening.rec is None:
            self.pieces.unused(opening.path)
            self._say(opening.error)
            return
        if self._why:
            log.info("recording again, into %s", opening.path)
        self._why = ""
        self._stuck, self._failed, self._missed = False, "", True
        self._opened_s = self._taken_s = time.monotonic()
        self.path, self.begun, self.rec = opening.path, self.begun + 1, opening.rec
        self._count()

    def _leave(self, why: str) -> None:
        if self.rec is not None:
            self._finishing.append(_finish(self.rec, self.name))
        self.rec = None
        self._say(why)

    def _say(self, why: str) -> None:
        if why != self._why:
            log.warning("not recording: %s", why)
        self._why = why
        self._count()

    def _count(self) -> None:
        kept = self.pieces.kept()
        self.detail = {
            "recording": "none" if self.rec is None else str(self.path),
            "pieces": f"{self.begun} begun, {len(kept)} kept, {sum(map(size, kept)) / MIB:.1f} MiB",
        }


def _finish(rec: rr.RecordingStream, name: str) -> threading.Thread:
    """Write what is queued and the footer, in a thread of its own: a long footer holds nobody up."""

    def finish() -> None:
        try:
            rec.flush(timeout_sec=STUCK_S)
        except RuntimeError as e:
            log.warning("%s: not everything was written: %s", name, e)
        rec.disconnect()

    thread = threading.Thread(target=finish, daemon=True, name=f"finish-{name}")
    thread.start()
    return thread


def _plain(error: BaseException) -> str:
    if isinstance(error, OSError) and error.strerror:
        return f"{error.filename}: {error.strerror}" if error.filename else error.strerror
    return str(error)
