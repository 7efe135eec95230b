"""Where everything is drawn: the recording and its local origin, since a viewer's coordinates are 32 bit wide."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
import numpy.typing as npt
import rerun as rr

from viz.run_time import When

F32 = npt.NDArray[np.float32]
NEAR_M = 5000.0
"""Coordinates up to here are drawn as they are [m]; a float32 still resolves half a millimetre."""


class Rows(Protocol):
    """Takes rows: a `viz.sinks.Recorder`."""

    def log(self, path: str, *what: rr.AsComponents, static: bool = False) -> None:
        """Log one row at the time last set."""

    def set_time(self, frame: int, t: float) -> None:
        """Everything logged from here on stands at this frame, t seconds after the run's begin."""


@dataclass
class Canvas:
    """Where rows go, and the point of the `map` frame that is drawn at (0, 0)."""

    rec: Rows
    origin: tuple[float, float] | None = None

    def log(self, path: str, *what: rr.AsComponents, static: bool = False) -> None:
        """Log at the time last set."""
        self.rec.log(path, *what, static=static)

    def set_time(self, when: When) -> None:
        """Everything logged from here on stands at `when`."""
        self.rec.set_time(when.frame, when.t)

    def place(self, x: float, y: float) -> None:
        """Choose the origin by the first position that is seen; a far one (UTM) is rounded to 100 m."""
        if self.origin is None:
            far = max(abs(x), abs(y)) > NEAR_M
            self.origin = (round(x, -2), round(y, -2)) if far else (0.0, 0.0)
            self.log("world", rr.AnyValues(map_x_at_origin=self.origin[0], map_y_at_origin=self.origin[1]), static=True)

    def points(self, x: npt.ArrayLike, y: npt.ArrayLike, z: npt.ArrayLike = 0.0) -> F32:
        """Points of the `map` frame [m] as drawn, shape [..., 3]."""
        ox, oy = self.origin or (0.0, 0.0)
        x, y, z = np.broadcast_arrays(np.asarray(x, float) - ox, np.asarray(y, float) - oy, np.asarray(z, float))
        return np.stack((x, y, z), axis=-1).astype(np.float32)


def turned(heading: float) -> rr.Quaternion:
    """The one quaternion of a heading [rad]."""
    return rr.Quaternion(xyzw=yaw(heading))


def yaw(heading: npt.ArrayLike) -> F32:
    """Quaternions x, y, z, w of headings [rad], shape [..., 4]."""
    half = np.asarray(heading, dtype=np.float64) / 2
    zero = np.zeros_like(half)
    return np.stack((zero, zero, np.sin(half), np.cos(half)), axis=-1).astype(np.float32)
