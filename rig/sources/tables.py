"""Trajectory tables: one row an agent and frame, one recorded vehicle replaced by the ego.

Columns `rec,track,type,frame,t,x,y,vx,vy,heading,length,width` at 10 Hz (csv or csv.gz); heading, length and width may
be empty. `FILE#REC:TRACK` chooses recording and vehicle, `FILE#REC` the recording; otherwise the ego replaces the
four-wheeled vehicle that is driven farthest among those recorded for at least 6 s. The run starts at that vehicle's
second frame (its velocity needs two) and lasts as long as it was recorded. Its own smoothed path, extended straight, is
the route; there is no map of such a place, and an explicitly empty one says so. The columns vx, vy are not used: they
are central differences, with 0.1 s of the future in them.
"""

from __future__ import annotations

import csv
import gzip
import zlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from common.geometry import Polyline
from common.messages import F64, FRAME_S, I64, Goal, Map, ObjectClass, Route
from rig.settings import RigSettings
from rig.sources.motion import fair, heading_from_motion
from rig.sources.start import without_ego
from rig.world import SIZES, Scenario, ScenarioError, Track, ego_at

COLUMNS = ("rec", "track", "type", "frame", "t", "x", "y", "vx", "vy", "heading", "length", "width")
OPTIONAL = ("heading", "length", "width")
NEEDED = ("rec", "track", "type", "frame", "t", "x", "y")
CLASSES = {k.name.lower(): k for k in ObjectClass}
FOUR_WHEELS = (ObjectClass.CAR, ObjectClass.TRUCK, ObjectClass.BUS)
AXLES = 0.6  # wheelbase of a car as a part of its length (2.7 m of 4.5 m)
GOAL_RADIUS_M = 4.0
BEYOND_M = 150.0  # the route goes straight on beyond the recorded path
JUMP_MPS = 90.0  # faster between two frames is not a motion
LONG_ENOUGH_S, FAR_ENOUGH_M = 6.0, 20.0


@dataclass(frozen=True)
class Rows:
    """One track of a table: rows in order of frame, and the line of the first."""

    rec: str
    name: str
    kind: str
    line: int
    frames: I64
    values: F64  # x, y, heading, length, width; NaN: not given; shape [k, 5]


def load(path: Path, selection: str, ego_track: int | None, settings: RigSettings) -> Scenario:
    """Read a table and make the drive of one of its vehicles.

    `selection` is `REC`, `REC:TRACK`, `:TRACK` or empty; `ego_track` is the name of the track, if it is a number.

    Raises:
        ScenarioError: the file, the line, why, and what to do.
    """
    rec, _, name = selection.partition(":")
    if ego_track is not None:
        name = str(ego_track)
    inside = read(path, rec)
    ego = _named(path, inside, name) if name else _farthest(path, inside)
    return replacing(path, inside, ego, settings)


# --- reading ---


def read(path: Path, only: str = "") -> list[Rows]:
    """All tracks of a table, or of one recording in it, in order of their first row.

    Raises:
        ScenarioError: missing columns, a value that is no number or not finite, a wrong rate, a repeated row, a gap.
    """
    names, rows, lines = _cells(path, only)
    if not rows:
        raise ScenarioError(f"no recording {only!r}" if only else "no rows", path=path)
    column = {name: i for i, name in enumerate(names)}
    numbers = {c: _numbers(path, lines, rows, column, c) for c in ("frame", "t", "x", "y", *OPTIONAL)}
    _check_rows(path, lines, numbers)
    members: dict[tuple[str, str], list[int]] = {}
    rec, track, kind = (column[c] for c in ("rec", "track", "type"))
    for i, row in enumerate(rows):
        members.setdefault((row[rec], row[track]), []).append(i)
    found = []
    for (recording, name), at in members.items():
        kinds = [rows[k][kind].strip().lower() for k in at]
        own = {c: v[at] for c, v in numbers.items()}
        _check_track(path, f"track {name} of {recording}", lines[at], own, kinds)
        values = np.stack([own[c] for c in ("x", "y", *OPTIONAL)], axis=-1)
        found.append(Rows(recording, name, kinds[0], int(lines[at[0]]), own["frame"].astype(np.int64), values))
    return found


def _cells(path: Path, only: str) -> tuple[list[str], list[list[str]], I64]:
    """The header, the rows and their lines."""
    opener = gzip.open if path.name.endswith(".gz") else open
    rows, lines = [], []
    try:
        with opener(path, "rt", encoding="utf-8", newline="") as f:
            reader = csv.reader(f)
            names = next(reader, [])
            missing = [c for c in NEEDED if c not in names]
            if missing:
                hint = f"The first line must name the columns {','.join(COLUMNS)}"
                raise ScenarioError(f"missing columns {', '.join(missing)}", path=path, line=1, hint=hint)
            rec = names.index("rec")
            for values in reader:
                if not values:
                    continue
                if len(values) != len(names):
                    raise ScenarioError(f"{len(values)} values, expected {len(names)}", path=path, line=reader.line_num)
                if only and values[rec] != only:
                    continue
                rows.append(values)
                lines.append(reader.line_num)
    except (OSError, EOFError, UnicodeDecodeError, csv.Error, zlib.error) as e:
        raise ScenarioError(f"cannot be read: {e}", path=path) from None
    return names, rows, np.array(lines, dtype=np.int64)


