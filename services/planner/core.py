"""The planner: risk volume, ego, map and route in, a validated plan out, every time it is asked."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from msgspec import structs

from common.codec import RefusedError, check
from common.messages import Ego, Map, Plan, Risk, Route, Stamped
from services.planner.backend import kernels
from services.planner.bezier import Start
from services.planner.cycle import Road, Scene, plan_default, plan_paper
from services.planner.decision import through_a_gap
from services.planner.lanes import RouteLanes
from services.planner.nearest import SLOW, nearest_alone
from services.planner.reference import ReferenceLine
from services.planner.safe_stop import missing_input, safe_stop, waiting
from services.planner.settings import PlannerSettings
from services.planner.trajectory import Memory
from services.planner.validator import validate
from services.planner.volume import Volume
from services.planner.work import Work, advance

_MOVING = 0.3  # m/s
_STEERS = 1.0  # m/s; slower than this the yaw rate does not tell the steering
_LINES_A_STEP = 128
"""How much of a new road is looked at in a step: most roads whole, and of a city so much that the plan is not late."""


class Planner:
    """Plans from the newest inputs; keeps the last plan, to start the next one from where the ego should be."""

    def __init__(self, settings: PlannerSettings) -> None:
        self._settings = settings
        self._memory: Memory | None = None
        self._had_all = False
        self._road: Road | None = None
        self._road_of: tuple[Route, Map] | None = None
        self._coming: tuple[tuple[Route, Map], Work[Road]] | None = None

    def warm_up(self) -> None:
        """Compile the kernels, where there are any (seconds when the cache is cold)."""
        if kernels is not None:
            kernels.warm_up()

    def step(
        self,
        ego: Stamped[Ego] | None,
        risk: Stamped[Risk] | None,
        map: Stamped[Map] | None,
        route: Stamped[Route] | None,
        now_ns: int,
    ) -> Plan:
        """Plan once. Times of the plan count from `capture_ns(ego, now_ns)`.

        Never raises: an error inside becomes a safe stop that names it.
        """
        try:
            plan, memory = self._plan(ego, risk, map, route, now_ns)
            check(plan)
        except RefusedError as e:
            plan, memory = self._stop(f"the plan breaks the contract of its message: {e}", ego, None, now_ns)
        except Exception as e:  # whatever it is, the vehicle must be told to stop, and why
            where = _where(e)
            plan, memory = self._stop(f"the planner failed: {type(e).__name__}: {e} ({where})", ego, None, now_ns)
        self._memory = memory
        return plan

    def _plan(
        self,
        ego: Stamped[Ego] | None,
        risk: Stamped[Risk] | None,
        road_map: Stamped[Map] | None,
        route: Stamped[Route] | None,
        now_ns: int,
    ) -> tuple[Plan, Memory | None]:
        settings = self._settings
        missing = missing_input(ego, risk, road_map, route, now_ns, settings)
        if ego is None or risk is None or road_map is None or route is None:
            if ego is None or not (self._had_all or self._moving(ego)):
                return waiting(missing, settings.name), None
            return self._stop(missing, ego, risk, now_ns)
        self._had_all = True
        if missing:
            return self._stop(missing, ego, risk, now_ns)
        try:
            road = self._prepared(route.value, road_map.value)
        except ValueError as e:
            return self._stop(f"the route cannot be driven: {e}", ego, risk, now_ns)

        start, travelled = self._start(ego)
        volume = Volume.of(risk.value, risk.capture_ns, ego.capture_ns)
        memory = self._memory if travelled is not None else None
        scene = Scene(ego.value, ego.capture_ns, start, road, volume, memory, travelled or 0.0)
        turned = _heading_off(road.reference, start, memory)
        if not (turned <= 1.2):
            return self._stop(f"the ego stands {np.degrees(turned):.0f}° across the route", ego, risk, now_ns)
        plan, new = (plan_paper if settings.name == "paper" else plan_default)(scene, settings)
        if settings.name == "default" and plan.desired_speed < settings.crawl and start.speed <= SLOW:
            plan, new, volume = _creeping(scene, plan, new, settings)
        problem = validate(plan, ego.value, volume, settings)
        if problem:
            stop, stopped = self._stop(f"the plan was not fit to publish: {problem}", ego, risk, now_ns)
            return stop, stopped
        return plan, new

    def _prepared(self, route: Route, road: Map) -> Road:
        """Reference line and lanes, made once for each route and map; the old ones until large new ones are ready.

        A preparation that is under way is finished before a newer one begins, lest none ever be.
        """
        known = self._road_of
        if self._road is not None and known is not None and known[1] is road and _same(known[0], route):
            self._coming = None
            return self._road
        of, work = self._coming or ((route, road), _preparing(route, road))
        self._coming = None  # an error inside ends it
        ready = advance(work, np.inf if self._road is None else _LINES_A_STEP)
        if ready is None:
            self._coming = of, work
        else:
            self._road, self._road_of = ready, of
            if self._memory is not None:  # its place and choice belong to the old line
                self._memory = replace(self._memory, target_name="", s=-1.0)
        assert self._road is not None  # the first one is made whole
        return self._road

    def _start(self, ego: Stamped[Ego]) -> tuple[Start, float | None]:
        """The previous plan's state where the ego follows it, otherwise the ego's own; and how far along that plan."""
        e, settings = ego.value, self._settings
        own = start_of(e, settings.max_curvature)
        if self._memory is not None:
            planned, distance = self._memory.state(ego.capture_ns)
            apart = np.hypot(planned.x - own.x, planned.y - own.y)
            turned = abs((planned.heading - own.heading + np.pi) % (2 * np.pi) - np.pi)
            if (
                apart <= settings.follow_distance
                and abs(planned.speed - own.speed) <= settings.follow_speed
                and turned <= 0.15
            ):
                return _led(planned, own, settings), distance
            if own.speed < _STEERS:
                return replace(own, curvature=planned.curvature), None
        return own, None

    def _stop(
        self, reason: str, ego: Stamped[Ego] | None, risk: Stamped[Risk] | None, now_ns: int
    ) -> tuple[Plan, Memory | None]:
        """Brake from where the ego is now, or, if its state is old, from where the last plan has it by now."""
        if ego is None:
            return Plan(mode="safe_stop", reason=reason[:1000], planner=self._settings.name), None
        volume = None
        if risk is not None:
            volume = Volume.of(risk.value, risk.capture_ns, ego.capture_ns)
        old = self._is_old(ego, now_ns)
        try:
            start, travelled = self._start(ego)
            path, distance = (self._memory.path, travelled) if self._memory and travelled is not None else (None, 0.0)
            if old and self._memory is not None:
                start, distance = self._memory.state(now_ns)
                path = self._memory.path
            plan, memory = safe_stop(reason, start, path, distance, ego.value, None if old else volume, self._settings)
            check(plan)
        except Exception as e:  # the last line of defence: hold still, and say everything
            text = f"{reason}; and the stop itself failed: {type(e).__name__}: {e}"
            return Plan(mode="safe_stop", reason=text[:1000], planner=self._settings.name), None
        return plan, None if memory is None else replace(memory, capture_ns=self.capture_ns(ego, now_ns))

    def capture_ns(self, ego: Stamped[Ego] | None, now_ns: int) -> int:
        """From when on the times of a plan count: the ego's capture, or now where no ego or only an old one is known.

        A plan that says for seconds on end that the ego is silent must not itself be refused as old.
        """
        return now_ns if ego is None or self._is_old(ego, now_ns) else ego.capture_ns

    def expires_ns(self, ego: Stamped[Ego] | None, risk: Stamped[Risk] | None, now_ns: int) -> int | None:
        """When the first of what is now in use will be too old; None: nothing will, there is none or it is already."""
        ends = [
            message.capture_ns + round(limit * 1e9) + 1
            for message, limit in ((ego, self._settings.max_ego_age), (risk, self._settings.max_risk_age))
            if message is not None
        ]
        return min((end for end in ends if end > now_ns), default=None)

    def _is_old(self, ego: Stamped[Ego], now_ns: int) -> bool:
        return not (ego.age_s(now_ns) <= self._settings.max_ego_age)

    @staticmethod
    def _moving(ego: Stamped[Ego]) -> bool:
        return not (abs(ego.value.speed) <= _MOVING)


def _creeping(scene: Scene, plan: Plan, new: Memory, settings: PlannerSettings) -> tuple[Plan, Memory, Volume]:
    """For who would stand or nearly so: a plan at a crawl, near bodies each looked at alone, if it gets further."""
    start = scene.start
    alone = nearest_alone(scene.volume, start.x, start.y, start.heading)
    if alone is not scene.volume:
        crept, memory = plan_default(
            replace(scene, volume=alone, most=settings.crawl, published=scene.volume), settings
        )
        if crept.desired_speed > plan.desired_speed and plan.decision is not None:
            decision = through_a_gap(plan.decision, crept.desired_speed, start.speed)
            return structs.replace(crept, decision=decision, reason=decision.sentence), memory, alone
    return plan, new, scene.volume


def _preparing(route: Route, road: Map) -> Work[Road]:
    reference = ReferenceLine.of(route.reference)
    yield len(reference.x) // 200
    lanes = yield from RouteLanes.preparing(reference, route, road)
    return Road(
        reference,
        lanes,
        route.speed_limit if route.speed_limit > 0 else np.inf,
        route.goal,
        *reference.project(route.goal.x, route.goal.y, float(reference.heading[-1])),
    )


def _led(planned: Start, own: Start, settings: PlannerSettings) -> Start:
    """The planned state, never far off what the vehicle does: a plan that runs ahead of it is caught up with by a jolt.

    Along and across alike: the velocity by `lead_speed`, the acceleration by `lead_accel`, the place by `lead_side`.
    """
    off_v, off_a, off_d = settings.lead_speed, settings.lead_accel, settings.lead_side
    speed = min(max(planned.speed, own.speed - off_v, 0.0), own.speed + off_v)
    accel = min(max(planned.acceleration, own.acceleration - off_a), own.acceleration + off_a)
    if own.speed < _STEERS:
        return replace(planned, speed=speed, acceleration=accel)
    c, s = np.cos(own.heading), np.sin(own.heading)
    side = float(c * (planned.y - own.y) - s * (planned.x - own.x))
    excess = side - min(max(side, -off_d), off_d)
    turned = (planned.heading - own.heading + np.pi) % (2 * np.pi) - np.pi
    turn = off_v / own.speed
    bend = off_a / own.speed**2
    return replace(
        planned,
        x=planned.x + float(s) * excess,
        y=planned.y - float(c) * excess,
        heading=planned.heading + min(max(turned, -turn), turn) - turned,
        curvature=min(max(planned.curvature, own.curvature - bend), own.curvature + bend),
        speed=speed,
        acceleration=accel,
    )


def start_of(ego: Ego, max_curvature: float) -> Start:
    """State of the rear axle from the ego's; the curvature from its yaw rate where it moves."""
    half = 0.5 * ego.wheelbase
    speed = max(ego.speed, 0.0)
    curvature = ego.yaw_rate / speed if speed > _STEERS else 0.0
    return Start(
        ego.x - half * float(np.cos(ego.heading)),
        ego.y - half * float(np.sin(ego.heading)),
        ego.heading,
        float(np.clip(curvature, -max_curvature, max_curvature)),
        speed,
        float(np.clip(ego.acceleration, -8.0, 2.0)) if speed > 0.1 else 0.0,
    )


def _same(a: Route, b: Route) -> bool:
    """Whether two routes say the same: one that is published again changes nothing."""
    return a is b or (
        a.goal == b.goal
        and a.lane_ids == b.lane_ids
        and a.speed_limit == b.speed_limit
        and a.lane_width == b.lane_width
        and np.array_equal(a.reference, b.reference)
    )


def _heading_off(reference: ReferenceLine, start: Start, memory: Memory | None) -> float:
    near = memory.s if memory is not None and memory.s >= 0 else None
    s, _ = reference.project(start.x, start.y, start.heading, near)
    return abs((start.heading - reference.point(s)[2] + np.pi) % (2 * np.pi) - np.pi)


def _where(error: Exception) -> str:
    trace = error.__traceback__
    while trace is not None and trace.tb_next is not None:
        trace = trace.tb_next
    return f"{trace.tb_frame.f_code.co_name}, line {trace.tb_lineno}" if trace is not None else "unknown place"
