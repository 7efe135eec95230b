"""The lanes of a map as flat arrays, with a spatial index: which lane does each object drive on.

All lanes' centre lines stand in one array of points; lane l owns points start[l] … stop[l] − 1. For matching, the
lines are cut into pieces of a few metres, sorted by the cell of a coarse grid, so that a query looks only at pieces
near by, however many lanes the map has.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from common.geometry import wrap_angle
from common.messages import F64, I64, Lane, Map
from services.predictor.kinematic import State
from services.predictor.settings import MapSettings

PIECE_M = 3.0
"""Length of a piece [m]; longer where the map is so large that there would be more than PIECES_MAX of them."""
PIECES_MAX = 300_000
CELL_PIECES_MAX = 256
"""Pieces looked at in one cell."""
HALF_WIDTH = (1.0, 5.0)
"""Bounds of half a lane's width [m]."""
JOIN_M = 5.0
"""A successor that begins farther than this from the lane's end is not one [m]."""
LIMIT_LEAST = 0.5
"""A lower speed limit is taken for none [m/s]."""
SHAPE_M = 15.0
"""Over how much of its length the shape of a successor is judged [m]."""

SLIP_MAX = 0.5
"""The body's yaw may turn the direction by so much; who reverses is not turned round [rad]."""

_KEY = np.int64(2) ** 31


@dataclass(frozen=True)
class Match:
    """The lane of each object, shape [n]; lane −1: none."""

    lane: I64  # index into the index's lanes
    s: F64  # arc length of the nearest point, from the lane's beginning [m]
    off: F64  # direction of motion relative to the lane's direction there [rad]
    swerve: F64  # turn rate beyond what the lane's curvature asks for [rad/s]

    def take(self, rows: npt.NDArray[np.bool_]) -> Match:
        """The chosen objects alone."""
        return Match(self.lane[rows], self.s[rows], self.off[rows], self.swerve[rows])


