"""Alarms in recorded traffic, in which nobody crashes: how often each method would cry wolf for an hour of driving.

Of each file the vehicle that drives farthest takes the ego's part. At each frame every method assumes that
the ego goes on along the path that it was recorded on, at its present speed; the others are seen as always.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from common.geometry import Polyline
from common.messages import F64, FRAME_S, Ego, Map, ObjectClass, Objects
from evaluation.hazards.alarms import Alarm, Bool, held, score
from evaluation.hazards.watch import Cores, FieldWatcher, Seen, stacked, times_to_collision
from evaluation.hazards.work import Work
from rig.sources import load_scenario, recorded_scenarios
from rig.world import Scenario, ScenarioError, Track

EGOS = 1
"""How many vehicles of one file take the ego's part."""
LONGEST_S = 12.0
"""Of one vehicle's drive, at most so much is looked at [s]."""
WARM_FRAMES = 10
"""Frames at the beginning that only make the history."""
MOVING_MPS = 1.0
"""A slower ego is not driving: such frames do not count [m/s]."""
APART_S = 2.0
"""Alarms that are less apart are one [s]."""
SMOOTH_M = 0.5
"""Spacing of the ego's path [m]."""


@dataclass(frozen=True)
class Drive:
    """One recorded vehicle as the ego."""

    name: str
    map: Map | None
    world: Scenario
    ego: Track
    path: Polyline
    s: F64
    """Arc length of its centre at each of its rows [m]."""
    first: int
    """The scenario's frame of row 0."""

    def speed(self, row: int) -> float:
        """Mean speed over the last 0.3 s [m/s]."""
        back = max(row - 3, 0)
        return float((self.s[row] - self.s[back]) / (max(row - back, 1) * FRAME_S))

    def objects(self, row: int) -> Objects:
        """What is perceived: everybody but the ego."""
        return self.world.objects_at((self.first + row) * FRAME_S)


@dataclass(frozen=True)
class Onward:
    """The ego's path from where it is, at its present speed."""

    path: Polyline
    s: float
    speed: float
    t: float

    def ego_poses(self, t: F64) -> tuple[F64, F64, F64]:
        """Centre and heading at times t [s]."""
        s = self.s + self.speed * (np.asarray(t) - self.t)
        p = self.path.at(s)
        d = self.path.at(s + 1.0) - self.path.at(s - 1.0)
        return p[..., 0], p[..., 1], np.arctan2(d[..., 1], d[..., 0])


def recordings() -> list[tuple[str, str]]:
    """All recordings below FOREFIELD_DATA: the name of the source, and the file."""
    data = os.environ.get("FOREFIELD_DATA")
    if not data:
        return []
    tables = [(path.name.split(".")[0], str(path)) for path in sorted((Path(data) / "tracks").rglob("*.csv*"))]
    scenarios = [(f"commonroad {name.split('-')[0]}", str(p)) for name, p in recorded_scenarios().items()]
    return tables + sorted(scenarios)


def watch_recording(recording: tuple[str, str], cores: Cores) -> list[tuple[Seen, Bool]]:
    """All drives of one file; none where nobody in it could be the ego."""
    name, path = recording
    try:
        world = load_scenario(path)
    except ScenarioError:
        return []
    return [seen for drive in _egos(name, world) if (seen := watch_drive(drive, cores)) is not None]


def _egos(name: str, world: Scenario) -> Iterator[Drive]:
    tracks = [*world.tracks, *([world.human] if world.human is not None else [])]
    fit = []
    for k, track in enumerate(tracks):
        if track.cls not in (ObjectClass.CAR, ObjectClass.TRUCK, ObjectClass.BUS):
            continue
        line = np.stack((track.x, track.y), axis=-1)
        if len(line) * FRAME_S >= 3.0 and np.hypot(*(line[-1] - line[0])) >= 20.0:
            fit.append((float(np.hypot(*np.diff(line, axis=0).T).sum()), k))
    for _, k in sorted(fit, reverse=True)[:EGOS]:
        track = tracks[k]
        line = np.stack((track.x, track.y), axis=-1)
        kept = [line[0]]
        for p in line[1:]:
            if np.hypot(*(p - kept[-1])) >= SMOOTH_M:
                kept.append(p)
        path = Polyline.of(np.array(kept))
        others = replace(world, tracks=tuple(t for i, t in enumerate(tracks) if i != k and t is not world.human))
        if track is not world.human and world.human is not None:
            human = replace(world.human, id=max((t.id for t in tracks), default=0) + 1)
            others = replace(others, tracks=(*others.tracks, human))
        yield Drive(f"{name} {world.name} {track.label or track.id}", world.map, others, track, path,
                    _along(path, line), track.frame0)  # fmt: skip


