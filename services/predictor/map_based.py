"""Map-based prediction: an object on a lane follows it, its successors, curves and limits.

In the path's Frenet frame (s along the lanes' centre, d to the left):

    d(s) = T + (d_0 − T) e^(−s / (v_0 τ))       the lateral motion seen now goes over into the target offset T
    ds/dt = v / (1 − κ d)

T is the centre of the next lane for a lane change in progress, this lane's centre for one that is ending, and
otherwise the offset that is kept. v keeps the acceleration seen (`kinematic.speeds_ahead`), below the limit and below
√(a_lat / |κ|), braking for what lies ahead with comfort. Where the lanes end the path goes straight on.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from common.geometry import wrap_angle
from common.messages import F64, FRAME_S, I64, PREDICTION_FRAMES, SPEED_LIMIT
from services.predictor.kinematic import Motion, State, speeds_ahead
from services.predictor.lanes import LaneIndex, Match
from services.predictor.settings import KinematicSettings, MapSettings

STATIONS = 64
"""Points along each path at which curvature and speed are found."""
CURVATURE_M = 3.0
"""Curvature is the change of heading over this far before and after [m]."""
CURVATURE_MAX = 0.5  # 1/m
LATERAL_MAX = 2.0  # m/s
TAU_S = (0.5, 4.0)
"""Bounds of the time constant of a lane change [s]."""
HEADING_M = 8.0
"""Distance over which the body's angle to its path goes [m]."""
LANES_MAX = 64
"""Lanes that one path may run through."""


def map_based(
    state: State, match: Match, index: LaneIndex, settings: MapSettings, kinematic: KinematicSettings
) -> Motion:
    """Motion of n ≥ 1 objects, each of which has a lane."""
    v0 = np.hypot(state.vx, state.vy)
    free = speeds_ahead(v0, state.acceleration, kinematic)
    reach = FRAME_S * free.sum(axis=1) + 5.0
    paths, s0 = _paths(state, match, index, reach, settings)
    px, py, psi = paths.at(s0[:, None])
    px, py, psi = px[:, 0], py[:, 0], psi[:, 0]
    nx, ny = -np.sin(psi), np.cos(psi)
    d0 = (state.x - px) * nx + (state.y - py) * ny
    lateral = np.clip(v0 * np.sin(state.course - psi), -LATERAL_MAX, LATERAL_MAX)
    target, tau = _target(d0, lateral, match, index, settings)

    s, v = _along(paths, s0, v0, free, reach, d0, target, tau, settings)
    fade = np.exp(-(s - s0[:, None]) / (np.maximum(v0, 1e-3) * tau)[:, None])
    d = target[:, None] + (d0 - target)[:, None] * fade
    qx, qy, course = paths.at(s)
    # what the projection leaves (nearest point and interpolated normal differ slightly) stays constant
    left_x, left_y = state.x - px - d0 * nx, state.y - py - d0 * ny
    slope0 = (target - d0) / (np.maximum(v0, 1e-3) * tau)
    angle = np.arctan(slope0[:, None] * fade)
    own = wrap_angle(state.heading - psi - np.arctan(slope0))
    course = np.unwrap(np.concatenate((psi[:, None], course), axis=1), axis=1)[:, 1:] - psi[:, None]
    turned = course + angle - np.arctan(slope0)[:, None] - own[:, None] * (1 - np.exp(-(s - s0[:, None]) / HEADING_M))
    normal = course + psi[:, None]
    return Motion(
        x=qx - d * np.sin(normal) + left_x[:, None],
        y=qy + d * np.cos(normal) + left_y[:, None],
        heading=state.heading[:, None] + turned,
        speed=v,
    )


def _target(d0: F64, lateral: F64, match: Match, index: LaneIndex, settings: MapSettings) -> tuple[F64, F64]:
    """Offset T towards which each object moves [m], and the time constant τ with which it gets there [s]."""
    lane = match.lane
    half = index.half_width[index.start[lane]]
    side = np.where(lateral > 0, [index.left[k] for k in lane], [index.right[k] for k in lane])
    across = np.where(side >= 0, half + index.half_width[index.start[side]], 0.0) * np.sign(lateral)
    fast = np.abs(lateral) >= settings.lane_change_mps
    returning = fast & (d0 * lateral < 0)
    leaving = fast & ~returning & (side >= 0)
    keep = np.clip(d0 + lateral * settings.settle_s, -np.maximum(half, np.abs(d0)), np.maximum(half, np.abs(d0)))
    target = np.where(returning, 0.0, np.where(leaving, across, keep))
    safe = np.where(fast, lateral, 1.0)
    tau = np.where(returning | leaving, np.clip((target - d0) / safe, *TAU_S), settings.settle_s)
    return target, tau


