"""Candidate paths of the rear axle: quintic Bezier offsets d(s) from the reference line, Frenet to `map` frame.

d(s) = target(s) + e(u), u = (s − s0) / L, where e is the quintic Bezier curve with
b0 = e(0), b1 = b0 + e'(0) L/5, b2 = 2 b1 − b0 + e''(0) L²/20 and b3 = b4 = b5 = 0: it meets position, direction and
steering at the start, and arrives at the target with all three.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from services.planner.backend import kernels
from services.planner.reference import ReferenceLine

F64 = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Start:
    """State from which is planned: of the rear axle, `map` frame."""

    x: float  # [m]
    y: float  # [m]
    heading: float  # [rad]
    curvature: float  # [1/m]
    speed: float  # ≥ 0 [m/s]
    acceleration: float  # [m/s²]


@dataclass(frozen=True)
class Target:
    """Where a path goes: a line beside the reference line."""

    name: str  # same name: same choice, for the hysteresis
    offset: F64  # d at arc lengths `s` of the frame, shape [m] [m]
    slope: F64  # dd/ds, shape [m]
    bend: F64  # d²d/ds², shape [m] [1/m]


@dataclass(frozen=True)
class Paths:
    """n paths of p points, evenly spaced along each path from the ego's rear axle."""

    step: float  # distance between points [m]
    x: F64  # rear axle [n, p] [m]
    y: F64
    heading: F64  # [n, p] [rad]
    curvature: F64  # [n, p] [1/m]
    s: F64  # arc length on the reference line [n, p] [m]
    d: F64  # offset from it [n, p] [m]
    end: F64  # length that may be driven: beyond it the curve is too tight [n] [m]
    length: F64  # L of the lateral move [n] [m]
    target: tuple[str, ...]  # [n]

    @property
    def stations(self) -> F64:
        """Distance of the points from the start [p] [m]."""
        return np.asarray(self.step * np.arange(self.x.shape[1]), dtype=np.float64)


def quintic(e0: F64, slope: F64, bend: F64, length: F64, u: F64) -> tuple[F64, F64, F64]:
    """The Bezier offset and its first two derivatives by s, at u [n, m] in [0, 1]; start values and length are [n]."""
    b0 = e0
    b1 = b0 + slope * length / 5.0
    b2 = 2.0 * b1 - b0 + bend * length**2 / 20.0
    w = 1.0 - u
    c0, c1, c2 = b0[:, None], b1[:, None], b2[:, None]
    n = length[:, None]
    e = w**3 * (c0 * w**2 + 5.0 * c1 * u * w + 10.0 * c2 * u**2)
    g0, g1, g2 = c1 - c0, c2 - c1, -c2
    first = 5.0 / n * w**2 * (g0 * w**2 + 4.0 * g1 * u * w + 6.0 * g2 * u**2)
    h0, h1, h2 = g1 - g0, g2 - g1, -g2
    second = 20.0 / n**2 * w * (h0 * w**2 + 3.0 * h1 * u * w + 3.0 * h2 * u**2)
    return e, first, second


def frenet_start(reference: ReferenceLine, start: Start, near: float | None) -> tuple[float, float, float, float]:
    """(s, d, d', d'') of the start; d' is limited to ±1.2 (50°), d'' to what a vehicle can steer."""
    s, d = reference.project(start.x, start.y, start.heading, near)
    _, _, heading, k, rate = reference.point(s)
    turn = float(np.clip((start.heading - heading + np.pi) % (2 * np.pi) - np.pi, -0.88, 0.88))
    q = max(1.0 - k * d, 0.2)
    slope = q * np.tan(turn)
    bend = q / np.cos(turn) ** 2 * (start.curvature * q / np.cos(turn) - k) - (rate * d + k * slope) * np.tan(turn)
    if start.speed < 0.1:  # standing, it may steer before it starts
        bend = 0.0
    return s, d, float(slope), float(np.clip(bend, -1.0, 1.0))


def build_paths(
    reference: ReferenceLine,
    s: F64,
    start: tuple[float, float, float, float],
    targets: list[Target],
    lengths: F64,
    *,
    step: float,
    points: int,
    max_curvature: float,
    reference_form: bool = False,
) -> Paths:
    """Paths from the start to each target within its length.

    Args:
        reference: The smooth reference line.
        s: Arc lengths on it at which the targets are given, from the start on [m], shape [m].
        start: (s, d, d', d'') of the rear axle.
        targets: One for each path.
        lengths: L for each path [m].
        step: Distance between the points of a path [m].
        points: How many of them.
        max_curvature: What is tighter ends the path [1/m].
        reference_form: Keep to NumPy.
    """
    names = tuple(t.name for t in targets)
    if kernels is not None and not reference_form:
        kinds = list({id(t): t for t in targets}.values())
        number = {id(t): k for k, t in enumerate(kinds)}
        line = {"s": s, **vars(reference.at(s))}
        lines: F64 = np.array([[getattr(t, k) for t in kinds] for k in ("offset", "slope", "bend")])
        kind = np.array([number[id(t)] for t in targets])
        built, end = kernels.build(line, start, lines, kind, lengths, step, points, max_curvature)
        x, y, heading, curvature, along, d = built
        return Paths(step, x, y, heading, curvature, along, d, end, lengths, names)
    offset, slope, bend = (np.stack([getattr(t, k) for t in targets]) for k in ("offset", "slope", "bend"))
    u = np.clip((s[None] - s[0]) / lengths[:, None], 0.0, 1.0)
    e, first, second = quintic(start[1] - offset[:, 0], start[2] - slope[:, 0], start[3] - bend[:, 0], lengths, u)
    d, d1, d2 = offset + e, slope + first, bend + second

    r = reference.at(s)
    q = 1.0 - r.curvature * d
    folded = q < 0.15  # inside the centre of the curve
    q = np.maximum(q, 0.15)
    turn = np.arctan2(d1, q)
    tan, cos = d1 / q, np.cos(turn)
    curvature = ((d2 + (r.curvature_rate * d + r.curvature * d1) * tan) * cos**2 / q + r.curvature) * cos / q
    heading = r.heading + turn
    x, y = r.x - d * np.sin(r.heading), r.y + d * np.cos(r.heading)
    gauge = np.hypot(q, d1)
    along = np.zeros_like(d)
    np.cumsum(0.5 * (gauge[:, 1:] + gauge[:, :-1]) * np.diff(s), axis=1, out=along[:, 1:])

    # to even spacing along each path
    want = step * np.arange(points)
    i = np.empty((len(targets), points), dtype=np.intp)
    for k in range(len(targets)):
        i[k] = np.searchsorted(along[k], want, side="right") - 1
    i = np.minimum(i, len(s) - 2)
    rows = np.arange(len(targets))[:, None]
    w = (want - along[rows, i]) / np.maximum(along[rows, i + 1] - along[rows, i], 1e-9)

    def even(a: F64) -> F64:
        return np.asarray(a[rows, i] + w * (a[rows, i + 1] - a[rows, i]))

    k_even = even(curvature)
    bad = (np.abs(k_even) > max_curvature) | folded[rows, i] | (w > 1.0 + 1e-9)
    bad[:, 0] = False
    end = np.where(bad.any(axis=1), want[np.maximum(bad.argmax(axis=1) - 1, 0)], want[-1])
    s_all = np.broadcast_to(s, d.shape)
    return Paths(
        step,
        even(x),
        even(y),
        even(heading),
        k_even,
        even(s_all),
        even(d),
        end,
        lengths,
        names,
    )
