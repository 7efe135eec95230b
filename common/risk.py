"""The paper's equations 1 to 5 in NumPy, float64: the reference that every kernel must equal.

Per dynamic object, E_max the scale of everything (SI units except speed in km/h inside the virtual mass), with
sat(x) = x / (1 + x / E_max):

    M_v = m T (α min(v_kmh, 130)^β + γ)                              virtual mass [kg], eq. 1
    pE  = sat(A / D^k1),  A = k r_a M_v                              potential, eq. 2; D: distance to the rectangle
    1/D_w = sqrt(g) / (D_lo + d0),  g = max(0, 1 − (D_la / w)²)      eq. 3
    K   = ½ M_v u² max(0, 1/D_w − 1/L),  L = |u| t + d0
    kE  = b g sat(E_k ln(1 + K / K0))                                eq. 4
    E_d = taper(D) pE + kE
    E_s = k_s (h − min(h, dis))²,  k_s = peak / h²,  h = κD/2        eq. 5

with ξ = sgn(u) s − l/2, D_lo = max(ξ, 0), b = clamp(1 + min(ξ, 0) / l, 0, 1); s is the arc length from the centre
along the predicted path and u the signed speed relative to the ego along that path.

Where the paper's printed kinetic term (`kinetic = "paper"`) is undefined or negative, this reading is finite, falls
along and across the path, grows with speed and mass and ends by its own support. Everything is elementwise: the
arguments broadcast. How a prediction becomes the arguments stands in `common.risk_sources`.
"""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np
import numpy.typing as npt
from msgspec import Meta

from common.config import Settings
from common.geometry import distance_to_rectangle
from common.messages import F64, ObjectClass

Positive = Annotated[float, Meta(gt=0.0)]
NotNegative = Annotated[float, Meta(ge=0.0)]

KMH = 3.6
"""km/h in one m/s."""
COUPLED = 0.5
"""Cosine of the largest turn across which neighbouring segments of a path share one arc length."""


class RiskParameters(Settings, frozen=True, kw_only=True):
    """Section `[risk]`: every constant of the equations, with unit and source.

    Sources: (P) the paper's equation, (M) the virtual mass of Wang et al.'s driving safety field that the paper takes
    over, (D) this project's design, from closed-loop runs.
    """

    alpha: NotNegative = 1.566e-14  # factor of the speed term in km/h [-] (M)
    beta: NotNegative = 6.687  # power of the speed in km/h [-] (M)
    gamma: Positive = 0.3345  # virtual mass at rest per kg [-] (M)
    speed_cap_kmh: Positive = 130.0  # the virtual mass grows no further [km/h] (D)

    type_unknown: Positive = 1.0  # T, factor of the class [-]; as a car (D)
    type_car: Positive = 1.0  # (M)
    type_truck: Positive = 0.3  # (D), between 0.15 and 0.375
    type_bus: Positive = 0.3  # as a truck (D)
    type_motorcycle: Positive = 15.0  # so that its virtual mass equals a pedestrian's (D)
    type_bicycle: Positive = 50.0  # (D)
    type_pedestrian: Positive = 50.0  # (D)

    mass_unknown: Positive = 1500.0  # m where no mass is known [kg] (D)
    mass_car: Positive = 1500.0
    mass_truck: Positive = 12000.0
    mass_bus: Positive = 12000.0
    mass_motorcycle: Positive = 250.0
    mass_bicycle: Positive = 90.0
    mass_pedestrian: Positive = 75.0

    k: Positive = 8.4e-4  # potential per virtual mass at 1 m [E_max m^k1 / kg] (D)
    r_a: Positive = 1.0  # road condition [-] (P)
    k1: Annotated[float, Meta(ge=0.5, le=6.0)] = 2.0  # power of the distance [-] (P)
    e_max: Positive = 1.0  # E_max, where every saturation ends [-] (P)
    taper_radius: Positive = 25.0  # R: the potential ends here [m] (D)
    taper_start: Annotated[float, Meta(ge=0.0, lt=1.0)] = 0.8  # share of R up to which it is untouched [-] (D)

    kinetic: Literal["sound", "paper"] = "sound"  # form of eq. 4; `paper` for comparison only
    t: Positive = 3.0  # time threshold of the kinetic term [s] (P)
    d0: Positive = 1.0  # softening of the distance [m] (D)
    K0: Positive = 500.0  # scale inside the logarithm [N] (D)
    E_k: Positive = 0.5  # factor of the logarithm [E_max] (D)
    slow: NotNegative = 0.3  # below this speed the heading stands for the path's tangent [m/s] (D)

    lane_line_peak: NotNegative = 0.1  # E_s on the line [E_max] (D)
    lane_line_half_width: Positive = 0.5  # least κD/2 [m] (D)
    barrier_peak: NotNegative = 1.5  # (D)
    barrier_half_width: Positive = 0.6  # least κD/2 [m] (D)
    lane_line_width: Positive = 0.15  # D of a line of paint [m] (D)
    barrier_width: Positive = 0.2  # D of a boundary that is a barrier [m]; wider ones get a flat top (D)
    edge_depth: Positive = 40.0  # how far the outer edge's peak goes on beyond it [m]; less where a lane begins (D)

    def type_factors(self) -> F64:
        """T by `ObjectClass`, shape [7]."""
        return np.array([getattr(self, f"type_{c.name.lower()}") for c in ObjectClass])

    def default_masses(self) -> F64:
        """m by `ObjectClass` where a mass is unknown [kg], shape [7]."""
        return np.array([getattr(self, f"mass_{c.name.lower()}") for c in ObjectClass])


