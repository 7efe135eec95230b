"""Row 17: what must hold of every plan, whatever the risk volume; tried by Hypothesis on random ones.

- The plan is finite, its tail ends at rest, and outside emergencies it stays within the limits, recomputed here from
  the points of the plan and not with the planner's own validator.
- Raising any cell's risk never raises the desired speed of a path through it that was looked at both times.
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass, field

import numpy as np
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import seed as seeded
from hypothesis import strategies as st

from common.codec import RefusedError, check
from common.geometry import wrap_angle
from common.messages import BLOCK, NO_SLOT, Ego, Goal, Grid, Map, Plan, Risk, Route, Slot, Stamped, Trajectory
from evaluation.faults.result import Figure, Row, Say, Scale, Verdict
from rig.world import ego_at
from services.planner.core import Planner
from services.planner.settings import PlannerSettings

NUMBER = 17
TARGET = (
    "plans finite, the tail ends at v = 0, within limits outside emergencies; raising any cell's risk never raises the"
    " desired speed of a path through it"
)
SETTINGS = PlannerSettings()
SLICES, H = 13, 0.5
BEHIND, AHEAD, WIDTH = 30.0, 100.0, 30.0
REACH_M = 3.0
"""A path that passes a cell's centre no farther off than this may read it with its footprint [m]."""


@dataclass
class Tally:
    """What was seen."""

    plans: Counter[str] = field(default_factory=Counter)
    emergencies: int = 0
    raised: int = 0
    touched: int = 0
    slower: int = 0
    liked_better: int = 0
    firmer: int = 0
    problems: Counter[str] = field(default_factory=Counter)
    example: dict[str, str] = field(default_factory=dict)

    def note(self, problem: str, where: str) -> None:
        """Something that must not be."""
        self.problems[problem] += 1
        self.example.setdefault(problem, where)


@dataclass(frozen=True)
class Case:
    """One random situation."""

    seed: int
    speed: float
    y: float
    heading: float
    acceleration: float
    age: float
    strength: float

    def ego(self) -> Ego:
        """On a straight road, a little off its line."""
        return ego_at(0.0, self.y, self.heading, self.speed, acceleration=self.acceleration)


CASES = st.builds(
    Case,
    seed=st.integers(0, 2**31),
    speed=st.floats(0.0, 28.0),
    y=st.floats(-1.5, 1.5),
    heading=st.floats(-0.15, 0.15),
    acceleration=st.floats(-6.0, 2.5),
    age=st.floats(0.0, 0.3),
    strength=st.sampled_from([0.0, 0.15, 0.5, 1.0, 3.0]),
)