def _along(path: Polyline, line: F64) -> F64:
    """Arc lengths of the recorded positions, never falling."""
    return np.asarray(np.maximum.accumulate(path.project(line)[0]))


def watch_drive(drive: Drive, cores: Cores) -> tuple[Seen, Bool] | None:
    """What the methods see, and in which frames the ego drives; None: too short."""
    rows_total = min(len(drive.s), round(LONGEST_S / FRAME_S) + WARM_FRAMES)
    begin = max(0, -drive.first)  # the world has no past before its frame 0
    if rows_total - begin <= WARM_FRAMES + 5:
        return None
    top = max(drive.speed(r) for r in range(begin, rows_total))
    watcher = FieldWatcher(top, curved=True, cores=cores)
    rows: list[tuple[float, F64, F64, tuple[float, ...]]] = []
    moving = []
    for row in range(begin, rows_total):
        t, objects = row * FRAME_S, drive.objects(row)
        prediction = watcher.observe(objects, t, drive.map)
        if row - begin < WARM_FRAMES:
            continue
        speed, s = drive.speed(row), float(drive.s[row])
        onward = Onward(drive.path, s, speed, t)
        x, y, heading = (float(v) for v in onward.ego_poses(np.asarray(t)))
        ego = Ego(
            x=x,
            y=y,
            heading=heading,
            vx=speed * float(np.cos(heading)),
            vy=speed * float(np.sin(heading)),
            acceleration=0.0,
            yaw_rate=0.0,
            length=drive.ego.length,
            width=drive.ego.width,
            wheelbase=0.6 * drive.ego.length,
        )
        field, current = watcher.read(prediction, ego, onward, t)
        rows.append((t, field, current, times_to_collision(ego, s, speed, drive.path, objects)))
        moving.append(speed >= MOVING_MPS)
    return stacked(rows), np.array(moving)


def onsets(alarm: Alarm, seen: Seen, moving: Bool) -> int:
    """How many alarms a drive has: each counts once, and again after `APART_S` of silence."""
    on = np.flatnonzero(moving & (held(score(alarm.method, seen, alarm.options), alarm.persistence) >= alarm.threshold))
    return 0 if not len(on) else 1 + int((np.diff(seen.t[on]) >= APART_S).sum())


def alarms_per_hour(
    alarms: Sequence[Alarm], at_recall: Mapping[str, Sequence[Alarm]], cores: Cores, work: Work
) -> dict[str, Any]:
    """Alarms of every method for an hour of driving, as tuned and at equal recall; as tuned for each source too."""
    files = recordings()
    watched = work.map(partial(watch_recording, cores=cores), files, "recorded traffic")
    drives = [(name, *drive) for (name, _), found in zip(files, watched, strict=True) for drive in found]
    hours = {name: 0.0 for name, _, _ in drives}
    for name, _, moving in drives:
        hours[name] += float(moving.sum()) * FRAME_S / 3600.0
    total = sum(hours.values())

    def counts(chosen: Sequence[Alarm], source: str | None = None) -> dict[str, int]:
        return {
            a.method: sum(onsets(a, seen, moving) for name, seen, moving in drives if source in (None, name))
            for a in chosen
        }

    def rates(numbers: dict[str, int]) -> dict[str, float | None]:
        return {m: n / total if total else None for m, n in numbers.items()}

    sums = counts(alarms)
    return {
        "drives": len(drives),
        "hours": total,
        "alarms": sums,
        "alarms_per_hour": rates(sums),
        "at_recall": {recall: rates(counts(chosen)) for recall, chosen in at_recall.items()},
        "by_source": {name: {"hours": hours[name], "alarms": counts(alarms, name)} for name in sorted(hours)},
    }
