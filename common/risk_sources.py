"""From messages to what the equations take: sources of risk at slices, and the reference field at any points.

A `DynamicSources` holds every object's rectangle, virtual mass, relative speed and path for a set of times; a
`StaticLine` one line of the road. `risk_at_points` sums them: M. All of it float64, `map` frame.

The path of an object is one polyline for all slices: driven path, current state, predicted frames, straight beyond both
ends; a slice only moves the arc length of the object's centre along it. Points nearer than `SPACING` to the one kept
before are dropped, seen from the current state, so that a standing object's jitter makes no path.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from common.geometry import wrap_angle
from common.messages import F64, FRAME_S, I64, PREDICTION_FRAMES, U8, Prediction
from common.risk import RiskParameters, dynamic_energy, static_energy, virtual_mass

Bools = npt.NDArray[np.bool_]
Indices = npt.NDArray[np.intp]

SPACING = 0.25
"""Least distance between vertices of a path [m]; also the half-length over which its tangent is taken."""
PREDICTION_S = PREDICTION_FRAMES * FRAME_S
"""How far a prediction reaches [s]; beyond, straight at the last speed."""

Kind = Literal["lane_line", "barrier"]


@dataclass(frozen=True)
class Paths:
    """Paths of n objects; rows are padded by repeating the last vertex.

    The first and the last vertex lie one metre beyond the path and only say which way it goes on.
    """

    vertices: F64
    """[n, P, 2], `map` frame [m]."""
    s: F64
    """Arc length of each vertex from the first, [n, P] [m]."""
    count: Indices
    """Number of vertices, ≥ 3, [n]."""
    frame_s: F64
    """Arc length of the current state and of the predicted frames, [n, 61] [m]."""

    def at(self, s: F64) -> F64:
        """Points at arc lengths s [k, n], straight beyond the ends; [k, n, 2]."""
        last = self.count - 2
        i = np.clip((self.s[None] <= s[..., None]).sum(-1) - 1, 0, last)
        n = np.arange(len(self.count))[None]
        a, b = self.vertices[n, i], self.vertices[n, i + 1]
        length = self.s[n, i + 1] - self.s[n, i]
        return np.asarray(a + (b - a) * ((s - self.s[n, i]) / length)[..., None])


@dataclass(frozen=True)
class DynamicSources:
    """n objects at k slices; arrays are [k, n] where nothing else stands."""

    id: I64
    """[n]."""
    cls: U8
    """ObjectClass, [n]."""
    x: F64
    """Centres [m]."""
    y: F64
    heading: F64
    """Body yaw [rad]."""
    length: F64
    """Rectangle, grown by the spread on every side [m]."""
    width: F64
    M_v: F64
    """Virtual mass [kg]."""
    u: F64
    """Signed speed relative to the ego along the path [m/s]."""
    s0: F64
    """Arc length of the centre on its path [m]."""
    paths: Paths

    def path(self, i: int) -> F64:
        """Vertices of object i's path, [p, 2] [m]."""
        return self.paths.vertices[i, : self.paths.count[i]]


@dataclass(frozen=True)
class StaticLine:
    """One static line; M takes the nearest of each kind, so that a line drawn twice counts once."""

    id: int
    """Of the lane, obstacle or stop line it comes from."""
    label: str
    """`lane_line`, `barrier`, `kerb`, `stop_line`, `closed_lane`."""
    kind: Kind
    points: F64
    """[n, 2], no point twice in a row [m]."""
    half_width: float
    """h = κD/2 [m]."""
    peak: float
    """[E_max]."""
    flat: float = 0.0
    """Half the width of the flat top of a line wider than its field needs [m]."""
    side: int = 0
    """0: both sides fall; +1 (−1): an outer edge, left (right) of it the field stays at its peak."""
    depth: F64 | None = None
    """How far beyond each segment the peak goes on [m], [n − 1]; needed where `side` is not 0."""


