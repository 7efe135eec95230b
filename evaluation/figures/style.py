"""How the figures look: one colour map for risk, perceptually uniform and safe for colour-blind readers; metres."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.colors import Colormap, ListedColormap
from matplotlib.patches import Polygon

from common.geometry import rectangle_corners
from common.messages import F64, Grid

RISK_TOP = 1.5
"""Upper end of the risk's colours [E_max]."""
INK = "#1b1b1b"
EGO = "#0072b2"
"""Blue of the Okabe-Ito palette."""
ACCENT = "#009e73"
"""Green of the same."""
RC = {
    "font.family": "sans-serif",
    "font.size": 9,
    "axes.titlesize": 9.5,
    "axes.labelsize": 9,
    "axes.linewidth": 0.7,
    "xtick.labelsize": 8,
    "ytick.labelsize": 8,
    "legend.fontsize": 8,
    "figure.dpi": 100,
    "savefig.dpi": 220,
    "savefig.facecolor": "white",
    "text.color": INK,
    "axes.labelcolor": INK,
}


def risk_colours() -> Colormap:
    """White at no risk, through orange, to almost black: magma reversed, its first steps lightened to white."""
    table = np.asarray(colormaps["magma_r"](np.linspace(0.0, 0.97, 256)))
    fade = np.clip(np.arange(256) / 40.0, 0.0, 1.0)[:, None]
    table[:, :3] = fade * table[:, :3] + (1.0 - fade)
    return ListedColormap(table, name="risk")


def show(ax: Any, m: F64, grid: Grid, top: float = RISK_TOP) -> Any:
    """Draw a field [rows, columns] of a grid that lies along x."""
    extent = (grid.x, grid.x + grid.rows * grid.h, grid.y, grid.y + grid.columns * grid.h)
    return ax.imshow(
        m.T,
        origin="lower",
        extent=extent,
        cmap=risk_colours(),
        vmin=0.0,
        vmax=top,
        interpolation="bilinear",
        aspect="equal",
    )


def body(ax: Any, x: float, y: float, heading: float, length: float, width: float, **how: Any) -> None:
    """Draw a rectangle with a line across it near its front."""
    style: dict[str, Any] = {"facecolor": "none", "edgecolor": INK, "linewidth": 0.9, "zorder": 5, **how}
    ax.add_patch(Polygon(rectangle_corners(x, y, heading, length, width), closed=True, **style))
    if style["linewidth"] and length > 1.0:
        front = length / 2 - 0.25 * min(length, 4.0)
        c, s = np.cos(heading), np.sin(heading)
        ends = [(x + c * front - s * d, y + s * front + c * d) for d in (-width / 2, width / 2)]
        ax.plot(*zip(*ends, strict=True), color=style["edgecolor"], lw=0.7 * style["linewidth"], zorder=style["zorder"])


def risk_bar(fig: Any, image: Any, axes: Any, label: str = r"risk $M$ [$E_\mathrm{max}$]", **how: Any) -> None:
    """A colour bar with its unit; the pointed end says that higher values are drawn alike."""
    bar = fig.colorbar(image, ax=axes, extend="max", **{"shrink": 0.9, "pad": 0.02, **how})
    bar.set_label(label)
    bar.outline.set_linewidth(0.6)


def metres(ax: Any, x: bool = True, y: bool = True) -> None:
    """Axis labels in metres."""
    if x:
        ax.set_xlabel("x [m]")
    if y:
        ax.set_ylabel("y [m]")