def saturation(x: npt.ArrayLike, p: RiskParameters) -> F64:
    """sat(x) = x / (1 + x / E_max): rises from 0 and stays below E_max."""
    x = np.asarray(x, dtype=np.float64)
    return np.asarray(x / (1.0 + x / p.e_max))


def taper(D: npt.ArrayLike, p: RiskParameters) -> F64:
    """1 up to `taper_start` R, then 1 − smoothstep, exactly 0 from D = R on. D [m]."""
    z = np.clip((np.asarray(D) / p.taper_radius - p.taper_start) / (1.0 - p.taper_start), 0.0, 1.0)
    return np.asarray(1.0 - z * z * (3.0 - 2.0 * z))


def masses(mass: npt.ArrayLike, cls: npt.ArrayLike, p: RiskParameters) -> F64:
    """m [kg]: the given mass, where that is 0 (unknown) the class' own."""
    mass = np.asarray(mass, dtype=np.float64)
    return np.where(mass > 0.0, mass, p.default_masses()[np.asarray(cls, dtype=np.intp)])


def virtual_mass(mass: npt.ArrayLike, cls: npt.ArrayLike, speed: npt.ArrayLike, p: RiskParameters) -> F64:
    """M_v = m T (α min(v_kmh, 130)^β + γ) [kg], equation 1.

    Args:
        mass: m [kg], 0: unknown, the class' default is taken.
        cls: ObjectClass.
        speed: The object's own speed [m/s]; it is turned into km/h here and nowhere else.
        p: Constants.
    """
    v_kmh = np.minimum(np.abs(np.asarray(speed, dtype=np.float64)) * KMH, p.speed_cap_kmh)
    T = p.type_factors()[np.asarray(cls, dtype=np.intp)]
    return np.asarray(masses(mass, cls, p) * T * (p.alpha * v_kmh**p.beta + p.gamma))


def potential_energy(D: npt.ArrayLike, M_v: npt.ArrayLike, p: RiskParameters) -> F64:
    """pE = A / (D^k1 + A / E_max), A = k r_a M_v, equation 2; E_max at D = 0. Without the taper.

    Args:
        D: Distance to the object's rectangle [m], 0 inside.
        M_v: Virtual mass [kg].
        p: Constants.
    """
    A = p.k * p.r_a * np.asarray(M_v, dtype=np.float64)
    return np.asarray(A / (np.asarray(D, dtype=np.float64) ** p.k1 + A / p.e_max))


def lateral_factor(D_la: npt.ArrayLike, width: npt.ArrayLike) -> F64:
    """g = max(0, 1 − (D_la / w)²): 1 on the path, 0 from one width beside it on."""
    return np.asarray(np.maximum(0.0, 1.0 - (np.asarray(D_la) / np.asarray(width)) ** 2))


def weighted_distance(D_lo: npt.ArrayLike, D_la: npt.ArrayLike, width: npt.ArrayLike, p: RiskParameters) -> F64:
    """D_w = (D_lo + d0) / sqrt(g) [m], equation 3; infinite from D_la = w on, so that 1/D_w is 0 there.

    Args:
        D_lo: Distance ahead of the bumper along the path, ≥ 0 [m].
        D_la: Distance beside the path [m].
        width: The object's width w [m].
        p: Constants.
    """
    with np.errstate(divide="ignore"):
        return np.asarray((np.asarray(D_lo) + p.d0) / np.sqrt(lateral_factor(D_la, width)))


