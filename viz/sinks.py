"""Where a recording goes: a file, a server for live viewers, or both at once."""

from __future__ import annotations

import json
import socket
import time
import uuid
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import rerun as rr
import rerun.blueprint as rrb

from viz.about import about
from viz.outlet import Files, Outlet, Server
from viz.pieces import MIB, Limits, Pieces
from viz.settings import VizSettings
from viz.standing import Standing


class SinkError(ValueError):
    """A recording cannot be written or served; the text says what to do."""


class Recorder:
    """Logs rows into every outlet, keeps what stands, and looks after the outlets. Used by one thread."""

    def __init__(self, outlets: list[Outlet], standing: Standing) -> None:
        self._outlets = outlets
        self._standing = standing
        self._frame: int | None = None
        self._t = 0.0

    def set_time(self, frame: int, t: float) -> None:
        """Everything logged from here on stands at this frame, t seconds after the run's begin."""
        self._frame, self._t = frame, t
        for outlet in self._outlets:
            if outlet.rec is not None:
                self._place(outlet.rec)

    def log(self, path: str, *what: rr.AsComponents, static: bool = False) -> None:
        """Log one row."""
        self._standing.note(path, what, static)
        for outlet in self._outlets:
            rec = outlet.ready()
            if rec is not None:
                rec.log(path, *what, static=static)

    def tend(self) -> None:
        """Look after the outlets; to be called several times a second."""
        now_s = time.monotonic()
        for outlet in self._outlets:
            outlet.tend(now_s)
            if outlet.renewed() and outlet.rec is not None:
                self._place(outlet.rec)
                for path, what, static in self._standing.rows():
                    outlet.rec.log(path, *what, static=static)

    @property
    def trouble(self) -> str:
        """What is not recorded or served, and why; empty: everything is well."""
        return "; ".join(outlet.trouble for outlet in self._outlets if outlet.trouble)

    @property
    def dropped(self) -> dict[str, int]:
        """Rows not taken, by outlet."""
        return {outlet.name: outlet.dropped for outlet in self._outlets}

    @property
    def detail(self) -> dict[str, str]:
        """What the status says about the recording."""
        return {k: v for outlet in self._outlets if isinstance(outlet, Files) for k, v in outlet.detail.items()}

    def close(self) -> None:
        """Finish everything."""
        for outlet in self._outlets:
            outlet.close()

    def _place(self, rec: rr.RecordingStream) -> None:
        if self._frame is not None:
            rec.set_time("frame", sequence=self._frame)
            rec.set_time("t", duration=self._t)


@contextmanager
def recording(
    settings: VizSettings, scenario: str, blueprint: rrb.Blueprint, configuration: dict[str, Any] | None = None
) -> Iterator[Recorder]:
    """Open the outlets, each with blueprint, name and configuration; on the way out everything is finished.

    Raises:
        SinkError: no such folder, or the port is taken.
    """
    identity = str(uuid.uuid4())
    standing = Standing()
    begin = _beginning(scenario, configuration or {})
    outlets: list[Outlet] = []
    if settings.record:
        outlets.append(Files(identity, settings.flush_s, blueprint, _pieces(settings), settings.footer, begin))
    if settings.serve:
        _check_free(settings.address, settings.serve)
        where = (settings.address, settings.serve)
        outlets.append(Server(identity, settings.live_flush_s, blueprint, where, settings.server_memory, begin))
    recorder = Recorder(outlets, standing)
    try:
        for outlet in outlets:
            try:
                outlet.start()
            except (RuntimeError, ValueError, OSError) as e:
                raise SinkError(f"[viz] cannot open the recording: {e}") from None
        text = about(scenario, configuration or {}, settings)
        recorder.log("about", rr.TextDocument(text, media_type=rr.MediaType.MARKDOWN), static=True)
        yield recorder
    finally:
        recorder.close()


def _pieces(settings: VizSettings) -> Pieces:
    path = Path(settings.record)
    parent = path if settings.record.endswith("/") else path.parent
    try:
        if not path.is_dir() and not parent.is_dir():
            raise SinkError(f"viz.record: {parent}: no such folder; create it or record elsewhere")
    except OSError as e:
        raise SinkError(f"viz.record: {path}: {e.strerror}") from None
    limits = Limits(
        round((settings.rotate_mib or settings.budget_mib / 2.0) * MIB),
        settings.rotate_minutes * 60.0,
        round(settings.budget_mib * MIB),
        round(settings.reserve_mib * MIB),
    )
    return Pieces.of(settings.record, limits)


def _beginning(scenario: str, configuration: dict[str, Any]) -> Callable[[rr.RecordingStream], None]:
    stored = json.dumps(configuration, sort_keys=True)

    def begin(rec: rr.RecordingStream) -> None:
        rec.send_recording_name(scenario or "live")
        rec.send_property("forefield", rr.AnyValues(scenario=scenario or "live", configuration=stored))

    return begin


def _check_free(address: str, port: int) -> None:
    # Rerun's server would only log that it cannot listen
    with socket.socket() as s:
        s.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            s.bind((address, port))
        except OSError as e:
            raise SinkError(
                f"viz.serve: cannot listen on {address}:{port}: {e.strerror}; choose another port"
            ) from None
