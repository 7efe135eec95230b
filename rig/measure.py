"""What a drive was like, measured from the world: the planner's own view of it is never asked.

Every figure comes from the driven states and the objects as they were. The plan in force is kept only to say why the
vehicle slowed down. Longitudinal acceleration is the driven speed's difference quotient over 0.2 s, jerk the difference
quotient of that over 0.2 s again (support 0.4 s, so that the integration step does not show); lateral acceleration is
speed · yaw rate, averaged over 0.2 s.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from common.geometry import Polyline, distance_between_rectangles, rectangle_corners, wrap_angle
from common.messages import F64, FRAME_S, Ego, Objects, Plan
from rig.world import Scenario

GRID_S = 0.05  # s, the grid on which speeds are compared
DROP_MPS = 1.0  # m/s, a slow-down worth explaining …
DROP_WITHIN_S = 2.0  # s, … within this
STOP_MPS = 0.1  # m/s, slower is a stop …
MOVING_MPS = 0.5  # m/s, … for one who moved at least this fast
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


@dataclass(frozen=True)
class _Reason:
    mode: str
    sentence: str
    source_id: int | None
    term: str | None
    slice_s: float | None


@dataclass
class Measure:
    """Give it every state of the drive in order of time; ask for the `summary` at any moment."""

    scenario: Scenario
    _t: list[float] = field(default_factory=list)
    _ego: list[Ego] = field(default_factory=list)
    _reasons: list[_Reason | None] = field(default_factory=list)
    collisions: list[Collision] = field(default_factory=list)
    min_clearance_m: float | None = None
    min_clearance: dict[str, Any] = field(default_factory=dict)
    goal_t: float | None = None
    _counts: bool = False
    _last_plan: Plan | None = None
    _last_reason: _Reason | None = None

    def observe(self, t: float, ego: Ego, objects: Objects, plan: Plan | None) -> None:
        """Note the state at `t` [s] of the run, with the objects at that very time and the plan then in force."""
        if self._t and t <= self._t[-1]:
            return
        self._t.append(t)
        self._ego.append(ego)
        if plan is not self._last_plan:
            self._last_plan, self._last_reason = plan, _reason(plan)
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
        t, v, lateral = self._on_grid()
        a, jerk = _rates(v)
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
            "max_abs_accel_lon": _peak(a),
            "max_abs_accel_lat": _peak(lateral),
            "max_abs_jerk": _peak(jerk),
            "p95_abs_jerk": round(float(np.percentile(np.abs(jerk), 95)), 3) if len(jerk) else 0.0,
            "reached_goal": self.goal_t is not None,
            "goal_t": None if self.goal_t is None else round(self.goal_t, 3),
        }
        return {"ego": ego, "interventions": self._interventions(t, v)}

    def _on_grid(self) -> tuple[F64, F64, F64]:
        """Times [s], driven speed [m/s] and lateral acceleration [m/s²] every 50 ms."""
        if len(self._t) < 2:
            return np.zeros(0), np.zeros(0), np.zeros(0)
        times = np.array(self._t)
        t = np.arange(times[0], times[-1] + 1e-9, GRID_S)
        v = np.interp(t, times, [e.speed for e in self._ego])
        lateral = np.interp(t, times, [e.speed * e.yaw_rate for e in self._ego])
        return t, v, np.convolve(lateral, np.ones(5) / 5, mode="valid") if len(lateral) >= 5 else lateral

    def _interventions(self, t: F64, v: F64) -> list[dict[str, Any]]:
        return [self._explained(t, v, *episode) for episode in slow_downs(t, v)]

    def _explained(self, t: F64, v: F64, i0: int, i1: int) -> dict[str, Any]:
        """The reason in force while most of the speed was lost."""
        lost: dict[tuple[str, int | None, str | None], float] = {}
        first: dict[tuple[str, int | None, str | None], _Reason] = {}
        times = np.array(self._t)
        for i in range(i0, i1):
            reason = self._reasons[int(np.searchsorted(times, t[i] + 1e-9, side="right")) - 1]
            if reason is None:
                reason = _Reason("waiting", "no plan", None, None, None)
            key = (reason.mode, reason.source_id, reason.term)
            lost[key] = lost.get(key, 0.0) + max(0.0, float(v[i] - v[i + 1]))
            first.setdefault(key, reason)
        why = first[max(lost, key=lambda k: lost[k])]
        return {
            "t": round(float(t[i0]), 2),
            "kind": "stop" if v[i1] < STOP_MPS else "slow",
            "source_id": why.source_id,
            "term": why.term,
            "slice_s": why.slice_s,
            "speed_from": round(float(v[i0]), 2),
            "speed_to": round(float(v[i1]), 2),
            "until": round(float(t[i1]), 2),
            "mode": why.mode,
            "sentence": why.sentence,
        }


def slow_downs(t: F64, v: F64) -> list[tuple[int, int]]:
    """First and last index of every slow-down: a drop of ≥ 1 m/s within 2 s, or coming to a stop.

    It starts at the highest speed of the 2 s before the drop shows, and lasts until the speed has risen by 0.3 m/s
    over its lowest or has not fallen for 2 s.
    """
    window = round(DROP_WITHIN_S / GRID_S)
    found: list[tuple[int, int]] = []
    start, moved = 0, False  # earliest index that may start the next one; has moved since the last stop
    i = 0
    while i < len(v):
        low = max(start, i - window)
        top = low + int(np.argmax(v[low : i + 1][::-1]))
        top = i - (top - low)  # the last of equal maxima
        moved = moved or v[i] > MOVING_MPS
        stops = moved and v[i] < STOP_MPS
        if v[top] - v[i] < DROP_MPS and not stops:
            i += 1
            continue
        if stops and v[top] - v[i] < DROP_MPS:
            top = start + int(np.flatnonzero(v[start : i + 1] >= MOVING_MPS)[-1]) if moved else top
        end = i
        for k in range(i, len(v)):
            if v[k] < v[end] - 1e-3:
                end = k
            if v[k] > v[end] + 0.3 or k - end >= window:
                break
        found.append((top, end))
        start, i = end, end + 1
        moved = bool(v[end] > MOVING_MPS)
    return [(a, b) for a, b in found if b > a]


def _rates(v: F64) -> tuple[F64, F64]:
    """Acceleration and jerk by difference quotients over 0.2 s."""
    a = (v[4:] - v[:-4]) / (4 * GRID_S) if len(v) > 4 else np.zeros(0)
    return a, (a[4:] - a[:-4]) / (4 * GRID_S) if len(a) > 4 else np.zeros(0)


def _peak(values: F64) -> float:
    return round(float(np.max(np.abs(values))), 3) if len(values) else 0.0


def _reason(plan: Plan | None) -> _Reason | None:
    if plan is None:
        return None
    d = plan.decision
    if d is None or plan.mode != "drive":
        return _Reason(plan.mode, plan.reason, *((d.source_id, d.term, d.slice_s) if d else (None, None, None)))
    return _Reason(plan.mode, d.sentence, d.source_id, d.term, d.slice_s)


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
