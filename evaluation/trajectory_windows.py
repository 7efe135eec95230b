"""Windows of recorded traffic: 30 frames of history, up to 60 of future, and what stood around.

Histories are as the service sees them: column 0 is now, looking back; velocities by backward differences; surrounding
risk and leader from everyone in the recording at that frame. Windows never reach across recordings or tracks.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
import numpy.typing as npt

from common.messages import F32, F64, FRAME_S, HISTORY_FRAMES, I64, PREDICTION_FRAMES, U8, ObjectClass
from common.risk import RiskParameters
from rig.sources import tables
from rig.world import SIZES
from services.predictor import features
from services.predictor.signals import SIGNALS, instant_signals
from services.predictor.surrounding_risk import VELOCITY_STEPS, Scene, backward_velocity

MOVED_M = 0.15
"""Displacement from which a direction of motion is believed where a source gives no heading [m]."""


Progress = Callable[[int, int], None]
"""What is done, of how much."""


def silent(done: int, whole: int) -> None:
    """Tell nobody."""


@dataclass(frozen=True)
class Recorded:
    """One track: k successive frames from `frame0`, the local frame of its recording."""

    name: str
    cls: int  # ObjectClass
    length: float  # [m]
    width: float
    frame0: int
    x: F64  # centre [m], shape [k]
    y: F64
    heading: F64  # [rad]


@dataclass(frozen=True)
class Recording:
    """All tracks of one recording, and the site (the file) it belongs to."""

    name: str
    site: str
    tracks: tuple[Recorded, ...]

    @property
    def positions(self) -> int:
        """Rows of all tracks."""
        return sum(len(t.x) for t in self.tracks)


@dataclass(frozen=True)
class Windows:
    """n windows; histories newest first."""

    recording: I64  # index into `names`, shape [n]
    track: I64  # unique over all recordings
    frame: I64  # frame of "now"
    cls: U8
    length: F64
    width: F64
    x: F64  # [n, 30]
    y: F64
    heading: F64
    signals: F32  # [n, 30, SIGNALS]
    future: F64  # [n, 60, 2]; beyond `known` the last known position
    known: I64  # frames of future, 1 … 60
    names: tuple[str, ...]
    sites: tuple[str, ...]
    """Site of each recording."""

    def __len__(self) -> int:
        return len(self.frame)

    def take(self, rows: npt.NDArray[np.integer] | npt.NDArray[np.bool_]) -> Windows:
        """The chosen windows alone."""
        chosen = {f.name: getattr(self, f.name)[rows] for f in fields(self) if f.name not in ("names", "sites")}
        return Windows(**chosen, names=self.names, sites=self.sites)

    @property
    def moving(self) -> npt.NDArray[np.bool_]:
        """Mean speed over the window above 1 m/s."""
        past = np.hypot(np.diff(self.x, axis=1), np.diff(self.y, axis=1)).sum(1)
        now = np.stack((self.x[:, 0], self.y[:, 0]), axis=-1)[:, None]
        ahead = np.linalg.norm(np.diff(np.concatenate((now, self.future), axis=1), axis=1), axis=-1).sum(1)
        return np.asarray((past + ahead) / (0.1 * (HISTORY_FRAMES - 1 + self.known)) > 1.0)


def gate_is_open(data: Windows) -> npt.NDArray[np.bool_]:
    """Whose present speed opens the networks' stop gate at all."""
    speed = np.hypot(data.x[:, 0] - data.x[:, VELOCITY_STEPS], data.y[:, 0] - data.y[:, VELOCITY_STEPS])
    return np.asarray(speed / (VELOCITY_STEPS * FRAME_S) > features.GATE_MPS[0])


def joined(parts: Sequence[Windows]) -> Windows:
    """Windows of several files as one set."""
    names = tuple(n for p in parts for n in p.names)
    sites = tuple(s for p in parts for s in p.sites)
    offsets = np.cumsum([0, *(len(p.names) for p in parts)])
    track_offsets = np.cumsum([0, *(int(p.track.max(initial=-1)) + 1 for p in parts)])
    values = {f.name: np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(Windows)[:-2]}
    values["recording"] = np.concatenate([p.recording + o for p, o in zip(parts, offsets, strict=False)])
    values["track"] = np.concatenate([p.track + o for p, o in zip(parts, track_offsets, strict=False)])
    return Windows(**values, names=names, sites=sites)


def recordings(path: Path) -> list[Recording]:
    """All recordings of a trajectory table.

    Raises:
        ScenarioError: the file, the line and the reason (`rig.sources.tables.read`).
    """
    site = path.name.removesuffix(".gz").removesuffix(".csv")
    found: dict[str, list[Recorded]] = {}
    for rows in tables.read(path):
        x, y, heading, length, width = (np.array(c) for c in zip(*rows.values, strict=True))
        cls = tables.CLASSES.get(rows.kind, ObjectClass.UNKNOWN)
        if not np.isfinite(heading).all():
            heading = np.where(np.isfinite(heading), heading, heading_behind(x, y))
        size = SIZES[cls]
        track = Recorded(
            rows.name, int(cls), _first(length, size[0]), _first(width, size[1]), rows.frames[0], x, y, heading
        )
        found.setdefault(rows.rec, []).append(track)
    return [Recording(name, site, tuple(tracks)) for name, tracks in found.items()]


