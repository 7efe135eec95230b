"""Where a recording goes: a file, a server for live viewers, or both at once."""

from __future__ import annotations

import json
import logging
import socket
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import rerun as rr
import rerun.blueprint as rrb

from viz.settings import VizSettings

APPLICATION = "forefield"

log = logging.getLogger("forefield")


class SinkError(ValueError):
    """A recording cannot be written or served; the text says what to do."""


@contextmanager
def recording(settings: VizSettings, scenario: str, blueprint: rrb.Blueprint) -> Iterator[rr.RecordingStream]:
    """Open a recording with its blueprint; on the way out everything is flushed and the file finished.

    Raises:
        SinkError: no such folder, or the port is taken.
    """
    flush_s = min(settings.flush_s, settings.live_flush_s) if settings.serve else settings.flush_s
    batcher = rr.ChunkBatcherConfig(flush_tick=flush_s)
    rec = rr.RecordingStream(APPLICATION, recording_id=uuid.uuid4(), batcher_config=batcher)
    sinks: list[Any] = []
    if settings.record:
        path = Path(settings.record)
        if not path.parent.is_dir():
            raise SinkError(f"viz.record: {path.parent}: no such folder; create it or record elsewhere")
        sinks.append(rr.FileSink(path, write_footer=settings.footer))
    if settings.serve:
        _check_free(settings.address, settings.serve)
        sinks.append(rr.GrpcServerSink(settings.address, settings.serve, server_memory_limit=settings.server_memory))
    try:
        if sinks:
            rec.set_sinks(*sinks, default_blueprint=blueprint)
    except (RuntimeError, ValueError, OSError) as e:
        raise SinkError(f"[viz] cannot open the recording: {e}") from None
    rec.send_recording_name(scenario or "live")
    try:
        yield rec
    finally:
        try:
            rec.flush(timeout_sec=2.0)
        except RuntimeError as e:  # a server that has gone must not keep the file from being finished
            log.warning("not everything was written: %s", e)
        rec.disconnect()


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


def log_about(rec: rr.RecordingStream, scenario: str, configuration: dict[str, Any], settings: VizSettings) -> None:
    """Store the scenario's name and the resolved configuration in the recording."""
    rec.send_property(
        "forefield", rr.AnyValues(scenario=scenario or "live", configuration=json.dumps(configuration, sort_keys=True))
    )
    text = "\n".join(
        (
            f"# {scenario or 'Live'}",
            "",
            "**Bird's-eye view**: the ego drives to the right; left on the picture is left of the ego (up).",
            "The heatmap is the risk M now, in units of E_max, black 0 to pale yellow "
            f"{settings.full_scale:g} E_max and above, the same scale in every frame. Off the road the field stays at "
            "the height of its edge; that plateau, wherever what stands still reaches the top of the scale, is drawn "
            "dark: the bright line along the kerb is its rim, the land behind it is no safer.",
            "",
            "Thin blue lines: candidate paths, brighter where the desired speed is higher. Wide green: the path "
            "chosen. Pink: the stopping tail. Red dot: the cell that decided the speed, with its source and risk.",
            "",
            "**Risk on the path**: one curve a slice, yellow now, blue the last.",
            "",
            "**Time stack**: the slices of the next seconds one above the other, "
            f"{settings.lift:g} m per second; the chosen path climbs through them. Only what moves is shown: where the "
            "largest share stands still, the slices are clear. `risk/exact` holds the volume with its own numbers.",
            "",
            "**Units**: m, s, m/s, m/s², ms. Timelines: `frame` counts messages of objects, `t` is seconds of the run.",
            "",
            "## Configuration",
            "```json",
            json.dumps(configuration, indent=2, sort_keys=True),
            "```",
        )
    )
    rec.log("about", rr.TextDocument(text, media_type=rr.MediaType.MARKDOWN), static=True)
