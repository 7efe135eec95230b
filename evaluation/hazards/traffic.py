"""Alarms in recorded traffic, in which nobody crashes: how often each method would cry wolf for an hour of driving.

Of each file the vehicle that drives farthest takes the ego's part. At each frame every method assumes that
the ego goes on along the path that it was recorded on, at its present speed; the others are seen as always.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from common.geometry import Polyline
from common.messages import F64, FRAME_S, Ego, Map, ObjectClass, Objects
from evaluation.hazards.alarms import Alarm, held, score
from evaluation.hazards.watch import Cores, FieldWatcher, Seen, Times, stacked
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


def drives(limit: int | None = None) -> Iterator[tuple[str, Drive]]:
    """All drives with the name of their source; `limit` of them at most for each source."""
    for name, worlds in _sources():
        count = 0
        for world in worlds():
            for drive in _egos(name, world):
                if limit is not None and count >= limit:
                    break
                count += 1
                yield name, drive


def _sources() -> Iterator[tuple[str, Callable[[], Iterator[Scenario]]]]:
    data = os.environ.get("FOREFIELD_DATA")
    if not data:
        return
    for path in sorted((Path(data) / "tracks").rglob("*.csv*")):
        yield path.name.split(".")[0], lambda path=path: _worlds([str(path)])  # type: ignore[misc]
    files = recorded_scenarios()
    for place in sorted({name.split("-")[0] for name in files}):
        chosen = [str(p) for name, p in files.items() if name.split("-")[0] == place]
        yield f"commonroad {place}", lambda chosen=chosen: _worlds(chosen)  # type: ignore[misc]


def _worlds(names: Sequence[str]) -> Iterator[Scenario]:
    for name in names:
        try:
            yield load_scenario(name)
        except ScenarioError:
            continue  # a recording without a vehicle that could be the ego


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


def watch_drive(drive: Drive, cores: Cores) -> tuple[Seen, np.ndarray] | None:
    """What the methods see, and in which frames the ego drives; None: too short."""
    rows_total = min(len(drive.s), round(LONGEST_S / FRAME_S) + WARM_FRAMES)
    begin = max(0, -drive.first)  # the world has no past before its frame 0
    if rows_total - begin <= WARM_FRAMES + 5:
        return None
    top = max(drive.speed(r) for r in range(begin, rows_total))
    watcher, times = FieldWatcher(top, curved=True, cores=cores), Times()
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
        rows.append((t, field, current, times(ego, s, speed, drive.path, objects)))
        moving.append(speed >= MOVING_MPS)
    return stacked(rows), np.array(moving)


def onsets(alarm: Alarm, seen: Seen, moving: np.ndarray) -> int:
    """How many alarms a drive has: each counts once, and again after `APART_S` of silence."""
    on = np.flatnonzero(moving & (held(score(alarm.method, seen, alarm.options), alarm.persistence) >= alarm.threshold))
    return 0 if not len(on) else 1 + int((np.diff(seen.t[on]) >= APART_S).sum())


def alarms_per_hour(
    alarms: Sequence[Alarm], cores: Cores, limit: int | None, say: Callable[[str], None]
) -> dict[str, Any]:
    """Alarms of every method for an hour of driving, in all and for each source."""
    hours: dict[str, float] = {}
    counts: dict[str, dict[str, int]] = {}
    number = 0
    for name, drive in drives(limit):
        seen = watch_drive(drive, cores)
        if seen is None:
            continue
        number += 1
        hours[name] = hours.get(name, 0.0) + float(seen[1].sum()) * FRAME_S / 3600.0
        per = counts.setdefault(name, {a.method: 0 for a in alarms})
        for a in alarms:
            per[a.method] += onsets(a, *seen)
        say(f"recorded traffic: {number} drives")
    total = sum(hours.values())
    sums = {a.method: sum(per[a.method] for per in counts.values()) for a in alarms}
    return {
        "drives": number,
        "hours": total,
        "alarms": sums,
        "alarms_per_hour": {m: n / total if total else None for m, n in sums.items()},
        "by_source": {name: {"hours": hours[name], "alarms": counts[name]} for name in sorted(hours)},
    }
