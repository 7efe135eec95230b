"""Labels that do not cover each other: all have one size on the screen, so where they stand decides."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from common.messages import F64, I64

ALONG_M, ACROSS_M = 20.0, 4.5
"""What a label takes in a view from above, along and across the picture [m]."""


def apart(x: F64, y: F64, at: tuple[float, float, float] | None, most: int) -> I64:
    """Which points may carry a label: the nearest first, none where a nearer one already has its own.

    Args:
        x: points of the `map` frame [m].
        y: likewise.
        at: position [m] and heading [rad] of the ego; None: unknown.
        most: largest number of labels.
    """
    ego_x, ego_y, heading = (float(np.mean(x)), float(np.mean(y)), 0.0) if at is None and len(x) else at or (0, 0, 0)
    c, s = np.cos(heading), np.sin(heading)
    along = c * (x - ego_x) + s * (y - ego_y)
    across = c * (y - ego_y) - s * (x - ego_x)
    kept: list[int] = []
    for i in np.argsort(np.hypot(along, across), kind="stable"):
        if len(kept) >= most:
            break
        if not any(abs(along[i] - along[k]) < ALONG_M and abs(across[i] - across[k]) < ACROSS_M for k in kept):
            kept.append(int(i))
    return np.array(kept, dtype=np.int64)


def beside(x: float, y: float, heading: float, left: float) -> tuple[npt.ArrayLike, npt.ArrayLike]:
    """The point `left` metres to the left of (x, y) for one who looks along `heading`."""
    return x - left * np.sin(heading), y + left * np.cos(heading)
