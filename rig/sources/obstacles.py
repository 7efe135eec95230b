"""CommonRoad's obstacles as tracks on the 10 Hz grid; what is no exact motion is left out with a warning."""

from __future__ import annotations

from typing import Any

import numpy as np

from common.messages import ObjectClass
from rig.sources.motion import heading_from_motion, on_frames
from rig.world import SIZES, Track

CLASSES = {
    "car": ObjectClass.CAR,
    "taxi": ObjectClass.CAR,
    "parkedVehicle": ObjectClass.CAR,
    "priorityVehicle": ObjectClass.CAR,
    "truck": ObjectClass.TRUCK,
    "train": ObjectClass.TRUCK,
    "bus": ObjectClass.BUS,
    "motorcycle": ObjectClass.MOTORCYCLE,
    "bicycle": ObjectClass.BICYCLE,
    "pedestrian": ObjectClass.PEDESTRIAN,
}
"""CommonRoad's obstacle types; every other one is `unknown`."""


def tracks_of(file: Any, dt: float, step0: int, warnings: list[str]) -> list[Track]:
    """Everyone who is recorded after the run starts, at time step `step0`; `dt` is a time step [s]."""
    tracks = []
    for o in sorted(file.obstacles, key=lambda k: k.obstacle_id):
        try:
            tracks.append(_track(o, dt, step0, warnings))
        except ValueError as e:
            warnings.append(f"obstacle {o.obstacle_id} left out: {e}")
    kept = [k for k in tracks if k.last >= 0]
    if len(kept) < len(tracks):
        warnings.append(f"{len(tracks) - len(kept)} obstacles end before the run starts")
    return kept


def _track(o: Any, dt: float, step0: int, warnings: list[str]) -> Track:
    kind = str(o.obstacle_type.value)
    cls = CLASSES.get(kind, ObjectClass.UNKNOWN)
    if kind not in CLASSES:
        warnings.append(f"obstacle {o.obstacle_id}: type {kind!r} is taken as unknown")
    states = _states(o)
    t = np.array([(s.time_step - step0) * dt for s in states])
    x, y = (np.array([float(s.position[k]) for s in states]) for k in (0, 1))
    given: list[Any] = [getattr(s, "orientation", None) for s in states]
    known = None not in given
    heading = np.array([float(h) for h in given]) if known else heading_from_motion(x, y, float(given[0] or 0.0))
    if not all(np.isfinite(v).all() for v in (x, y, heading)):
        raise ValueError("a position or heading that is not finite")
    if len(t) > 1 and not (np.diff(t) > 0).all():
        raise ValueError("its time steps do not increase")
    length, width, forward = _size(_shape(o), SIZES[cls])
    x, y = x + forward * np.cos(heading), y + forward * np.sin(heading)
    velocity = _first_velocity(states[0], float(heading[0]))
    frame0, x, y, heading = on_frames(t, x, y, heading)
    return Track(
        id=int(o.obstacle_id),
        cls=cls,
        length=length,
        width=width,
        frame0=frame0,
        x=x,
        y=y,
        heading=heading,
        first_velocity=velocity,
        label=f"{kind} {o.obstacle_id}",
    )


def _states(o: Any) -> list[Any]:
    """Every state with an exact position and time, the initial one first."""
    states = [o.initial_state]
    prediction = getattr(o, "prediction", None)
    if prediction is not None:
        trajectory = getattr(prediction, "trajectory", None)
        if trajectory is None:
            raise ValueError("its motion is a set of occupancies, not a trajectory")
        states += trajectory.state_list
    for s in states:
        if np.shape(s.position) != (2,) or not isinstance(s.time_step, int | np.integer):
            raise ValueError("a position or time that is not exact")
    return states


def to_the_end(track: Track, last: int) -> Track:
    """One without motion (a static obstacle) stands there for the whole run."""
    if len(track.x) > 1:
        return track
    n = max(1, last - track.frame0 + 1)
    x, y, heading = (np.repeat(v, n) for v in (track.x, track.y, track.heading))
    return Track(
        track.id, track.cls, track.length, track.width, track.frame0, x, y, heading, (0.0, 0.0), label=track.label
    )


def _first_velocity(state: Any, heading: float) -> tuple[float, float] | None:
    speed: Any = getattr(state, "velocity", None)
    if not isinstance(speed, int | float | np.number):
        return None
    lateral: Any = getattr(state, "velocity_y", None)
    if lateral is not None:
        return float(speed), float(lateral)
    return float(speed) * float(np.cos(heading)), float(speed) * float(np.sin(heading))


def _shape(o: Any) -> Any:
    return o.obstacle_shape


def _size(shape: Any, otherwise: tuple[float, float]) -> tuple[float, float, float]:
    """Length, width and how far the rectangle's centre lies ahead of the position [m]."""
    if hasattr(shape, "length") and hasattr(shape, "width"):
        return _sane(float(shape.length), float(shape.width), float(getattr(shape, "origin_x_shift", 0.0) or 0.0))
    if hasattr(shape, "radius"):
        return _sane(2 * float(shape.radius), 2 * float(shape.radius), 0.0)
    vertices = getattr(shape, "vertices", None)
    if vertices is not None:
        low, high = np.min(vertices, axis=0), np.max(vertices, axis=0)
        return _sane(float(high[0] - low[0]), float(high[1] - low[1]), float(high[0] + low[0]) / 2)
    return (*otherwise, 0.0)


def _sane(length: float, width: float, forward: float) -> tuple[float, float, float]:
    if not (0.05 <= length <= 100.0 and 0.05 <= width <= 100.0):
        raise ValueError(f"a size of {length:g} × {width:g} m")
    return length, width, forward
