"""The comparison as a picture."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

COLOURS = {
    "field_predictive": "#0072b2",
    "field_current": "#56b4e9",
    "ttc_lane": "#d55e00",
    "ttc_2d": "#e69f00",
    "wttc": "#999999",
}
"""Okabe and Ito's palette, safe for colour-blind readers."""
WRONG = "#d55e00"
RIGHT = "#dbe9f2"


def plot(result: dict[str, Any], path: Path) -> None:
    """Draw rates with their intervals, leads, what other thresholds would give, and the verdicts on the 24."""
    with mpl.rc_context({"font.size": 9, "axes.titlesize": 9.5, "savefig.dpi": 200, "axes.linewidth": 0.7}):
        _figure(result).savefig(path)


def _figure(result: dict[str, Any]) -> Figure:
    methods = list(result["random"])
    fig = Figure(figsize=(12.0, 6.0), layout="constrained")
    grid = fig.add_gridspec(2, 3, width_ratios=[0.8, 0.8, 1.1])
    _rates(fig.add_subplot(grid[0, :2]), result, methods)
    _leads(fig.add_subplot(grid[1, 0]), result, methods)
    _frontier(fig.add_subplot(grid[1, 1]), result, methods)
    _matrix(fig.add_subplot(grid[:, 2]), result, methods)
    return fig


def _rates(ax: Any, result: dict[str, Any], methods: list[str]) -> None:
    kinds = ("accuracy", "recall", "false_alarm_rate")
    width = 0.8 / len(methods)
    for k, m in enumerate(methods):
        f = result["random"][m]
        x = np.arange(len(kinds)) + (k - (len(methods) - 1) / 2) * width
        y = np.array([f[kind] for kind in kinds])
        ends = np.array([f["ci"][kind] for kind in kinds]).T
        ax.bar(x, 100 * y, 0.9 * width, color=COLOURS.get(m, "#999999"), label=m)
        ax.errorbar(x, 100 * y, 100 * np.abs(ends - y), fmt="none", ecolor="#1b1b1b", elinewidth=0.8, capsize=1.5)
    ax.set_xticks(range(len(kinds)), ["accuracy", "recall", "false alarms"])
    ax.set_ylabel("share [%]")
    ax.set_ylim(0, 128)
    ax.set_yticks(range(0, 101, 20))
    ax.axhline(95, color="#1b1b1b", lw=0.6, ls=":", zorder=0)
    n = result["random"][methods[0]]["n"]
    ax.set_title(f"(a)  {n} random variants of unseen seeds, 95 % intervals")
    ax.legend(frameon=False, fontsize=7, ncols=3, loc="upper center")


def _leads(ax: Any, result: dict[str, Any], methods: list[str]) -> None:
    for k, m in enumerate(methods):
        f = result["random"][m]
        low, high = f["ci"]["median_lead_s"]
        y = len(methods) - 1 - k
        ax.barh(y, f["median_lead_s"], 0.6, color=COLOURS.get(m, "#999999"))
        ax.plot([low, high], [y, y], color="#1b1b1b", lw=1.0)
    ax.axvline(result["rules"]["alarm_s"], color="#1b1b1b", lw=0.8, ls=":")
    ax.set_yticks(range(len(methods)), methods[::-1])
    ax.set_xlabel("median lead [s]; dotted: what counts")
    ax.set_title("(b)  how early")


def _frontier(ax: Any, result: dict[str, Any], methods: list[str]) -> None:
    """Each method at every threshold; a dot where it was tuned."""
    for m in methods:
        points = sorted(result["frontier"][m], key=lambda p: p["threshold"])
        lead, right = ([p[key] for p in points] for key in ("median_lead_s", "accuracy"))
        ax.plot(lead, 100 * np.array(right), color=COLOURS.get(m, "#999999"), lw=1.1)
        f = result["random"][m]
        ax.plot(f["median_lead_s"], 100 * f["accuracy"], "o", ms=4.5, color=COLOURS.get(m, "#999999"))
    ax.axvline(result["rules"]["alarm_s"], color="#1b1b1b", lw=0.8, ls=":")
    ax.axhline(95, color="#1b1b1b", lw=0.6, ls=":", zorder=0)
    ax.set_xlabel("median lead [s]")
    ax.set_ylabel("accuracy [%]")
    ax.set_ylim(45, 101)
    ax.set_title("(c)  every threshold; dot: as tuned")


def _matrix(ax: Any, result: dict[str, Any], methods: list[str]) -> None:
    cases = result["cases"]
    good = np.array([[c["methods"][m]["correct"] for m in methods] for c in cases])
    ax.imshow(good, cmap=mpl.colors.ListedColormap([WRONG, RIGHT]), vmin=0, vmax=1, aspect="auto")
    for i, case in enumerate(cases):
        for j, m in enumerate(methods):
            alarm = case["methods"][m]["alarm_s"]
            if case["label"] == "hazard":
                text = "–" if alarm is None else f"{case['event_s'] - alarm:.1f} s"
            else:
                text = "" if alarm is None else "false"
            ax.text(j, i, text, ha="center", va="center", fontsize=7, color="#1b1b1b")
    ax.set_xticks(range(len(methods)), [m.replace("_", "\n") for m in methods], fontsize=7.5)
    ax.set_yticks(range(len(cases)), [c["name"] for c in cases], fontsize=7.5)
    ax.axhline(11.5, color="#1b1b1b", lw=1.0)
    ax.set_title("(d)  the 24: lead of the warning; orange: wrong")
    ax.tick_params(length=0)
