"""Track histories: what was seen of each object during the last three seconds.

`Tracks` holds the samples as they came, by capture time; `frames` reads them at 10 Hz, backwards from the last
capture. Everything looks backward only: no frame depends on anything captured after it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from common.geometry import wrap_angle
from common.messages import F64, FRAME_S, HISTORY_FRAMES, I64, MAX_OBJECTS, U8, ObjectClass, Objects
from services.predictor.settings import HistorySettings

Bool = npt.NDArray[np.bool_]

SAMPLES = 40
"""Samples kept of each object; with the least spacing they reach farther back than the 30 frames."""
SPACING_NS = 80_000_000
"""Least spacing of kept samples [ns]; of faster messages the newest replaces the one before."""
SEEN_S = 0.06
"""A frame with no sample within this time is interpolated [s]."""

_ANY, _VEHICLE, _CYCLE, _PEDESTRIAN = range(4)
_KIND = np.zeros(len(ObjectClass), dtype=np.uint8)
_KIND[[ObjectClass.CAR, ObjectClass.TRUCK, ObjectClass.BUS]] = _VEHICLE
_KIND[[ObjectClass.MOTORCYCLE, ObjectClass.BICYCLE]] = _CYCLE
_KIND[ObjectClass.PEDESTRIAN] = _PEDESTRIAN


@dataclass(frozen=True)
class Tracks:
    """Samples of m objects, sorted by id. Columns run from the oldest sample to the newest.

    Columns before the first sample repeat it.
    """

    capture_ns: int | None
    """Capture of the last message that was observed [ns]; None: none yet."""
    id: I64
    cls: U8
    length: F64  # [m], shape [m]
    width: F64
    count: I64  # samples held, shape [m]
    t_ns: I64  # capture of each sample [ns], shape [m, SAMPLES]
    x: F64  # centre, `map` frame [m], shape [m, SAMPLES]
    y: F64
    heading: F64  # [rad]

    @staticmethod
    def empty() -> Tracks:
        """Nothing seen yet."""
        none, samples = np.zeros(0), np.zeros((0, SAMPLES))
        i, j = none.astype(np.int64), samples.astype(np.int64)
        return Tracks(None, i, none.astype(np.uint8), none, none, i, j, samples, samples, samples)


@dataclass(frozen=True)
class Frames:
    """Histories at 10 Hz, shape [n, 30]: column k lies k · 0.1 s before the capture, column 0 is now.

    Where `valid` is false the object was not known yet; positions there repeat the oldest known one.
    """

    x: F64  # [m]
    y: F64
    heading: F64  # [rad]
    valid: Bool
    """Seen, or between two samples."""
    seen: Bool
    """Valid and not bridging a gap."""

    @property
    def steps(self) -> I64:
        """How many steps of 0.1 s reach back from now, shape [n]."""
        return np.asarray(np.maximum(self.valid.sum(axis=1) - 1, 0))


def observe(tracks: Tracks, objects: Objects, capture_ns: int, settings: HistorySettings) -> Tracks:
    """Add what one message saw.

    A capture before the last one is ignored; the same capture again replaces the last sample. If the capture lies
    farther back than the longest gap, the clock was set: everything starts anew.
    """
    gap_ns = round(settings.gap_s * 1e9)
    kept = tracks
    if tracks.capture_ns is not None:
        ahead = capture_ns - tracks.capture_ns
        if -gap_ns <= ahead < 0:
            return tracks
        if abs(ahead) > gap_ns:
            kept = Tracks.empty()
    slot = np.searchsorted(kept.id, objects.id)
    slot[slot == len(kept.id)] = 0
    same = kept.id[slot] == objects.id if len(kept.id) else np.zeros(len(objects.id), dtype=bool)
    row = np.flatnonzero(same)
    same[row] = _same_object(kept, slot[row], objects, row, capture_ns, settings)
    seen = _extended(kept, slot, same, objects, capture_ns)
    unseen = _remembered(kept, ~np.isin(kept.id, objects.id), capture_ns, gap_ns)
    return _merged(capture_ns, seen, unseen)


def frames(tracks: Tracks, ids: I64) -> Frames:
    """Histories of the objects `ids`, each of which must have a track, at 10 Hz back from the last capture."""
    r = np.searchsorted(tracks.id, ids)
    age = ((tracks.capture_ns or 0) - tracks.t_ns[r]) * 1e-9
    wanted = FRAME_S * np.arange(HISTORY_FRAMES)
    # samples older than the frame (a microsecond forgives rounding): the last of them and the one after bracket it
    older = (age[:, None, :] > wanted[:, None] + 1e-6).sum(axis=2)
    valid = (older > 0) | (np.abs(age[:, :1] - wanted) <= 1e-6)
    i = np.maximum(older - 1, 0)
    j = np.minimum(older, SAMPLES - 1)
    rows = np.arange(len(r))[:, None]
    age_i, age_j = age[rows, i], age[rows, j]
    span = age_i - age_j
    w = np.clip(np.where(span > 0, (age_i - wanted) / np.where(span > 0, span, 1.0), 1.0), 0.0, 1.0)
    x, y, h = tracks.x[r], tracks.y[r], tracks.heading[r]
    seen = valid & (np.minimum(np.abs(age_i - wanted), np.abs(age_j - wanted)) <= SEEN_S)
    return Frames(
        x=x[rows, i] + w * (x[rows, j] - x[rows, i]),
        y=y[rows, i] + w * (y[rows, j] - y[rows, i]),
        heading=h[rows, i] + w * wrap_angle(h[rows, j] - h[rows, i]),
        valid=valid,
        seen=seen,
    )


def _same_object(
    tracks: Tracks,
    r: npt.NDArray[np.intp],
    objects: Objects,
    o: npt.NDArray[np.intp],
    capture_ns: int,
    s: HistorySettings,
) -> Bool:
    """Whether objects `o` continue tracks `r`: same kind, same size, and a step that physics allows."""
    kind_old, kind = _KIND[tracks.cls[r]], _KIND[objects.cls[o]]
    same = (kind_old == kind) | (kind_old == _ANY) | (kind == _ANY)
    for old, new in ((tracks.length[r], objects.length[o]), (tracks.width[r], objects.width[o])):
        high, low = np.maximum(old, new), np.minimum(old, new)
        same &= (high <= s.size_ratio * low) | (high - low <= s.size_slack_m)

    dt = (capture_ns - tracks.t_ns[r, -1]) * 1e-9
    dx, dy = objects.x[o] - tracks.x[r, -1], objects.y[o] - tracks.y[r, -1]
    # velocity of the track over up to five samples
    back = -np.minimum(tracks.count[r], 5)
    span = (tracks.t_ns[r, -1] - tracks.t_ns[r, back]) * 1e-9
    moving = span > 0.02
    span = np.where(moving, span, 1.0)
    vx = (tracks.x[r, -1] - tracks.x[r, back]) / span
    vy = (tracks.y[r, -1] - tracks.y[r, back]) / span
    limit = s.step_slack_m + s.step_drift_mps * dt + 0.5 * s.step_acceleration_mps2 * dt**2
    as_before = moving & (np.hypot(dx - vx * dt, dy - vy * dt) <= limit)
    as_said = np.hypot(dx - objects.vx[o] * dt, dy - objects.vy[o] * dt) <= limit
    fastest = np.full(len(o), s.vehicle_speed_mps)
    fastest[objects.cls[o] == ObjectClass.BICYCLE] = s.bicycle_speed_mps
    fastest[objects.cls[o] == ObjectClass.PEDESTRIAN] = s.pedestrian_speed_mps
    as_first = ~moving & (np.hypot(dx, dy) <= s.step_slack_m + fastest * dt)
    return np.asarray(same & (as_before | as_said | as_first))


def _extended(tracks: Tracks, slot: npt.NDArray[np.intp], same: Bool, objects: Objects, capture_ns: int) -> Tracks:
    """The tracks of a message's objects, with its sample added."""
    n = len(objects.id)
    t = np.full((n, SAMPLES), capture_ns, dtype=np.int64)
    x, y, heading = (np.repeat(a[:, None], SAMPLES, axis=1) for a in (objects.x, objects.y, objects.heading))
    count = np.zeros(n, dtype=np.int64)
    r = slot[same]
    for new, old in ((t, tracks.t_ns), (x, tracks.x), (y, tracks.y), (heading, tracks.heading), (count, tracks.count)):
        new[same] = old[r]
    crowded = (count >= 2) & (t[:, -1] - t[:, -2] < SPACING_NS)
    replace = same & (crowded | (t[:, -1] == capture_ns))
    append = ~replace
    now = np.full(n, capture_ns, dtype=np.int64)
    for a, last in ((t, now), (x, objects.x), (y, objects.y), (heading, objects.heading)):
        a[append, :-1] = a[append, 1:]
        a[:, -1] = last
    return Tracks(
        capture_ns=capture_ns,
        id=objects.id,
        cls=objects.cls,
        length=objects.length,
        width=objects.width,
        count=np.minimum(count + append, SAMPLES),
        t_ns=t,
        x=x,
        y=y,
        heading=heading,
    )


