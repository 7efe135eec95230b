"""The drivable area of a map, and how far a body reaches beyond it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import shapely

from common.geometry import rectangle_corners
from common.messages import F64, Ego, Map

SEAM_M = 0.1
"""Lanes that do not quite meet are joined over so much."""


@dataclass(frozen=True)
class RoadArea:
    """All lanes as one area without holes (what lies between the ways through a junction is road), and hard lines.

    An island is kept out by the kerb around it.
    """

    area: Any  # shapely geometry
    lines: Any

    @staticmethod
    def of(road: Map | None) -> RoadArea | None:
        """None where no lane is known."""
        if road is None or not road.lanes:
            return None
        parts = []
        for lane in road.lanes:
            shape = shapely.Polygon(np.vstack((lane.left, lane.right[::-1])))
            parts.append(shape if shape.is_valid else shape.buffer(0.0))
        whole = shapely.union_all([p.buffer(SEAM_M / 2, join_style="mitre") for p in parts])
        polygons = shapely.get_parts(whole)
        filled = shapely.union_all([shapely.Polygon(p.exterior) for p in polygons if p.geom_type == "Polygon"])
        hard = [shapely.LineString(o.points) for o in road.obstacles if o.kind in ("barrier", "kerb")]
        shapely.prepare(filled)
        return RoadArea(filled, shapely.union_all(hard) if hard else None)

    def overhang(self, states: Sequence[Ego]) -> F64:
        """How far each state's outline lies outside, or 1 m where it cuts a kerb or barrier [m]."""
        e = states
        corners = rectangle_corners(
            [s.x for s in e], [s.y for s in e], [s.heading for s in e], [s.length for s in e], [s.width for s in e]
        )
        points = np.concatenate((corners, 0.5 * (corners + np.roll(corners, 1, axis=1))), axis=1)
        inside = shapely.contains_xy(self.area, points[..., 0], points[..., 1])
        out = np.zeros(points.shape[:2])
        if not inside.all():
            away = shapely.points(points[~inside])
            out[~inside] = shapely.distance(away, self.area)
        worst = out.max(axis=1)
        if self.lines is not None:
            worst = np.where(shapely.intersects(shapely.polygons(corners), self.lines), np.maximum(worst, 1.0), worst)
        return np.asarray(np.maximum(worst - SEAM_M / 2, 0.0))
