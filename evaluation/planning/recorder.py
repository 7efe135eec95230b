"""What happened in a drive, state by state, for measures that need the whole of it."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from common.geometry import Polyline, wrap_angle
from common.messages import F64, FRAME_S, Ego, Objects, Plan


@dataclass
class Recorder:
    """Call it with every state in order of time."""

    t: list[float] = field(default_factory=list)
    ego: list[Ego] = field(default_factory=list)
    mode: list[str] = field(default_factory=list)
    frames: list[Objects] = field(default_factory=list)
    """The others at every whole 0.1 s."""
    at_frame: list[int] = field(default_factory=list)
    """Row of each frame."""

    def __call__(self, t: float, ego: Ego, objects: Objects, plan: Plan | None) -> None:
        """Note one state."""
        if t >= len(self.frames) * FRAME_S - 1e-6:
            self.frames.append(objects)
            self.at_frame.append(len(self.t))
        self.t.append(t)
        self.ego.append(ego)
        self.mode.append("waiting" if plan is None else plan.mode)

    @cached_property
    def driven(self) -> F64:
        """Distance driven at each state [m]."""
        x, y = np.array([e.x for e in self.ego]), np.array([e.y for e in self.ego])
        return np.concatenate(([0.0], np.cumsum(np.hypot(np.diff(x), np.diff(y)))))

    def distance(self, t: float) -> float:
        """Distance driven until t [m]."""
        return float(np.interp(t, self.t, self.driven)) if self.t else 0.0

    @cached_property
    def path(self) -> Polyline:
        """The way of the ego's centre, going straight on where it ended."""
        last = self.ego[-1]
        points = [(e.x, e.y) for e in self.ego]
        points.append((last.x + 0.5 * np.cos(last.heading), last.y + 0.5 * np.sin(last.heading)))
        return Polyline.of(np.array(points), tolerance=1e-3)

    def poses(self, s: F64) -> tuple[F64, F64, F64]:
        """Centre and heading where the ego has driven (or would, going straight on) distance `s` [m]."""
        moved = np.concatenate(([True], np.diff(self.driven) > 1e-6))
        at = self.driven[moved]
        turn = np.unwrap([e.heading for e in self.ego])[moved]
        over = np.maximum(s - at[-1], 0.0)
        x = np.interp(s, at, np.array([e.x for e in self.ego])[moved])
        y = np.interp(s, at, np.array([e.y for e in self.ego])[moved])
        heading = np.interp(s, at, turn)
        return x + over * np.cos(heading), y + over * np.sin(heading), np.asarray(wrap_angle(heading))