def paths(prediction: Prediction) -> Paths:
    """Build the paths of all objects of a prediction."""
    n = len(prediction.id)
    h = prediction.past_x.shape[1]
    px = np.concatenate((prediction.past_x, prediction.x0[:, None], prediction.x), axis=1)
    py = np.concatenate((prediction.past_y, prediction.y0[:, None], prediction.y), axis=1)
    points = np.stack((px, py), axis=-1)
    kept = _spaced(points, h)
    ahead = np.count_nonzero(kept[:, h + 1 :], axis=1)
    behind = np.count_nonzero(kept[:, :h], axis=1)

    order = np.argsort(~kept, axis=1, kind="stable")
    rows = np.arange(n)[:, None]
    count = ahead + behind + 1
    width = int(count.max(initial=1))
    inner = points[rows, np.minimum(order[:, :width], points.shape[1] - 1)]
    column = np.minimum(np.arange(width)[None], count[:, None] - 1)
    inner = inner[rows, column]

    body = np.stack((np.cos(prediction.heading0), np.sin(prediction.heading0)), axis=-1)
    r = np.arange(n)
    first = _unit(inner[r, np.minimum(1, count - 1)] - inner[:, 0])
    final = _unit(inner[r, count - 1] - inner[r, np.maximum(count - 2, 0)])
    # without a path ahead the body says where it goes on, the way it came; the same behind
    forth = np.where((ahead > 0)[:, None], final, body * _sign(np.sum(body * final, -1))[:, None])
    back = np.where((behind > 0)[:, None], first, np.where((ahead > 0)[:, None], first, body))

    vertices = np.concatenate((inner[:, :1] - back[:, None], inner, inner[:, -1:]), axis=1)
    vertices[r, count + 1] = inner[r, count - 1] + forth
    column = np.minimum(np.arange(width + 2)[None], count[:, None] + 1)
    vertices = vertices[rows, column]
    steps = np.hypot(*np.moveaxis(np.diff(vertices, axis=1), -1, 0))
    s = np.concatenate((np.zeros((n, 1)), np.cumsum(steps, axis=1)), axis=1)

    # arc length of a dropped frame: its foot on the segment between the kept ones
    segment = np.cumsum(kept, axis=1)[:, h:]
    a, b = vertices[rows, segment], vertices[rows, segment + 1]
    length = s[rows, segment + 1] - s[rows, segment]
    along = np.sum((points[:, h:] - a) * (b - a), axis=-1) / length
    frame_s = s[rows, segment] + np.where(kept[:, h:], 0.0, np.clip(along, 0.0, length))
    return Paths(vertices=vertices, s=s, count=count + 2, frame_s=frame_s)


def dynamic_sources(
    prediction: Prediction, times: npt.ArrayLike, ego_velocity: tuple[float, float], p: RiskParameters
) -> DynamicSources:
    """Every object of a prediction at the given times.

    Args:
        prediction: What the objects will do, frames of 0.1 s.
        times: Times of the slices from the prediction's capture [s], shape [k].
        ego_velocity: The ego's current velocity vector, held for all slices, `map` frame [m/s].
        p: Constants.
    """
    t = np.asarray(times, dtype=np.float64)
    i, w, late = _frame(t)
    lines = paths(prediction)
    speed = _between(np.concatenate((np.hypot(prediction.vx0, prediction.vy0)[:, None], prediction.speed), 1), i, w)
    s0 = _between(lines.frame_s, i, w) + late[:, None] * speed
    beyond = late[:, None] > 0.0
    here = np.where(
        beyond[..., None],
        lines.at(s0),
        np.stack(
            (
                _between(np.concatenate((prediction.x0[:, None], prediction.x), 1), i, w),
                _between(np.concatenate((prediction.y0[:, None], prediction.y), 1), i, w),
            ),
            axis=-1,
        ),
    )
    headings = np.concatenate((prediction.heading0[:, None], prediction.heading), 1)
    headings = headings[:, :1] + np.concatenate(
        (np.zeros((len(headings), 1)), np.cumsum(wrap_angle(np.diff(headings, axis=1)), axis=1)), axis=1
    )
    heading = wrap_angle(_between(headings, i, w))
    tangent = _unit(lines.at(s0 + SPACING) - lines.at(s0 - SPACING))
    body = np.stack((np.cos(heading), np.sin(heading)), axis=-1)
    body = body * _sign(np.sum(body * tangent, -1))[..., None]
    tangent = np.where((speed < p.slow)[..., None], body, tangent)
    u = speed - (tangent[..., 0] * ego_velocity[0] + tangent[..., 1] * ego_velocity[1])
    sigma = np.zeros_like(speed)
    if prediction.sigma is not None:
        sigma = _between(np.concatenate((np.zeros((len(prediction.id), 1)), prediction.sigma), 1), i, w)
    return DynamicSources(
        id=prediction.id,
        cls=prediction.cls,
        x=here[..., 0],
        y=here[..., 1],
        heading=heading,
        length=prediction.length[None] + 2.0 * sigma,
        width=prediction.width[None] + 2.0 * sigma,
        M_v=virtual_mass(prediction.mass[None], prediction.cls[None], speed, p),
        u=u,
        s0=s0,
        paths=lines,
    )


def line_distance(px: npt.ArrayLike, py: npt.ArrayLike, line: StaticLine) -> F64:
    """dis [m] of equation 5: distance to the line (to its flat top); 0 beyond an outer edge as far as `depth`."""
    q = np.stack(np.broadcast_arrays(np.asarray(px, float), np.asarray(py, float)), axis=-1)
    steps = np.diff(line.points, axis=0)
    lengths = np.hypot(steps[:, 0], steps[:, 1])
    tangents = steps / lengths[:, None]
    best = np.full(q.shape[:-1], np.inf)
    for k, (a, t, length) in enumerate(zip(line.points[:-1], tangents, lengths, strict=True)):
        rel = q - a
        along = rel @ t
        beside = rel[..., 1] * t[0] - rel[..., 0] * t[1]
        distance = np.hypot(beside, along - np.clip(along, 0.0, length))
        dis = np.maximum(distance - line.flat, 0.0)
        if line.side and line.depth is not None:
            covered = (along >= 0.0) & (along <= length)
            if k + 1 < len(lengths):  # the wedge outside a bend belongs to the segment before it
                covered |= (along > length) & ((q - line.points[k + 1]) @ tangents[k + 1] < 0.0)
            beyond = covered & (line.side * beside >= 0.0)
            dis = np.where(beyond, np.minimum(dis, np.maximum(distance - line.depth[k], 0.0)), dis)
        best = np.minimum(best, dis)
    return best


