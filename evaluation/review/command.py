"""Reviewing a recording: what `forefield review` does."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table

from evaluation.review import bounds as bounds_
from evaluation.review import hindsight
from evaluation.review.bounds import Bounds
from evaluation.review.drive import Drive, drive_of
from evaluation.review.hindsight import Errors, Group
from evaluation.review.page import page
from evaluation.review.recording import Recording, load
from evaluation.review.result import result


@dataclass(frozen=True)
class Review:
    """A recording and what was found in it."""

    recording: Recording
    drive: Drive
    bounds: Bounds
    errors: dict[Group, list[Errors]]
    result: dict[str, Any]


def review(*paths: Path) -> Review:
    """Read and judge a recording, all its pieces together.

    Raises:
        ReviewError: it cannot be reviewed; one line that says why.
    """
    recording = load(*paths)
    drive = drive_of(recording)
    held = bounds_.bounds(recording.configuration)
    errors = hindsight.errors(recording)
    return Review(recording, drive, held, errors, result(recording, drive, held, errors))


def write_page(found: Review, out: Path, console: Console) -> None:
    """Write the page, whole or not at all."""
    with Progress(
        TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn(), console=console,
        transient=True,
    ) as progress:  # fmt: skip
        task = progress.add_task("drawing", total=None)

        def steps(moments: Sequence[Any]) -> Iterator[Any]:
            progress.update(task, total=max(len(moments), 1))
            for moment in moments:
                yield moment
                progress.advance(task)

        text = page(found.recording, found.drive, found.bounds, found.errors, found.result, steps)
    draft = out.with_name(f".{out.name}.draft")
    draft.write_text(text, "utf-8")
    draft.replace(out)


def table(found: dict[str, Any]) -> Table:
    """The summary for a terminal."""
    s = found["summary"]
    out = Table(title=escape(s["scenario"]), title_justify="left", show_header=False, min_width=60)
    out.add_column(style="bold", no_wrap=True)
    out.add_column()
    out.add_row(
        "drive", f"{s['distance_m']:.0f} m in {s['duration_s']:.1f} s, {s['mean_speed_mps']:.1f} m/s on average"
    )
    out.add_row("modes", ", ".join(f"{m.replace('_', ' ')} {t:.1f} s" for m, t in s["modes_s"].items()))
    near = "no road user came near"
    if s["min_clearance_at"] is not None:
        near = f"{s['min_clearance_m']:.2f} m to {s['min_clearance_at']['id']} at {s['min_clearance_at']['t']:.1f} s"
    out.add_row("closest", near)
    for c in s["contacts"]:
        out.add_row("contact", f"[red]with {c['id']} at {c['t']:.1f} s[/]")
    for n, i in enumerate(found["interventions"]):
        change = f"{i['t']:.1f} s: {i['kind']} {i['speed_from']:.1f} → {i['speed_to']:.1f} m/s"
        out.add_row("" if n else "slowed", f"{change}: {escape(i['sentence'])}")
    if not found["interventions"]:
        out.add_row("slowed", "never")
    q = found["latency_ms"]["end_to_end"]
    told = "nothing came" if q["p50"] is None else f"{q['p50']:.1f} ms, 99 % within {q['p99']:.1f} ms"
    out.add_row("end to end", told)
    return out
