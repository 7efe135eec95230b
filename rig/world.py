"""A world to drive in: a map, a route, an ego at its start, and the recorded or generated motion of the others.

Whatever the source, tracks lie on the 10 Hz grid of the bus; time 0 is the start of the run. Velocities are backward
differences, (p(t) − p(t − 0.1 s)) / 0.1 s: what a perception could know at t, nothing of the future.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import msgspec
import numpy as np

from common.geometry import wrap_angle
from common.messages import F64, FRAME_S, MAX_OBJECTS, Closures, Ego, Map, ObjectClass, Objects, Route

SIZES: dict[ObjectClass, tuple[float, float]] = {
    ObjectClass.UNKNOWN: (1.0, 1.0),
    ObjectClass.CAR: (4.5, 1.8),
    ObjectClass.TRUCK: (10.0, 2.5),
    ObjectClass.BUS: (12.0, 2.55),
    ObjectClass.MOTORCYCLE: (2.2, 0.8),
    ObjectClass.BICYCLE: (1.8, 0.6),
    ObjectClass.PEDESTRIAN: (0.5, 0.5),
}
"""Length and width assumed where a source tells none [m]."""

EGO_SIZE = (4.5, 1.8, 2.7)
"""Length, width and wheelbase of the ego where a source tells none [m]."""


class ScenarioError(ValueError):
    """A scenario that cannot be used: where (file, line), why, and what to do."""

    def __init__(self, reason: str, *, path: Path | str | None = None, line: int | None = None, hint: str = "") -> None:
        where = "" if path is None else f"{path}{'' if line is None else f':{line}'}: "
        super().__init__(f"{where}{reason}{f'. {hint}' if hint else ''}")
        self.path = None if path is None else str(path)
        self.line = line
        self.reason = reason
        self.hint = hint


@dataclass(frozen=True)
class Track:
    """One other road user on the 10 Hz grid: k successive frames from `frame0`, `map` frame, the rectangle's centre."""

    id: int
    cls: ObjectClass
    length: float  # [m]
    width: float  # [m]
    frame0: int  # frame of the first row; frame 0 is the start of the run
    x: F64  # [k] [m]
    y: F64  # [k] [m]
    heading: F64  # [k] [rad]
    first_velocity: tuple[float, float] | None = None  # [m/s] as recorded; None: the object counts from its second row
    mass: float = 0.0  # [kg]; 0: unknown
    label: str = ""  # the source's own name of it

    @cached_property
    def velocity(self) -> F64:
        """Backward differences [m/s], shape [k, 2]; the first row is as recorded, or 0 where it is not."""
        p = np.stack((self.x, self.y), axis=-1)
        v = np.zeros_like(p)
        v[1:] = np.diff(p, axis=0) / FRAME_S
        v[0] = (0.0, 0.0) if self.first_velocity is None else self.first_velocity
        return v

    @property
    def first_seen(self) -> int:
        """First frame in which the object is reported."""
        return self.frame0 + (1 if self.first_velocity is None else 0)

    @property
    def last(self) -> int:
        """Last recorded frame."""
        return self.frame0 + len(self.x) - 1


@dataclass(frozen=True)
class Closure:
    """A stop line or lane that is closed from `start_s` until before `end_s`."""

    id: int
    start_s: float
    end_s: float


@dataclass(frozen=True)
class Scenario:
    """Everything the bench needs to know about one drive."""

    name: str
    title: str
    source: str  # commonroad, table, built-in
    duration_s: float
    map: Map | None
    route: Route
    ego0: Ego
    tracks: tuple[Track, ...] = ()
    closures: tuple[Closure, ...] = ()
    warnings: tuple[str, ...] = ()
    human: Track | None = None
    """How the recorded driver drove where the ego now drives; None: the source does not tell."""
    human_goal_s: float | None = None
    """When the recorded driver was at the goal [s]; None: the source does not tell."""
    detail: dict[str, str] = field(default_factory=dict)

    def objects_at(self, t: float) -> Objects:
        """What is there at `t` [s]: recorded frames exactly, interpolated in between; nobody outside his record.

        Before 0 (the run-up) those of frame 0 stand where they came from at the velocity of frame 0.
        """
        if t < 0.0:
            now = self.objects_at(0.0)
            return msgspec.structs.replace(now, x=now.x + now.vx * t, y=now.y + now.vy * t)
        f = t / FRAME_S
        low = round(f) if abs(f - round(f)) < 1e-6 else int(np.floor(f))
        w = max(0.0, f - low) if abs(f - low) >= 1e-6 else 0.0
        rows = [(k, low - k.frame0) for k in self.tracks if k.first_seen <= low and low + (w > 0.0) <= k.last]
        rows = rows[:MAX_OBJECTS]

        def between(values: list[tuple[float, float]]) -> F64:
            return np.array([a + (b - a) * w for a, b in values], dtype=np.float64)

        step = 1 if w > 0.0 else 0
        velocity = np.array([k.velocity[i] * (1 - w) + k.velocity[i + step] * w for k, i in rows]).reshape(-1, 2)
        return Objects(
            id=np.array([k.id for k, _ in rows], dtype=np.int64),
            cls=np.array([k.cls for k, _ in rows], dtype=np.uint8),
            x=between([(k.x[i], k.x[i + step]) for k, i in rows]),
            y=between([(k.y[i], k.y[i + step]) for k, i in rows]),
            heading=np.array(
                [_turn(k.heading[i], k.heading[i + step], w) for k, i in rows],
                dtype=np.float64,
            ),
            vx=np.ascontiguousarray(velocity[:, 0]),
            vy=np.ascontiguousarray(velocity[:, 1]),
            length=np.array([k.length for k, _ in rows], dtype=np.float64),
            width=np.array([k.width for k, _ in rows], dtype=np.float64),
            mass=np.array([k.mass for k, _ in rows], dtype=np.float64),
        )

    def closures_at(self, t: float) -> Closures:
        """What is closed at `t` [s]; the run-up sees what 0 sees."""
        t = max(t, 0.0)
        return Closures(ids=sorted({c.id for c in self.closures if c.start_s <= t < c.end_s}))

    def ego_before(self, t: float) -> Ego:
        """The ego in the run-up, t ≤ 0 [s]: it came straight at its first velocity and reaches `ego0` at 0."""
        e = self.ego0
        t = min(t, 0.0)
        return msgspec.structs.replace(e, x=e.x + e.vx * t, y=e.y + e.vy * t)


def _turn(a: float, b: float, w: float) -> float:
    return float(wrap_angle(a + w * float(wrap_angle(b - a))))


def ego_at(
    x: float,
    y: float,
    heading: float,
    speed: float,
    *,
    size: tuple[float, float, float] = EGO_SIZE,
    acceleration: float = 0.0,
) -> Ego:
    """An ego whose centre is at (x, y) and which moves straight along its heading at `speed` [m/s]."""
    return Ego(
        x=float(x),
        y=float(y),
        heading=float(wrap_angle(heading)),
        vx=float(speed * np.cos(heading)),
        vy=float(speed * np.sin(heading)),
        acceleration=float(acceleration),
        yaw_rate=0.0,
        length=size[0],
        width=size[1],
        wheelbase=size[2],
    )
