"""A recording with a grace time: whoever was still there when it ended drives on, so that the ego may arrive later.

A recording ends when its driver was through; who drives more gently needs longer for the same way. The drive may last
half as long again (at least `AT_LEAST_S` more). Those whose record was cut off by its end go on along their lanes at
their last speed, straight on where no lane is known; who stood then, stands. Those who had left before are gone. Lights
stay as they were last. With reactive traffic whoever is beyond his record looks at everybody (`reactive.py`).
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from common.geometry import Polyline, wrap_angle
from common.messages import F64, FRAME_S
from rig.sources import routing
from rig.world import Scenario, Track

SHARE = 0.5
"""Of the recorded time, on top of it."""
AT_LEAST_S = 10.0
CUT_FRAMES = 2
"""A record that ends within so many frames of the whole one was cut off."""
STANDS = 0.3
"""Slower than this at the end, one stands [m/s]."""
RETURN_M = 20.0
"""Length over which one comes back to the centre of his lane [m]."""


def prolonged(scenario: Scenario) -> Scenario:
    """The same world for longer; as it is where no map tells where others would drive."""
    if scenario.map is None or not scenario.map.lanes:
        return scenario
    more = max(SHARE * scenario.duration_s, AT_LEAST_S)
    roads = routing.Roads.of(scenario.map)
    last = round(scenario.duration_s / FRAME_S)
    tracks = tuple(_driven_on(k, roads, math.ceil(more / FRAME_S)) if _cut(k, last) else k for k in scenario.tracks)
    return replace(scenario, duration_s=round(scenario.duration_s + more, 3), tracks=tracks)


def _cut(track: Track, last: int) -> bool:
    return len(track.x) > 1 and track.last >= last - CUT_FRAMES


def _driven_on(track: Track, roads: routing.Roads, frames: int) -> Track:
    """The track with so many frames more, fewer where the road ends."""
    back = min(5, len(track.x) - 1)
    x, y, heading = float(track.x[-1]), float(track.y[-1]), float(track.heading[-1])
    moved = np.array([x - track.x[-1 - back], y - track.y[-1 - back]])
    speed = float(np.hypot(*moved)) / (back * FRAME_S)
    way: F64 = speed * FRAME_S * np.arange(1, frames + 1, dtype=np.float64)
    if speed < STANDS:
        more = np.tile([x, y], (frames, 1)), np.full(frames, heading)
    else:
        more = _along(_lane(roads, x, y, math.atan2(moved[1], moved[0]), float(way[-1])), x, y, heading, way)
    px, py = (np.concatenate((a, b)) for a, b in zip((track.x, track.y), more[0].T, strict=True))
    return replace(track, x=px, y=py, heading=np.concatenate((track.heading, more[1])))


def _lane(roads: routing.Roads, x: float, y: float, course: float, far: float) -> Polyline | None:
    """The centre line of the lane at a place and of those that follow it."""
    found = roads.at(x, y, course, reach=0.5)
    if not found:
        return None
    chain = routing.following(roads, found[0][1], far)
    return Polyline.of(np.vstack([roads.lines[i].points for i in chain]), tolerance=1e-3)


def _along(line: Polyline | None, x: float, y: float, heading: float, way: F64) -> tuple[F64, F64]:
    """Positions [k, 2] and headings [k] after driving `way` [k] [m] along a line, easing onto it; None: straight on."""
    if line is None:
        ahead = np.array([math.cos(heading), math.sin(heading)])
        return np.array([x, y]) + way[:, None] * ahead, np.full(len(way), heading)
    s, d = (float(v) for v in line.project(np.array([x, y])))
    way = way[s + way <= line.length]
    u = np.clip(1.0 - way / RETURN_M, 0.0, 1.0)
    off = d * u**3 * (10.0 - 15.0 * u + 6.0 * u * u)
    along = np.array([float(line.heading(v)) for v in s + way])
    points = line.at(s + way) + off[:, None] * np.stack((-np.sin(along), np.cos(along)), axis=-1)
    steps = np.diff(np.vstack(([[x, y]], points)), axis=0)
    course = np.arctan2(steps[:, 1], steps[:, 0])
    turn = np.asarray(wrap_angle(course - heading)) * np.clip(way / 5.0, 0.0, 1.0)
    return points, np.asarray(wrap_angle(heading + turn))
