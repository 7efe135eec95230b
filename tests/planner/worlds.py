"""Small worlds for the planner's tests: boxes that move, the potential field around them, an ego that follows its plan.

The field is the potential term of a car alone, pE = A / (D² + A), written here again so that these tests stand alone.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from common.geometry import distance_to_rectangle
from common.messages import NO_SLOT, Ego, Goal, Grid, Lane, Map, Plan, Risk, Route, Slot, Stamped
from services.planner.core import Planner
from services.planner.settings import PlannerSettings

A = 0.42
MS = 1_000_000
LENGTH, WIDTH, WHEELBASE = 4.5, 1.8, 2.7


@dataclass
class Box:
    """A rectangle with its pose over time, and what is predicted of it."""

    pose: Callable[[float], tuple[float, float, float]]
    length: float = 4.5
    width: float = 1.8
    id: int = 1
    cls: int = 1
    predict: Callable[[float, float], tuple[float, float, float]] | None = None

    def predicted(self, now: float, ahead: float) -> tuple[float, float, float]:
        if self.predict is not None:
            return self.predict(now, ahead)
        x0, y0, _ = self.pose(now - 0.1)
        x1, y1, h1 = self.pose(now)
        return x1 + (x1 - x0) * 10 * ahead, y1 + (y1 - y0) * 10 * ahead, h1


def box(x: float, y: float, vx: float = 0.0, vy: float = 0.0, heading: float = 0.0, **more: float) -> Box:
    return Box(lambda t: (x + vx * t, y + vy * t, heading), **more)


def ego_at(x: float, y: float, heading: float = 0.0, speed: float = 0.0, **more: float) -> Ego:
    values = {
        "x": x,
        "y": y,
        "heading": heading,
        "vx": speed * np.cos(heading),
        "vy": speed * np.sin(heading),
        "acceleration": 0.0,
        "yaw_rate": 0.0,
        "length": LENGTH,
        "width": WIDTH,
        "wheelbase": WHEELBASE,
    }
    return Ego(**{k: float(v) for k, v in (values | more).items()})


def risk_of(
    ego: Ego,
    boxes: list[Box],
    now: float = 0.0,
    *,
    ahead: float = 130.0,
    behind: float = 30.0,
    width: float = 40.0,
    h: float = 0.5,
    statics: Callable[[np.ndarray, np.ndarray], np.ndarray] | None = None,
) -> Risk:
    c, s = np.cos(ego.heading), np.sin(ego.heading)
    rows, columns = round((ahead + behind) / h), round(width / h)
    gx, gy = ego.x - c * behind + s * width / 2, ego.y - s * behind - c * width / 2
    i, j = (np.arange(rows) + 0.5) * h, (np.arange(columns) + 0.5) * h
    px = gx + c * i[:, None] - s * j[None]
    py = gy + s * i[:, None] + c * j[None]
    times = [0.5 * k for k in range(13)]
    volume = np.zeros((13, rows, columns))
    best = np.zeros((13, rows, columns))
    who = np.full((13, rows, columns), NO_SLOT, dtype=np.uint8)
    for slot, b in enumerate(boxes):
        for k, t in enumerate(times):
            x, y, heading = b.predicted(now, t)
            if (x - ego.x) ** 2 + (y - ego.y) ** 2 > 200**2:
                continue
            d = distance_to_rectangle(px, py, x, y, heading, b.length, b.width)
            e = A / (d**2 + A) * (d < 25.0)
            who[k][e > np.maximum(best[k], 1e-3)] = slot
            best[k] = np.maximum(best[k], e)
            volume[k] += e
    if statics is not None:
        volume += statics(px, py)[None]
    bi, bj = -(-rows // 4), -(-columns // 4)
    dominant = np.full((13, bi, bj), NO_SLOT, dtype=np.uint8)
    pad = np.pad(who, ((0, 0), (0, bi * 4 - rows), (0, bj * 4 - columns)), constant_values=NO_SLOT)
    dominant[:] = pad.reshape(13, bi, 4, bj, 4).min(axis=(2, 4))
    return Risk(
        grid=Grid(x=float(gx), y=float(gy), heading=float(ego.heading), rows=rows, columns=columns, h=h),
        slice_times=times,
        slots=[Slot(b.id, "potential", b.cls) for b in boxes],
        volume=volume.astype(np.float32),
        dominant=dominant,
    )


def barrier(y: float, side: float = 1.0) -> Callable[[np.ndarray, np.ndarray], np.ndarray]:
    """A kerb along y with no far side: peak 1.5, half-width 0.6 m."""

    def energy(px: np.ndarray, py: np.ndarray) -> np.ndarray:
        d = np.maximum(side * (y - py), 0.0)
        return 1.5 / 0.36 * (0.6 - np.minimum(0.6, d)) ** 2

    return energy


def straight_route(length: float = 400.0, speed: float = 14.0, **goal: object) -> Route:
    values = {"x": length - 5.0, "y": 0.0, "radius": 3.0, "stop": False} | goal
    return Route(reference=np.array([[-20.0, 0.0], [length, 0.0]]), goal=Goal(**values), speed_limit=speed)  # type: ignore[arg-type]


def lane(
    id_: int,
    y: float,
    length: float = 400.0,
    width: float = 3.5,
    limit: float = 14.0,
    against: bool = False,
    **more: object,
) -> Lane:
    x = np.linspace(-30.0, length + 30, 60)
    order = slice(None, None, -1) if against else slice(None)
    left, right = (y - width / 2, y + width / 2) if against else (y + width / 2, y - width / 2)

    def line(value: float) -> np.ndarray:
        return np.ascontiguousarray(np.stack((x, np.full_like(x, value)), axis=1)[order])

    return Lane(id=id_, centre=line(y), left=line(left), right=line(right), speed_limit=limit, **more)  # type: ignore[arg-type]


def stamped(value: object, t: float) -> Stamped:
    return Stamped(value, round(t * 1e9), round(t * 1e9))


@dataclass
class Drive:
    """What happened in a closed loop, every 50 ms."""

    t: list[float] = field(default_factory=list)
    ego: list[Ego] = field(default_factory=list)
    plans: list[Plan] = field(default_factory=list)
    clearance: list[float] = field(default_factory=list)

    @property
    def speed(self) -> np.ndarray:
        return np.array([e.speed for e in self.ego])

    @property
    def x(self) -> np.ndarray:
        return np.array([e.x for e in self.ego])

    @property
    def y(self) -> np.ndarray:
        return np.array([e.y for e in self.ego])

    @property
    def acceleration(self) -> np.ndarray:
        return np.array([e.acceleration for e in self.ego])

    @property
    def modes(self) -> list[str]:
        return [p.mode for p in self.plans]

    def jerk(self) -> np.ndarray:
        return np.diff(self.acceleration) / 0.05

    def sign_changes(self, band: float = 0.15) -> int:
        a = self.acceleration
        signs = np.sign(a[np.abs(a) > band])
        return int(np.sum(signs[1:] != signs[:-1]))


def follow(plan: Plan, ego: Ego, t: float) -> Ego:
    """Where a vehicle that follows its plan perfectly is, t after the plan's capture."""
    p = plan.profile if t <= plan.valid_for else plan.tail
    if p is None:
        return ego

    def at(name: str) -> float:
        return float(np.interp(t, p.t, getattr(p, name)))

    v, heading, k = at("speed"), at("heading"), at("curvature")
    slip = np.arctan(0.5 * ego.wheelbase * k)  # the centre moves a little across the body
    vc = v / np.cos(slip)
    return ego_at(
        at("x"),
        at("y"),
        heading,
        acceleration=at("acceleration"),
        yaw_rate=v * k,
        length=ego.length,
        width=ego.width,
        wheelbase=ego.wheelbase,
        vx=vc * np.cos(heading + slip),
        vy=vc * np.sin(heading + slip),
    )