def _remembered(tracks: Tracks, missing: Bool, capture_ns: int, gap_ns: int) -> Tracks:
    """Tracks that the message did not contain and that are not too old; at most 2 · MAX_OBJECTS, the newest."""
    r = np.flatnonzero(missing)
    r = r[capture_ns - tracks.t_ns[r, -1] <= gap_ns]
    if len(r) > 2 * MAX_OBJECTS:
        r = r[np.argsort(tracks.t_ns[r, -1], kind="stable")[-2 * MAX_OBJECTS :]]
    return _rows(tracks, r)


def _rows(tracks: Tracks, r: npt.NDArray[np.intp]) -> Tracks:
    return Tracks(
        capture_ns=tracks.capture_ns,
        id=tracks.id[r],
        cls=tracks.cls[r],
        length=tracks.length[r],
        width=tracks.width[r],
        count=tracks.count[r],
        t_ns=tracks.t_ns[r],
        x=tracks.x[r],
        y=tracks.y[r],
        heading=tracks.heading[r],
    )


def _merged(capture_ns: int, a: Tracks, b: Tracks) -> Tracks:
    both = Tracks(
        capture_ns=capture_ns,
        id=np.concatenate((a.id, b.id)),
        cls=np.concatenate((a.cls, b.cls)),
        length=np.concatenate((a.length, b.length)),
        width=np.concatenate((a.width, b.width)),
        count=np.concatenate((a.count, b.count)),
        t_ns=np.concatenate((a.t_ns, b.t_ns)),
        x=np.concatenate((a.x, b.x)),
        y=np.concatenate((a.y, b.y)),
        heading=np.concatenate((a.heading, b.heading)),
    )
    order = np.argsort(both.id, kind="stable")
    return _rows(both, order)
