"""A driver with one idea: along the route by Treiber's IDM. The yardstick where no human is known.

It sees the road users themselves, keeps to the reference line, slows for curves as a comfortable driver would, for
whoever is in its strip ahead, for closed lines; it never leaves its lane and foresees nothing.
"""

from __future__ import annotations

import math

import numpy as np

from common.geometry import Polyline
from common.messages import F64, Closures, Ego, Map, Objects, Plan, Route, Stamped, Trajectory
from evaluation.planning import corridor
from evaluation.planning.car_following import Following, idm

DT = 0.1
HORIZON_S = 4.0
VALID_S = 0.3
LATERAL = 1.2
"""Comfortable lateral acceleration [m/s²]."""
CURVE_BRAKE = 1.0
"""Deceleration with which curves are approached [m/s²]."""
HARDEST = 8.0
DEFAULT_LIMIT = 13.9


class Way:
    """The route as this driver knows it: line, wanted speed at each station, lines across it."""

    def __init__(self, route: Route, road: Map | None, half_width: float) -> None:
        self.line = Polyline.of(route.reference).resampled(1.0)
        p = self.line.points
        heading = np.unwrap(np.arctan2(*np.diff(p, axis=0).T[::-1]))
        step = self.line.length / (len(p) - 1)
        kappa = np.abs(np.gradient(heading) / step)
        kappa = np.convolve(np.pad(kappa, 2, mode="edge"), np.ones(5) / 5, mode="valid")
        v = np.sqrt(LATERAL / np.maximum(np.append(kappa, kappa[-1]), 1e-4))
        v = np.minimum(v, self._limits(route, road))
        for i in range(len(v) - 2, -1, -1):
            v[i] = min(v[i], math.sqrt(v[i + 1] ** 2 + 2 * CURVE_BRAKE * step))
        self.speed: F64 = v
        self._s = np.arange(len(p)) * step
        self._heading = np.concatenate((heading[:1], 0.5 * (heading[1:] + heading[:-1]), heading[-1:]))
        self._kappa = np.gradient(self._heading) / step
        self.step = step
        self.stops = corridor.stops_along(self.line, road, half_width)
        goal = route.goal
        self.goal_s = float(self.line.project(np.array([goal.x, goal.y]))[0]) if goal.stop else math.inf

    def _limits(self, route: Route, road: Map | None) -> F64:
        n = len(self.line.points)
        top = route.speed_limit if route.speed_limit > 0 else math.inf
        limit = np.full(n, math.inf)
        wanted = set(route.lane_ids)
        for lane in road.lanes if road is not None else []:
            if lane.id in wanted and lane.speed_limit > 0:
                centre = Polyline.of(lane.centre)
                s, d = centre.project(self.line.points)
                on = (np.abs(d) < 2.0) & (s >= 0.0) & (s <= centre.length)
                limit[on] = np.minimum(limit[on], lane.speed_limit)
        limit = np.minimum(limit, top)
        return np.where(np.isfinite(limit), limit, DEFAULT_LIMIT)

    def at(self, s: F64) -> tuple[F64, F64, F64, F64]:
        """x, y, heading, curvature at arc lengths `s`; straight beyond the end."""
        p, over = self.line.points, np.maximum(s - self._s[-1], 0.0)
        heading = np.interp(s, self._s, self._heading)
        x = np.interp(s, self._s, p[:, 0]) + over * np.cos(heading)
        y = np.interp(s, self._s, p[:, 1]) + over * np.sin(heading)
        return x, y, heading, np.interp(s, self._s, self._kappa)

    def wanted(self, s: float) -> float:
        """Speed wanted at arc length s [m/s]."""
        i = min(max(round(s / self.step), 0), len(self.speed) - 1)
        return float(self.speed[i])


