"""A path and a motion along it: kept as the memory from which is replanned, published as a trajectory."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from common.messages import Trajectory
from services.planner.bezier import Paths, Start

F64 = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Path:
    """One path of the rear axle with evenly spaced points; an arc of its last curvature beyond its end."""

    step: float
    x: F64
    y: F64
    heading: F64
    curvature: F64

    @staticmethod
    def of(paths: Paths, index: int) -> Path:
        """One of many."""
        return Path(paths.step, paths.x[index], paths.y[index], paths.heading[index], paths.curvature[index])

    @staticmethod
    def arc(start: Start, length: float, step: float = 0.5) -> Path:
        """The circle on which the start stands."""
        s: F64 = np.asarray(step * np.arange(max(int(np.ceil(length / step)), 1) + 1), dtype=np.float64)
        k = start.curvature
        heading = start.heading + k * s
        half = 0.5 * k * s
        chord = s * np.sinc(half / np.pi)
        return Path(
            step,
            start.x + chord * np.cos(start.heading + half),
            start.y + chord * np.sin(start.heading + half),
            heading,
            np.full(len(s), k),
        )

    def at(self, distance: F64) -> tuple[F64, F64, F64, F64]:
        """x, y, heading, curvature at distances along it."""
        last = self.step * (len(self.x) - 1)
        inside = np.minimum(np.maximum(distance, 0.0), last)
        f = inside / self.step
        i = np.minimum(f.astype(np.intp), len(self.x) - 2)
        w = f - i
        heading = self.heading[i] + w * (self.heading[i + 1] - self.heading[i])
        over = distance - inside
        return (
            self.x[i] + w * (self.x[i + 1] - self.x[i]) + over * np.cos(heading),
            self.y[i] + w * (self.y[i + 1] - self.y[i]) + over * np.sin(heading),
            heading,
            self.curvature[i] + w * (self.curvature[i + 1] - self.curvature[i]),
        )


@dataclass(frozen=True)
class Motion:
    """Distance, speed and acceleration over time, piecewise of constant jerk enough to be interpolated."""

    t: F64  # from the plan's capture [s]
    distance: F64  # [m]
    speed: F64  # [m/s]
    acceleration: F64  # [m/s²]

    def at(self, t: float) -> tuple[float, float, float]:
        """(distance, speed, acceleration) at a time, held at the ends."""
        i = min(max(int(np.searchsorted(self.t, t, side="right")) - 1, 0), len(self.t) - 2)
        h = float(self.t[i + 1] - self.t[i])
        u = min(max(t - float(self.t[i]), 0.0), h)
        w = u / h
        v0, v1 = float(self.speed[i]), float(self.speed[i + 1])
        v = v0 + w * (v1 - v0)
        s = float(self.distance[i]) + min(
            0.5 * (v0 + v) * u, float(self.distance[i + 1] - self.distance[i]) if w >= 1.0 else np.inf
        )
        a = float(self.acceleration[i]) + w * float(self.acceleration[i + 1] - self.acceleration[i])
        return s, v, a

    def until(self, t: float) -> Motion:
        """The part up to t, with a sample there."""
        keep = self.t < t - 1e-6
        s, v, a = self.at(t)
        return Motion(
            np.append(self.t[keep], t),
            np.append(self.distance[keep], s),
            np.append(self.speed[keep], v),
            np.append(self.acceleration[keep], a),
        )


def brake_motion(t0: float, distance: float, speed: float, acceleration: float, brake: float, jerk: float) -> Motion:
    """Brake to rest from a state at t0; times go on, the last sample stands still. `jerk` builds the brake up."""
    dt = 0.05
    t, s, v, a = [t0], [float(distance)], [max(float(speed), 0.0)], [float(acceleration)]
    while v[-1] > 0.0:
        # near rest the brake is let go so that the vehicle stands softly
        wanted = -min(brake, math.sqrt(2.0 * jerk * v[-1]) + 0.3)
        rise = jerk if a[-1] > wanted else 4.0 * jerk
        a_next = a[-1] + min(max(wanted - a[-1], -rise * dt), 4.0 * jerk * dt)
        v_next = v[-1] + 0.5 * (a[-1] + a_next) * dt
        if v_next <= 1e-3:
            mean = max(-0.5 * (a[-1] + a_next), v[-1] / (4.0 * dt), 1e-3)
            h = max(v[-1] / mean, 1e-3)
            t.append(t[-1] + h)
            s.append(s[-1] + 0.5 * v[-1] * h)
            v.append(0.0)
            a.append(0.0)
            break
        t.append(t[-1] + dt)
        s.append(s[-1] + 0.5 * (v[-1] + v_next) * dt)
        v.append(v_next)
        a.append(a_next)
    if len(t) == 1:  # already at rest
        t.append(t0 + 2.0 * dt)
        s.append(distance)
        v.append(0.0)
        a[0] = 0.0
        a.append(0.0)
    return Motion(np.array(t), np.array(s), np.array(v), np.array(a))


def trajectory_of(path: Path, motion: Motion, wheelbase: float) -> Trajectory:
    """The motion of the rectangle's centre, which lies half a wheelbase ahead of the rear axle."""
    x, y, heading, curvature = path.at(motion.distance)
    return Trajectory(
        t=np.ascontiguousarray(motion.t),
        x=x + 0.5 * wheelbase * np.cos(heading),
        y=y + 0.5 * wheelbase * np.sin(heading),
        heading=heading,
        curvature=np.ascontiguousarray(curvature),
        speed=np.maximum(motion.speed, 0.0),
        acceleration=np.ascontiguousarray(motion.acceleration),
    )


@dataclass(frozen=True)
class Memory:
    """What was planned last: where the ego should be at any time since."""

    capture_ns: int
    path: Path
    motion: Motion  # the profile
    tail: Motion
    valid_for: float
    target_name: str
    target_speed: float  # the filtered target [m/s]
    remaining: float  # length of the lateral move still to go at the plan's capture [m]
    s: float  # arc length on the reference line at the plan's capture [m]
    margin: float = np.inf  # risk beyond contact that the flanks were let have, inf where nobody has said [E_max]
    patience: float = 1.0  # share of the cost of leaving the lane, while something stands in it

    def state(self, now_ns: int) -> tuple[Start, float]:
        """The planned state at a time, and how far along the path it is; after the profile, the tail."""
        t = (now_ns - self.capture_ns) * 1e-9
        distance, v, a = (self.motion if t <= self.valid_for else self.tail).at(t)
        x, y, heading, curvature = (float(q[0]) for q in self.path.at(np.array([distance])))
        return Start(x, y, heading, curvature, max(v, 0.0), a), distance
