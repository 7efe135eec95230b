"""What recordings leave out: headings from motion, the 10 Hz grid."""

from __future__ import annotations

import numpy as np

from common.geometry import Polyline, wrap_angle
from common.messages import F64, FRAME_S

MOVED_M = 0.15
"""Displacement [m] from which a direction of motion is believed."""

SIGMAS_M = (12.0, 8.0, 5.0, 3.0, 2.0, 1.5)
"""Lengths over which a line may be smoothed [m], the gentlest last."""


def heading_from_motion(x: F64, y: F64, otherwise: float = 0.0) -> F64:
    """Direction of motion at each row [rad], looking back as far as it takes to have moved 0.15 m.

    Rows before the first believable motion take its direction; one who never moves gets `otherwise`.
    """
    heading = np.full(len(x), np.nan)
    anchor = 0
    for i in range(1, len(x)):
        dx, dy = x[i] - x[anchor], y[i] - y[anchor]
        if np.hypot(dx, dy) >= MOVED_M:
            heading[i] = np.arctan2(dy, dx)
            anchor = max(anchor + 1, i - 5)
            while anchor < i - 1 and np.hypot(x[i] - x[anchor + 1], y[i] - y[anchor + 1]) >= MOVED_M:
                anchor += 1
        elif i > 0:
            heading[i] = heading[i - 1]
    known = np.flatnonzero(np.isfinite(heading))
    if not len(known):
        return np.full(len(x), otherwise)
    heading[: known[0]] = heading[known[0]]
    return heading


def on_frames(t: F64, x: F64, y: F64, heading: F64) -> tuple[int, F64, F64, F64]:
    """Bring a record at times `t` [s] onto the 10 Hz grid by linear interpolation; returns the first frame and rows."""
    first = int(np.ceil(t[0] / FRAME_S - 1e-6))
    last = int(np.floor(t[-1] / FRAME_S + 1e-6))
    grid = np.arange(first, max(last, first) + 1) * FRAME_S
    turned = np.unwrap(heading)
    return first, np.interp(grid, t, x), np.interp(grid, t, y), wrap_angle(np.interp(grid, t, turned))


def smoothed(points: F64, sigma_m: float = 1.5, step_m: float = 0.5) -> F64:
    """A line with points every `step_m`, smoothed over `sigma_m` [m] of arc length; the ends stay where they are.

    Recorded paths and lane centres have kinks between their points; a Gaussian over arc length leaves a curvature of
    at most kink / (2.5 σ) and moves an arc of radius R inwards by σ²/2R.
    """
    line = Polyline.of(points, tolerance=1e-3).resampled(step_m)
    step = line.length / (len(line.points) - 1)
    reach = max(1, round(3 * sigma_m / step))
    kernel = np.exp(-0.5 * (np.arange(-reach, reach + 1) * step / sigma_m) ** 2)
    kernel /= kernel.sum()
    beyond = np.arange(1, reach + 1) * step
    padded = np.vstack((line.at(-beyond[::-1]), line.points, line.at(line.length + beyond)))
    return np.stack([np.convolve(padded[:, k], kernel, mode="valid") for k in (0, 1)], axis=-1)


def fair(points: F64, allowed_m: float = 0.2) -> F64:
    """The line smoothed as far as it moves by no more than `allowed_m` [m]: straight roads much, tight turns little."""
    raw = Polyline.of(points, tolerance=1e-3).resampled(0.5)
    line = raw.points
    for sigma in SIGMAS_M:
        line = smoothed(points, sigma)
        if float(np.max(np.abs(raw.project(line)[1]))) <= allowed_m:
            break
    return line