def run(scale: Scale, seed: int, say: Say) -> Row:
    """Both properties on so many volumes."""
    n = scale.repetitions(400, 10_000, 15)
    tally, done = Tally(), 0

    @seeded(seed)
    @settings(
        max_examples=n, database=None, deadline=None, phases=[Phase.generate], suppress_health_check=list(HealthCheck)
    )
    @given(CASES)
    def every(case: Case) -> None:
        nonlocal done
        done += 1
        plan = _plans(case, tally)
        if plan is not None:
            _monotonic(case, plan, tally)
        if done % max(n // 10, 50) == 0:
            say(f"{done} of {n}: {dict(tally.problems) or 'nothing wrong'}")

    every()
    verdict = Verdict()
    for problem, count in tally.problems.items():
        verdict.need(False, f"{problem}: {count}× (such as {tally.example[problem]})")
    figures: dict[str, Figure] = {
        "random volumes": done, **{f"plans: {mode}": k for mode, k in sorted(tally.plans.items())},
        "of them emergencies": tally.emergencies, "cells raised": tally.raised, "paths through them": tally.touched,
        "of them slower afterwards": tally.slower, "violations": tally.problems.total(),
        "paths faster because gentler braking had failed and firmer was tried": tally.firmer,
        "paths with a better score afterwards": tally.liked_better,
    }  # fmt: skip
    proof = f"{done} random volumes, {tally.raised} of them again with a cell raised, seed {seed}"
    return verdict.row(NUMBER, f"planner properties on {n} random volumes (Hypothesis)", TARGET, figures, proof)


def volume_of(case: Case) -> Risk:
    """Blobs that stand, appear, go and move, some through the ego."""
    rng = np.random.default_rng(case.seed)
    rows, columns = round((AHEAD + BEHIND) / H), round(WIDTH / H)
    cells = np.zeros((SLICES, rows, columns), dtype=np.float32)
    for _ in range(rng.integers(0, 9)):
        i, j = rng.uniform(BEHIND / H - 20, rows), rng.normal(columns / 2, 7.0)
        di, dj = rng.normal(0.0, 6.0), rng.normal(0.0, 1.5)
        length, width = rng.integers(2, 30), rng.integers(2, 14)
        first, last = sorted(rng.integers(0, SLICES + 1, 2))
        level = rng.random() * case.strength
        for k in range(first, last):
            a, b = int(i + di * k), int(j + dj * k)
            cells[k, max(a, 0) : max(a + length, 0), max(b, 0) : max(b + width, 0)] += level
    dominant = np.full((SLICES, -(-rows // BLOCK), -(-columns // BLOCK)), NO_SLOT, np.uint8)
    dominant[cells.reshape(SLICES, rows, columns)[:, ::BLOCK, ::BLOCK] > 0.2] = rng.integers(0, 2)
    grid = Grid(x=-BEHIND, y=-WIDTH / 2, heading=0.0, rows=rows, columns=columns, h=H)
    return Risk(
        grid=grid, slice_times=[0.5 * k for k in range(SLICES)],
        slots=[Slot(1, "potential", 1), Slot(2, "potential", 6)], volume=cells, dominant=dominant,
    )  # fmt: skip


def planned(case: Case, risk: Risk, planner: Planner, t: float = 1.0, ego: Ego | None = None) -> Plan:
    """One plan."""

    def at(value: object, when: float) -> Stamped:  # type: ignore[type-arg]
        return Stamped(value, round(when * 1e9), round(when * 1e9))

    route = Route(
        reference=np.array([[-60.0, 0.0], [400.0, 0.0]]), goal=Goal(x=395.0, y=0.0, radius=3.0), speed_limit=28.0
    )
    now_ns = round(t * 1e9)
    return planner.step(at(ego or case.ego(), t), at(risk, t - case.age), at(Map(), 0.0), at(route, 0.0), now_ns)


# --- finite, at rest in the end, within limits ---


def _plans(case: Case, tally: Tally) -> Plan | None:
    """Two plans in a row, both checked; returns the first if it drives."""
    planner, risk, ego = Planner(SETTINGS), volume_of(case), case.ego()
    first = None
    for k in range(2):
        plan = planned(case, risk, planner, 1.0 + 0.05 * k, ego)
        tally.plans[plan.mode] += 1
        for problem in problems(plan, ego, tally):
            tally.note(problem, f"{case}, plan {k}: {plan.reason[:120]}")
        first = plan if k == 0 else first
        ego = _driven(plan, ego)
    return first if first is not None and first.mode == "drive" and first.candidates is not None else None


def _driven(plan: Plan, ego: Ego) -> Ego:
    p, t = plan.profile, 0.05
    if p is None:
        return ego
    x, y, heading, v, a = (float(np.interp(t, p.t, q)) for q in (p.x, p.y, p.heading, p.speed, p.acceleration))
    return ego_at(x, y, heading, v, acceleration=a)


def problems(plan: Plan, ego: Ego, tally: Tally) -> list[str]:
    """What is wrong with a plan."""
    try:
        check(plan)
    except RefusedError as e:
        return [f"breaks its message's contract ({e.reason})"]
    if plan.profile is None or plan.tail is None:
        return ["a moving ego without profile or tail"]
    found = ["an error inside"] if "the planner failed" in plan.reason or "itself failed" in plan.reason else []
    if abs(plan.tail.speed[-1]) > 0.0:
        found.append("the tail does not end at rest")
    if not (abs(plan.tail.t[0] - plan.valid_for) <= 1e-6):
        found.append("the tail does not start at valid_for")
    emergency = is_emergency(plan, ego)
    tally.emergencies += int(emergency)
    for name, part in (("profile", plan.profile), ("tail", plan.tail)):
        found += [f"{name}: {p}" for p in beyond(part, ego, emergency or name == "tail")]
    return found


def is_emergency(plan: Plan, ego: Ego) -> bool:
    """Risk that made it brake harder than firmly, a stop for want of inputs, or a start that is one already.

    That is an ego that crosses the road at more than 1 m/s or brakes harder than firmly itself.
    """
    assert plan.profile is not None
    hard = float(plan.profile.acceleration.min()) < -1.05 * SETTINGS.tier_brake[1]
    slides = abs(np.sin(ego.heading) * ego.speed) > 1.0 or ego.acceleration < -SETTINGS.tier_brake[1]
    return plan.mode == "safe_stop" or slides or (hard and plan.decision is not None and plan.decision.risk is not None)


def beyond(part: Trajectory, ego: Ego, emergency: bool) -> list[str]:
    """Limits that a trajectory's points break, worked out from positions and times alone."""
    dt = np.diff(part.t)
    half = 0.5 * ego.wheelbase
    x, y = part.x - half * np.cos(part.heading), part.y - half * np.sin(part.heading)  # the rear axle
    way = np.hypot(np.diff(x), np.diff(y))
    speed = way / dt
    turn = np.abs(wrap_angle(np.diff(part.heading)))
    bend = np.where(way > 0.3, turn / np.maximum(way, 1e-9), 0.0)
    change = np.diff(part.speed) / dt
    coming_to_rest = part.speed[1:] <= 0.0  # the brake is let go within the step
    brake = SETTINGS.max_brake if emergency else max(SETTINGS.tier_brake[1], -float(part.acceleration[0]))
    side = SETTINGS.max_lateral_accel if emergency else SETTINGS.tier_lateral[-1]
    rules = {
        "speed below 0": bool((part.speed >= 0.0).all()),
        "times do not increase": bool((dt > 0.0).all()),
        "moves faster than it says": bool((np.abs(speed - 0.5 * (part.speed[1:] + part.speed[:-1])) <= 0.6).all()),
        "accelerates too hard": bool((change <= max(SETTINGS.accel, float(part.acceleration[0])) + 0.35).all()),
        "brakes too hard": bool((-change[~coming_to_rest] <= brake + 0.35).all()),
        "turns too tightly": bool((bend <= 1.15 * SETTINGS.max_curvature + 0.01).all()),
        "too fast for a curve": bool((speed**2 * bend <= side + 0.6).all()),
    }
    return [name for name, holds in rules.items() if not holds]


# --- more risk is never more speed ---


def _monotonic(case: Case, plan: Plan, tally: Tally) -> None:
    rng = np.random.default_rng(case.seed + 1)
    risk = volume_of(case)
    low = planned(case, risk, Planner(SETTINGS))
    cells = risk.volume.copy()
    # a cell that some path passes: at random along one of the candidates
    assert low.candidates is not None
    k, p = rng.integers(len(low.candidates.x)), rng.integers(low.candidates.x.shape[1])
    i = int((low.candidates.x[k, p] + BEHIND) / H)
    j = int((low.candidates.y[k, p] + WIDTH / 2) / H)
    if not (0 <= i < cells.shape[1] and 0 <= j < cells.shape[2]):
        return
    slices = slice(int(rng.integers(SLICES)), SLICES if rng.random() < 0.3 else None)
    which = slices if slices.stop is not None else slices.start
    cells[which, i, j] += np.float32(rng.choice([0.05, 0.3, 1.0, 3.0]))
    high = planned(case, Risk(**{f: getattr(risk, f) for f in risk.__struct_fields__} | {"volume": cells}),
                   Planner(SETTINGS))  # fmt: skip
    if high.candidates is None or high.candidates.x.shape != low.candidates.x.shape:
        return
    tally.raised += 1
    x, y = (i + 0.5) * H - BEHIND, (j + 0.5) * H - WIDTH / 2
    a, b = low.candidates, high.candidates
    through = np.hypot(a.x - x, a.y - y).min(axis=1) <= REACH_M
    looked_at = (a.score > -500.0) & (b.score > -500.0)
    tally.touched += int(through.sum())
    tally.slower += int((through & (b.desired_speed < a.desired_speed - 1e-9)).sum())
    faster = through & looked_at & (b.desired_speed > a.desired_speed + 1e-6)
    tally.liked_better += int((through & looked_at & (b.score > a.score + 1e-6)).sum())
    if faster.any():
        tally.firmer += int((faster & (a.score - b.score > 0.5 * SETTINGS.tier_cost)).sum())
        worst = int(np.argmax(np.where(faster, b.desired_speed - a.desired_speed, -math.inf)))
        tally.note(
            "a raised cell raised the desired speed of a path through it",
            f"{case}, cell {i}, {j}: {a.desired_speed[worst]:.2f} → {b.desired_speed[worst]:.2f} m/s, score"
            f" {a.score[worst]:.2f} → {b.score[worst]:.2f}",
        )
