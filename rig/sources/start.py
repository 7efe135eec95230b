"""Nobody starts where the ego is."""

from __future__ import annotations

import numpy as np

from common.geometry import distance_between_rectangles, rectangle_corners, wrap_angle
from common.messages import Ego
from rig.world import Track


def without_ego(tracks: list[Track], ego: Ego, warnings: list[str]) -> tuple[list[Track], Track | None]:
    """Take out who overlaps the ego at frame 0, each with a warning; returns the rest and the recorded driver, if any.

    The recorded driver is the one whose body covers the ego's centre and who heads the same way.
    """
    human = None
    rest = []
    for k in tracks:
        i = -k.frame0
        if 0 <= i < len(k.x):
            c, s = np.cos(k.heading[i]), np.sin(k.heading[i])
            dx, dy = ego.x - k.x[i], ego.y - k.y[i]
            inside = abs(c * dx + s * dy) < k.length / 2 and abs(c * dy - s * dx) < k.width / 2
            if human is None and inside and abs(float(wrap_angle(k.heading[i] - ego.heading))) < 0.5:
                human = k
                warnings.append(f"{k.label} stands in the ego's place at the start: it is the recorded driver")
                continue
            body = rectangle_corners(ego.x, ego.y, ego.heading, ego.length, ego.width)
            other = rectangle_corners(k.x[i], k.y[i], k.heading[i], k.length, k.width)
            if float(distance_between_rectangles(body, other)) <= 0.0:
                warnings.append(f"{k.label} overlaps the ego at the start and is left out")
                continue
        rest.append(k)
    return rest, human
