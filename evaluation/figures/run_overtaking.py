"""The paper's overtaking: four frames of our own system passing a slow pedestrian, and the speed that it drove."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.figure import Figure

from common.messages import F64
from evaluation.figures.run_draw import frame, road_axes
from evaluation.figures.run_scenes import Run, run
from evaluation.figures.style import ACCENT, EGO, INK, risk_bar

BEGINS_M, BACK_M = 0.4, 0.3
"""The ego has left its line when it is so far beside it, and is back when it is no further [m]."""


def moments(s: F64, d: F64, other_s: F64) -> list[tuple[int, str]]:
    """Indices of the four frames and what they show, found in the drive itself.

    Args:
        s: the ego along the road [m].
        d: the ego to the left of its line [m].
        other_s: the pedestrian along the road [m].
    """
    beside = int(np.nanargmin(np.abs(s - other_s)))
    out = np.flatnonzero(np.abs(d[: beside + 1]) > BEGINS_M)
    begins = int(out[0]) if len(out) else beside
    home = np.flatnonzero(np.abs(d[beside:]) < BACK_M)
    back = beside + int(home[0]) if len(home) else len(s) - 1
    seen = max(begins - 12, 0)
    return [
        (seen, "it comes nearer"),
        (begins, "it moves over"),
        (beside, "it passes"),
        (back, "it is back"),
    ]


def overtaking() -> Figure:
    """Four frames along the road, and the speed below them."""
    drive = run("slow_pedestrian")
    (s, d), (other_s, _) = drive.along(), drive.of(drive.only_other)
    chosen = moments(s, d, other_s)
    fig = Figure(figsize=(10.2, 7.3), layout="constrained")
    rows = fig.subplots(5, 1, gridspec_kw={"height_ratios": [1.0, 1.0, 1.0, 1.0, 1.6]})
    low, high = s[chosen[0][0]] - 12.0, s[chosen[-1][0]] + 26.0
    image = None
    for letter, ax, (k, what) in zip("abcd", rows, chosen, strict=False):
        step = drive.steps[k]
        image = frame(ax, drive, step, low, high, trail=k)
        ax.set_title(f"({letter})  t = {step.t:.1f} s: {what}, {step.ego.speed:.1f} m/s", loc="left")
    for ax in rows[:3]:
        ax.set_xlabel("")
        ax.set_xticklabels([])
    _speed(rows[4], drive, chosen)
    if image is not None:
        risk_bar(fig, image, list(rows[:4]), shrink=0.6)
    fig.suptitle(
        "Passing a slow pedestrian: the field of the moment, candidates (grey), the chosen path (green)", size=10
    )
    return fig


def _speed(ax: Any, drive: Run, chosen: list[tuple[int, str]]) -> None:
    wanted = [np.nan if p.plan is None else p.plan.desired_speed for p in drive.steps]
    ax.plot(drive.t, wanted, color=ACCENT, lw=0.9, label="desired")
    ax.plot(drive.t, drive.speed, color=EGO, lw=1.6, label="driven")
    ax.set_xlabel("t [s]")
    ax.set_ylabel("speed [m/s]")
    ax.set_ylim(0.0, 1.12 * max(np.nanmax(wanted), drive.speed.max()))
    ax.grid(alpha=0.25, lw=0.5)
    for letter, (k, _) in zip("abcd", chosen, strict=True):
        ax.axvline(drive.steps[k].t, color=INK, lw=0.7, ls=":")
        ax.text(drive.steps[k].t, ax.get_ylim()[1] * 0.97, f" {letter}", va="top", fontsize=8.5)
    ax.legend(loc="lower right", frameon=False, ncols=2)
    ax.set_title("(e)  speed", loc="left")
    road_axes(ax)
