"""A SUMO network as our map: lanes with boundaries and successors, a stop line where a light holds a lane."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from common.geometry import Polyline
from common.messages import F64, BoundaryType, Lane, Map, Obstacle
from rig.sources.roads import beside

SHORTEST_M = 0.3
"""Shorter lanes are joints; their neighbours are joined across them."""
STOP_IDS = 1_000_000


@dataclass(frozen=True)
class Link:
    """One way out of a lane that a light rules."""

    to: str
    light: str
    index: int


@dataclass(frozen=True)
class SumoRoads:
    """The map, and what SUMO calls its parts."""

    map: Map
    ids: dict[str, int]
    """Our id of each of SUMO's lanes."""
    edges: dict[str, list[int]]
    """Our lanes of each of SUMO's edges."""
    links: dict[int, list[Link]]
    """By the id of a stop line."""

    @staticmethod
    def read(path: Path) -> SumoRoads:
        """Read a network, the ways through its junctions included."""
        import sumolib

        net = sumolib.net.readNet(str(path), withInternal=True)
        every = [lane for edge in net.getEdges(withInternal=True) for lane in edge.getLanes()]
        every = [k for k in every if k.allows("passenger")]
        usable = [k for k in every if _length(k) >= SHORTEST_M]
        ids = {k.getID(): i + 1 for i, k in enumerate(usable)}
        known = {k.getID(): k for k in every}
        lanes = [_lane(net, k, ids, known) for k in usable]
        links: dict[int, list[Link]] = {}
        obstacles = []
        for k, lane in zip(usable, lanes, strict=True):
            ruled = [
                Link(c.getToLane().getID(), c.getTLSID(), c.getTLLinkIndex())
                for c in k.getOutgoing()
                if c.getTLSID() and c.getTLLinkIndex() >= 0
            ]
            if ruled:
                id = STOP_IDS + ids[k.getID()]
                links[id] = ruled
                ends = np.ascontiguousarray([lane.left[-1], lane.right[-1]])
                obstacles.append(Obstacle(id=id, kind="stop_line", points=ends, width=0.3))
        edges: dict[str, list[int]] = {}
        for k in usable:
            edges.setdefault(k.getEdge().getID(), []).append(ids[k.getID()])
        return SumoRoads(Map(lanes=lanes, obstacles=obstacles), ids, edges, links)


def _length(lane: Any) -> float:
    p = np.array([q[:2] for q in lane.getShape()])
    return float(np.hypot(*np.diff(p, axis=0).T).sum())


def _lane(net: Any, lane: Any, ids: dict[str, int], known: dict[str, Any]) -> Lane:
    centre = Polyline.of(np.array([q[:2] for q in lane.getShape()]), tolerance=0.02)
    line = centre.resampled(2.0).points if centre.length > 4.0 else centre.points
    half = lane.getWidth() / 2
    edge, index = lane.getEdge(), lane.getIndex()
    inside = edge.getFunction() == "internal"
    number = edge.getLaneNumber()
    other_way = (
        any(e.getToNode() is edge.getFromNode() for e in edge.getToNode().getOutgoing()) if not inside else False
    )
    left: BoundaryType = (
        "virtual" if inside else "dashed" if index < number - 1 else "solid" if other_way else "road_edge"
    )
    right: BoundaryType = "virtual" if inside else "dashed" if index > 0 else "road_edge"

    def neighbour(step: int) -> int | None:
        if inside or not 0 <= index + step < number:
            return None
        return ids.get(edge.getLanes()[index + step].getID())

    return Lane(
        id=ids[lane.getID()],
        centre=np.ascontiguousarray(line),
        left=_side(line, half),
        right=_side(line, -half),
        left_type=left,
        right_type=right,
        speed_limit=float(lane.getSpeed()),
        successors=sorted(_successors(lane, ids, known)),
        left_neighbour=neighbour(1),
        right_neighbour=neighbour(-1),
    )


def _side(line: F64, offset: float) -> F64:
    return np.ascontiguousarray(beside(line, offset))


def _successors(lane: Any, ids: dict[str, int], known: dict[str, Any], depth: int = 0) -> set[int]:
    """Lanes that follow, through joints too short to be lanes."""
    found: set[int] = set()
    for c in lane.getOutgoing():
        via = c.getViaLaneID()
        target = via if via else c.getToLane().getID()
        if target in ids:
            found.add(ids[target])
        elif target in known and depth < 4:
            found |= _successors(known[target], ids, known, depth + 1)
    return found