class IdmDriver:
    """Plans along the route by the IDM; remembers only how the route is."""

    def __init__(self, p: Following | None = None) -> None:
        self._p = p or Following()
        self._way: Way | None = None
        self._of: Route | None = None

    def plan(
        self, ego: Stamped[Ego], objects: Stamped[Objects], map: Map | None, route: Route, closures: Closures
    ) -> Plan:
        """The next 4 s behind whoever is ahead, and a firm brake after `valid_for`."""
        e = ego.value
        if self._way is None or self._of is not route:
            self._way, self._of = Way(route, map, e.width / 2), route
        way = self._way
        half = e.wheelbase / 2
        rear = np.array([e.x - half * math.cos(e.heading), e.y - half * math.sin(e.heading)])
        s0, d0 = (float(v) for v in way.line.project(rear))
        age = (ego.capture_ns - objects.capture_ns) * 1e-9
        o = objects.value
        velocity = np.stack((o.vx, o.vy), axis=-1)
        corners = corridor.bodies(o) + (velocity * age)[:, None, :]
        v = max(e.speed, 0.0)
        lead = corridor.leader(way.line, s0, half + e.length / 2, e.width / 2, corners, velocity, 20.0 + 6.0 * v)
        line = min(corridor.closed_at(way.stops, closures, s0 + half), way.goal_s)
        times = np.arange(0.0, HORIZON_S + 1e-9, DT)
        s, speed, acceleration = [s0], [v], [0.0]
        for t in times:
            gap = lead.gap + lead.speed * t - (s[-1] - s0)
            a = idm(self._p, speed[-1], way.wanted(s[-1] + 0.5 * speed[-1]), max(gap, 0.05), speed[-1] - lead.speed)
            if math.isfinite(line):
                ahead = line - s[-1] - half - e.length / 2 + self._p.gap - 1.0
                a = min(a, idm(self._p, speed[-1], way.wanted(s[-1]), max(ahead, 0.05), speed[-1]))
            a = max(a, -HARDEST)
            after = max(0.0, speed[-1] + a * DT)
            acceleration[-1] = (after - speed[-1]) / DT
            s.append(s[-1] + 0.5 * (speed[-1] + after) * DT)
            speed.append(after)
            acceleration.append(0.0)
        n = len(times)
        profile = self._trajectory(way, times, s[:n], speed[:n], acceleration[:n], (s0, d0), e)
        k = round(VALID_S / DT)
        tail = self._tail(way, s[k], speed[k], (s0, d0), e)
        who = "free road" if math.isinf(lead.gap) else f"{lead.gap:.1f} m behind {int(o.id[lead.index])}"
        return Plan(
            mode="drive", reason=f"IDM: {who}", planner="idm", valid_for=VALID_S, profile=profile, tail=tail,
            desired_speed=way.wanted(s0),
        )  # fmt: skip

    def _tail(self, way: Way, s: float, v: float, start: tuple[float, float], e: Ego) -> Trajectory:
        brake, dt = 3.0, 0.1
        t, way_s, speed = [VALID_S], [s], [v]
        while speed[-1] > 0.0 or len(t) < 3:
            after = max(0.0, speed[-1] - brake * dt)
            way_s.append(way_s[-1] + 0.5 * (speed[-1] + after) * dt)
            speed.append(after)
            t.append(t[-1] + dt)
        a = np.where(np.array(speed) > 0.0, -brake, 0.0)
        return self._trajectory(way, np.array(t), way_s, speed, a.tolist(), start, e)

    @staticmethod
    def _trajectory(
        way: Way, t: F64, s: list[float], v: list[float], a: list[float], start: tuple[float, float], e: Ego
    ) -> Trajectory:
        """Along the line; an offset at the start fades within some seconds of driving."""
        s0, d0 = start
        at = np.asarray(s)
        length = max(12.0, 3.0 * v[0])
        u = np.clip((at - s0) / length, 0.0, 1.0)
        d = d0 * (1.0 - u**3 * (10.0 - 15.0 * u + 6.0 * u * u))
        slope = -d0 * 30.0 * u * u * (1.0 - u) ** 2 / length

        x, y, along, kappa = way.at(at)
        heading = along + np.arctan(slope)
        x, y = x - d * np.sin(along), y + d * np.cos(along)
        half = e.wheelbase / 2
        return Trajectory(
            t=np.ascontiguousarray(t, dtype=np.float64),
            x=x + half * np.cos(heading),
            y=y + half * np.sin(heading),
            heading=heading,
            curvature=np.ascontiguousarray(np.clip(kappa, -0.3, 0.3)),
            speed=np.asarray(v, dtype=np.float64),
            acceleration=np.asarray(a, dtype=np.float64),
        )
