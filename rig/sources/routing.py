"""A route through lanes: the cheapest lane sequence from a pose to a goal, and a reference line along it.

Costs are metres: a successor costs its length, a lane change 30 m (80 m across a solid line). The reference line joins
centre lines; a lane change moves over with a quintic step in 6.5 s and at least 45 m where the lane is long enough.
"""

from __future__ import annotations

import heapq
import itertools
from collections.abc import Collection
from dataclasses import dataclass

import numpy as np

from common.geometry import Polyline, wrap_angle
from common.messages import F64, Lane, Map
from rig.sources.motion import fair

CHANGE_M, CHANGE_SOLID_M = 30.0, 80.0
BEFORE_M, BEYOND_M = 30.0, 100.0  # the reference reaches this far behind the start and beyond the goal
CHANGE_LENGTH_M, CHANGE_TIME_S = 45.0, 6.5  # over a lane of 3.5 m: 0.5 m/s² sideways (5.8 w / T²)
FORBIDDEN = ("kerb", "barrier", "road_edge")


@dataclass(frozen=True)
class Roads:
    """Lanes of a map with their centre lines, looked up by id."""

    lanes: dict[int, Lane]
    lines: dict[int, Polyline]
    before: dict[int, list[int]]

    @staticmethod
    def of(map: Map) -> Roads:
        """Index a map; a successor or neighbour that the map does not hold is ignored."""
        lanes = {k.id: k for k in map.lanes}
        before: dict[int, list[int]] = {i: [] for i in lanes}
        for k in map.lanes:
            for n in k.successors:
                if n in lanes:
                    before[n].append(k.id)
        return Roads(lanes, {i: Polyline.of(k.centre) for i, k in lanes.items()}, before)

    def at(self, x: float, y: float, heading: float | None, reach: float = 3.0) -> list[tuple[float, int]]:
        """Lanes at a point, nearest first: (cost [m], id). Those that run another way by over 60° are left out.

        The cost is the distance to the centre line beyond its half width, plus 5 m a radian of heading.
        """
        found = []
        for i, line in self.lines.items():
            s, d = line.project(np.array([x, y]))
            gap = max(0.0, -float(s), float(s) - line.length)
            off = float(np.hypot(gap, d))
            width = self.width(i)
            turn = 0.0 if heading is None else abs(float(wrap_angle(line.heading(s) - heading)))
            if off <= width / 2 + reach and turn < np.pi / 3:
                found.append((max(0.0, off - width / 2) * 4 + off + 5.0 * turn, i))
        return sorted(found)

    def width(self, i: int) -> float:
        """Width of a lane at its middle [m]."""
        lane = self.lanes[i]
        _, d = Polyline.of(lane.left).project(Polyline.of(lane.right).resampled(5.0).points)
        return float(np.median(np.abs(d)))

    def after(self, i: int) -> list[int]:
        """Successors of a lane that the map holds."""
        return [n for n in self.lanes[i].successors if n in self.lanes]

    def straightest(self, i: int, options: list[int], *, backwards: bool = False) -> int:
        """Which of several successors (or predecessors) turns least."""

        def bend(n: int) -> float:
            line = self.lines[n]
            if backwards:
                return abs(float(wrap_angle(self.lines[i].heading(0.0) - line.heading(0.0))))
            return abs(float(wrap_angle(line.heading(line.length) - self.lines[i].heading(self.lines[i].length))))

        return min(options, key=lambda n: (bend(n), n))

    def changes(self, i: int) -> list[tuple[int, float]]:
        """Lanes beside that run the same way, with the cost of changing there [m]."""
        lane = self.lanes[i]
        found = []
        for n, same, kind in (
            (lane.left_neighbour, lane.left_same_direction, lane.left_type),
            (lane.right_neighbour, lane.right_same_direction, lane.right_type),
        ):
            if n is not None and same and n in self.lanes and kind not in FORBIDDEN:
                found.append((n, CHANGE_SOLID_M if kind == "solid" else CHANGE_M))
        return found


