"""Where paths may lead: offsets from the reference line, the lanes beside it, and changes of lane that begin later.

Who finds no gap beside himself finds one further on, at another speed: a change that begins at a fixed place ahead is
a candidate of its own, and the highest speed at which it meets nobody is the speed that fits the gap.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from services.planner.bezier import Target
from services.planner.lanes import RouteLanes, Track
from services.planner.search import LATER, REFERENCE, later_from, track_name
from services.planner.settings import PlannerSettings
from services.planner.trajectory import Memory

F64 = npt.NDArray[np.float64]

_BESIDE = 5.0  # m; lanes further from the ego are no targets
_SAME = 0.5  # m; a lane this near to the reference line is no other target
_TRACKS = 3
_ON_IT, _IN_IT = 1.0, 1.75  # m; nearer than this to a lane's centre the ego is on it, or still in it

_APART = 2.0  # m; lanes whose centres are nearer than this are not changed between
_EVERY = 10.0  # m; between the places at which a change may begin
_SOONEST, _LATEST = 0.3, 2.5  # s; a change begins so far ahead at the speed now
_MOVE = (15.0, 4.6)  # least length of the change [m], and in seconds of the speed now


def targets(
    lanes: RouteLanes,
    s: F64,
    d: float,
    speed: float,
    settings: PlannerSettings,
    memory: Memory | None,
    travelled: float,
) -> tuple[list[Target], F64, int]:
    """Every target with every length, changes that begin later once, and the move under way with what is left of it.

    Args:
        lanes: The road along the reference line.
        s: Arc lengths at which targets are given, from the ego on [m] [m].
        d: Offset of the ego [m].
        speed: Of the ego [m/s].
        settings: Offsets and lengths.
        memory: The plan in force.
        travelled: How far the ego is along its path [m].

    Returns:
        Targets and lengths [m] of the n paths, and from which one on they are the move under way.
    """
    found, lengths = [], []
    every = kinds(lanes, s, d, speed, settings, None if memory is None else memory.target_name)
    for kind in every:
        for least, seconds in settings.lengths[: 1 if kind.name.startswith(LATER) else None]:
            found.append(kind)
            lengths.append(max(least, seconds * speed))
    fresh = len(found)
    if memory is not None:
        left = max(memory.remaining - travelled, 6.0, 1.5 * speed)
        for kind in every:
            if kind.name == memory.target_name:
                found.append(kind)
                lengths.append(left)
    return found, np.array(lengths), fresh


def kinds(
    lanes: RouteLanes, s: F64, d: float, speed: float, settings: PlannerSettings, wanted: str | None = None
) -> list[Target]:
    """The targets, each once; `wanted` is the name of one that was chosen before."""
    zero = np.zeros_like(s)
    found = [
        Target(REFERENCE if o == 0.0 else f"{o:+.1f} m", np.full_like(s, o), zero, zero)
        for o in dict.fromkeys((0.0, *settings.offsets))
    ]
    stations = np.arange(len(lanes.limit), dtype=np.float64)
    longest = max(settings.lengths[-1][0], settings.lengths[-1][1] * speed)
    ahead = lanes.index(np.linspace(s[0], s[0] + longest, 5)[1:])
    for name, side in (("left lane", lanes.left), ("right lane", lanes.right)):
        if side.exists[ahead].all() and not side.same_direction[ahead].all():
            centre = np.interp(s, stations, side.centre)
            slope = np.interp(s, stations, side.slope) * ((s > 0) & (s < stations[-1]))
            found.append(Target(name, centre, slope, np.gradient(slope, s)))
    near = near_tracks(lanes, float(s[0]), d, longest)
    found += [_along(lanes, lanes.tracks[k], track_name(k), s) for k in near]
    return found + _later(lanes, near, s, d, speed, wanted)


def _along(lanes: RouteLanes, track: Track, name: str, s: F64) -> Target:
    stations = np.arange(len(lanes.limit), dtype=np.float64)
    inside = (s > 0) & (s < stations[-1])
    offset, slope, bend = (np.interp(s, stations, q) for q in (track.centre, track.slope, track.bend))
    return Target(name, offset, slope * inside, bend * inside)


def near_tracks(lanes: RouteLanes, s: float, d: float, longest: float) -> list[int]:
    """Indices of the lanes that the ego could drive in, the nearest first, other than under the reference line.

    A lane that soon ends or leads away from the route is one only for whoever is in it, and not on the route already.
    """
    here, there = (int(i) for i in lanes.index(np.array([s, s + longest])))
    found = []
    for k, track in enumerate(lanes.tracks):
        if track.first <= here <= track.last - 2:
            away = abs(float(track.centre[here]) - d)
            if lanes.ends(track.leaves) and track.leaves < there and (away > _IN_IT or abs(d) < _ON_IT):
                continue
            if away <= _BESIDE and np.abs(track.centre[here : max(there, here + 1) + 1]).max() > _SAME:
                found.append((away, k))
    return [k for _, k in sorted(found)[:_TRACKS]]


def _later(lanes: RouteLanes, near: list[int], s: F64, d: float, speed: float, wanted: str | None) -> list[Target]:
    """Changes towards the route out of the lane in which the ego is, beginning at every 10 m of the reference line."""
    here = int(lanes.index(s[0]))
    own = next((k for k in near if abs(float(lanes.tracks[k].centre[here]) - d) <= _ON_IT), None)
    first, last = s[0] + _SOONEST * speed, s[0] + _LATEST * speed + _EVERY
    starts = _EVERY * np.arange(np.ceil(first / _EVERY), np.floor(last / _EVERY) + 1)
    begun = [] if wanted is None or not wanted.startswith(LATER) else [_parsed(wanted)]
    every = [] if own is None else [(float(at), own) for at in starts]
    move = max(_MOVE[0], _MOVE[1] * speed)
    found = []
    for at, k in dict.fromkeys((*every, *begun)):
        track, over = lanes.tracks[k], _towards(lanes, lanes.tracks[k], at)
        if over is None or not s[0] <= at + move <= lanes.stations[track.leaves]:
            continue
        if over < 0 or at + move <= lanes.stations[lanes.tracks[over].leaves]:
            to = Target("", *np.zeros((3, len(s)))) if over < 0 else _along(lanes, lanes.tracks[over], "", s)
            found.append(_change(_along(lanes, track, "", s), to, s, at, move, f"{LATER}{at:.0f} from {k}"))
    return found


def _parsed(name: str) -> tuple[float, int]:
    return float(name.removeprefix(LATER).split()[0]), later_from(name)


def _change(stay: Target, to: Target, s: F64, at: float, move: float, name: str) -> Target:
    """From one line to another between arc lengths `at` and `at + move`, meeting both with direction and bend."""
    u = np.clip((s - at) / move, 0.0, 1.0)
    w = u**3 * (10.0 - 15.0 * u + 6.0 * u**2)
    w1 = 30.0 * u**2 * (1.0 - u) ** 2 / move
    w2 = 60.0 * u * (1.0 - u) * (1.0 - 2.0 * u) / move**2
    gap, turn = to.offset - stay.offset, to.slope - stay.slope
    return Target(
        name,
        stay.offset + w * gap,
        stay.slope + w * turn + w1 * gap,
        stay.bend + w * (to.bend - stay.bend) + 2.0 * w1 * turn + w2 * gap,
    )


def _towards(lanes: RouteLanes, track: Track, at: float) -> int | None:
    """The lane beside a lane on the side of the reference line; −1: that line itself; None: it is already there."""
    i = int(lanes.index(at))
    c = float(track.centre[i])
    if abs(c) < _APART or not track.first <= i <= track.last:
        return None
    between = [
        (abs(float(t.centre[i]) - c), k)
        for k, t in enumerate(lanes.tracks)
        if t.first <= i <= t.last and _APART <= (c - float(t.centre[i])) * np.sign(c) <= abs(c) - _APART
    ]
    return min(between)[1] if between else -1
