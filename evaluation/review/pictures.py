"""The picture of a moment: from above, the ego drives to the right; the field now, and the slice that decided."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Polygon
from matplotlib.patheffects import withStroke
from matplotlib.transforms import Affine2D

from common.geometry import rectangle_corners
from common.messages import F64
from evaluation.figures.style import ACCENT, EGO, INK, RISK_TOP, risk_bar, risk_colours
from evaluation.review.moments import Field, Moment
from evaluation.review.recording import Recording, Seen
from viz.colours import CLASS_NAMES

BEHIND_M, AHEAD_M, BESIDE_M = 22.0, (45.0, 110.0), (9.0, 24.0)
"""How far is seen behind; ahead and to each side at least and at most [m]."""
WIDTH_IN = 7.4
CELL = "#d1006c"
"""Of the cell that decided: stands out on every part of the risk's scale."""
EDGES = {"kerb", "barrier", "road_edge"}
ROUGH_LABEL_M = (17.0, 3.6)
"""Room that a label takes along and across [m]."""


@dataclass(frozen=True)
class Window:
    """What is seen, in the ego's frame [m]."""

    ahead: float
    low: float
    high: float

    @staticmethod
    def around(points: F64) -> Window:
        """As little as shows the points [n, 2], within the limits."""
        x, y = (points[:, 0], points[:, 1]) if len(points) else (np.zeros(1), np.zeros(1))
        least, most = BESIDE_M
        return Window(
            float(np.clip(np.max(x) + 14.0, *AHEAD_M)),
            float(np.clip(np.min(y) - 5.0, -most, -least)),
            float(np.clip(np.max(y) + 5.0, least, most)),
        )


def _drawn(pose: tuple[float, float, float], recording: Recording) -> tuple[float, float]:
    return pose[0] - recording.origin[0], pose[1] - recording.origin[1]


def in_frame(points: Any, at: tuple[float, float], heading: float) -> F64:
    """Drawn coordinates [n, 2] in the frame of one at `at` who looks along `heading`: ahead, left [m]."""
    p = np.asarray(points, dtype=np.float64).reshape(-1, 2) - at
    c, s = np.cos(heading), np.sin(heading)
    return np.asarray(p @ np.array(((c, -s), (s, c))))


class Bird:
    """One view from above, in the frame of the ego at a moment: x ahead, y to its left [m]."""

    def __init__(self, ax: Any, pose: tuple[float, float, float], recording: Recording, window: Window) -> None:
        self.ax, self.window = ax, window
        self._recording = recording
        self.heading = pose[2]
        self._at = _drawn(pose, recording)
        self._labels: list[tuple[float, float]] = []
        ax.set_xlim(-BEHIND_M, window.ahead)
        ax.set_ylim(window.low, window.high)
        ax.set_aspect("equal")
        ax.set_ylabel("left [m]")
        ax.tick_params(length=2.5)

    def here(self, points: Any) -> F64:
        """Drawn coordinates [n, 2] in the ego's frame."""
        return in_frame(points, self._at, self.heading)

    def field(self, drawn: Field) -> Any:
        """The field, on the scale of every picture."""
        rows, columns = drawn.levels.shape
        risk = drawn.levels.astype(np.float64) / 255.0 * (self._recording.full_scale / self._recording.e_max)
        corner = self.here([drawn.corner])[0]
        place = Affine2D().rotate(drawn.heading - self.heading).translate(*corner)
        return self.ax.imshow(
            risk,
            origin="upper",
            extent=(0.0, columns * drawn.cell, 0.0, rows * drawn.cell),
            cmap=risk_colours(),
            vmin=0.0,
            vmax=RISK_TOP,
            interpolation="bilinear",
            transform=place + self.ax.transData,
            zorder=1,
        )

    def road(self) -> None:
        """Lane lines thin, edges of the road thicker."""
        for line in self._recording.road:
            if line.kind in ("virtual_line", "goal"):
                continue
            points = self.here(line.points - self._recording.origin)
            reach = self.window.ahead + 15.0
            near = (np.abs(points[:, 0]) < reach) & (np.abs(points[:, 1]) < reach)
            if not np.any(near) and len(points) > 2:
                continue
            edge = line.kind in EDGES
            self.ax.plot(
                points[:, 0], points[:, 1], color="#8a8f98", lw=1.1 if edge else 0.5, zorder=2, solid_capstyle="butt"
            )

    def body(self, corners: F64, colour: str, width: float = 1.0, fill: str = "none", style: str = "-") -> None:
        """An outline given in drawn coordinates."""
        outline = self.here(corners)
        patch = Polygon(outline, closed=True, facecolor=fill, edgecolor=colour, lw=width, ls=style, zorder=5)
        patch.set_path_effects([withStroke(linewidth=width + 1.4, foreground="white", alpha=0.85)])
        self.ax.add_patch(patch)

    def path(self, points: F64, colour: str, width: float, style: str = "-") -> None:
        """A line given in drawn coordinates."""
        p = self.here(points)
        self.ax.plot(p[:, 0], p[:, 1], color=colour, lw=width, ls=style, zorder=4, solid_capstyle="round")

    def mark(self, at: tuple[float, float], text: str) -> None:
        """The cell that decided, with its sign on a line."""
        x, y = self.here([at])[0]
        self.ax.plot([x], [y], marker="o", ms=5.5, mfc="none", mec=CELL, mew=1.6, zorder=9)
        self.ax.plot([x], [y], marker=".", ms=2.5, color=CELL, zorder=9)
        low, high = self.window.low, self.window.high
        up = high - y >= y - low
        where = (float(np.clip(x, -BEHIND_M + 12, self.window.ahead - 14)), high - 1.9 if up else low + 1.9)
        self._labels += [where, (x, y)]
        self.ax.annotate(
            text,
            (x, y),
            where,
            ha="center",
            va="center",
            fontsize=8,
            color=CELL,
            fontweight="bold",
            arrowprops={"arrowstyle": "-", "color": CELL, "lw": 0.9, "shrinkB": 4},
            bbox={"boxstyle": "round,pad=0.25", "fc": "white", "ec": CELL, "lw": 0.6, "alpha": 0.92},
            zorder=10,
        )

    def name(self, at: tuple[float, float], text: str, colour: str = INK) -> None:
        """A small label beside something, left out where it would cover another."""
        x, y = self.here([at])[0]
        w = self.window
        if not (-BEHIND_M + 6 < x < w.ahead - 6 and w.low + 1 < y < w.high - 1):
            return
        below = (y < -0.5 or y > w.high - 3.5) and y > w.low + 3.0
        place = (x, y - 2.1 if below else y + 2.1)
        taken = any(
            abs(place[0] - a) < ROUGH_LABEL_M[0] and abs(place[1] - b) < ROUGH_LABEL_M[1] for a, b in self._labels
        )
        if taken:
            return
        self._labels.append(place)
        self.ax.text(
            *place, text, ha="center", va="center", fontsize=7, color=colour, zorder=8,
            bbox={"boxstyle": "round,pad=0.12", "fc": "white", "ec": "none", "alpha": 0.65},
        )  # fmt: skip


