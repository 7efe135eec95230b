"""How the others move: speeds that are linear between points, smooth lane changes, and parameters that are drawn."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from common.geometry import Polyline
from common.messages import F64, ObjectClass
from evaluation.hazards.episode import STEP_S, Actor


class Draw:
    """Parameters of a situation: nominal (the named one), or drawn uniformly from their ranges by a generator."""

    def __init__(self, random: np.random.Generator | None = None) -> None:
        self._random = random
        self.values: dict[str, float] = {}
        """Everything drawn so far."""

    def __call__(self, name: str, nominal: float, low: float, high: float) -> float:
        """The nominal value, or one between `low` and `high`."""
        value = nominal if self._random is None else float(self._random.uniform(low, high))
        self.values[name] = value
        return value

    def side(self, name: str) -> int:
        """+1 (nominal) or −1."""
        value = 1 if self._random is None else int(self._random.choice([-1, 1]))
        self.values[name] = value
        return value

    def car(self, name: str = "car") -> tuple[float, float]:
        """Length and width of a car [m]."""
        return self(f"{name}_length", 4.5, 3.7, 5.2), self(f"{name}_width", 1.8, 1.65, 2.0)

    def wander(self, t: F64, name: str = "wander") -> F64:
        """How a driver who keeps the lane sways in it [m]; nominal: not at all."""
        amplitude = self(f"{name}_m", 0.0, 0.0, 0.12)
        period, phase = self(f"{name}_s", 8.0, 6.0, 12.0), self(f"{name}_phase", 0.0, 0.0, 2 * np.pi)
        return np.asarray(amplitude * np.sin(2 * np.pi * t / period + phase))


def travelled(t: F64, points: Sequence[tuple[float, float]]) -> F64:
    """Distance driven since t = 0 [m] at a speed that is linear between (t [s], v [m/s]) and constant beyond."""
    v = np.interp(t, [p[0] for p in points], [p[1] for p in points])
    s = np.concatenate(([0.0], np.cumsum((v[1:] + v[:-1]) / 2 * STEP_S)))
    return np.asarray(s - np.interp(0.0, t, s))


def shift(t: F64, start: float, duration: float, distance: float) -> F64:
    """A smooth step from 0 to `distance` [m] between `start` and `start + duration` [s]; its second derivative too."""
    z = np.clip((t - start) / duration, 0.0, 1.0)
    return np.asarray(distance * z**3 * (10.0 - 15.0 * z + 6.0 * z * z))


def actor(
    cls: ObjectClass, size: tuple[float, float], line: Polyline, s: npt.ArrayLike, d: npt.ArrayLike = 0.0
) -> Actor:
    """Whoever moves along `line` at arc lengths s [m], d [m] to its left, one of each for a point of the time grid.

    The body points where it moves; while it stands it keeps the heading it had, at first the line's.
    """
    s, d = np.broadcast_arrays(np.asarray(s, dtype=np.float64), np.asarray(d, dtype=np.float64))
    p = line.at(s)
    along = line.at(s + 0.5) - line.at(s - 0.5)
    direction = np.arctan2(along[:, 1], along[:, 0])
    x, y = p[:, 0] - d * np.sin(direction), p[:, 1] + d * np.cos(direction)
    ds, dd = np.gradient(s, STEP_S), np.gradient(d, STEP_S)
    # below walking pace a body no longer turns
    slip = np.where(np.abs(ds) > 0.3, np.arctan2(dd, np.maximum(np.abs(ds), 0.3)), 0.0)
    return Actor(cls=cls, length=size[0], width=size[1], x=x, y=y, heading=direction + slip)


def standing(cls: ObjectClass, size: tuple[float, float], x: float, y: float, heading: float, t: F64) -> Actor:
    """Somebody who stands at (x, y) all the time."""
    k = np.ones(len(t))
    return Actor(cls=cls, length=size[0], width=size[1], x=x * k, y=y * k, heading=heading * k)


def straight(x0: float, y0: float, x1: float, y1: float) -> Polyline:
    """The line from one point to another."""
    return Polyline.of([(x0, y0), (x1, y1)])
