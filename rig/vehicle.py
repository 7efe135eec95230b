"""The simulated vehicle: a kinematic bicycle that drives the published plan, and nothing else.

State: the rear axle's pose, the speed v along the heading ψ, the acceleration a and the wheel angle δ:
```
ẋ = v cos ψ,  ẏ = v sin ψ,  ψ̇ = v κ,  κ = tan(δ) / wheelbase,  v̇ = a
```
v ≥ 0 (no reverse); a, its rate (jerk), δ and its rate are limited (`RigSettings`).

Tracking law, at plan time τ = now − capture: the profile until `valid_for`, then the tail, then a standstill.
```
κ_cmd = κ(s) − e / L² − 2 ε / L                 e, ε: lateral and heading error at the nearest point s of the path
a_cmd = a(τ) + k_v (v(τ) − v) + k_s (s(τ) − s)  feed-forward and feedback along the path
```
The first line is linear state feedback in arc length: a small error obeys e'' = −e/L² − 2e'/L, critically damped with
length L = max(2.5 m, 0.6 s · v), whatever the speed (Samson's path coordinates, linearised).
Without a plan, or with one that has no trajectory, it brakes and holds.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from common.geometry import wrap_angle
from common.messages import F64, Ego, Plan, Stamped
from rig.settings import RigSettings

STANDING = 0.05  # m/s, m/s²; slower than this and asked for no more, the brake holds


@dataclass(frozen=True)
class _Line:
    """A polyline of k points, ready to be projected on."""

    x: F64  # where its segments begin [k - 1], as what does not say otherwise [m]
    y: F64
    tx: F64  # its direction
    ty: F64
    s: F64  # arc length of the points [k] [m]
    step: F64  # length [m]
    low: F64  # bounds of the arc length on it: the first and the last go on straight [m]
    high: F64
    heading: F64  # [k] [rad]
    curvature: F64  # [k] [1/m]


@dataclass(frozen=True)
class Wanted:
    """What a plan asks of the rear axle: m rows over plan time, arc length from the first row."""

    t: F64  # [s]
    x: F64  # rear axle [m]
    y: F64
    heading: F64  # unwrapped [rad]
    curvature: F64  # [1/m]
    speed: F64  # [m/s]
    acceleration: F64  # [m/s²]
    s: F64  # [m]

    @staticmethod
    def of(plan: Plan, wheelbase: float) -> Wanted | None:
        """The profile's rows up to `valid_for`, then the tail's; None: the plan has nothing to drive."""
        parts = []
        if plan.profile is not None and len(plan.profile.t):
            parts.append((plan.profile, plan.profile.t < plan.valid_for - 1e-9))
        if plan.tail is not None and len(plan.tail.t):
            after = plan.tail.t >= plan.valid_for - 1e-9 if parts else np.ones(len(plan.tail.t), dtype=bool)
            parts.append((plan.tail, after))

        def column(name: str) -> F64:
            return np.concatenate([getattr(p, name)[keep] for p, keep in parts]) if parts else np.zeros(0)

        t = column("t")
        if not len(t):
            return None
        heading = np.unwrap(column("heading"))
        x = column("x") - wheelbase / 2 * np.cos(heading)
        y = column("y") - wheelbase / 2 * np.sin(heading)
        s = np.concatenate(([0.0], np.cumsum(np.hypot(np.diff(x), np.diff(y)))))
        return Wanted(t, x, y, heading, column("curvature"), column("speed"), column("acceleration"), s)

    def at(self, tau: float) -> tuple[float, float, float]:
        """Arc length, speed and acceleration wanted at plan time `tau`; beyond the last row: standing there."""
        if tau > self.t[-1]:
            return float(self.s[-1]), 0.0, 0.0
        i = min(max(int(np.searchsorted(self.t, tau, side="right")) - 1, 0), max(len(self.t) - 2, 0))
        if len(self.t) == 1:
            return float(self.s[0]), float(self.speed[0]), float(self.acceleration[0])
        t0, t1 = self.t.item(i), self.t.item(i + 1)
        w = min(max((tau - t0) / (t1 - t0), 0.0), 1.0)

        def between(a: F64) -> float:
            low: float = a.item(i)
            return low + w * (float(a.item(i + 1)) - low)

        return between(self.s), between(self.speed), between(self.acceleration)

    @cached_property
    def _line(self) -> _Line:
        """The rows without those where it stands."""
        keep = np.concatenate(([True], np.diff(self.s) > 1e-6))
        px, py, s = self.x[keep], self.y[keep], self.s[keep]
        step = np.diff(s)
        low, high = np.zeros(len(step)), step.copy()
        low[0], high[-1] = -np.inf, np.inf
        tx, ty = np.diff(px) / step, np.diff(py) / step
        return _Line(px[:-1], py[:-1], tx, ty, s, step, low, high, self.heading[keep], self.curvature[keep])

    def nearest(self, x: float, y: float) -> tuple[float, float, float, float]:
        """Arc length, lateral offset (left > 0), heading, curvature at the nearest point; straight beyond the ends."""
        if self.s[-1] < 1e-6:
            c, n = math.cos(self.heading[0]), math.sin(self.heading[0])
            dx, dy = x - self.x[0], y - self.y[0]
            return c * dx + n * dy, c * dy - n * dx, float(self.heading[0]), float(self.curvature[0])
        line = self._line
        rx, ry = x - line.x, y - line.y
        u = np.minimum(np.maximum(rx * line.tx + ry * line.ty, line.low), line.high)
        dx, dy = rx - u * line.tx, ry - u * line.ty
        i = int(np.argmin(dx * dx + dy * dy))
        along: float = u.item(i)
        w = min(max(along / line.step.item(i), 0.0), 1.0)

        def between(a: F64) -> float:
            low: float = a.item(i)
            return low + w * (float(a.item(i + 1)) - low)

        return (
            line.s.item(i) + along,
            line.tx.item(i) * dy.item(i) - line.ty.item(i) * dx.item(i),
            between(line.heading),
            between(line.curvature),
        )


class SimulatedVehicle:
    """Our own vehicle in the bench. `receive` a plan whenever one arrives, `step` the time."""

    def __init__(self, ego0: Ego, settings: RigSettings) -> None:
        self.settings = settings
        self.wheelbase = ego0.wheelbase
        self._size = (ego0.length, ego0.width)
        self.plan: Stamped[Plan] | None = None
        self._wanted: Wanted | None = None
        self.place(ego0)

    def place(self, ego: Ego) -> None:
        """Put the vehicle into a state, plan and all limits aside (the start of a run)."""
        self.heading = ego.heading
        self.x = ego.x - self.wheelbase / 2 * math.cos(ego.heading)
        self.y = ego.y - self.wheelbase / 2 * math.sin(ego.heading)
        self.speed = max(0.0, ego.speed)
        limit = (-self.settings.max_deceleration, self.settings.max_acceleration)
        self.acceleration = float(np.clip(ego.acceleration, *limit))
        curvature = ego.yaw_rate / self.speed if self.speed > 0.5 else 0.0
        limit_steer = self.settings.max_steer
        self.steer = float(np.clip(math.atan(curvature * self.wheelbase), -limit_steer, limit_steer))

    def receive(self, plan: Stamped[Plan]) -> None:
        """Take a newer plan; an older one than that in force (by capture) is ignored."""
        if self.plan is not None and plan.capture_ns < self.plan.capture_ns:
            return
        self.plan = plan
        self._wanted = Wanted.of(plan.value, self.wheelbase)

    def step(self, dt_s: float, now_ns: int) -> Ego:
        """Drive on by `dt_s` [s] from time `now_ns` and return the state then."""
        n = max(1, math.ceil(dt_s / self.settings.substep_s - 1e-9))
        h = dt_s / n
        for i in range(n):
            self._substep(h, now_ns + round((i + 0.5) * h * 1e9))
        return self.ego()

    def ego(self) -> Ego:
        """The state as the vehicle would publish it."""
        yaw_rate = self.speed * math.tan(self.steer) / self.wheelbase
        c, n = math.cos(self.heading), math.sin(self.heading)
        lateral = yaw_rate * self.wheelbase / 2
        return Ego(
            x=self.x + self.wheelbase / 2 * c,
            y=self.y + self.wheelbase / 2 * n,
            heading=float(wrap_angle(self.heading)),
            vx=self.speed * c - lateral * n,
            vy=self.speed * n + lateral * c,
            acceleration=self.acceleration,
            yaw_rate=yaw_rate,
            length=self._size[0],
            width=self._size[1],
            wheelbase=self.wheelbase,
        )

    def _substep(self, h: float, now_ns: int) -> None:
        wanted, curvature = self._command(now_ns)
        k = self.settings
        # what the actuators can do within h
        wanted = min(max(wanted, -k.max_deceleration), k.max_acceleration)
        self.acceleration += min(max(wanted - self.acceleration, -k.max_jerk * h), k.max_jerk * h)
        steer = min(max(math.atan(curvature * self.wheelbase), -k.max_steer), k.max_steer)
        self.steer += min(max(steer - self.steer, -k.max_steer_rate * h), k.max_steer_rate * h)
        # the midpoint rule; standing, the brake holds
        speed = self.speed + self.acceleration * h
        if speed <= 0.0:
            speed = 0.0
            self.acceleration = max(self.acceleration, 0.0) if wanted > 0.0 else 0.0
        mean = (self.speed + speed) / 2
        kappa = math.tan(self.steer) / self.wheelbase
        middle = self.heading + mean * kappa * h / 2
        self.x += mean * math.cos(middle) * h
        self.y += mean * math.sin(middle) * h
        self.heading += mean * kappa * h
        self.speed = speed

    def _command(self, now_ns: int) -> tuple[float, float]:
        """Wanted acceleration [m/s²] and curvature [1/m]."""
        k = self.settings
        held = math.tan(self.steer) / self.wheelbase
        if self.plan is None or self._wanted is None:
            return (-k.hold_deceleration if self.speed > 0.0 else 0.0), held
        tau = (now_ns - self.plan.capture_ns) * 1e-9
        s_wanted, v_wanted, a_wanted = self._wanted.at(tau)
        s, e, psi, kappa = self._wanted.nearest(self.x, self.y)
        if v_wanted < STANDING and a_wanted <= STANDING and self.speed < STANDING:
            return (-k.hold_deceleration if self.speed > 0.0 else 0.0), held
        length = max(k.tracking_length_m, k.tracking_length_s * self.speed)
        epsilon = float(wrap_angle(self.heading - psi))
        curvature = kappa - e / length**2 - 2.0 * epsilon / length
        behind = min(max(s_wanted - s, -1.0), 1.0)
        if tau > self._wanted.t[-1]:  # the plan is over: stand
            return -k.hold_deceleration, curvature
        a = a_wanted + k.tracking_speed_gain * (v_wanted - self.speed) + k.tracking_position_gain * behind
        return a, curvature
