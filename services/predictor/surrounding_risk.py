"""Surrounding risk: the 9 dimensions that the paper's network reads beside the position.

For each object, a 3 × 3 grid of points in its own frame, offsets {−d, 0, +d} along and {−3.5, 0, +3.5} m across its
heading with d = max(length, speed · 1 s); at each point the field E_d of all *other* objects at that instant, with
straight paths and the object itself in the ego's place in u; then log1p. The same function serves training and service.

Velocities come from backward differences alone (`backward_velocity`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from common.messages import F32, F64, FRAME_S, U8
from common.risk import RiskParameters, kinetic_energy, virtual_mass

RISK_POINTS = 9
"""Points of the grid: behind right, behind, behind left, right, middle, left, ahead right, ahead, ahead left."""
ACROSS_M = 3.5
"""Lateral spacing of the points: a lane's width [m]."""
HEADWAY_S = 1.0
"""Longitudinal spacing of the points, as time at the object's own speed [s]."""
BLOCK_PAIRS = 16_384
"""Pairs of a point and a source that are worked on at once: their arrays stay in the cache."""
VELOCITY_STEPS = 3
"""Backward steps of 0.1 s whose mean is the velocity."""


@dataclass(frozen=True)
class Scene:
    """n road users at one instant, `map` frame, shape [n]."""

    x: F64  # centre [m]
    y: F64
    heading: F64  # body yaw [rad]
    vx: F64  # by backward differences [m/s]
    vy: F64
    length: F64  # [m]
    width: F64
    mass: F64  # [kg]; 0: unknown
    cls: U8  # ObjectClass


def backward_velocity(x: F64, y: F64, steps: npt.NDArray[np.integer]) -> tuple[F64, F64]:
    """Velocity [m/s] from histories [n, k ≥ 4], newest first: the mean of up to three steps; 0 with none."""
    rows, k = np.arange(len(x)), np.minimum(steps, VELOCITY_STEPS)
    span = FRAME_S * np.maximum(k, 1)
    return (x[:, 0] - x[rows, k]) / span, (y[:, 0] - y[rows, k]) / span


def surrounding_risk(scene: Scene, targets: int, p: RiskParameters) -> F32:
    """log1p of the field of all others at the nine points of the first `targets` road users, shape [targets, 9]."""
    n = len(scene.x)
    if targets == 0 or n < 2:
        return np.zeros((targets, RISK_POINTS), dtype=np.float32)
    speed = np.hypot(scene.vx, scene.vy)
    M_v = virtual_mass(scene.mass, scene.cls, speed, p)
    px, py = _points(scene, speed, targets)
    total = np.empty((targets, RISK_POINTS))
    some = max(1, BLOCK_PAIRS // (RISK_POINTS * n))
    for i in range(0, targets, some):
        rows = slice(i, min(i + some, targets))
        total[rows] = _block(scene, speed, M_v, px[rows], py[rows], i, p)
    return np.log1p(total).astype(np.float32)


def _block(scene: Scene, speed: F64, M_v: F64, px: F64, py: F64, first: int, p: RiskParameters) -> F64:
    """The field of all others at the points [m, 9] of the m road users from row `first` on."""
    # relative positions of points and sources, [m, 9, n]; metres in float32 are exact enough
    dx = (px[:, :, None] - scene.x).astype(np.float32)
    dy = (py[:, :, None] - scene.y).astype(np.float32)
    energy = _potential(scene, M_v, dx, dy, p)
    _add_kinetic(energy, scene, speed, M_v, dx, dy, first, p)
    own = np.arange(len(px))
    energy[own, :, first + own] = 0.0
    return np.asarray(energy.sum(axis=2, dtype=np.float64))


def _points(scene: Scene, speed: F64, m: int) -> tuple[F64, F64]:
    """Coordinates of the nine points [m], shape [m, 9]."""
    d = np.maximum(scene.length, speed * HEADWAY_S)[:m, None]
    along = d * np.repeat([-1.0, 0.0, 1.0], 3)
    across = np.tile([-ACROSS_M, 0.0, ACROSS_M], 3)
    c, s = np.cos(scene.heading[:m, None]), np.sin(scene.heading[:m, None])
    return scene.x[:m, None] + along * c - across * s, scene.y[:m, None] + along * s + across * c


def _potential(scene: Scene, M_v: F64, dx: F32, dy: F32, p: RiskParameters) -> F32:
    """pE and its taper of every source at points (dx, dy) from its centre [m]; `common.risk.potential_energy`."""
    c, s, half_l, half_w, A = (
        a.astype(np.float32)
        for a in (np.cos(scene.heading), np.sin(scene.heading), scene.length / 2, scene.width / 2, p.k * p.r_a * M_v)
    )
    ahead = np.abs(dx * c + dy * s)
    ahead -= half_l
    np.maximum(ahead, 0.0, out=ahead)
    beside = np.abs(dy * c - dx * s)
    beside -= half_w
    np.maximum(beside, 0.0, out=beside)
    D2 = ahead * ahead
    D2 += beside * beside
    D = np.sqrt(D2)
    z = D / np.float32(p.taper_radius)
    z -= np.float32(p.taper_start)
    z *= np.float32(1.0 / (1.0 - p.taper_start))
    np.clip(z, 0.0, 1.0, out=z)
    energy: F32 = D2 if p.k1 == 2.0 else D ** np.float32(p.k1)
    energy += A / np.float32(p.e_max)
    np.divide(A, energy, out=energy)
    energy *= 1.0 - z * z * (3.0 - 2.0 * z)
    return energy


def _add_kinetic(
    energy: F32, scene: Scene, speed: F64, M_v: F64, dx: F32, dy: F32, first: int, p: RiskParameters
) -> None:
    """Add kE where a point lies within one width of a source's straight path; `common.risk.kinetic_energy`."""
    moving = speed >= max(p.slow, 1e-9)
    safe = np.where(moving, speed, 1.0)
    tx = np.where(moving, scene.vx / safe, np.cos(scene.heading))
    ty = np.where(moving, scene.vy / safe, np.sin(scene.heading))
    beside = np.abs(dy * tx.astype(np.float32) - dx * ty.astype(np.float32))
    near = beside < scene.width.astype(np.float32)
    t, q, s = np.nonzero(near)
    u = (scene.vx[s] - scene.vx[first + t]) * tx[s] + (scene.vy[s] - scene.vy[first + t]) * ty[s]
    along = dx[near] * tx[s] + dy[near] * ty[s]
    energy[t, q, s] += kinetic_energy(along, beside[near], M_v[s], u, scene.length[s], scene.width[s], p)