def kinetic_energy(
    s: npt.ArrayLike,
    D_la: npt.ArrayLike,
    M_v: npt.ArrayLike,
    u: npt.ArrayLike,
    length: npt.ArrayLike,
    width: npt.ArrayLike,
    p: RiskParameters,
) -> F64:
    """kE = b g sat(E_k ln(1 + K / K0)), equation 4, at points given by their place on the object's path.

    The lobe begins on the body, where b fades it in from the far bumper (0) to the near one (1), and ends by itself
    |u| t beyond the near bumper, and at one width beside the path.

    Args:
        s: Arc length from the object's centre along its path [m].
        D_la: Distance beside the path [m].
        M_v: Virtual mass [kg].
        u: Speed relative to the ego along the path [m/s]; > 0: the lobe lies ahead, < 0: behind.
        length: l [m].
        width: w [m].
        p: Constants; `kinetic = "paper"` gives the printed form, 0 where that is not defined.
    """
    if p.kinetic == "paper":
        return printed_kinetic_energy(s, D_la, u, width, p)
    u = np.asarray(u, dtype=np.float64)
    xi = np.sign(u) * np.asarray(s) - np.asarray(length) / 2
    b = np.clip(1.0 + np.minimum(xi, 0.0) / np.asarray(length), 0.0, 1.0)
    inverse_D_w = 1.0 / weighted_distance(np.maximum(xi, 0.0), D_la, width, p)
    L = np.abs(u) * p.t + p.d0
    K = 0.5 * np.asarray(M_v) * u**2 * np.maximum(0.0, inverse_D_w - 1.0 / L)
    return np.asarray(b * lateral_factor(D_la, width) * saturation(p.E_k * np.log1p(K / p.K0), p))


def printed_kinetic_energy(
    s: npt.ArrayLike, D_la: npt.ArrayLike, u: npt.ArrayLike, width: npt.ArrayLike, p: RiskParameters
) -> F64:
    """The kinetic term as the paper prints it, in shape: t / (D_w (|u| t − D_w)), D_w = |s| / sqrt(g); comparison only.

    Its printed factor has the virtual mass in the denominator; here it is left out. It is not defined beside the path
    (D_la ≥ w), negative behind the horizon (D_w > |u| t) and infinite at both ends: it is 0 there and at most E_max.
    """
    u = np.asarray(u, dtype=np.float64)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        D_w = np.abs(s) / np.sqrt(lateral_factor(D_la, width))
        rest = np.abs(u) * p.t - D_w
        printed = p.t / (D_w * rest)
    ahead = (np.sign(u) * np.asarray(s) > 0.0) & (rest > 0.0) & np.isfinite(printed)
    return np.where(ahead, np.minimum(printed, p.e_max), 0.0)


def static_energy(dis: npt.ArrayLike, half_width: npt.ArrayLike, peak: npt.ArrayLike) -> F64:
    """E_s = k_s (h − min(h, dis))², k_s = peak / h², h = κD/2, equation 5: peak on the line, 0 from h on.

    Args:
        dis: Distance to the line [m]; 0 beyond a road's outer edge, which has no far side.
        half_width: h = κD/2 [m].
        peak: Value on the line [E_max].
    """
    h = np.asarray(half_width, dtype=np.float64)
    return np.asarray(np.asarray(peak) / h**2 * (h - np.minimum(h, dis)) ** 2)


def dynamic_energy(
    px: npt.ArrayLike,
    py: npt.ArrayLike,
    *,
    x: float,
    y: float,
    heading: float,
    length: float,
    width: float,
    M_v: float,
    u: float,
    path: F64,
    s0: float,
    p: RiskParameters,
) -> tuple[F64, F64]:
    """Tapered potential and kinetic energy of one object at points: E_d is their sum.

    Args:
        px: Points [m], `map` frame, any shape.
        py: Their y, same shape.
        x: Centre of the object's rectangle [m].
        y: Its y.
        heading: Its body yaw [rad].
        length: l [m].
        width: w [m].
        M_v: Virtual mass [kg].
        u: Signed relative speed along the path [m/s].
        path: Vertices [n, 2] of the driven and predicted path [m]; straight beyond both ends.
        s0: Arc length of the object's centre, counted from the first vertex [m].
        p: Constants.

    Returns:
        pE · taper and kE, both of the points' shape.
    """
    D = distance_to_rectangle(px, py, x, y, heading, length, width)
    pE = potential_energy(D, M_v, p) * taper(D, p)
    kE = np.zeros(np.broadcast(px, py).shape)
    for s, D_la, counts in local_closest(px, py, path):
        kE = np.maximum(kE, np.where(counts, kinetic_energy(s - s0, D_la, M_v, u, length, width, p), 0.0))
    return pE, kE


