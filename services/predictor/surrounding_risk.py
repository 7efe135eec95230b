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
from common.risk import (
    RiskParameters,
    kinetic_energy,
    potential_energy,
    taper,
    virtual_mass,
)

RISK_POINTS = 9
"""Points of the grid: behind right, behind, behind left, right, middle, left, ahead right, ahead, ahead left."""
ACROSS_M = 3.5
"""Lateral spacing of the points: a lane's width [m]."""
HEADWAY_S = 1.0
"""Longitudinal spacing of the points, as time at the object's own speed [s]."""
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
    # pairs of a point and another object that its field may reach
    reach = p.taper_radius + np.hypot(scene.length, scene.width) / 2 + p.t * speed
    dx, dy = px[:, :, None] - scene.x, py[:, :, None] - scene.y
    own = np.eye(targets, n, dtype=bool)[:, None, :]
    closing = p.t * speed[:targets, None, None]  # the target's own speed lengthens the lobe
    near = (dx * dx + dy * dy < (reach + closing) ** 2) & ~own
    t, q, s = np.nonzero(near)
    dx, dy = dx[near], dy[near]
    energy = _energy(scene, speed, M_v, t, s, dx, dy, p)
    total = np.bincount(t * RISK_POINTS + q, weights=energy, minlength=targets * RISK_POINTS)
    return np.log1p(total).reshape(targets, RISK_POINTS).astype(np.float32)


def _points(scene: Scene, speed: F64, m: int) -> tuple[F64, F64]:
    """Coordinates of the nine points [m], shape [m, 9]."""
    d = np.maximum(scene.length, speed * HEADWAY_S)[:m, None]
    along = d * np.repeat([-1.0, 0.0, 1.0], 3)
    across = np.tile([-ACROSS_M, 0.0, ACROSS_M], 3)
    c, s = np.cos(scene.heading[:m, None]), np.sin(scene.heading[:m, None])
    return scene.x[:m, None] + along * c - across * s, scene.y[:m, None] + along * s + across * c


def _energy(
    scene: Scene,
    speed: F64,
    M_v: F64,
    t: npt.NDArray[np.intp],
    s: npt.NDArray[np.intp],
    dx: F64,
    dy: F64,
    p: RiskParameters,
) -> F64:
    """E_d of sources `s` at points (dx, dy) from their centres [m], for targets `t`; `common.risk.straight_energy`."""
    c, n = np.cos(scene.heading), np.sin(scene.heading)
    half_l, half_w = scene.length / 2, scene.width / 2
    ahead, beside = dx * c[s] + dy * n[s], dy * c[s] - dx * n[s]
    D = np.hypot(np.maximum(np.abs(ahead) - half_l[s], 0.0), np.maximum(np.abs(beside) - half_w[s], 0.0))
    energy = np.zeros(len(s))
    inside = np.flatnonzero(p.taper_radius > D)
    energy[inside] = potential_energy(D[inside], M_v[s[inside]], p) * taper(D[inside], p)

    moving = speed >= max(p.slow, 1e-9)
    safe = np.where(moving, speed, 1.0)
    tx, ty = np.where(moving, scene.vx / safe, c), np.where(moving, scene.vy / safe, n)
    D_la = np.abs(dy * tx[s] - dx * ty[s])
    lobe = np.flatnonzero(D_la < scene.width[s])
    t, s = t[lobe], s[lobe]
    u = (scene.vx[s] - scene.vx[t]) * tx[s] + (scene.vy[s] - scene.vy[t]) * ty[s]
    along = dx[lobe] * tx[s] + dy[lobe] * ty[s]
    energy[lobe] += kinetic_energy(along, D_la[lobe], M_v[s], u, scene.length[s], scene.width[s], p)
    return energy