def line_energy(px: npt.ArrayLike, py: npt.ArrayLike, line: StaticLine) -> F64:
    """E_s of one line at points."""
    return static_energy(line_distance(px, py, line), line.half_width, line.peak)


@dataclass(frozen=True)
class Shares:
    """What every source adds to M at points, in one slice; the points' shape stands for [...]."""

    potential: F64
    """Tapered pE, [n, ...]."""
    kinetic: F64
    """kE, [n, ...]."""
    static: F64
    """E_s of each line where it is the nearest of its kind, otherwise 0, [m, ...]."""

    @property
    def total(self) -> F64:
        """M, [...]."""
        return np.asarray(self.potential.sum(0) + self.kinetic.sum(0) + self.static.sum(0))


def shares_at_points(
    px: npt.ArrayLike,
    py: npt.ArrayLike,
    sources: DynamicSources,
    j: int,
    lines: tuple[StaticLine, ...],
    p: RiskParameters,
) -> Shares:
    """Every source's share of M in slice j at points [m], `map` frame."""
    shape = np.broadcast(px, py).shape
    n = len(sources.id)
    potential, kinetic = np.zeros((n, *shape)), np.zeros((n, *shape))
    for i in range(n):
        potential[i], kinetic[i] = dynamic_energy(
            px,
            py,
            x=float(sources.x[j, i]),
            y=float(sources.y[j, i]),
            heading=float(sources.heading[j, i]),
            length=float(sources.length[j, i]),
            width=float(sources.width[j, i]),
            M_v=float(sources.M_v[j, i]),
            u=float(sources.u[j, i]),
            path=sources.path(i),
            s0=float(sources.s0[j, i]),
            p=p,
        )
    static = np.zeros((len(lines), *shape))
    for k, line in enumerate(lines):
        static[k] = line_energy(px, py, line)
    for kind in ("lane_line", "barrier"):
        members = np.array([k for k, line in enumerate(lines) if line.kind == kind], dtype=np.intp)
        if len(members):
            group = static[members]
            nearest = np.arange(len(members)).reshape(-1, *(1,) * len(shape)) == np.argmax(group, axis=0)
            static[members] = np.where(nearest, group, 0.0)
    return Shares(potential=potential, kinetic=kinetic, static=static)


def risk_at_points(
    px: npt.ArrayLike,
    py: npt.ArrayLike,
    sources: DynamicSources,
    j: int,
    lines: tuple[StaticLine, ...],
    p: RiskParameters,
) -> F64:
    """M_j at points [m], `map` frame: the sum over all sources in slice j."""
    return shares_at_points(px, py, sources, j, lines, p).total


def _frame(t: F64) -> tuple[Indices, F64, F64]:
    """Index of the frame before each time, weight of the one after it, time past the last frame [s]."""
    f = np.clip(t / FRAME_S, 0.0, PREDICTION_FRAMES)
    i = np.minimum(np.floor(f + 1e-9).astype(np.intp), PREDICTION_FRAMES - 1)
    return i, np.maximum(f - i, 0.0), np.maximum(t - PREDICTION_S, 0.0)


def _between(values: npt.NDArray[Any], i: Indices, w: F64) -> F64:
    """Values [n, 61] at frames i + w, [k, n]."""
    return np.asarray(values[:, i] * (1.0 - w) + values[:, i + 1] * w, dtype=np.float64).T


def _spaced(points: F64, h: int) -> Bools:
    """Which points [n, f, 2] to keep: column h, and going both ways every next one at least SPACING away."""
    kept = np.zeros(points.shape[:2], dtype=bool)
    kept[:, h] = True
    for frames in (range(h + 1, points.shape[1]), range(h - 1, -1, -1)):
        last = points[:, h].copy()
        for f in frames:
            step = points[:, f] - last
            far = step[:, 0] ** 2 + step[:, 1] ** 2 >= SPACING**2
            kept[:, f] = far
            last[far] = points[far, f]
    return kept


def _unit(v: F64) -> F64:
    length = np.hypot(v[..., 0], v[..., 1])[..., None]
    return np.asarray(v / np.where(length > 0.0, length, 1.0))


def _sign(v: F64) -> F64:
    """+1 for v ≥ 0, −1 below."""
    return np.where(v >= 0.0, 1.0, -1.0)