def local_closest(px: npt.ArrayLike, py: npt.ArrayLike, path: F64) -> list[tuple[F64, F64, npt.NDArray[np.bool_]]]:
    """The local closest points of a path, one candidate a segment: arc length, distance, and whether it counts.

    A segment counts where its closest point lies within it; a vertex, told by the segment that starts there, counts
    only where both neighbouring segments clamp to it. The end segments go on straight for ever.

    Inside a bend two neighbouring segments both hold a closest point. Taking each one's own arc length there would make
    the field jump where one of them ends, by the bend's angle times the distance. So both get the same one: the way on
    a segment, plus what is already covered of the next, minus what is left of the one before. This is continuous in
    every bend up to half its radius, and a vertex put on a segment changes nothing as long as the pieces are longer
    than the bend's angle times the distance. Neighbours that turn by more than 60° are not coupled.

    Args:
        px: Points [m], any shape.
        py: Their y.
        path: Vertices [n, 2], n ≥ 2 [m].

    Returns:
        For each of the n − 1 segments (s from the first vertex [m], D_la [m], counts).
    """
    q = np.stack(np.broadcast_arrays(np.asarray(px, float), np.asarray(py, float)), axis=-1)
    step = np.diff(path, axis=0)
    lengths = np.hypot(step[:, 0], step[:, 1])
    tangents = step / lengths[:, None]
    starts = np.concatenate(([0.0], np.cumsum(lengths)))
    coupled = np.sum(tangents[:-1] * tangents[1:], axis=-1) >= COUPLED
    last = len(lengths) - 1
    found = []
    for k, (a, t, length) in enumerate(zip(path[:-1], tangents, lengths, strict=True)):
        rel = q - a
        along = rel @ t
        beside = rel[..., 1] * t[0] - rel[..., 0] * t[1]
        counts = np.ones(along.shape, dtype=bool)
        before = np.zeros_like(along)
        s = starts[k] + along
        if k > 0:
            covered = rel @ tangents[k - 1]
            before = np.minimum(along, 0.0)
            counts &= (along >= 0.0) | (covered > 0.0)
            if coupled[k - 1]:
                s = s - np.clip(-covered, 0.0, np.inf if k == 1 else lengths[k - 1])
        if k < last:
            counts &= along <= length
            if coupled[k]:
                s = s + np.clip((q - path[k + 1]) @ tangents[k + 1], 0.0, np.inf if k + 1 == last else lengths[k + 1])
        found.append((s - before, np.hypot(beside, before), counts))
    return found


def straight_energy(
    px: npt.ArrayLike,
    py: npt.ArrayLike,
    *,
    x: npt.ArrayLike,
    y: npt.ArrayLike,
    heading: npt.ArrayLike,
    vx: npt.ArrayLike,
    vy: npt.ArrayLike,
    length: npt.ArrayLike,
    width: npt.ArrayLike,
    mass: npt.ArrayLike,
    cls: npt.ArrayLike,
    to_vx: npt.ArrayLike = 0.0,
    to_vy: npt.ArrayLike = 0.0,
    p: RiskParameters,
) -> F64:
    """E_d of objects whose paths are straight, for whoever moves at (to_vx, to_vy) [m/s]; all arguments broadcast.

    This is what the surrounding risk needs: the target takes the ego's place in u. The path is the line along the
    velocity, below `slow` along the heading.
    """
    vx, vy = np.asarray(vx, dtype=np.float64), np.asarray(vy, dtype=np.float64)
    speed = np.hypot(vx, vy)
    moving = speed >= max(p.slow, 1e-9)
    safe = np.where(moving, speed, 1.0)
    tx = np.where(moving, vx / safe, np.cos(heading))
    ty = np.where(moving, vy / safe, np.sin(heading))
    u = (vx - np.asarray(to_vx)) * tx + (vy - np.asarray(to_vy)) * ty
    M_v = virtual_mass(mass, cls, speed, p)
    dx, dy = np.asarray(px) - np.asarray(x), np.asarray(py) - np.asarray(y)
    D = distance_to_rectangle(px, py, x, y, heading, length, width)
    kE = kinetic_energy(dx * tx + dy * ty, np.abs(dy * tx - dx * ty), M_v, u, length, width, p)
    return np.asarray(potential_energy(D, M_v, p) * taper(D, p) + kE)