class LaneIndex:
    """Lanes of one map. Built once for each map; read only."""

    def __init__(self, lanes: list[Lane]) -> None:
        counts = [len(lane.centre) for lane in lanes]
        points, owner = _joined([lane.centre for lane in lanes])
        keep = _first(owner) | (_steps(points) > 1e-3)
        self.half_width = _half_widths(lanes, points, owner, counts)[keep]
        """Half of the lane's width at each point [m]."""
        self.points, owner = points[keep], owner[keep]
        """Centre points of all lanes, shape [p, 2] [m]."""
        self.start = np.searchsorted(owner, np.arange(len(lanes)))
        self.stop = np.searchsorted(owner, np.arange(len(lanes)), side="right")
        step = np.where(_first(owner), 0.0, _steps(self.points))
        total = np.cumsum(step)
        self.s = total - total[self.start][owner] if len(owner) else total
        """Arc length of each point from its lane's beginning [m]."""
        self.length = self.s[self.stop - 1] if len(lanes) else np.zeros(0)
        """Length of each lane [m]; 0: a lane that is a point."""
        limit = np.array([lane.speed_limit for lane in lanes], dtype=np.float64)
        self.limit = np.where(limit >= LIMIT_LEAST, limit, 0.0)
        """Speed limit of each lane [m/s]; 0: unknown."""
        ids = {lane.id: i for i, lane in reversed(list(enumerate(lanes)))}
        self.left = [_neighbour(ids, lane.left_neighbour, lane.left_same_direction) for lane in lanes]
        """Lane to the left in the same direction, or −1."""
        self.right = [_neighbour(ids, lane.right_neighbour, lane.right_same_direction) for lane in lanes]
        self._successor_ids = [[ids[i] for i in lane.successors if i in ids] for lane in lanes]
        self._successors: dict[int, list[int]] = {}
        self._shapes: dict[int, tuple[float, float]] = {}
        self._build_pieces(owner)

    @staticmethod
    def of(map: Map) -> LaneIndex:
        """Index the lanes of a map."""
        return LaneIndex(map.lanes)

    def successors(self, lane: int) -> list[int]:
        """Lanes that go on where this one ends: near its end, not against its direction."""
        if lane not in self._successors:
            end, direction = self.points[self.stop[lane] - 1], self._direction(lane, at_end=True)
            self._successors[lane] = [
                k
                for k in dict.fromkeys(self._successor_ids[lane])
                if self.length[k] > 0
                and np.hypot(*(self.points[self.start[k]] - end)) <= JOIN_M
                and direction @ self._direction(k, at_end=False) > -0.2
            ]
        return self._successors[lane]

    def shape(self, lane: int, successor: int) -> tuple[float, float]:
        """Where a successor leads within SHAPE_M: metres ahead and to the left, seen from the lane's end."""
        if successor not in self._shapes:
            i, j = self.start[successor], self.stop[successor]
            s = min(SHAPE_M, float(self.length[successor]))
            x, y = (float(np.interp(s, self.s[i:j], self.points[i:j, k])) for k in (0, 1))
            self._shapes[successor] = x, y
        end, t = self.points[self.stop[lane] - 1], self._direction(lane, at_end=True)
        rx, ry = np.asarray(self._shapes[successor]) - end
        return float(t[0] * rx + t[1] * ry), float(t[0] * ry - t[1] * rx)

    def match(self, state: State, settings: MapSettings) -> Match:
        """The lane that fits each object's position, direction and turn rate best.

        Cost of a piece: (d / half width)² + (Δψ / 0.3)² + ((ω − v κ) / `swerve_scale`)², the last for what
        moves.
        """
        n = len(state.x)
        result = Match(np.full(n, -1, dtype=np.int64), np.zeros(n), np.zeros(n), np.zeros(n))
        obj, piece = self._near(state.x, state.y)
        if not len(obj):
            return result
        slip = np.clip(wrap_angle(state.heading - state.course), -SLIP_MAX, SLIP_MAX)
        direction = state.course + settings.body_yaw * slip
        rx, ry = state.x[obj] - self._px[piece], state.y[obj] - self._py[piece]
        tx, ty, length = self._tx[piece], self._ty[piece], self._plength[piece]
        u = np.clip(rx * tx + ry * ty, 0.0, length)
        distance = np.hypot(rx - u * tx, ry - u * ty)
        off = wrap_angle(direction[obj] - self._pheading[piece])
        half = self._phalf[piece]
        swerve = np.where(
            state.speed[obj] > 2.0, state.turn_rate[obj] - state.speed[obj] * self._pcurvature[piece], 0.0
        )
        follows = (np.abs(off) <= settings.heading_tolerance) & (np.abs(swerve) <= settings.swerve_max)
        ok = np.flatnonzero((distance <= half + settings.margin_m) & follows)
        obj, piece, u, off, swerve = obj[ok], piece[ok], u[ok], off[ok], swerve[ok]
        cost = (distance[ok] / half[ok]) ** 2 + (off / 0.3) ** 2 + (swerve / settings.swerve_scale) ** 2
        order = np.lexsort((piece, cost, obj))
        best = order[_first(obj[order])]
        result.lane[obj[best]] = self._plane[piece[best]]
        result.s[obj[best]] = self._ps[piece[best]] + u[best]
        result.off[obj[best]], result.swerve[obj[best]] = off[best], swerve[best]
        return result

    def _direction(self, lane: int, *, at_end: bool) -> F64:
        i = self.stop[lane] - 2 if at_end else self.start[lane]
        d = self.points[i + 1] - self.points[i]
        return np.asarray(d / np.hypot(*d))

    def _build_pieces(self, owner: npt.NDArray[np.intp]) -> None:
        """Cut the lanes into pieces of equal length and sort them by cell."""
        step = max(PIECE_M, float(self.length.sum()) / PIECES_MAX)
        n = np.ceil(self.length / step).astype(np.int64)
        lane = np.repeat(np.arange(len(n)), n)
        k = np.arange(len(lane)) - np.repeat(np.cumsum(n) - n, n)
        each = self.length[lane] / n[lane]
        # one axis for all lanes: lane l begins at base[l], and a gap of 1 m keeps lanes apart
        base = np.cumsum(self.length + 1.0) - (self.length + 1.0)
        axis = base[owner] + self.s if len(owner) else np.zeros(0)

        def at(s: F64, values: F64) -> F64:
            return np.asarray(np.interp(base[lane] + s, axis, values)) if len(lane) else np.zeros(0)

        x0, y0 = at(k * each, self.points[:, 0]), at(k * each, self.points[:, 1])
        x1, y1 = at((k + 1) * each, self.points[:, 0]), at((k + 1) * each, self.points[:, 1])
        chord = np.hypot(x1 - x0, y1 - y0)
        safe = np.maximum(chord, 1e-9)
        heading = np.arctan2(y1 - y0, x1 - x0)
        before = np.where((k > 0), np.roll(heading, 1), heading)
        after = np.where(k < n[lane] - 1, np.roll(heading, -1), heading)
        span = each * np.maximum((k > 0).astype(np.int64) + (k < n[lane] - 1), 1)
        curvature = wrap_angle(after - before) / np.maximum(span, 1e-3)
        self._cell = step + HALF_WIDTH[1]
        keys = self._cell_key((x0 + x1) / 2, (y0 + y1) / 2)
        order = np.argsort(keys, kind="stable")
        self._keys = keys[order]
        self._px, self._py, self._plength = x0[order], y0[order], chord[order]
        self._tx, self._ty = ((x1 - x0) / safe)[order], ((y1 - y0) / safe)[order]
        self._pheading, self._pcurvature = heading[order], curvature[order]
        self._plane, self._ps = lane[order], (k * each)[order]
        self._phalf = at((k + 0.5) * each, self.half_width)[order]

    def _cell_key(self, x: F64, y: F64) -> I64:
        return self._key(np.floor(x / self._cell).astype(np.int64), np.floor(y / self._cell).astype(np.int64))

    @staticmethod
    def _key(i: I64, j: I64) -> I64:
        return np.asarray(i * _KEY + j)

    def _near(self, x: F64, y: F64) -> tuple[npt.NDArray[np.intp], npt.NDArray[np.intp]]:
        """Pairs (object, piece) of the nine cells about each object."""
        around = np.arange(-1, 2)
        i = np.floor(x / self._cell).astype(np.int64)[:, None, None] + around[:, None]
        j = np.floor(y / self._cell).astype(np.int64)[:, None, None] + around
        keys = self._key(i, j).reshape(-1)
        low = np.searchsorted(self._keys, keys)
        n = np.minimum(np.searchsorted(self._keys, keys, side="right") - low, CELL_PIECES_MAX)
        obj = np.repeat(np.repeat(np.arange(len(x)), 9), n)
        return obj, np.repeat(low - (np.cumsum(n) - n), n) + np.arange(len(obj))