def lane_sequence(roads: Roads, starts: list[tuple[float, int]], goals: Collection[int]) -> list[int] | None:
    """Cheapest sequence of lanes (Dijkstra) from one of `starts` (cost, id) to one of `goals`; None: not connected."""
    queue: list[tuple[float, int, tuple[int, ...]]] = [(cost, i, (i,)) for cost, i in starts]
    heapq.heapify(queue)
    done: set[int] = set()
    while queue:
        cost, i, path = heapq.heappop(queue)
        if i in goals:
            return list(path)
        if i in done:
            continue
        done.add(i)
        steps = [(n, roads.lines[n].length) for n in roads.after(i)] + roads.changes(i)
        for n, more in steps:
            if n not in done:
                heapq.heappush(queue, (cost + more, n, (*path, n)))
    return None


def following(roads: Roads, start: int, length: float) -> list[int]:
    """From `start` along the straightest successors for at least `length` [m] beyond it, where the map allows."""
    path, far = [start], 0.0
    while far < length:
        options = [n for n in roads.after(path[-1]) if n not in path]
        if not options:
            break
        path.append(roads.straightest(path[-1], options))
        far += roads.lines[path[-1]].length
    return path


def reference(roads: Roads, path: list[int], x: float, y: float, speed: float) -> F64:
    """The smooth reference line along a lane sequence for an ego at (x, y), from up to 30 m behind it, shape [n, 2]."""
    chains = _chains(roads, path)
    first = chains[0]
    line = _joined(roads, first)
    here = float(line.project(np.array([x, y]))[0])
    behind = [*first]
    while here < BEFORE_M and roads.before[behind[0]]:
        options = [n for n in roads.before[behind[0]] if n not in behind]
        if not options:
            break
        behind.insert(0, roads.straightest(behind[0], options, backwards=True))
        line = _joined(roads, behind)
        here = float(line.project(np.array([x, y]))[0])
    points = line.cut(max(0.0, here - BEFORE_M), max(here, 0.0) + 0.5).points if here > 0 else line.at([here, 0.0])
    position = here
    for k, chain in enumerate(chains[1:], start=1):
        target = _joined(roads, [*_back(roads, chain[0]), *chain])
        end = float(line.project(roads.lines[chains[k - 1][-1]].points[-1])[0])
        room = max(end - position, 5.0) / _changes_in_row(chains, k)
        span = min(room, max(CHANGE_LENGTH_M, CHANGE_TIME_S * speed))
        s = np.arange(position, position + span, 0.5)
        w = (s - position) / span
        w = w**3 * (10 - 15 * w + 6 * w**2)
        a = line.at(s)
        b = target.at(target.project(a)[0])
        points = np.vstack((points, a + w[:, None] * (b - a)))
        position = float(target.project(line.at(position + span))[0])
        line = target
    points = np.vstack((points, line.cut(position, max(line.length, position + 1.0)).points))
    return fair(_forward(points))


def _chains(roads: Roads, path: list[int]) -> list[list[int]]:
    chains = [[path[0]]]
    for a, b in itertools.pairwise(path):
        if b in roads.lanes[a].successors:
            chains[-1].append(b)
        else:
            chains.append([b])
    return chains


def _changes_in_row(chains: list[list[int]], k: int) -> int:
    """How many changes, from the k-th on, must happen beside the same stretch of road."""
    n = 1
    while k + n - 1 < len(chains) - 1 and len(chains[k + n - 1]) == 1:
        n += 1
    return n


def _back(roads: Roads, i: int) -> list[int]:
    before = roads.before[i]
    return [roads.straightest(i, before, backwards=True)] if before else []


def _joined(roads: Roads, chain: list[int]) -> Polyline:
    return Polyline.of(np.vstack([roads.lines[i].points for i in chain]), tolerance=1e-3)


def _forward(points: F64) -> F64:
    """Drop points that step back against the direction of travel (joints of lines that do not quite meet)."""
    kept = [points[0], points[1]]
    for p in points[2:]:
        step, last = p - kept[-1], kept[-1] - kept[-2]
        if np.hypot(*step) > 1e-3 and float(step @ last) > 0.0:
            kept.append(p)
    return np.array(kept)