def _along(
    paths: _Paths,
    s0: F64,
    v0: F64,
    free: F64,
    reach: F64,
    d0: F64,
    target: F64,
    tau: F64,
    settings: MapSettings,
) -> tuple[F64, F64]:
    """Arc length s and speed v at the 60 frames, shape [n, 60]."""
    n = len(s0)
    ds = reach / (STATIONS - 1)
    station = s0[:, None] + ds[:, None] * np.arange(STATIONS)
    kappa = wrap_angle(paths.at(station + CURVATURE_M)[2] - paths.at(station - CURVATURE_M)[2]) / (2 * CURVATURE_M)
    kappa = np.clip(kappa, -CURVATURE_MAX, CURVATURE_MAX)
    # who now corners harder, or drives faster than allowed, goes on to do so
    a_lat = np.maximum(settings.lateral_mps2, v0**2 * np.abs(kappa[:, 0]))
    allowed = np.sqrt(a_lat[:, None] / np.maximum(np.abs(kappa), 1e-6))
    limit = paths.limit_at(station)
    habit = np.maximum(v0 / np.where(limit[:, 0] > 0, limit[:, 0], np.inf), 1.0)
    allowed = np.minimum(allowed, np.where(limit > 0, limit * habit[:, None], np.inf))
    squared = np.ascontiguousarray(allowed.T) ** 2  # station by station: a row is all objects at one
    gained = 2 * settings.braking_mps2 * ds
    for k in range(STATIONS - 2, -1, -1):
        np.minimum(squared[k], squared[k + 1] + gained, out=squared[k])
    allowed = np.sqrt(squared).ravel()

    s, v = np.empty((PREDICTION_FRAMES, n)), np.empty((PREDICTION_FRAMES, n))
    bent, wished = np.ascontiguousarray(kappa.T).ravel(), np.ascontiguousarray(free.T)
    wished = np.diff(wished, axis=0, prepend=v0[None])
    slowest, aside, fading = settings.braking_mps2 * FRAME_S, d0 - target, -1.0 / (np.maximum(v0, 1e-3) * tau)
    moved, v_now, rows = np.zeros(n), v0, np.arange(n)
    for i in range(PREDICTION_FRAMES):
        near = np.minimum((moved / ds).astype(np.int64), STATIONS - 1) * n + rows
        v_next = np.minimum(v_now + wished[i], np.maximum(allowed.take(near), v_now - slowest))
        v_next = np.minimum(np.maximum(v_next, 0.0), SPEED_LIMIT)
        d = target + aside * np.exp(moved * fading)
        shrink = np.minimum(np.maximum(1.0 - bent.take(near) * d, 0.3), 3.0)
        moved = moved + FRAME_S / 2 * (v_now + v_next) / shrink
        v_now = v_next
        s[i], v[i] = moved, v_now
    return np.ascontiguousarray((s0 + s).T), np.ascontiguousarray(v.T)


@dataclass(frozen=True)
class _Paths:
    """One line for each of n objects, all points in one array; straight beyond the ends."""

    points: F64  # [p, 2]
    tangents: F64  # of the segment that begins at each point, [p, 2]
    vertex: F64  # mean tangent at each point, [p, 2]
    s: F64  # arc length from the path's beginning [m], [p]
    limit: F64  # speed limit [m/s] at each point, 0: unknown
    base: F64  # where each path begins on the common axis [m], [n]
    length: F64  # [n]
    axis: F64  # base + s, increasing over all paths, [p]
    last: I64  # index of each path's last point, [n]

    def at(self, s: F64) -> tuple[F64, F64, F64]:
        """x, y and direction at arc lengths s, shape [n, k]; the direction turns smoothly along each segment."""
        j = self._segment(s)
        step = s - self.s[j]
        x = self.points[j, 0] + self.tangents[j, 0] * step
        y = self.points[j, 1] + self.tangents[j, 1] * step
        u = np.clip(step / np.maximum(self.s[j + 1] - self.s[j], 1e-9), 0.0, 1.0)
        tx = self.vertex[j, 0] + u * (self.vertex[j + 1, 0] - self.vertex[j, 0])
        ty = self.vertex[j, 1] + u * (self.vertex[j + 1, 1] - self.vertex[j, 1])
        return x, y, np.arctan2(ty, tx)

    def limit_at(self, s: F64) -> F64:
        """Speed limit at arc lengths s, shape [n, k]."""
        return np.asarray(self.limit[self._segment(s)])

    def _segment(self, s: F64) -> npt.NDArray[np.intp]:
        key = self.base[:, None] + np.clip(s, 0.0, self.length[:, None])
        j = np.searchsorted(self.axis, key.ravel(), side="right").reshape(s.shape) - 1
        return np.minimum(j, self.last[:, None] - 1)