def _joined(lines: list[F64]) -> tuple[F64, npt.NDArray[np.intp]]:
    """Points of all lines in one array, and which line owns each."""
    if not lines:
        return np.zeros((0, 2)), np.zeros(0, dtype=np.intp)
    return np.concatenate(lines), np.repeat(np.arange(len(lines)), [len(line) for line in lines])


def _first(owner: npt.NDArray[np.intp]) -> npt.NDArray[np.bool_]:
    """Where a new owner begins."""
    first = np.ones(len(owner), dtype=bool)
    first[1:] = owner[1:] != owner[:-1]
    return first


def _steps(points: F64) -> F64:
    """Distance of each point from the one before; 0 for the first."""
    steps = np.zeros(len(points))
    d = np.diff(points, axis=0)
    steps[1:] = np.hypot(d[:, 0], d[:, 1])
    return steps


def _fractions(points: F64, owner: npt.NDArray[np.intp]) -> F64:
    """2 · owner + share of the line's length at each point, 0 … 1: increases over all lines."""
    total = np.cumsum(np.where(_first(owner), 0.0, _steps(points)))
    first = _first(owner)
    start = total[first][owner]
    last = np.append(first[1:], True)
    length = total[last][owner] - start
    return np.asarray(2.0 * owner + np.clip((total - start) / np.maximum(length, 1e-9), 0.0, 1.0))


def _half_widths(lanes: list[Lane], centre: F64, owner: npt.NDArray[np.intp], counts: list[int]) -> F64:
    """Half the distance between left and right boundary beside each centre point [m]."""
    if not counts:
        return np.zeros(0)
    at = _fractions(centre, owner)
    sides = []
    for lines in ([lane.left for lane in lanes], [lane.right for lane in lanes]):
        points, side_owner = _joined(lines)
        f = _fractions(points, side_owner)
        sides.append([np.interp(at, f, points[:, k]) for k in (0, 1)])
    (lx, ly), (rx, ry) = sides
    return np.clip(np.hypot(lx - rx, ly - ry) / 2, *HALF_WIDTH)


def _neighbour(ids: dict[int, int], neighbour: int | None, same_direction: bool) -> int:
    return ids.get(neighbour, -1) if neighbour is not None and same_direction else -1
