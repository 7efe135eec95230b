"""Small scenes for the predictor's tests: objects on given paths, maps of a few lanes."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from common.messages import FRAME_S, Lane, Map, ObjectClass, Objects, Prediction, Stamped
from common.risk import RiskParameters
from services.predictor.core import Predictor
from services.predictor.settings import PredictorSettings

Path = Callable[[float], tuple[float, float, float, float]]
"""Time [s] → x, y, heading, speed along the heading."""

T = FRAME_S * np.arange(1, 61)


def objects_of(
    states: Sequence[tuple[float, float, float, float]],
    *,
    ids: Sequence[int] | None = None,
    cls: int = ObjectClass.CAR,
    length: float = 4.5,
    width: float = 1.8,
) -> Objects:
    """One message from (x, y, heading, speed) of each object."""
    a = np.asarray(states, dtype=np.float64).reshape(-1, 4)
    n = len(a)
    return Objects(
        id=np.asarray(range(n) if ids is None else ids, dtype=np.int64),
        cls=np.full(n, cls, dtype=np.uint8),
        x=a[:, 0].copy(),
        y=a[:, 1].copy(),
        heading=a[:, 2].copy(),
        vx=a[:, 3] * np.cos(a[:, 2]),
        vy=a[:, 3] * np.sin(a[:, 2]),
        length=np.full(n, length),
        width=np.full(n, width),
        mass=np.zeros(n),
    )


def stamped(objects: Objects, t: float) -> Stamped[Objects]:
    return Stamped(objects, capture_ns=round(t * 1e9), received_ns=round(t * 1e9))


def predictor(**settings: object) -> Predictor:
    return Predictor(PredictorSettings(**settings), RiskParameters())  # type: ignore[arg-type]


def drive(
    paths: Sequence[Path],
    *,
    frames: int = 30,
    map: Map | None = None,
    cls: int = ObjectClass.CAR,
    dt: float = FRAME_S,
    with_: Predictor | None = None,
) -> Prediction:
    """The prediction after `frames` messages; the last one is at t = 0."""
    p = with_ or predictor()
    prediction = None
    for k in range(frames - 1, -1, -1):
        t = -k * dt
        prediction = p.step(stamped(objects_of([path(t) for path in paths], cls=cls), 100.0 + t), None, map)
    assert prediction is not None
    return prediction


def straight(x: float, y: float, heading: float, speed: float, acceleration: float = 0.0) -> Path:
    """Constant acceleration along a line; at rest once the speed is 0."""

    def path(t: float) -> tuple[float, float, float, float]:
        stop = -speed / acceleration if acceleration else np.inf
        t = min(t, stop) if acceleration < 0 else t
        s = speed * t + 0.5 * acceleration * t * t
        return x + s * np.cos(heading), y + s * np.sin(heading), heading, speed + acceleration * t

    return path


def circle(x: float, y: float, heading: float, speed: float, turn_rate: float) -> Path:
    """Constant speed on a circle."""
    r = speed / turn_rate

    def path(t: float) -> tuple[float, float, float, float]:
        h = heading + turn_rate * t
        return x + r * (np.sin(h) - np.sin(heading)), y - r * (np.cos(h) - np.cos(heading)), h, speed

    return path


def lane(points: object, *, id: int, width: float = 3.5, **fields: object) -> Lane:
    """A lane about a centre line."""
    p = np.asarray(points, dtype=np.float64)
    d = np.gradient(p, axis=0)
    n = np.stack((-d[:, 1], d[:, 0]), axis=1) / np.maximum(np.hypot(d[:, 0], d[:, 1]), 1e-9)[:, None]
    return Lane(id=id, centre=p, left=p + n * width / 2, right=p - n * width / 2, **fields)  # type: ignore[arg-type]


def line(x0: float, y0: float, x1: float, y1: float, n: int = 11) -> np.ndarray:
    return np.stack((np.linspace(x0, x1, n), np.linspace(y0, y1, n)), axis=1)


def arc(x: float, y: float, heading: float, radius: float, angle: float, n: int = 25) -> np.ndarray:
    """Points of an arc that begins at (x, y) in direction `heading`; angle > 0 turns left."""
    h = heading + np.linspace(0.0, angle, n)
    r = radius * np.sign(angle)
    return np.stack((x + r * (np.sin(h) - np.sin(heading)), y - r * (np.cos(h) - np.cos(heading))), axis=1)