def _paths(state: State, match: Match, index: LaneIndex, reach: F64, settings: MapSettings) -> tuple[_Paths, F64]:
    """The lanes each object will run through, as one path each, and where on it the object is (s_0)."""
    starts: list[int] = []
    stops: list[int] = []
    lanes: list[int] = []
    owners: list[int] = []
    s0 = np.empty(len(reach))
    for o, lane in enumerate(match.lane.tolist()):
        i, j = int(index.start[lane]), int(index.stop[lane])
        here = i + int(np.searchsorted(index.s[i:j], match.s[o], side="right")) - 1
        here = min(max(here - 1, i), j - 2)  # one point more behind, so that the direction here is a mean
        s0[o] = match.s[o] - index.s[here]
        swerve = _Swerve(float(state.speed[o]), float(match.off[o]), float(match.swerve[o]))
        chain = _chain(index, lane, float(match.s[o]), float(reach[o]), swerve, settings.branch_s)
        starts += [here, *(int(index.start[k]) for k in chain[1:])]
        stops += [int(index.stop[k]) for k in chain]
        lanes += chain
        owners += [o] * len(chain)
    n = np.asarray(stops) - np.asarray(starts)
    which = np.repeat(np.asarray(starts) - (np.cumsum(n) - n), n) + np.arange(int(n.sum()))
    return _assembled(index.points[which], np.repeat(owners, n), np.repeat(index.limit[lanes], n)), s0


def _assembled(points: F64, owner: npt.NDArray[np.intp], limit: F64) -> _Paths:
    """Drop repeated points (a successor begins where its lane ends) and find tangents and arc lengths."""
    step = np.zeros(len(points))
    step[1:] = np.hypot(*np.diff(points, axis=0).T)
    first = np.ones(len(points), dtype=bool)
    first[1:] = owner[1:] != owner[:-1]
    keep = first | (step > 1e-3)
    # of two points at one place the later lane's limit counts
    repeated = np.flatnonzero(~keep)
    limit = limit.copy()
    limit[repeated - 1] = limit[repeated]
    points, owner, limit = points[keep], owner[keep], limit[keep]
    first = np.ones(len(points), dtype=bool)
    first[1:] = owner[1:] != owner[:-1]
    last = np.append(first[1:], True)
    d = np.zeros_like(points)
    d[:-1] = np.diff(points, axis=0)
    ends = np.flatnonzero(last)
    d[ends] = d[ends - 1]
    length = np.hypot(d[:, 0], d[:, 1])
    tangents = d / np.maximum(length, 1e-9)[:, None]
    into = np.where(first[:, None], tangents, np.roll(tangents, 1, axis=0))
    vertex = into + tangents
    vertex = np.where(np.hypot(vertex[:, 0], vertex[:, 1])[:, None] > 0.1, vertex, tangents)
    vertex /= np.hypot(vertex[:, 0], vertex[:, 1])[:, None]
    total = np.cumsum(np.where(first, 0.0, np.roll(length, 1)))
    s = total - total[first][owner]
    lengths = s[ends]
    base = np.cumsum(lengths + 1.0) - (lengths + 1.0)
    return _Paths(points, tangents, vertex, s, limit, base, lengths, base[owner] + s, ends)


@dataclass(frozen=True)
class _Swerve:
    """How the last second's motion leaves the lane, as the choice at a branch needs it."""

    speed: float  # [m/s]
    off: float  # course relative to the lane [rad]
    turn_rate: float  # beyond the lane's own [rad/s]

    def direction(self, ahead: float) -> float:
        """Direction, relative to the lane's, of the point that the present arc reaches `ahead` metres on [rad]."""
        return self.off + 0.5 * self.turn_rate / max(self.speed, 1.0) * ahead


def _chain(index: LaneIndex, lane: int, s: float, reach: float, swerve: _Swerve, branch_s: float) -> list[int]:
    """Lane and successors over `reach` metres: at the first branch as the motion tells, then the straightest."""
    chain, left = [lane], float(index.length[lane]) - s
    decided = False
    while left < reach and len(chain) < LANES_MAX:
        options = index.successors(chain[-1])
        if not options:
            break
        best = options[0]
        if len(options) > 1:
            follow = not decided and left <= swerve.speed * branch_s
            best = _branch(index, chain[-1], options, swerve if follow else None)
            decided = True
        chain.append(best)
        left += float(index.length[best])
    return chain


def _branch(index: LaneIndex, lane: int, options: list[int], swerve: _Swerve | None) -> int:
    """The successor whose shape is nearest to where the present motion leads; without it, the straightest."""

    def miss(successor: int) -> float:
        ahead, left = index.shape(lane, successor)
        wanted = 0.0 if swerve is None else swerve.direction(max(ahead, 0.0))
        return abs(math.atan2(left, ahead) - wanted)

    return min(options, key=miss)
