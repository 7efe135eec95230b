"""One moment of a run, drawn along its road: field, candidates, the path driven, everyone."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.patheffects import withStroke
from matplotlib.transforms import Affine2D

from common.geometry import Polyline
from common.messages import F64
from evaluation.figures.run_scenes import FieldThen, Run, Step
from evaluation.figures.style import ACCENT, EGO, INK, RISK_TOP, body, metres, risk_colours

OFF_ROAD = "#e9eaec"
LEFT_M, RIGHT_M = 6.4, 2.9


def frame(ax: Any, drive: Run, step: Step, low: float, high: float, trail: int) -> Any:
    """Draw a moment between two places of the road [m]; `trail`: index of the step, for the path driven so far."""
    line = Polyline.of(drive.scenario.route.reference)
    x0, y0 = (float(v) for v in line.at(low))
    turn = float(line.heading(low))  # the built-in roads of these figures are straight

    def here(points: Any) -> F64:
        p = np.asarray(points, dtype=np.float64).reshape(-1, 2) - (x0, y0)
        c, s = np.cos(turn), np.sin(turn)
        return np.asarray(p @ np.array(((c, -s), (s, c))) + np.array((low, 0.0)))

    image = None if step.field is None else _field(ax, step.field, here, turn)
    _road(ax, drive, here)
    if step.plan is not None:
        if step.plan.candidates is not None:
            c = step.plan.candidates
            for k in range(len(c.x)):
                p = here(np.stack((c.x[k], c.y[k]), axis=-1))
                ax.plot(p[:, 0], p[:, 1], color="#6f7782", lw=0.35, zorder=3)
        if step.plan.profile is not None:
            p = here(np.stack((step.plan.profile.x, step.plan.profile.y), axis=-1))
            ax.plot(p[:, 0], p[:, 1], color=ACCENT, lw=2.2, zorder=4)
    driven = here([(s.ego.x, s.ego.y) for s in drive.steps[: trail + 1]])
    ax.plot(driven[:, 0], driven[:, 1], color=EGO, lw=0.9, ls="--", zorder=4)
    e, o = step.ego, step.objects
    (ex, ey) = here([(e.x, e.y)])[0]
    body(ax, ex, ey, e.heading - turn, e.length, e.width, edgecolor=EGO, facecolor="white", linewidth=1.4)
    for k in range(len(o.id)):
        (px, py) = here([(o.x[k], o.y[k])])[0]
        body(
            ax, px, py, float(o.heading[k]) - turn, float(o.length[k]), float(o.width[k]), edgecolor=INK, linewidth=1.1,
            path_effects=[withStroke(linewidth=2.6, foreground="white", alpha=0.85)],
        )  # fmt: skip
    ax.set_xlim(low, high)
    ax.set_ylim(-RIGHT_M, LEFT_M)
    ax.set_aspect("equal")
    ax.set_yticks([-2, 0, 2, 4, 6])
    metres(ax)
    road_axes(ax)
    return image


def road_axes(ax: Any) -> None:
    """Short ticks."""
    ax.tick_params(length=2.5)


def _field(ax: Any, then: FieldThen, here: Any, turn: float) -> Any:
    g = then.grid
    place = Affine2D().rotate(g.heading - turn).translate(*here([(g.x, g.y)])[0])
    return ax.imshow(
        then.m.T,
        origin="lower",
        extent=(0.0, g.rows * g.h, 0.0, g.columns * g.h),
        cmap=risk_colours(),
        vmin=0.0,
        vmax=RISK_TOP,
        interpolation="bilinear",
        transform=place + ax.transData,
        zorder=1,
    )


def _road(ax: Any, drive: Run, here: Any) -> None:
    """Lane lines; what lies off the road is covered: there the field stays at the peak of the edge."""
    outline = (
        [line for lane in drive.scenario.map.lanes for line in (lane.left, lane.right)] if drive.scenario.map else []
    )
    if outline:
        y = np.concatenate([here(line)[:, 1] for line in outline])
        for low, high in ((float(y.max()), LEFT_M + 1.0), (-RIGHT_M - 1.0, float(y.min()))):
            ax.axhspan(low, high, color=OFF_ROAD, lw=0, zorder=2)
    for lane in drive.scenario.map.lanes if drive.scenario.map is not None else []:
        for points, kind in ((lane.left, lane.left_type), (lane.right, lane.right_type)):
            if kind == "virtual":
                continue
            p = here(points)
            edge = kind in ("kerb", "barrier", "road_edge")
            ax.plot(
                p[:, 0],
                p[:, 1],
                color="#8a8f98",
                lw=1.1 if edge else 0.6,
                ls="--" if kind == "dashed" else "-",
                zorder=2,
            )