def picture(
    recording: Recording,
    moment: Moment,
    pose: tuple[float, float, float],
    seen: Seen | None,
    decided: str,
    slice_s: float,
) -> Figure:
    """Draw one moment.

    Args:
        recording: where it stands.
        moment: what was drawn then.
        pose: centre [m] and heading [rad] of the ego then, `map` frame.
        seen: everyone perceived then.
        decided: who decided and how high the risk is, in a few words; empty: nothing on the road did.
        slice_s: when the slice that decided begins, from now [s].
    """
    both = bool(decided) and moment.slice is not None and moment.slice.levels.size > 0
    window = _window(recording, moment, pose)
    tall = (WIDTH_IN - 1.5) * (window.high - window.low) / (window.ahead + BEHIND_M) + 0.35
    fig = Figure(figsize=(WIDTH_IN, (2 if both else 1) * tall + 0.4), layout="constrained")
    axes = list(fig.subplots(2 if both else 1, 1, sharex=True, squeeze=False)[:, 0])
    image = _now(Bird(axes[0], pose, recording, window), moment, pose, seen, recording, decided)
    if both:
        image = _then(Bird(axes[1], pose, recording, window), moment, decided, slice_s) or image
    axes[-1].set_xlabel("ahead of the ego [m]")
    if image is not None:
        risk_bar(fig, image, axes, shrink=0.75)
    return fig


def _window(recording: Recording, moment: Moment, pose: tuple[float, float, float]) -> Window:
    told = [np.array([moment.decided])] if moment.decided is not None else []
    told += [line for line in (moment.profile, moment.ego) if line is not None]
    at = _drawn(pose, recording)
    return Window.around(in_frame(np.concatenate([[at], *told]), at, pose[2]))


def _now(
    bird: Bird,
    moment: Moment,
    pose: tuple[float, float, float],
    seen: Seen | None,
    recording: Recording,
    decided: str,
) -> Any:
    bird.ax.set_title("now: the risk, every candidate path (grey) and the one driven (green)", loc="left")
    bird.road()
    image = None if moment.now is None else bird.field(moment.now)
    for candidate in moment.candidates:
        bird.path(candidate, "#6f7782", 0.35)
    if moment.profile is not None:
        bird.path(moment.profile, ACCENT, 2.6)
    if moment.decided is not None and decided:
        bird.mark(moment.decided, decided)
    here = np.array(recording.origin)
    bird.body(rectangle_corners(*pose, *recording.size) - here, EGO, 1.5, "white")
    bird.name((pose[0] - here[0], pose[1] - here[1]), "ego", EGO)
    if seen is not None:
        corners = rectangle_corners(seen.x, seen.y, seen.heading, seen.length, seen.width) - here
        speed = np.hypot(seen.vx, seen.vy)
        for k in np.argsort(np.hypot(seen.x - pose[0], seen.y - pose[1])):
            bird.body(corners[k], INK, 0.9)
            text = f"{CLASS_NAMES[int(seen.cls[k])]} {int(seen.id[k])} · {speed[k]:.0f} m/s"
            bird.name((float(seen.x[k] - here[0]), float(seen.y[k] - here[1])), text)
    return image


def _then(bird: Bird, moment: Moment, decided: str, slice_s: float) -> Any:
    when = "now" if slice_s < 0.05 else f"in {slice_s:.1f} s"
    bird.ax.set_title(
        f"{when}: the slice that decided, everyone where predicted, the ego where it would be", loc="left"
    )
    bird.road()
    image = None if moment.slice is None else bird.field(moment.slice)
    if moment.profile is not None:
        bird.path(moment.profile, ACCENT, 1.2)
    if moment.boxes is not None:
        b = moment.boxes
        corners = rectangle_corners(b.centre[:, 0], b.centre[:, 1], b.heading, 2 * b.half[:, 0], 2 * b.half[:, 1])
        for outline in corners:
            bird.body(outline, INK, 0.9)
    if moment.ego is not None:
        bird.body(moment.ego[:4], EGO, 1.5, "white")
    if moment.decided is not None and decided:
        bird.mark(moment.decided, decided)
    return image
