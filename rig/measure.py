"""What a drive was like, measured from the world: the planner's own view of it is never asked.

Every figure comes from the driven states and the objects as they were. The plan in force is kept only to say why the
vehicle slowed down. Comfort is that of `rig.comfort`, slow-downs are those of `rig.interventions`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from common.geometry import Polyline, distance_between_rectangles, rectangle_corners, wrap_angle
from common.messages import FRAME_S, Ego, Objects, Plan
from rig.comfort import motion
from rig.interventions import DROP_WITHIN_S, STOP_MPS, Reason, interventions, reason_of
from rig.world import Scenario

LANE_KEEPING_M = 1.0  # m, more lateral motion than this within 2 s is not keeping the lane
GENTLE_BRAKE = 3.0  # m/s²


@dataclass(frozen=True)
class Collision:
    """First contact with one object."""

    t: float
    id: int
    cls: int
    at_fault: bool
    why: str
    relative_speed: float  # [m/s]


@dataclass
class Measure:
    """Give it every state of the drive in order of time; ask for the `summary` at any moment."""

    scenario: Scenario
    _t: list[float] = field(default_factory=list)
    _ego: list[Ego] = field(default_factory=list)
    _reasons: list[Reason | None] = field(default_factory=list)
    collisions: list[Collision] = field(default_factory=list)
    min_clearance_m: float | None = None
    min_clearance: dict[str, Any] = field(default_factory=dict)
    goal_t: float | None = None
    _counts: bool = False
    _last_plan: Plan | None = None
    _last_reason: Reason | None = None

    def observe(self, t: float, ego: Ego, objects: Objects, plan: Plan | None) -> None:
        """Note the state at `t` [s] of the run, with the objects at that very time and the plan then in force."""
        if self._t and t <= self._t[-1]:
            return
        self._t.append(t)
        self._ego.append(ego)
        if plan is not self._last_plan:
            self._last_plan, self._last_reason = plan, reason_of(plan)
        self._reasons.append(self._last_reason)
        self._contacts(t, ego, objects)
        goal = self.scenario.route.goal
        inside = math.hypot(ego.x - goal.x, ego.y - goal.y) <= goal.radius
        # who begins inside his goal has reached it once he has left it and is back, or when the record ends
        self._counts = self._counts or not inside or t >= self.scenario.duration_s - FRAME_S / 2
        if self.goal_t is None and inside and self._counts and (not goal.stop or abs(ego.speed) < STOP_MPS):
            self.goal_t = t

    # --- collision and clearance ---

    def _contacts(self, t: float, ego: Ego, objects: Objects) -> None:
        if not len(objects.id):
            return
        reach = np.hypot(objects.length, objects.width) / 2 + math.hypot(ego.length, ego.width) / 2
        far = np.hypot(objects.x - ego.x, objects.y - ego.y) - reach
        bound = math.inf if self.min_clearance_m is None else self.min_clearance_m
        near = np.flatnonzero(far <= max(bound, 0.0))
        if not len(near):
            return
        body = rectangle_corners(ego.x, ego.y, ego.heading, ego.length, ego.width)
        others = rectangle_corners(
            objects.x[near], objects.y[near], objects.heading[near], objects.length[near], objects.width[near]
        )
        distance = distance_between_rectangles(body, others)
        best = int(np.argmin(distance))
        if distance[best] < bound:
            self.min_clearance_m = float(distance[best])
            self.min_clearance = {"t": round(t, 3), "id": int(objects.id[near[best]])}
        known = {c.id for c in self.collisions}
        for i in near[distance <= 0.0]:
            if int(objects.id[i]) not in known:
                self.collisions.append(self._judge(t, ego, objects, int(i)))

    def _judge(self, t: float, ego: Ego, objects: Objects, i: int) -> Collision:
        """Not at fault only when the other's front strikes the ego's rear while it keeps its lane and brakes gently."""
        dvx, dvy = float(objects.vx[i]) - ego.vx, float(objects.vy[i]) - ego.vy
        why = self._fault(t, ego, objects, i)
        return Collision(
            t=round(t, 3),
            id=int(objects.id[i]),
            cls=int(objects.cls[i]),
            at_fault=bool(why),
            why=why or "struck from behind while keeping the lane",
            relative_speed=math.hypot(dvx, dvy),
        )

    def _fault(self, t: float, ego: Ego, objects: Objects, i: int) -> str:
        c, s = math.cos(ego.heading), math.sin(ego.heading)
        front_x = objects.x[i] + objects.length[i] / 2 * math.cos(objects.heading[i])
        front_y = objects.y[i] + objects.length[i] / 2 * math.sin(objects.heading[i])
        ahead = c * (front_x - ego.x) + s * (front_y - ego.y)
        beside = -s * (front_x - ego.x) + c * (front_y - ego.y)
        closing = c * (objects.vx[i] - ego.vx) + s * (objects.vy[i] - ego.vy)
        along = abs(float(wrap_angle(objects.heading[i] - ego.heading))) < math.pi / 4
        rear = ahead < 0.0 and abs(ahead + ego.length / 2) <= 1.0
        touching = abs(beside) < (ego.width + objects.width[i]) / 2
        if not (along and rear and touching and closing > 0.0):
            return "not struck from behind"
        if self._lateral_motion(t) > LANE_KEEPING_M:
            return "struck from behind while leaving the lane"
        if self._hardest_brake(t) > GENTLE_BRAKE:
            return f"struck from behind while braking with more than {GENTLE_BRAKE:g} m/s²"
        return ""

    def _since(self, t: float, span: float) -> list[Ego]:
        return [e for ti, e in zip(self._t, self._ego, strict=True) if ti >= t - span]

    def _lateral_motion(self, t: float) -> float:
        """Largest change of the offset from the lane then driven in, over the last 2 s [m]."""
        past = self._since(t, DROP_WITHIN_S)
        line = _lane_line(self.scenario, past[0])
        _, d = line.project(np.array([(e.x, e.y) for e in past]))
        return float(np.max(np.abs(d - d[0])))

    def _hardest_brake(self, t: float) -> float:
        past = self._since(t, DROP_WITHIN_S)
        return max(-e.acceleration for e in past)

    # --- the summary ---

    def summary(self) -> dict[str, Any]:
        """The `ego` and `interventions` parts of a run's report."""
        on_grid = motion(self._t, [e.speed for e in self._ego], [e.yaw_rate for e in self._ego])
        driven = np.hypot(np.diff([e.x for e in self._ego]), np.diff([e.y for e in self._ego])) if self._t else []
        distance = float(np.sum(driven))
        span = float(self._t[-1] - self._t[0]) if len(self._t) > 1 else 0.0
        ego = {
            "collision": bool(self.collisions),
            "collision_at_fault": any(c.at_fault for c in self.collisions),
            "collisions": [
                {
                    "t": c.t,
                    "id": c.id,
                    "cls": c.cls,
                    "at_fault": c.at_fault,
                    "why": c.why,
                    "relative_speed": round(c.relative_speed, 2),
                }
                for c in self.collisions
            ],
            "min_clearance_m": None if self.min_clearance_m is None else round(self.min_clearance_m, 3),
            "min_clearance_at": self.min_clearance or None,
            "distance_m": round(distance, 2),
            "mean_speed_mps": round(distance / span, 3) if span > 0 else 0.0,
            **on_grid.peaks(),
            "reached_goal": self.goal_t is not None,
            "goal_t": None if self.goal_t is None else round(self.goal_t, 3),
        }
        found = interventions(on_grid.t, on_grid.speed, self._t, self._reasons)
        return {"ego": ego, "interventions": [i.as_dict() for i in found]}


def _lane_line(scenario: Scenario, ego: Ego) -> Polyline:
    """Centre of the lane nearest to the ego among those that run its way; without one, the route."""
    best, line = math.inf, scenario.route.reference
    for lane in scenario.map.lanes if scenario.map is not None else []:
        step = lane.centre - (ego.x, ego.y)
        if np.min(np.hypot(step[:, 0], step[:, 1])) > best + 60.0:
            continue
        centre = Polyline.of(lane.centre)
        s, d = centre.project(np.array([ego.x, ego.y]))
        turn = abs(float(wrap_angle(centre.heading(s) - ego.heading)))
        inside = -1.0 <= s <= centre.length + 1.0
        if inside and turn < math.pi / 4 and abs(float(d)) < best:
            best, line = abs(float(d)), lane.centre
    return Polyline.of(line)
