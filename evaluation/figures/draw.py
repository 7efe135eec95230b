"""The four figures: a turning object, a single frame with lane lines, the slices, and the slices of a path."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.figure import Figure

from common.messages import ObjectClass
from common.risk import RiskParameters
from common.risk_sources import dynamic_sources, shares_at_points
from evaluation.figures.scenes import EGO_LENGTH, EGO_WIDTH, Scene, traffic, turning
from evaluation.figures.style import ACCENT, EGO, INK, body, metres, risk_bar, show
from evaluation.hazards.footprint import footprint, met


def turning_object() -> Figure:
    """The field of a car in a left turn: potential, kinetic along the curved path, and their sum from the kernels."""
    scene = turning()
    g, p = scene.risk.grid, scene.prediction
    x = g.x + (np.arange(g.rows) + 0.5)[:, None] * g.h
    y = g.y + (np.arange(g.columns) + 0.5)[None, :] * g.h
    risk = RiskParameters()
    sources = dynamic_sources(p, [0.0], (scene.ego.vx, scene.ego.vy), risk)
    shares = shares_at_points(x, y, sources, 0, (), risk)
    fields = (shares.potential[0], shares.kinetic[0], np.asarray(scene.risk.volume[0], dtype=np.float64))
    names = ("potential energy  $pE$", "kinetic energy  $kE$", "dynamic energy  $E_d = pE + kE$")
    fig = Figure(figsize=(10.2, 3.15), layout="constrained")
    axes = fig.subplots(1, 3, sharey=True)
    for i, (ax, m, name) in enumerate(zip(axes, fields, names, strict=True)):
        image = show(ax, m, g)
        path = sources.path(0)
        ax.plot(*path.T, color=ACCENT, lw=1.1, ls="--", zorder=4, label="path, driven and predicted")
        body(ax, float(p.x0[0]), float(p.y0[0]), float(p.heading0[0]), float(p.length[0]), float(p.width[0]))
        ax.contour(x[:, 0], y[0], m.T, levels=[0.2, 0.5, 0.8], colors=INK, linewidths=0.5, alpha=0.7)
        _limits(ax, g)
        ax.set_title(f"({'abc'[i]})  {name}")
        metres(ax, y=i == 0)
    axes[0].legend(loc="upper left", frameon=False)
    risk_bar(fig, image, axes, r"energy [$E_\mathrm{max}$]")
    speed = float(np.hypot(p.vx0[0], p.vy0[0]))
    fig.suptitle(f"A car turning left at {speed:.1f} m/s; contours at 0.2, 0.5 and 0.8", fontsize=9.5)
    return fig


def single_frame() -> Figure:
    """The field now: traffic, lane lines, barriers; above as a map, below as a section along the ego's lane."""
    scene = traffic()
    g = scene.risk.grid
    m = np.asarray(scene.risk.volume[0], dtype=np.float64)
    fig = Figure(figsize=(10.2, 3.6), layout="constrained")
    ax, section = fig.subplots(2, 1, sharex=True, gridspec_kw={"height_ratios": [1.25, 1.0]})
    image = show(ax, m, g)
    _bodies(ax, scene, 0)
    _limits(ax, g)
    metres(ax, x=False)
    ax.set_title("(a)  risk now; arrows: velocity over 1 s")
    x = g.x + (np.arange(g.rows) + 0.5) * g.h
    for y, colour, style, name in (
        (scene.ego.y, EGO, "-", "ego's lane"),
        (-3.5, "#d55e00", "--", "right lane"),
        (1.75, INK, ":", "lane line to the left"),
    ):
        j = int((y - g.y) / g.h)
        section.plot(x, m[:, j], color=colour, ls=style, lw=1.2, label=f"{name}, y = {y:+.2f} m")
    section.axhline(0.8, color=INK, lw=0.6, alpha=0.6)
    section.annotate("contact threshold 0.8", (x[5], 0.82), fontsize=7.5, alpha=0.8)
    section.set_ylim(0.0, 2.0)
    section.set_ylabel(r"risk $M$ [$E_\mathrm{max}$]")
    section.legend(loc="upper right", frameon=False, ncols=3)
    section.set_title("(b)  sections along the road")
    section.grid(alpha=0.25, lw=0.5)
    metres(section, y=False)
    risk_bar(fig, image, ax)
    return fig


def multi_slice() -> Figure:
    """Slices of the volume; the ego where it would be if it kept its speed."""
    scene = traffic()
    g, times = scene.risk.grid, scene.risk.slice_times
    chosen = [0, 2, 4, 6, 8, 10]
    fig = Figure(figsize=(10.2, 8.0), layout="constrained")
    axes = fig.subplots(len(chosen), 1, sharex=True, sharey=True)
    for ax, j in zip(axes, chosen, strict=True):
        image = show(ax, np.asarray(scene.risk.volume[j], dtype=np.float64), g)
        _bodies(ax, scene, j)
        _limits(ax, g)
        ax.set_yticks([-5, 0, 5])
        ax.text(
            0.006, 0.985, f"$t_{{{j}}}$ = {times[j]:.1f} s", transform=ax.transAxes, va="top", color="white", zorder=9
        )
    metres(axes[-1], y=False)
    for ax in axes:
        metres(ax, x=False)
    risk_bar(fig, image, axes, shrink=0.6)
    fig.suptitle("The risk volume: the field at the predicted poses; blue: the ego at constant speed", fontsize=9.5)
    return fig


