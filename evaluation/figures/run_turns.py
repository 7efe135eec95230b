"""Turns of our own system seen from above: three moments of a drive round a junction, and the speed that it drove."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import shapely
from matplotlib.figure import Figure
from matplotlib.patches import PathPatch
from matplotlib.path import Path
from matplotlib.patheffects import withStroke
from matplotlib.transforms import Affine2D

from common.messages import F64
from evaluation.figures.run_draw import OFF_ROAD, road_axes
from evaluation.figures.run_scenes import Run, Step, run
from evaluation.figures.style import ACCENT, EGO, INK, RISK_TOP, body, metres, risk_bar, risk_colours
from evaluation.planning.road_area import RoadArea

HALF_VIEW_M = 24.0
"""Half the side of the square that is drawn [m]."""


def shares(heading: F64) -> F64:
    """How much of the whole turn is done at each moment, of unwrapped headings [n] [rad] → [n]."""
    turned = np.unwrap(heading) - heading[0]
    return np.asarray(turned / turned[-1] if abs(turned[-1]) > 0.1 else np.linspace(0.0, 1.0, len(heading)))


def u_turn_moments(speed: F64, share: F64) -> list[tuple[int, str]]:
    """Indices of a drive's moments: a tenth of the turn done, half, all of it."""
    reached = [int(np.argmax(share >= part)) for part in (0.1, 0.5, 0.97)]
    return list(zip(reached, ("it begins", "half round", "it is round"), strict=True))


def crossing_moments(speed: F64, share: F64) -> list[tuple[int, str]]:
    """Indices of a drive's moments: at its slowest before the turn, half round, round."""
    turning = max(int(np.argmax(share >= 0.5)), 1)
    done = int(np.argmax(share >= 0.97))
    waits = int(np.argmin(speed[:turning]))
    return [(waits, "it lets them pass"), (turning, "it crosses"), (done, "it is across")]


def u_turn() -> Figure:
    """Round on a wide road."""
    return _turning("u_turn", "U-turn on a wide road", u_turn_moments)


def unprotected_left() -> Figure:
    """Left across a stream of oncoming cars."""
    return _turning("unprotected_left", "Left across a stream of oncoming cars", crossing_moments)


def _turning(name: str, title: str, moments: Callable[[F64, F64], list[tuple[int, str]]]) -> Figure:
    drive = run(name)
    share = shares(np.array([s.ego.heading for s in drive.steps]))
    chosen = moments(drive.speed, share)
    frames = _Frames.of(drive, int(np.argmax(share >= 0.5)))
    fig = Figure(figsize=(10.2, 5.9), layout="constrained")
    grid = fig.add_gridspec(2, 3, height_ratios=(2.3, 1.0))
    image, tops = None, []
    for letter, column, (k, what) in zip("abc", range(3), chosen, strict=True):
        ax = fig.add_subplot(grid[0, column])
        image = frames.draw(ax, drive.steps[k], k) or image
        ax.set_title(f"({letter})  t = {drive.t[k]:.1f} s: {what}, {drive.speed[k]:.1f} m/s", loc="left")
        if column:
            ax.set_ylabel("")
            ax.set_yticklabels([])
        tops.append(ax)
    _speed(fig.add_subplot(grid[1, :]), drive, chosen)
    if image is not None:
        risk_bar(fig, image, tops, shrink=0.8)
    fig.suptitle(f"{title}: the field of the moment, candidates (grey), the chosen path (green)", size=10)
    return fig


