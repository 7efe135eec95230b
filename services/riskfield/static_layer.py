"""The road as sources of risk: boundaries, obstacles and what is closed now, built once a map and cut to each grid.

- `unknown`, `dashed`, `solid` boundaries are lane lines; `kerb`, `barrier`, `road_edge` are barriers; `virtual` is
  nothing. Two lanes that share a boundary give one line; where they disagree on its type the more telling one holds.
- A barrier-type boundary with no lane beyond it is the road's outer edge and has no far side: the field stays at its
  peak beyond it, until a lane of the map begins there.
- Obstacles count as barriers; a stop line only while closed, then it is a barrier across.
- A closed lane is a barrier across its beginning and along the boundaries that neighbours share with it, so that it is
  not entered; its sides do not hold while the ego is in it, for it must be able to leave.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from common.geometry import Polyline
from common.messages import F32, F64, Ego, Grid, Lane, Map
from common.risk import RiskParameters
from common.risk_sources import Bools, StaticLine
from services.riskfield.grid import into_grid
from services.riskfield.layout import LINE_FIELDS

RANK = {"unknown": 0, "virtual": 1, "dashed": 2, "solid": 3, "road_edge": 4, "kerb": 5, "barrier": 6}
"""Where two lanes disagree on their boundary, the higher one holds; a type is a statement, `unknown` is none."""
BARRIERS = ("road_edge", "kerb", "barrier")
SAME_LINE = 0.3
"""Ends of one line drawn twice lie nearer than this [m]."""
SAMPLE = 1.0
"""Distance of the points by which lanes beyond an edge are found [m]."""


@dataclass
class _Boundary:
    points: F64
    kind: str
    lane: int
    side: int
    owners: int = 1
    neighbour: bool = False


class StaticLayer:
    """The lines of one map, with what is needed to cut them to a grid quickly."""

    def __init__(self, world: Map, p: RiskParameters) -> None:
        self._p = p
        self._lanes = {lane.id: lane for lane in world.lanes}
        self._stop_lines = {o.id: o for o in world.obstacles if o.kind == "stop_line"}
        lines = [line for b in _boundaries(world.lanes) if (line := self._boundary_line(b)) is not None]
        for o in world.obstacles:
            if o.kind != "stop_line" and (points := distinct(o.points)) is not None:
                lines.append(barrier(o.id, o.kind, points, o.width, p))
        self.lines: tuple[StaticLine, ...] = tuple(lines)
        """Every line that does not depend on closures; outer edges still without their depth."""
        self._boxes = _boxes([line.points for line in lines])
        self._deep: dict[int, StaticLine] = {}

    @cached_property
    def _lane_boxes(self) -> F64:
        return _boxes([lane.centre for lane in self._lanes.values()])

    def within(self, grid: Grid, closed: Iterable[int], ego: Ego) -> tuple[StaticLine, ...]:
        """Lines whose field may touch the grid, closures among them."""
        box = self._grid_box(grid)
        found = [self._with_depth(int(i)) for i in np.flatnonzero(_touch(self._boxes, box))]
        for line in self._closures(closed, ego):
            if _touch(_boxes([line.points]), box)[0]:
                found.append(line)
        return tuple(found)

    def _grid_box(self, grid: Grid) -> F64:
        length, width = grid.rows * grid.h, grid.columns * grid.h
        c, s = math.cos(grid.heading), math.sin(grid.heading)
        x = [grid.x, grid.x + c * length, grid.x - s * width, grid.x + c * length - s * width]
        y = [grid.y, grid.y + s * length, grid.y + c * width, grid.y + s * length + c * width]
        margin = max(self._p.edge_depth, self._p.barrier_half_width) + 2.0
        return np.array([min(x) - margin, min(y) - margin, max(x) + margin, max(y) + margin])

    def _boundary_line(self, b: _Boundary) -> StaticLine | None:
        if b.kind == "virtual" or (points := distinct(b.points)) is None:
            return None
        p = self._p
        if b.kind in BARRIERS:
            outer = b.owners == 1 and not b.neighbour
            label = "kerb" if b.kind == "kerb" else "barrier"
            return barrier(b.lane, label, points, p.barrier_width, p, side=b.side if outer else 0)
        half = max(p.lane_line_half_width, p.lane_line_width / 2)
        return StaticLine(b.lane, "lane_line", "lane_line", points, half, p.lane_line_peak)

    def _with_depth(self, i: int) -> StaticLine:
        line = self.lines[i]
        if not line.side:
            return line
        if i not in self._deep:
            self._deep[i] = _deepened(line, self._depth(line))
        return self._deep[i]

    def _depth(self, line: StaticLine) -> F64:
        """How far beyond each segment of an outer edge there is no lane [m], [n − 1]."""
        a = line.points[:-1]
        step = np.diff(line.points, axis=0)
        length = np.hypot(step[:, 0], step[:, 1])
        t = step / length[:, None]
        depth = np.full(len(a), self._p.edge_depth)
        box = _boxes([line.points])[0] + self._p.edge_depth * np.array([-1.0, -1.0, 1.0, 1.0])
        lanes = list(self._lanes.values())
        for k in np.flatnonzero(_touch(self._lane_boxes, box)):
            lane = lanes[int(k)]
            if (points := distinct(lane.centre)) is None:
                continue
            half = min(math.dist(lane.left[e], lane.right[e]) for e in (0, -1)) / 2
            rel = Polyline(points).resampled(SAMPLE).points[:, None] - a[None]
            along = np.sum(rel * t, axis=-1)
            beside = line.side * (rel[..., 1] * t[:, 0] - rel[..., 0] * t[:, 1])
            beyond = (along >= -SAMPLE / 2) & (along <= length + SAMPLE / 2) & (beside > SAME_LINE)
            free = np.where(beyond, beside - half - line.half_width, np.inf).min(axis=0)
            depth = np.minimum(depth, np.maximum(free, 0.0))
        return depth

    def _closures(self, closed: Iterable[int], ego: Ego) -> list[StaticLine]:
        p, lines = self._p, []
        for i in closed:
            if i in self._stop_lines and (points := distinct(self._stop_lines[i].points)) is not None:
                lines.append(barrier(i, "stop_line", points, self._stop_lines[i].width, p))
            lane = self._lanes.get(i)
            if lane is None:
                continue
            across = distinct(np.array([lane.left[0], lane.right[0]]))
            if across is not None:
                lines.append(barrier(i, "closed_lane", across, p.barrier_width, p))
            if _inside(lane, ego):
                continue
            for shared, side in ((lane.left_neighbour, lane.left), (lane.right_neighbour, lane.right)):
                if shared is not None and (points := distinct(side)) is not None:
                    lines.append(barrier(i, "closed_lane", points, p.barrier_width, p))
        return lines


def barrier(id: int, label: str, points: F64, width: float, p: RiskParameters, side: int = 0) -> StaticLine:
    """A line that is not to be crossed; one wider than `barrier_width` has a flat top of its extra width."""
    flat = max(width - p.barrier_width, 0.0) / 2
    return StaticLine(id, label, "barrier", points, p.barrier_half_width, p.barrier_peak, flat, side)


def distinct(points: F64) -> F64 | None:
    """The points without repeated ones; None where fewer than two are left."""
    try:
        return Polyline.of(points, tolerance=1e-3).points
    except ValueError:
        return None


def pack_lines(lines: tuple[StaticLine, ...], grid: Grid) -> F32:
    """Segments of lines as the kernels read them, [m, len(LINE_FIELDS)]; only those that touch the grid."""
    if not lines:
        return np.zeros((0, len(LINE_FIELDS)), dtype=np.float32)
    counts = np.array([len(line.points) for line in lines])
    index = np.repeat(np.arange(len(lines)), counts)
    points = into_grid(grid, np.concatenate([line.points for line in lines]))
    real = index[1:] == index[:-1]  # the others lead from one line to the next
    step = np.diff(points, axis=0)[real]
    points, index = points[:-1][real], index[:-1][real]
    length = np.hypot(step[:, 0], step[:, 1])
    t = step / length[:, None]
    goes_on = np.append(index[1:] == index[:-1], False)
    following = np.where(goes_on[:, None], np.roll(t, -1, axis=0), 0.0)

    half, k_s, flat, side, kind = np.array(
        [(n.half_width, n.peak / n.half_width**2, n.flat, n.side, n.kind == "barrier") for n in lines], dtype=np.float64
    )[index].T
    depth = np.concatenate([np.zeros(len(n.points) - 1) if n.depth is None else n.depth for n in lines])
    reach = half + flat
    deep = np.where(side != 0.0, depth + half, 0.0)
    cross = np.abs(t[:, 0] * following[:, 1] - t[:, 1] * following[:, 0])
    wedge = deep * np.where(np.sum(t * following, -1) > 0.0, cross, 1.0) * goes_on
    along_low, along_high = -reach, length + np.maximum(reach, wedge)
    beside_low = -np.where(side < 0.0, np.maximum(reach, deep), reach)
    beside_high = np.where(side > 0.0, np.maximum(reach, deep), reach)
    corners = points[:, 0] + np.stack(
        [al * t[:, 0] - pe * t[:, 1] for al in (along_low, along_high) for pe in (beside_low, beside_high)]
    )
    values: dict[str, F64] = {
        "x": points[:, 0],
        "y": points[:, 1],
        "tx": t[:, 0],
        "ty": t[:, 1],
        "length": length,
        "next_x": following[:, 0],
        "next_y": following[:, 1],
        "half_width": half,
        "k_s": k_s,
        "flat": flat,
        "side": side,
        "depth": depth,
        "kind": kind,
        "index": index.astype(np.float64),
        "x_low": corners.min(0),
        "x_high": corners.max(0),
        "along_low": along_low,
        "along_high": along_high,
        "beside_low": beside_low,
        "beside_high": beside_high,
    }
    touches = (values["x_low"] <= grid.rows * grid.h) & (values["x_high"] >= 0.0)
    return np.stack([values[name][touches] for name in LINE_FIELDS], axis=-1).astype(np.float32)


def _boundaries(lanes: list[Lane]) -> list[_Boundary]:
    """Every boundary once."""
    found: list[_Boundary] = []
    by_ends: dict[tuple[tuple[int, int], ...], _Boundary] = {}
    by_lane: dict[tuple[int, int], _Boundary] = {}
    for lane in lanes:
        for side, points, kind, neighbour, same_way in (
            (+1, lane.left, lane.left_type, lane.left_neighbour, lane.left_same_direction),
            (-1, lane.right, lane.right_type, lane.right_neighbour, lane.right_same_direction),
        ):
            ends = tuple(sorted((int(e[0]), int(e[1])) for e in np.round(points[[0, -1]] * 100.0)))
            key = (*ends, (round(float(np.hypot(*np.diff(points, axis=0).T).sum())), 0))
            other = by_ends.get(key)
            if other is None and neighbour is not None:
                other = by_lane.get((neighbour, -side if same_way else side))
                if other is not None and not _same_ends(other.points, points):
                    other = None
            if other is None:
                other = _Boundary(points, kind, lane.id, side, neighbour=neighbour is not None)
                found.append(other)
                by_ends[key] = other
            else:
                other.owners += 1
                other.kind = max(other.kind, kind, key=RANK.__getitem__)
                other.neighbour |= neighbour is not None
            by_lane[lane.id, side] = other
    return found


def _same_ends(a: F64, b: F64) -> bool:
    forth = max(math.dist(a[0], b[0]), math.dist(a[-1], b[-1]))
    back = max(math.dist(a[0], b[-1]), math.dist(a[-1], b[0]))
    return min(forth, back) < SAME_LINE


def _boxes(lines: list[F64]) -> F64:
    """Bounding boxes x0, y0, x1, y1 of lines, [n, 4]."""
    if not lines:
        return np.zeros((0, 4))
    return np.array([(*points.min(axis=0), *points.max(axis=0)) for points in lines])


def _touch(boxes: F64, box: F64) -> Bools:
    return np.asarray(
        (boxes[:, 0] <= box[2]) & (boxes[:, 2] >= box[0]) & (boxes[:, 1] <= box[3]) & (boxes[:, 3] >= box[1])
    )


def _deepened(line: StaticLine, depth: F64) -> StaticLine:
    return StaticLine(
        line.id, line.label, line.kind, line.points, line.half_width, line.peak, line.flat, line.side, depth
    )


def _inside(lane: Lane, ego: Ego) -> bool:
    """Whether the ego's centre lies in a lane."""
    polygon = np.concatenate((lane.left, lane.right[::-1]))
    x0, y0 = polygon[:, 0], polygon[:, 1]
    x1, y1 = np.roll(x0, -1), np.roll(y0, -1)
    crosses = (y0 > ego.y) != (y1 > ego.y)
    dy = np.where(y1 == y0, 1.0, y1 - y0)
    return bool(np.count_nonzero(crosses & (ego.x < x0 + (ego.y - y0) * (x1 - x0) / dy)) % 2)