def _numbers(path: Path, lines: I64, rows: list[list[str]], column: dict[str, int], name: str) -> F64:
    """One column as numbers; empty ones are NaN where the column is optional."""
    k = column.get(name)
    if k is None:
        return np.full(len(rows), np.nan)
    empty = "nan" if name in OPTIONAL else ""
    try:
        values = np.array([row[k] or empty for row in rows]).astype(np.float64)
    except ValueError:
        for i, row in enumerate(rows):
            if not _is_number(row[k] or empty):
                raise ScenarioError(f"{name} {row[k]!r} is not a number", path=path, line=int(lines[i])) from None
        raise
    bad = ~np.isfinite(values) | (np.abs(values) > 1e8)
    for i in np.flatnonzero(bad).tolist():
        if name not in OPTIONAL or rows[i][k].strip():
            raise ScenarioError(f"{name} is {rows[i][k]}", path=path, line=int(lines[i]))
    return values


def _is_number(text: str) -> bool:
    try:
        np.array([text]).astype(np.float64)
    except ValueError:
        return False
    return True


def _check_rows(path: Path, lines: I64, numbers: dict[str, F64]) -> None:
    frame, t = numbers["frame"], numbers["t"]
    for i in np.flatnonzero(frame != np.round(frame))[:1]:
        raise ScenarioError(f"frame {frame[i]:g} is not a whole number", path=path, line=int(lines[i]))
    for i in np.flatnonzero(~(np.abs(t - frame * FRAME_S) <= 0.02))[:1]:
        raise ScenarioError(
            f"frame {frame[i]:.0f} at t = {t[i]:g} s: not 10 Hz",
            path=path,
            line=int(lines[i]),
            hint="Resample the table to 10 Hz, with t = frame / 10",
        )
    for name in ("length", "width"):
        v = numbers[name]
        for i in np.flatnonzero((v < 0.05) | (v > 100.0))[:1]:
            raise ScenarioError(f"a {name} of {v[i]:g} m", path=path, line=int(lines[i]))


def _check_track(path: Path, who: str, lines: I64, own: dict[str, F64], kinds: list[str]) -> None:
    frame = own["frame"]
    step = np.diff(frame)
    for i in np.flatnonzero(step != 1)[:1]:
        line = int(lines[i + 1])
        if frame[i + 1] in frame[: i + 1]:
            raise ScenarioError(f"{who}: frame {frame[i + 1]:.0f} stands there twice", path=path, line=line)
        raise ScenarioError(
            f"{who}: frame {frame[i + 1]:.0f} follows {frame[i]:.0f}",
            path=path,
            line=line,
            hint="Frames of a track must follow each other at 10 Hz; give the part behind a gap another name",
        )
    jump = np.hypot(np.diff(own["x"]), np.diff(own["y"]))
    for i in np.flatnonzero(jump > JUMP_MPS * FRAME_S)[:1]:
        raise ScenarioError(f"{who} jumps {jump[i]:.0f} m", path=path, line=int(lines[i + 1]))
    for line, kind in zip(lines.tolist(), kinds, strict=True):
        if kind != kinds[0]:
            raise ScenarioError(f"{who}: {kind!r} was {kinds[0]!r} before", path=path, line=line)


# --- choosing ---


def _named(path: Path, tracks: list[Rows], name: str) -> Rows:
    found = [r for r in tracks if r.name == name]
    if not found:
        raise ScenarioError(f"no track {name!r}", path=path, hint=f"There are {_some([r.name for r in tracks])}")
    if len(found) > 1:
        raise ScenarioError(
            f"track {name!r} stands in {len(found)} recordings",
            path=path,
            hint=f"Choose one: {path.name}#{found[0].rec}:{name}",
        )
    if len(found[0].frames) < 2 + round(1.0 / FRAME_S):
        raise ScenarioError(f"track {name!r} is too short to drive", path=path, line=found[0].line)
    return found[0]


def _farthest(path: Path, tracks: list[Rows]) -> Rows:
    """The four-wheeled vehicle driven farthest; the first of equals."""
    fit = drivable(tracks)
    if not fit:
        raise ScenarioError(
            f"no car, truck or bus moves {FAR_ENOUGH_M:.0f} m in at least {LONG_ENOUGH_S:.0f} s",
            path=path,
            hint="Name one: FILE#REC:TRACK",
        )
    return max(fit, key=_way)


def _some(names: list[str]) -> str:
    unique = list(dict.fromkeys(names))
    return ", ".join(unique[:12]) + (f" … ({len(unique)} in all)" if len(unique) > 12 else "")


