"""An episode: one short piece of traffic in which nobody reacts, on a fine time grid; and what can be seen of it.

Times count from the first moment at which an alarm is possible; `HISTORY_S` before it the others can already be seen.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import numpy.typing as npt

from common.geometry import Polyline, rectangle_corners
from common.messages import F64, FRAME_S, Ego, Map, ObjectClass, Objects
from rig.world import EGO_SIZE

STEP_S = 0.02
"""Spacing of the time grid on which everything is simulated [s]."""
HISTORY_S = 3.0
"""How long the others can be seen before the first possible alarm [s]."""
SUBSTEPS = round(FRAME_S / STEP_S)


@dataclass(frozen=True)
class Actor:
    """One other road user on the time grid: k poses of the rectangle's centre, `map` frame."""

    cls: ObjectClass
    length: float  # [m]
    width: float  # [m]
    x: F64  # [k] [m]
    y: F64  # [k] [m]
    heading: F64  # [k] [rad]


@dataclass(frozen=True)
class Episode:
    """A situation, the ego on its own path at its own speed, and the others doing what they will do."""

    name: str
    map: Map
    path: Polyline
    """The ego's path, [m]; straight beyond its ends."""
    speed: float
    """The ego's speed [m/s], never changed."""
    s0: float
    """Arc length of the ego's centre on its path at t = 0 [m]."""
    duration_s: float
    actors: tuple[Actor, ...]
    onset_s: float | None = None
    """When the manoeuvre begins that makes the danger; None: it can be seen from the start."""
    parameters: dict[str, float] = field(default_factory=dict)
    """What was drawn."""

    @property
    def times(self) -> F64:
        """The time grid, from −`HISTORY_S` to the end [s]."""
        return grid(self.duration_s)

    def ego_poses(self, t: npt.ArrayLike) -> tuple[F64, F64, F64]:
        """Centre and heading of the ego at times t [s], any shape."""
        s = self.s0 + self.speed * np.asarray(t, dtype=np.float64)
        p = self.path.at(s)
        # the body's yaw turns smoothly: mean direction over one metre
        d = self.path.at(s + 0.5) - self.path.at(s - 0.5)
        return p[..., 0], p[..., 1], np.arctan2(d[..., 1], d[..., 0])

    def ego(self, t: float) -> Ego:
        """What the ego knows of itself at t [s]."""
        x, y, heading = (float(v) for v in self.ego_poses(t))
        turned = float(self.ego_poses(t + 0.05)[2]) - float(self.ego_poses(t - 0.05)[2])
        return Ego(
            x=x,
            y=y,
            heading=heading,
            vx=self.speed * float(np.cos(heading)),
            vy=self.speed * float(np.sin(heading)),
            acceleration=0.0,
            yaw_rate=float(np.remainder(turned + np.pi, 2 * np.pi) - np.pi) / 0.1,
            length=EGO_SIZE[0],
            width=EGO_SIZE[1],
            wheelbase=EGO_SIZE[2],
        )

    @cached_property
    def visible(self) -> npt.NDArray[np.bool_]:
        """Whether each actor can be seen at each frame of 0.1 s from −`HISTORY_S` on, [frames, actors].

        Hidden is whoever's centre and front and rear middle all lie behind another vehicle, seen from the ego's centre.
        """
        at = np.arange(0, len(self.times), SUBSTEPS)
        n = len(self.actors)
        seen = np.ones((len(at), n), dtype=bool)
        ex, ey, _ = self.ego_poses(self.times[at])
        eye = np.stack((ex, ey), axis=-1)
        for i, a in enumerate(self.actors):
            c = np.stack((np.cos(a.heading[at]), np.sin(a.heading[at])), axis=-1) * a.length / 2
            centre = np.stack((a.x[at], a.y[at]), axis=-1)
            hidden = np.zeros((3, len(at)), dtype=bool)
            for k, b in enumerate(self.actors):
                if k == i or b.cls in (ObjectClass.PEDESTRIAN, ObjectClass.BICYCLE):
                    continue
                box = rectangle_corners(b.x[at], b.y[at], b.heading[at], b.length, b.width)
                for m, target in enumerate((centre, centre + c, centre - c)):
                    hidden[m] |= _crosses(eye, target, box)
            seen[:, i] = ~hidden.all(0)
        return seen

    def objects(self, frame: int) -> Objects:
        """What the ego perceives at t = `frame` · 0.1 s: who is not hidden; velocities by backward differences."""
        k = round(HISTORY_S / FRAME_S) + frame
        i = k * SUBSTEPS
        back = max(i - SUBSTEPS, 0)
        span = max(i - back, 1) * STEP_S
        rows = [n for n in range(len(self.actors)) if self.visible[k, n]]
        chosen = [self.actors[n] for n in rows]
        return Objects(
            id=np.array(rows, dtype=np.int64) + 1,
            cls=np.array([a.cls for a in chosen], dtype=np.uint8),
            x=np.array([a.x[i] for a in chosen], dtype=np.float64),
            y=np.array([a.y[i] for a in chosen], dtype=np.float64),
            heading=np.array([a.heading[i] for a in chosen], dtype=np.float64),
            vx=np.array([(a.x[i] - a.x[back]) / span for a in chosen], dtype=np.float64),
            vy=np.array([(a.y[i] - a.y[back]) / span for a in chosen], dtype=np.float64),
            length=np.array([a.length for a in chosen], dtype=np.float64),
            width=np.array([a.width for a in chosen], dtype=np.float64),
            mass=np.zeros(len(chosen)),
        )


def grid(duration_s: float) -> F64:
    """The time grid of an episode [s]."""
    before = round(HISTORY_S / STEP_S)
    return np.asarray(np.arange(-before, round(duration_s / STEP_S) + 1) * STEP_S)


def _crosses(a: F64, b: F64, box: F64) -> npt.NDArray[np.bool_]:
    """Whether segments a → b [k, 2] pass through convex boxes [k, 4, 2] (corners counter-clockwise)."""
    low, high = np.zeros(len(a)), np.ones(len(a))
    d = b - a
    for i in range(4):
        edge = box[:, (i + 1) % 4] - box[:, i]
        inward = np.stack((-edge[:, 1], edge[:, 0]), axis=-1)
        rate = np.sum(inward * d, -1)
        depth = np.sum(inward * (a - box[:, i]), -1)
        with np.errstate(divide="ignore", invalid="ignore"):
            u = -depth / rate
        low = np.where(rate > 0, np.maximum(low, u), low)
        high = np.where(rate < 0, np.minimum(high, u), high)
        high = np.where((rate == 0) & (depth < 0), -1.0, high)
    return np.asarray(low < high)