def drive(
    boxes: list[Box],
    route: Route,
    ego: Ego,
    *,
    seconds: float,
    road: Map | None = None,
    settings: PlannerSettings | None = None,
    noise: float = 0.0,
    risk_age: float = 0.1,
    **grid: object,
) -> Drive:
    """Closed loop: risk at 10 Hz, `risk_age` old when it is used, plans at 20 Hz."""
    planner = Planner(settings or PlannerSettings())
    rng = np.random.default_rng(3)
    out = Drive()
    road_stamped, route_stamped = stamped(road or Map(), 0.0), stamped(route, 0.0)
    waiting: list[Stamped] = []
    for step in range(round(seconds / 0.05)):
        t = 0.05 * step
        if step % 2 == 0:
            jitter = [noise * rng.standard_normal(2) for _ in boxes]
            seen = [
                Box(b.pose, b.length, b.width, b.id, b.cls, _noisy(b, n)) if noise else b
                for b, n in zip(boxes, jitter, strict=True)
            ]
            waiting.append(stamped(risk_of(ego, seen, t, **grid), t))  # type: ignore[arg-type]
        due = [r for r in waiting if r.capture_ns <= round((t - risk_age) * 1e9)]
        risk = due[-1] if due else waiting[0]
        waiting = waiting[-6:]
        plan = planner.step(stamped(ego, t), risk, road_stamped, route_stamped, round(t * 1e9) + 10 * MS)
        out.t.append(t)
        out.ego.append(ego)
        out.plans.append(plan)
        out.clearance.append(clearance(ego, boxes, t))
        ego = follow(plan, ego, 0.05)
    return out


def _noisy(b: Box, noise: np.ndarray) -> Callable[[float, float], tuple[float, float, float]]:
    def predict(now: float, ahead: float) -> tuple[float, float, float]:
        x, y, heading = b.predicted(now, ahead)
        return x + noise[0] * ahead, y + 0.3 * noise[1] * ahead, heading

    return predict


def clearance(ego: Ego, boxes: list[Box], t: float) -> float:
    """Smallest distance between the ego's outline and the boxes [m]."""
    if not boxes:
        return 1e3
    u = np.linspace(-0.5, 0.5, 21)
    lx = np.concatenate((u, u, np.full(21, -0.5), np.full(21, 0.5))) * ego.length
    ly = np.concatenate((np.full(21, -0.5), np.full(21, 0.5), u, u)) * ego.width
    c, s = np.cos(ego.heading), np.sin(ego.heading)
    px, py = ego.x + c * lx - s * ly, ego.y + s * lx + c * ly
    return float(min(distance_to_rectangle(px, py, *b.pose(t), b.length, b.width).min() for b in boxes))