def path_slices() -> Figure:
    """A path cut into slices: each stretch of road with the field of the slice in which the ego is there."""
    scene = traffic()
    g, times, ego = scene.risk.grid, np.asarray(scene.risk.slice_times), scene.ego
    volume = np.asarray(scene.risk.volume, dtype=np.float64)
    last = 10
    x = g.x + (np.arange(g.rows) + 0.5) * g.h
    # slice j holds while the ego's centre is between x(t_j) and x(t_j + 1)
    cuts = ego.x + ego.speed * times[: last + 1]
    j_of = np.clip(np.searchsorted(cuts, x, side="right") - 1, 0, last - 1)
    stitched = volume[j_of, np.arange(g.rows)]
    fig = Figure(figsize=(10.2, 4.9), layout="constrained")
    ax, strip, bars = fig.subplots(3, 1, sharex=True, gridspec_kw={"height_ratios": [1.0, 1.0, 1.3]})
    image = show(ax, volume[0], g)
    _bodies(ax, scene, 0)
    ax.set_title("(a)  the field now, and the path with its cuts")
    show(strip, stitched, g)
    strip.set_title(
        "(b)  on each stretch the field of the slice in which the ego is there; blue: its footprint at $t_j$"
    )
    for a in (ax, strip):
        a.plot([ego.x, cuts[-1]], [ego.y, ego.y], color=EGO, lw=1.0, zorder=6)
        a.vlines(cuts, -6.0, 6.0, color=INK, lw=0.5, ls=":", zorder=4)
    shape = footprint(EGO_LENGTH, EGO_WIDTH)
    worst, now = [], []
    for j in range(last):
        body(strip, float(cuts[j]), ego.y, 0.0, EGO_LENGTH, EGO_WIDTH, edgecolor=EGO, linewidth=0.8)
        along = np.linspace(cuts[j], cuts[j + 1], 6)
        still = np.zeros_like(along)
        worst.append(float(met(scene.risk, j, along, still + ego.y, still, shape).max()))
        now.append(float(met(scene.risk, 0, along, still + ego.y, still, shape).max()))
    width = np.diff(cuts)
    bars.bar(
        cuts[:-1], worst, width, align="edge", color="#e69f00", edgecolor="white", label=r"in its own slice, $M_j$"
    )
    bars.step(cuts, [*now, now[-1]], where="post", color=INK, lw=1.1, ls="--", label=r"in the field of now, $M_0$")
    bars.axhline(0.8, color=INK, lw=0.6, alpha=0.6)
    bars.annotate("contact threshold 0.8", (g.x + 0.5, 0.83), fontsize=7.5, alpha=0.8)
    for j in range(last):
        bars.text(cuts[j] + width[j] / 2, worst[j] + 0.03, f"{j}", ha="center", fontsize=7.5)
    bars.set_ylim(0.0, max(1.2, 1.15 * max(*worst, *now)))
    bars.set_ylabel(r"max risk [$E_\mathrm{max}$]")
    bars.set_title("(c)  highest risk under the footprint in each slice (number: slice)")
    bars.legend(loc="upper right", frameon=False)
    bars.grid(axis="y", alpha=0.25, lw=0.5)
    for a in (ax, strip):
        _limits(a, g)
        metres(a, x=False)
    metres(bars, y=False)
    risk_bar(fig, image, [ax, strip], shrink=0.8)
    return fig


FIGURES = {
    "turning_object": turning_object,
    "single_frame": single_frame,
    "multi_slice": multi_slice,
    "path_slices": path_slices,
}
"""Every figure by the name of its file."""


def _bodies(ax: Any, scene: Scene, j: int) -> None:
    """Everybody at slice j, and the ego where it would be."""
    p, t = scene.prediction, scene.risk.slice_times[j]
    sources = dynamic_sources(p, [t], (scene.ego.vx, scene.ego.vy), RiskParameters())
    for i in range(len(p.id)):
        x, y, heading = float(sources.x[0, i]), float(sources.y[0, i]), float(sources.heading[0, i])
        light = p.cls[i] != ObjectClass.PEDESTRIAN
        body(ax, x, y, heading, float(p.length[i]), float(p.width[i]), edgecolor="#f5f5f5" if light else INK)
        if j == 0:
            _arrow(ax, x, y, float(p.vx0[i]), float(p.vy0[i]), INK)
    ego = scene.ego
    body(ax, ego.x + ego.vx * t, ego.y + ego.vy * t, ego.heading, ego.length, ego.width, edgecolor=EGO, linewidth=1.3)
    if j == 0:
        _arrow(ax, ego.x, ego.y, ego.vx, ego.vy, EGO)


def _arrow(ax: Any, x: float, y: float, vx: float, vy: float, colour: str) -> None:
    ax.annotate("", (x + vx, y + vy), (x, y), arrowprops={"arrowstyle": "->", "lw": 0.8, "color": colour}, zorder=6)


def _limits(ax: Any, g: Any) -> None:
    ax.set_xlim(g.x, g.x + g.rows * g.h)
    ax.set_ylim(g.y, g.y + g.columns * g.h)
