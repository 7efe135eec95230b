"""One page that holds everything: pictures inside, no script, nothing fetched; made for screen and paper alike."""

from __future__ import annotations

import base64
import io
import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import matplotlib as mpl
import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined
from matplotlib.figure import Figure
from PIL import Image

from common.messages import FRAME_S
from evaluation.figures.style import RC
from evaluation.review import charts, pictures
from evaluation.review.bounds import Bounds
from evaluation.review.choose import Shown, shown
from evaluation.review.drive import Drive, pose_at
from evaluation.review.hindsight import Errors, Group
from evaluation.review.moments import Moment, drawn_at, moments
from evaluation.review.recording import Recording, Seen
from rig.interventions import Intervention
from viz.decision import brief, source

DPI = 150
QUALITY = 88
"""Of a picture of the field: a quarter of a PNG's size."""
TERMS = {
    "potential": "potential term: how near it is",
    "kinetic": "kinetic term: how fast the two close in on each other",
    "static": "static term: a lane line, the road's edge or something closed",
    "curve": "a curve: lateral acceleration",
    "limit": "a lower speed limit",
    "horizon": "the end of what is known ahead",
    "goal": "the goal",
    "comfort": "comfort",
}
Steps = Callable[[Sequence[Any]], Iterator[Any]]
"""Goes through a sequence, showing how far it is."""


@dataclass(frozen=True)
class Card:
    """One slow-down or stop, as the page tells it."""

    number: int
    found: dict[str, Any]
    who: str
    """Class and id of the source; empty: nothing on the road."""
    term: str
    where: str
    """Where the cell that decided lies, seen from the ego."""
    risk: float | None
    place: tuple[float, float]
    recording_t: float
    picture: str


def page(
    recording: Recording,
    drive: Drive,
    bounds: Bounds,
    errors: dict[Group, list[Errors]],
    result: dict[str, Any],
    steps: Steps = iter,
) -> str:
    """The page as HTML.

    Args:
        recording: what was read.
        drive: the drive in it.
        bounds: what it is held against.
        errors: prediction error in hindsight.
        result: the review's JSON.
        steps: shows how far the pictures are.

    Raises:
        ReviewError: the recording cannot be read again for its pictures.
    """
    style: dict[Any, Any] = {**RC, "svg.hashsalt": "forefield"}
    with mpl.rc_context(style):
        hindsight = charts.hindsight(errors)
        figures = {
            "timeline": vector(charts.timeline(recording, drive, bounds)),
            "map": vector(charts.drive_map(recording, drive)),
            "latency": vector(charts.latencies(recording, drive, FRAME_S * 1e3)),
            "hindsight": None if hindsight is None else vector(hindsight),
        }
        cards = list(_cards(recording, drive, result, steps))
    environment = Environment(
        loader=PackageLoader("evaluation.review", "."), autoescape=True, undefined=StrictUndefined, trim_blocks=True,
        lstrip_blocks=True,
    )  # fmt: skip
    return environment.get_template("page.html.j2").render(
        r=result,
        s=result["summary"],
        cards=cards,
        figures=figures,
        bounds=bounds,
        configuration=json.dumps(recording.configuration, indent=2, sort_keys=True),
    )


def _cards(recording: Recording, drive: Drive, result: dict[str, Any], steps: Steps) -> Iterator[Card]:
    found = drive.interventions
    drawn = drawn_at(recording.paths) if found else np.zeros(0)
    chosen = [shown(recording, drive, i, drawn) for i in found]
    drawings = moments(recording.paths, [c.t for c in chosen])
    for k in steps(range(len(found))):
        yield _card(k, recording, drive, found[k], result["interventions"][k], chosen[k], drawings[k])


def _card(
    k: int,
    recording: Recording,
    drive: Drive,
    found: Intervention,
    told: dict[str, Any],
    chosen: Shown,
    moment: Moment,
) -> Card:
    pose = pose_at(drive.states, moment.t - drive.began)
    decision = None if chosen.plan is None else chosen.plan.said.decision
    drives = chosen.plan is not None and chosen.plan.said.mode == "drive"
    mark = brief(decision) if decision is not None and drives else ""
    slice_s = 0.0 if decision is None or decision.slice_s is None else decision.slice_s
    fig = pictures.picture(recording, moment, pose, _seen(recording, moment.t), mark, slice_s)
    where = ""
    if decision is not None and decision.x is not None and decision.y is not None:
        at = (pose[0] - recording.origin[0], pose[1] - recording.origin[1])
        cell = (decision.x - recording.origin[0], decision.y - recording.origin[1])
        ahead, left = pictures.in_frame([cell], at, pose[2])[0]
        where = f"{abs(ahead):.0f} m {'ahead' if ahead >= 0 else 'behind'}, {abs(left):.1f} m to the "
        where += "left" if left >= 0 else "right"
    return Card(
        number=k + 1,
        found=told,
        who="" if decision is None else source(decision),
        term=TERMS.get(found.reason.term or "", found.reason.term or ""),
        where=where,
        risk=None if decision is None else decision.risk,
        place=charts.place_of(drive, found),
        recording_t=moment.t,
        picture=raster(fig),
    )


def _seen(recording: Recording, t: float) -> Seen | None:
    near = min(recording.seen, key=lambda seen: abs(seen.t - t), default=None)
    return near if near is not None and abs(near.t - t) <= 3 * FRAME_S else None


def vector(fig: Figure) -> str:
    """A figure as an address that holds it, SVG."""
    out = io.BytesIO()
    fig.savefig(out, format="svg", metadata={"Date": None})
    return "data:image/svg+xml;base64," + base64.b64encode(out.getvalue()).decode()


def raster(fig: Figure) -> str:
    """A figure as an address that holds it, WebP."""
    raw, out = io.BytesIO(), io.BytesIO()
    fig.savefig(raw, format="png", dpi=DPI)
    Image.open(raw).convert("RGB").save(out, format="webp", quality=QUALITY, method=6)
    return "data:image/webp;base64," + base64.b64encode(out.getvalue()).decode()