class _Frames:
    """Everything that stays the same from frame to frame: the view and the road."""

    def __init__(self, drive: Run, origin: F64, turn: float) -> None:
        self.drive, self.origin, self.turn = drive, origin, turn
        area = RoadArea.of(drive.scenario.map)
        self.road = None if area is None else _outline(area.area, self.here)

    @staticmethod
    def of(drive: Run, middle: int) -> _Frames:
        """The view lies around the ego's place at the middle of its turn, its first heading points up."""
        ego = drive.steps[middle].ego
        return _Frames(drive, np.array((ego.x, ego.y)), drive.steps[0].ego.heading - np.pi / 2)

    def here(self, points: Any) -> F64:
        p = np.asarray(points, dtype=np.float64).reshape(-1, 2) - self.origin
        c, s = np.cos(self.turn), np.sin(self.turn)
        return np.asarray(p @ np.array(((c, -s), (s, c))))

    def draw(self, ax: Any, step: Step, trail: int) -> Any:
        ax.set_facecolor(OFF_ROAD)
        image = None
        clip = None if self.road is None else PathPatch(self.road, transform=ax.transData)
        if self.road is not None:
            ax.add_patch(PathPatch(self.road, facecolor="white", lw=0, zorder=0.5))
        if step.field is not None:
            g, m = step.field.grid, step.field.m
            place = Affine2D().rotate(g.heading - self.turn).translate(*self.here([(g.x, g.y)])[0])
            image = ax.imshow(
                m.T, origin="lower", extent=(0.0, g.rows * g.h, 0.0, g.columns * g.h), cmap=risk_colours(),
                vmin=0.0, vmax=RISK_TOP, interpolation="bilinear", transform=place + ax.transData, zorder=1,
            )  # fmt: skip
            if clip is not None:
                image.set_clip_path(clip)
        self._lines(ax)
        if step.plan is not None:
            self._plan(ax, step)
        driven = self.here([(s.ego.x, s.ego.y) for s in self.drive.steps[: trail + 1]])
        ax.plot(driven[:, 0], driven[:, 1], color=EGO, lw=0.9, ls="--", zorder=4)
        e, o = step.ego, step.objects
        (x, y) = self.here([(e.x, e.y)])[0]
        body(ax, x, y, e.heading - self.turn, e.length, e.width, edgecolor=EGO, facecolor="white", linewidth=1.4)
        for k in range(len(o.id)):
            (x, y) = self.here([(o.x[k], o.y[k])])[0]
            body(
                ax, x, y, float(o.heading[k]) - self.turn, float(o.length[k]), float(o.width[k]), linewidth=1.1,
                path_effects=[withStroke(linewidth=2.6, foreground="white", alpha=0.85)],
            )  # fmt: skip
        ax.set_xlim(-HALF_VIEW_M, HALF_VIEW_M)
        ax.set_ylim(-HALF_VIEW_M, HALF_VIEW_M)
        ax.set_aspect("equal")
        metres(ax)
        road_axes(ax)
        return image

    def _lines(self, ax: Any) -> None:
        for lane in self.drive.scenario.map.lanes if self.drive.scenario.map is not None else []:
            for points, kind in ((lane.left, lane.left_type), (lane.right, lane.right_type)):
                if kind != "virtual":
                    p = self.here(points)
                    ls = "--" if kind == "dashed" else "-"
                    ax.plot(p[:, 0], p[:, 1], color="#8a8f98", lw=0.6, ls=ls, zorder=2)

    def _plan(self, ax: Any, step: Step) -> None:
        plan = step.plan
        if plan is None:
            return
        if plan.candidates is not None:
            for x, y in zip(plan.candidates.x, plan.candidates.y, strict=True):
                p = self.here(np.stack((x, y), axis=-1))
                ax.plot(p[:, 0], p[:, 1], color="#6f7782", lw=0.35, zorder=3)
        if plan.profile is not None:
            p = self.here(np.stack((plan.profile.x, plan.profile.y), axis=-1))
            ax.plot(p[:, 0], p[:, 1], color=ACCENT, lw=2.2, zorder=4)


def _outline(area: Any, here: Callable[[Any], F64]) -> Path:
    """The area's outlines as one path."""
    rings = [ring for part in shapely.get_parts(area) for ring in (part.exterior, *part.interiors)]
    return Path.make_compound_path(*(Path(here(ring.coords), closed=True) for ring in rings))


def _speed(ax: Any, drive: Run, chosen: list[tuple[int, str]]) -> None:
    ax.plot(drive.t, drive.speed, color=EGO, lw=1.6, label="driven")
    ax.set_xlabel("t [s]")
    ax.set_ylabel("speed [m/s]")
    ax.set_ylim(0.0, 1.18 * drive.speed.max())
    ax.set_xlim(0.0, drive.t[-1])
    ax.grid(alpha=0.25, lw=0.5)
    for letter, (k, _) in zip("abc", chosen, strict=True):
        ax.axvline(drive.t[k], color=INK, lw=0.7, ls=":")
        ax.text(drive.t[k], ax.get_ylim()[1] * 0.97, f" {letter}", va="top", fontsize=8.5)
    ax.set_title("(d)  driven speed", loc="left")
    road_axes(ax)
