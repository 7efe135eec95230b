"""SUMO's traffic around an ego that is moved by our plan, step by step of 0.1 s."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from common.geometry import wrap_angle
from common.messages import FRAME_S, Closures, Ego, ObjectClass, Objects
from evaluation.planning.sumo_roads import SumoRoads

SEEN_M = 120.0
"""Who is farther from the ego is not seen."""
CLASSES = {
    "passenger": ObjectClass.CAR,
    "truck": ObjectClass.TRUCK,
    "bus": ObjectClass.BUS,
    "motorcycle": ObjectClass.MOTORCYCLE,
    "bicycle": ObjectClass.BICYCLE,
}
AMBER_BRAKE = 2.5
"""Amber is red for who can stop with this [m/s²]."""


class SumoTraffic:
    """One drive: the ego is the vehicle `ego_id`; the others see it as one of them."""

    def __init__(self, sumo: Any, roads: SumoRoads, ego_id: str, ego: Ego, way: set[str]) -> None:
        self._sumo, self._roads, self._ego_id = sumo, roads, ego_id
        self._way = way
        self._ids: dict[str, int] = {}
        self._frame = 0
        self._kind: dict[str, tuple[ObjectClass, float, float]] = {}
        self._now = self._look(ego)
        self._past = self._now
        self._closures = self._lights(ego)
        self.gone = ""

    def _look(self, ego: Ego) -> dict[int, tuple[float, float, float, float, float, str]]:
        """By id: x, y, heading, vx, vy of the rectangle's centre, and SUMO's name."""
        v = self._sumo.vehicle
        found = {}
        for name in v.getIDList():
            if name == self._ego_id:
                continue
            x, y = v.getPosition(name)
            if math.hypot(x - ego.x, y - ego.y) > SEEN_M:
                continue
            if name not in self._kind:
                cls = CLASSES.get(v.getVehicleClass(name), ObjectClass.CAR)
                self._kind[name] = (cls, v.getLength(name), v.getWidth(name))
            heading = math.pi / 2 - math.radians(v.getAngle(name))
            half, speed = self._kind[name][1] / 2, v.getSpeed(name)
            c, s = math.cos(heading), math.sin(heading)
            id = self._ids.setdefault(name, len(self._ids) + 1)
            found[id] = (x - half * c, y - half * s, heading, speed * c, speed * s, name)
        return found

    def advance(self, t: float, ego: Ego) -> None:
        """Move the ego in SUMO to where it is, and everybody else one step on."""
        while self._frame * FRAME_S <= t + 1e-9:
            self._past = self._now
            self._place(ego)
            self._sumo.simulationStep()
            self._now = self._look(ego)
            self._closures = self._lights(ego)
            self._frame += 1

    def _place(self, ego: Ego) -> None:
        v = self._sumo.vehicle
        if self._ego_id not in v.getIDList():
            self.gone = self.gone or "SUMO has taken the ego off the road"
            return
        c, s = math.cos(ego.heading), math.sin(ego.heading)
        angle = (90.0 - math.degrees(ego.heading)) % 360.0
        # where it will be when the step is done, the front bumper's middle
        ahead = ego.length / 2 + ego.speed * FRAME_S
        try:
            v.setSpeed(self._ego_id, ego.speed)
            v.moveToXY(self._ego_id, "", -1, ego.x + ahead * c, ego.y + ahead * s, angle, 2)
        except self._sumo.TraCIException as e:
            self.gone = self.gone or str(e)

    def objects_at(self, t: float) -> Objects:
        """Who is seen at `t` [s]."""
        w = min(max(t / FRAME_S - (self._frame - 1), 0.0), 1.0) if t > 1e-9 and self._frame else 0.0
        rows = []
        for id, b in self._now.items():
            a = self._past.get(id)
            if a is None:
                continue
            vx, vy = (b[0] - a[0]) / FRAME_S, (b[1] - a[1]) / FRAME_S
            if self._past is self._now or math.hypot(vx, vy) > 60.0:
                vx, vy = b[3], b[4]
            cls, length, width = self._kind[b[5]]
            turned = a[2] + w * float(wrap_angle(b[2] - a[2]))
            x, y = a[0] + w * (b[0] - a[0]), a[1] + w * (b[1] - a[1])
            if t < 0.0:
                x, y = x + t * vx, y + t * vy
            rows.append((id, cls, x, y, turned, vx, vy, length, width))
        c = np.array(rows, dtype=np.float64).reshape(-1, 9).T
        return Objects(
            id=c[0].astype(np.int64), cls=c[1].astype(np.uint8), x=c[2].copy(), y=c[3].copy(),
            heading=np.asarray(wrap_angle(c[4])), vx=c[5].copy(), vy=c[6].copy(), length=c[7].copy(),
            width=c[8].copy(), mass=np.zeros(c.shape[1]),
        )  # fmt: skip

    def closures_at(self, t: float) -> Closures:
        """Stop lines that are shut now for the ego's way on, or for every way on."""
        return self._closures

    def _lights(self, ego: Ego) -> Closures:
        states: dict[str, str] = {}
        shut = []
        stops = {o.id: o for o in self._roads.map.obstacles}
        for id, links in self._roads.links.items():
            middle = stops[id].points.mean(axis=0)
            away = math.hypot(middle[0] - ego.x, middle[1] - ego.y)
            if away > SEEN_M:
                continue
            asked = [k for k in links if k.to.rsplit("_", 1)[0] in self._way] or links
            signals = []
            for k in asked:
                if k.light not in states:
                    states[k.light] = self._sumo.trafficlight.getRedYellowGreenState(k.light)
                signals.append(states[k.light][k.index])
            far = away - ego.length / 2 > ego.speed**2 / (2 * AMBER_BRAKE) + 2.0
            if all(s in "ru" or (s in "yY" and far) for s in signals):
                shut.append(id)
        return Closures(ids=sorted(shut))