def heading_behind(x: F64, y: F64) -> F64:
    """Direction of motion at each row, from the past alone; 0 until something moved."""
    heading, anchor, last = np.zeros(len(x)), 0, 0.0
    for i in range(1, len(x)):
        anchor = max(anchor, i - 5)
        while anchor < i - 1 and np.hypot(x[i] - x[anchor + 1], y[i] - y[anchor + 1]) >= MOVED_M:
            anchor += 1
        dx, dy = x[i] - x[anchor], y[i] - y[anchor]
        if np.hypot(dx, dy) >= MOVED_M:
            last = float(np.arctan2(dy, dx))
        heading[i] = last
    return heading


def windows(
    sources: Iterable[Recording],
    risk: RiskParameters,
    *,
    stride: int = 5,
    future_least: int = PREDICTION_FRAMES,
    progress: Progress = silent,
) -> Windows:
    """Cut windows every `stride` frames; those with at least `future_least` frames of future.

    `progress` gets the positions that were worked on, and how many there are.
    """
    found = list(sources) or [Recording("", "", ())]
    done, whole = 0, sum(r.positions for r in found)
    parts = []
    for r in found:
        parts.append(_of_recording(r, risk, stride, future_least))
        done += r.positions
        progress(done, whole)
    return joined(parts)


def _of_recording(recording: Recording, risk: RiskParameters, stride: int, least: int) -> Windows:
    signals = (
        track_signals(recording, risk) if any(len(t.x) >= HISTORY_FRAMES + least for t in recording.tracks) else []
    )
    rows: dict[str, list[npt.NDArray[np.generic]]] = {f.name: [] for f in fields(Windows)[:-2]}
    back = -np.arange(HISTORY_FRAMES)
    ahead = np.arange(1, PREDICTION_FRAMES + 1)
    for i, t in enumerate(recording.tracks):
        now = np.arange(HISTORY_FRAMES - 1, len(t.x) - least, stride)
        if not len(now):
            continue
        h = now[:, None] + back
        f = np.minimum(now[:, None] + ahead, len(t.x) - 1)
        values = {
            "recording": np.zeros(len(now), dtype=np.int64),
            "track": np.full(len(now), i, dtype=np.int64),
            "frame": t.frame0 + now,
            "cls": np.full(len(now), t.cls, dtype=np.uint8),
            "length": np.full(len(now), t.length),
            "width": np.full(len(now), t.width),
            "x": t.x[h],
            "y": t.y[h],
            "heading": t.heading[h],
            "signals": signals[i][h],
            "future": np.stack((t.x[f], t.y[f]), axis=-1),
            "known": np.minimum(len(t.x) - 1 - now, PREDICTION_FRAMES),
        }
        for name, value in values.items():
            rows[name].append(value)
    empty = {
        "cls": np.zeros(0, np.uint8), "signals": np.zeros((0, HISTORY_FRAMES, SIGNALS), np.float32),
        "future": np.zeros((0, PREDICTION_FRAMES, 2)), **{k: np.zeros((0, HISTORY_FRAMES)) for k in "xy"},
        "heading": np.zeros((0, HISTORY_FRAMES)), "length": np.zeros(0), "width": np.zeros(0),
    }  # fmt: skip
    merged = {k: np.concatenate(v) if v else empty.get(k, np.zeros(0, np.int64)) for k, v in rows.items()}
    return Windows(**merged, names=(recording.name,), sites=(recording.site,))  # type: ignore[arg-type]


def track_signals(recording: Recording, risk: RiskParameters) -> list[F32]:
    """Surrounding risk and leader signals of every track at each of its frames, shape [k, SIGNALS] each."""
    result = [np.zeros((len(t.x), SIGNALS), dtype=np.float32) for t in recording.tracks]
    at: dict[int, list[int]] = {}
    for i, t in enumerate(recording.tracks):
        for frame in range(t.frame0, t.frame0 + len(t.x)):
            at.setdefault(frame, []).append(i)
    velocity = [_velocity(t) for t in recording.tracks]
    for frame, present in at.items():
        tracks = [recording.tracks[i] for i in present]
        k = [frame - t.frame0 for t in tracks]
        scene = Scene(
            x=np.array([t.x[j] for t, j in zip(tracks, k, strict=True)]),
            y=np.array([t.y[j] for t, j in zip(tracks, k, strict=True)]),
            heading=np.array([t.heading[j] for t, j in zip(tracks, k, strict=True)]),
            vx=np.array([velocity[i][0][j] for i, j in zip(present, k, strict=True)]),
            vy=np.array([velocity[i][1][j] for i, j in zip(present, k, strict=True)]),
            length=np.array([t.length for t in tracks]),
            width=np.array([t.width for t in tracks]),
            mass=np.zeros(len(tracks)),
            cls=np.array([t.cls for t in tracks], dtype=np.uint8),
        )
        for i, j, values in zip(present, k, instant_signals(scene, len(present), risk), strict=True):
            result[i][j] = values
    return result


def _velocity(t: Recorded) -> tuple[F64, F64]:
    """Velocity at every frame by backward differences [m/s]."""
    rows = np.arange(len(t.x))
    past = np.maximum(rows[:, None] - np.arange(VELOCITY_STEPS + 1), 0)
    return backward_velocity(t.x[past], t.y[past], rows)


def _first(values: F64, otherwise: float) -> float:
    """The first given size: later frames must not change what is known now."""
    known = values[np.isfinite(values)]
    return float(known[0]) if len(known) else otherwise