def drivable(tracks: list[Rows]) -> list[Rows]:
    """The four-wheeled vehicles that are recorded long enough and drive far enough to be replaced by the ego."""
    long = [r for r in tracks if len(r.frames) > LONG_ENOUGH_S / FRAME_S]
    return [r for r in long if CLASSES.get(r.kind, ObjectClass.UNKNOWN) in FOUR_WHEELS and _way(r) > FAR_ENOUGH_M]


def _way(rows: Rows) -> float:
    """Distance driven [m], looked at every half second."""
    return float(np.hypot(*np.diff(rows.values[::5, :2], axis=0).T).sum())


def replacing(path: Path, tracks: list[Rows], ego: Rows, settings: RigSettings) -> Scenario:
    """The drive of `ego`, one of `tracks` as `read` gives them, among the others of its recording."""
    return _scenario(path, ego, [r for r in tracks if r.rec == ego.rec and r is not ego], settings)


# --- the world ---


def _scenario(path: Path, ego: Rows, others: list[Rows], settings: RigSettings) -> Scenario:
    warnings: list[str] = []
    start = int(ego.frames[1])
    human = _track(0, ego, start, warnings)
    tracks = [_track(i + 1, r, start, warnings) for i, r in enumerate(others)]
    last = human.last
    tracks = [k for k in tracks if k.last >= 0 and k.first_seen <= last]
    v = human.velocity[1]
    size = (human.length, human.width, AXLES * human.length)
    ego0 = ego_at(human.x[1], human.y[1], human.heading[1], float(np.hypot(*v)), size=size)
    limit = settings.default_speed_limit or _limit(human, settings)
    tracks, _ = without_ego(tracks, ego0, warnings)
    route, far = _route(human, limit)
    warnings.append(f"no map: the recorded path of {ego.name} is the route, {limit:g} m/s the speed limit")
    if far < 5.0:
        warnings.append(f"{ego.name} moves only {far:.1f} m")
    return Scenario(
        name=f"{path.name.removesuffix('.gz').removesuffix('.csv')}-{ego.rec}-{ego.name}",
        title=f"{path.name}: where {ego.kind} {ego.name} of {ego.rec} drove",
        source="table",
        duration_s=round(last * FRAME_S, 3),
        map=Map(),
        route=route,
        ego0=ego0,
        tracks=tuple(tracks),
        warnings=tuple(warnings),
        human=human,
        detail={"file": path.name, "rec": ego.rec, "track": ego.name},
    )


def _track(id: int, rows: Rows, start: int, warnings: list[str]) -> Track:
    x, y, heading, length, width = (np.ascontiguousarray(c) for c in rows.values.T)
    cls = CLASSES.get(rows.kind, ObjectClass.UNKNOWN)
    if rows.kind not in CLASSES:
        text = f"type {rows.kind!r} is taken as unknown"
        if text not in warnings:
            warnings.append(text)
    given = np.isfinite(heading)
    if not given.all():
        heading = np.where(given, heading, heading_from_motion(x, y))
    return Track(
        id=id,
        cls=cls,
        length=_mean(length, SIZES[cls][0]),
        width=_mean(width, SIZES[cls][1]),
        frame0=int(rows.frames[0]) - start,
        x=x,
        y=y,
        heading=heading,
        label=f"{rows.kind} {rows.name}",
    )


def _mean(values: F64, otherwise: float) -> float:
    known = values[np.isfinite(values)]
    return float(np.median(known)) if len(known) else otherwise


def _limit(human: Track, settings: RigSettings) -> float:
    """Motorway or street, by how fast the recorded driver went at his fastest [m/s]."""
    fastest = float(np.percentile(np.hypot(*human.velocity[1:].T), 95))
    return settings.urban_speed_limit if fastest <= settings.urban_speed_limit else settings.motorway_speed_limit


def _route(human: Track, limit: float) -> tuple[Route, float]:
    """The recorded path where it moves on, smoothed and extended straight; and its length [m]."""
    path = np.stack((human.x, human.y), axis=-1)
    kept = [path[0]]
    for p in path[1:]:
        if np.hypot(*(p - kept[-1])) >= 0.5:
            kept.append(p)
    ahead = np.array([np.cos(human.heading[1]), np.sin(human.heading[1])])
    if len(kept) < 2:
        kept = [path[0] - ahead, path[0], path[0] + ahead]
    line = Polyline.of(fair(np.array(kept)))
    # the last metres give the direction, not the last half metre alone
    tail = line.at(line.length) - line.at(max(0.0, line.length - 5.0))
    tail /= np.hypot(*tail)
    more = line.at(line.length) + np.arange(1.0, BEYOND_M)[:, None] * tail
    goal = path[-1]
    reference = np.ascontiguousarray(fair(np.vstack((line.points, more))))
    route = Route(
        reference=reference,
        goal=Goal(x=float(goal[0]), y=float(goal[1]), radius=GOAL_RADIUS_M),
        speed_limit=limit,
        lane_width=3.5,
    )
    return route, line.length
