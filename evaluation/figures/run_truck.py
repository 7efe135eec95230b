"""The paper's truck: beside it our own system drives slower than beside a car, on the same road at the same speeds."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from evaluation.figures.run_draw import frame
from evaluation.figures.run_scenes import run
from evaluation.figures.style import INK, risk_bar

TRUCK, CAR = "#d55e00", "#009e73"


def truck() -> Figure:
    """The field beside a truck and beside a car, and the speeds of both drives."""
    drives = {"truck": run("truck_adjacent"), "car": run("car_adjacent")}
    fig = Figure(figsize=(10.2, 5.6), layout="constrained")
    rows = fig.subplots(3, 1, gridspec_kw={"height_ratios": [1.0, 1.0, 2.0]})
    image = None
    for letter, ax, (kind, drive) in zip("ab", rows, drives.items(), strict=False):
        s, _ = drive.along()
        other_s, _ = drive.of(drive.only_other)
        k = int(np.nanargmin(np.abs(s - other_s)))
        step = drive.steps[k]
        image = frame(ax, drive, step, s[k] - 28.0, s[k] + 62.0, trail=k) or image
        slowest = float(drive.speed.min())
        ax.set_title(
            f"({letter})  beside a {kind}, t = {step.t:.1f} s, {step.ego.speed:.1f} m/s; slowest {slowest:.1f} m/s",
            loc="left",
        )
        rows[2].plot(s, drive.speed, color=TRUCK if kind == "truck" else CAR, lw=1.6, label=f"beside a {kind}")
        rows[2].axvline(s[k], color=TRUCK if kind == "truck" else CAR, lw=0.7, ls=":")
    rows[0].set_xlabel("")
    limit = next(iter(drives.values())).scenario.route.speed_limit
    if limit:
        rows[2].axhline(limit, color=INK, lw=0.7, ls="--", label="limit")
    low = min(float(d.speed.min()) for d in drives.values())
    top = max(limit, *(float(d.speed.max()) for d in drives.values()))
    rows[2].set_ylim(low - 0.25 * (top - low) - 0.2, top + 0.25 * (top - low) + 0.2)
    rows[2].set_xlabel("along the road [m]")
    rows[2].set_ylabel("driven speed [m/s]")
    rows[2].grid(alpha=0.25, lw=0.5)
    rows[2].legend(loc="lower right", frameon=False, ncols=3)
    rows[2].set_title("(c)  speed along the road; dotted: level with it", loc="left")
    if image is not None:
        risk_bar(fig, image, list(rows[:2]), shrink=0.8)
    fig.suptitle("A truck's field is wider than a car's, and the ego passes it more slowly", size=10)
    return fig
