"""Two recordings in one file: the drawings of each under its own prefix, both from the begin of their runs."""

from __future__ import annotations

import uuid
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import rerun as rr
import rerun.blueprint as rrb
from rerun.chunk import Chunk

from evaluation.review.command import Review
from evaluation.review.compare import markdown
from evaluation.review.tables import TIME, chunks
from viz.colours import GROUND, ORANGE, SKY

CONTENT = ["/world/**", "/plot/**", "/plan", "/why"]
PREFIXES = ("a", "b")
COLOURS = {"a": SKY, "b": ORANGE}
SERIES = {"plot/speed/ego": "speed", "plot/speed/desired": "desired", "plot/acceleration/ego": "acceleration"}


def write(a: Review, b: Review, found: dict[str, Any], out: Path) -> None:
    """Write both recordings and the table into one file with a layout of its own.

    Raises:
        ReviewError: one of them cannot be read.
        OSError: the file cannot be written.
    """
    draft = out.with_name(f".{out.stem}.draft.rrd")
    stream = rr.RecordingStream("forefield", recording_id=uuid.uuid4())
    try:
        stream.set_sinks(rr.FileSink(draft), default_blueprint=blueprint(a, b))
        stream.send_recording_name(f"{a.recording.path.name} | {b.recording.path.name}")
        for prefix, review in zip(PREFIXES, (a, b), strict=True):
            for path in review.recording.paths:
                stream.send_chunks(shifted(path, prefix, review.drive.began))
            for series, name in SERIES.items():
                style = rr.SeriesLines(
                    names=[f"{name} {prefix.upper()}"], colors=[_shade(prefix, series)], widths=[1.6]
                )
                stream.log(f"{prefix}/{series}", style, static=True)
        table = rr.TextDocument(markdown(found), media_type=rr.MediaType.MARKDOWN)
        stream.log("changes", table, static=True)
        stream.flush()
    finally:
        stream.disconnect()
    draft.replace(out)


def _shade(prefix: str, series: str) -> tuple[int, int, int]:
    colour = COLOURS[prefix]
    return (colour[0] * 2 // 3, colour[1] * 2 // 3, colour[2] * 2 // 3) if "desired" in series else colour


def shifted(path: Path, prefix: str, began_s: float) -> Iterator[Chunk]:
    """The drawings of a recording under a prefix, with time 0 where its run begins."""
    began = round(began_s * 1e9)
    for chunk in chunks(path, CONTENT):
        batch = chunk.to_record_batch()
        if not chunk.is_static and TIME not in batch.schema.names:
            continue  # logged before the drive had a time: shown on no common one
        if not chunk.is_static:
            batch = _from(batch, began)
        for part in Chunk.from_record_batch(batch):
            yield part.with_entity_path(f"/{prefix}{chunk.entity_path}")


def _from(batch: pa.RecordBatch, began_ns: int) -> pa.RecordBatch:
    keep = [name for name in batch.schema.names if name not in ("log_time", "log_tick", "frame")]
    batch = batch.select(keep)
    k = batch.schema.get_field_index(TIME)
    ns = np.asarray(batch.column(k).cast(pa.int64()).to_numpy(zero_copy_only=False)) - began_ns
    field = batch.schema.field(k)
    return batch.set_column(k, field, pa.array(ns, pa.int64()).cast(field.type))


def blueprint(a: Review, b: Review) -> rrb.Blueprint:
    """A above B from above; on the right what changed, and the curves of both in one."""
    birds = [_bird(prefix, review.recording.path.name) for prefix, review in zip(PREFIXES, (a, b), strict=True)]
    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Vertical(*birds),
            rrb.Vertical(
                rrb.Tabs(
                    rrb.TextDocumentView(origin="changes", name="What changed"),
                    rrb.TextDocumentView(origin="a/why", name="Why, A"),
                    rrb.TextDocumentView(origin="b/why", name="Why, B"),
                    active_tab=0,
                ),
                _series("Speed [m/s]", ["plot/speed/ego", "plot/speed/desired"]),
                _series("Acceleration [m/s²]", ["plot/acceleration/ego"]),
                rrb.TextLogView(origin="/", contents=["+ a/plan", "+ b/plan"], name="What each said"),
                row_shares=[4, 3, 3, 2],
            ),
            column_shares=[3, 2],
        ),
        rrb.TimePanel(state="collapsed", timeline="t"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.BlueprintPanel(state="collapsed"),
        auto_layout=False,
        auto_views=False,
    )


def _bird(prefix: str, name: str) -> rrb.Spatial3DView:
    return rrb.Spatial3DView(
        origin=f"{prefix}/world/ego",
        contents=[f"+ {prefix}/world/**", f"- {prefix}/world/map/virtual_line"],
        name=f"{prefix.upper()} · {name}",
        background=rrb.Background(color=GROUND, kind="SolidColor"),
        line_grid=False,
        eye_controls=rrb.EyeControls3D(
            kind=rrb.Eye3DKind.Orbital,
            position=(34.0, -4.0, 56.0),
            look_target=(34.0, -4.0, 0.0),
            eye_up=(0.0, 1.0, 0.0),
        ),
    )


def _series(name: str, entities: list[str]) -> rrb.TimeSeriesView:
    contents = [f"+ {prefix}/{entity}" for prefix in PREFIXES for entity in entities]
    return rrb.TimeSeriesView(
        origin="/", contents=contents, name=name, plot_legend=rrb.PlotLegend(corner=rrb.Corner2D.LeftTop)
    )
