"""One planning cycle, as numbered steps: sample, look up, search, choose, roll out, stop, explain."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from common.messages import Candidates, Decision, Ego, Goal, Plan, SliceRisk
from services.planner.algorithm import (
    choose,
    max_risk_searching,
    path_sampling,
    path_slicing,
    speed_calculating,
    trajectory_generating,
)
from services.planner.bezier import Paths, Start, Target, build_paths, frenet_start
from services.planner.decision import Obstruction, explain, explain_cap, verb
from services.planner.footprint import Footprint, PathRisk, path_risk
from services.planner.goal import goal_cost
from services.planner.lanes import RouteLanes
from services.planner.passing import OUT, Blocked, blocked_by, in_view, patience, priced, waiting_gap
from services.planner.pushers import pushers, without
from services.planner.reference import ReferenceLine
from services.planner.road_edges import leaves_road
from services.planner.rollout import DT, FAILURES, Field, Rollouts, Tier, hardest_brake, roll_out
from services.planner.search import (
    LATER,
    REFERENCE,
    full_brake,
    gentlest,
    lane_centre_distance,
    path_cost,
    search,
    track_index,
)
from services.planner.settings import PlannerSettings
from services.planner.speed import CAUSES, Cap, brake_before, curve_speed, stop_at
from services.planner.stopping import stopping_tail
from services.planner.targets import kinds, targets
from services.planner.trajectory import Memory, Motion, Path, trajectory_of
from services.planner.volume import Volume

F64 = npt.NDArray[np.float64]

_ROUND = 1.2  # m; who moves so far to the side goes round what stands in the lane
_LEAVES = 0.6
"""A path whose offset changes by more than this leaves where the ego drives [m]."""


_THEN = 0.1
"""So much of the speed at which a path passes what stands counts beside what it allows now."""

_SLOW, _GAIN = 10.0, 5.0
"""A path counts as no faster than so much above the speed now, or above `_SLOW`: none is reached at once [m/s]."""


@dataclass(frozen=True)
class Road:
    """What stays the same while route and map do."""

    reference: ReferenceLine
    lanes: RouteLanes
    route_limit: float  # highest wanted speed of the route; inf: none [m/s]
    goal: Goal
    goal_s: float  # where on the reference line the ego's centre reaches the goal [m]
    goal_d: float = 0.0  # and how far to its left the goal lies [m]


@dataclass(frozen=True)
class Scene:
    """Everything one cycle looks at."""

    ego: Ego
    capture_ns: int
    start: Start
    road: Road
    volume: Volume
    memory: Memory | None  # the plan in force, if the ego follows it
    travelled: float  # how far the ego is along that plan's path [m]
    published: Volume | None = None  # what is told of risk is read there, if `volume` is not what was published
    most: float = np.inf  # highest target speed, whatever is allowed [m/s]


@dataclass(frozen=True)
class _Sampled:
    """Paths with what they meet."""

    frenet: tuple[float, float, float, float]
    targets: list[Target]
    fresh: int  # so many of them are new moves; the last one, if there is one more, is the move under way
    paths: Paths
    footprint: Footprint
    risk: PathRisk
    cap: Cap
    s_max: F64  # [n]
    volume: Volume
    moved: F64  # how far paths leave the lane in which they begin [n] [m]
    road_end: F64  # how far the front may go until no lane is there [n] [m]


def plan_default(scene: Scene, settings: PlannerSettings) -> tuple[Plan, Memory]:
    """The form that drove: search over path, target speed and braking tier, in rollouts of the driven controller."""
    previous = scene.memory.target_name if scene.memory is not None else ""
    look = _sample(scene, settings)
    start, paths = scene.start, look.paths
    stands = blocked_by(paths, scene.road.lanes, look.risk, scene.volume, look.footprint, settings)
    share = _patience(scene, stands, settings)
    field = Field.of(
        look.risk, scene.volume, look.cap, paths.end, look.s_max, paths.step, settings, paths.curvature,
        hardest_brake(start, settings), waiting_gap(stands, start.speed, settings),
    )  # fmt: skip
    field = replace(field, s_max=np.minimum(field.s_max, scene.most))
    committed = np.arange(len(paths.target)) >= look.fresh
    cost = path_cost(
        paths, scene.road.lanes, look.footprint.half_width, previous, committed, priced(settings, stands, share)
    )
    cost += goal_cost(paths, scene.road.lanes, _tracks_of(paths), _goal(scene), start.speed, settings)
    off = leaves_road(paths, scene.road.lanes, look.footprint.half_width, settings.lane_margin)
    narrow = np.char.startswith(np.array(paths.target), LATER)

    def off_centre(rest: F64) -> F64:
        return lane_centre_distance(paths, scene.road.lanes, rest)

    verdict = search(field, start, settings, cost, off_centre, off, narrow)

    # what curves allow within 3 s counts as much as what risk allows; but nobody cuts corners to be faster in them
    near = paths.stations[None] <= 3.0 * np.maximum(verdict.desired, start.speed)[:, None] + 1.0
    curve = np.where(near & (look.cap.cause != CAUSES.index("limit")), look.cap.speed, np.inf).min(axis=1)
    curve = np.minimum(curve, curve[np.array(paths.target) == REFERENCE].max())
    soon = max(start.speed, _SLOW) + _GAIN
    view = in_view(stands, look.risk, field.stays.reshape(len(cost), -1)[:, 0], look.s_max, settings)
    score = np.minimum(np.minimum(verdict.desired, curve), np.minimum(soon, view))
    if stands is not None:  # where what is beside now binds all alike, what comes then tells them apart
        score += _THEN * np.minimum(soon, view)
    score = score - settings.tier_cost * verdict.tier - verdict.penalty - cost
    if (verdict.tier > 1).any():
        score -= np.where(verdict.tier > 1, settings.squeeze_cost * _squeeze(look, start), 0.0)
    score = np.where(verdict.passed, score, -1e3 - cost)

    tier_index = len(Tier.all(settings)) - 1
    if verdict.passed.any():
        chosen = int(np.argmax(score))
        tier = gentlest(field, start, verdict, chosen, settings, off_centre, narrow)
        tier_index = tier.index
        wanted = _filtered(float(verdict.desired[chosen]), tier, scene, settings)
        target, motion = wanted, None
        for target in dict.fromkeys((wanted, float(verdict.desired[chosen]))):
            for hold in dict.fromkeys((float(verdict.hold[chosen]), settings.hold_s)):
                r = _one(field, start, chosen, target, hold, tier, settings)
                if r.passed[0]:
                    motion = Motion(r.t, r.distance[0], r.speed[0], r.acceleration[0])
                    break
            if motion is not None:
                break
        if motion is None:
            target = min(target, float(verdict.desired[chosen]))
            r = _one(field, start, chosen, target, float(verdict.hold[chosen]), tier, settings)
            motion = Motion(r.t, r.distance[0], r.speed[0], r.acceleration[0])
        failure, at, distance = verdict.failure[chosen], verdict.failed_at[chosen], verdict.failed_distance[chosen]
    else:
        chosen, rollouts = full_brake(field, start, settings, look.moved)
        target = 0.0
        motion = Motion(rollouts.t, rollouts.distance[chosen], rollouts.speed[chosen], rollouts.acceleration[chosen])
        failure, at = rollouts.failure[chosen], rollouts.failed_at[chosen]
        distance = rollouts.distance[chosen, at]
    decision = _decide(scene, look, chosen, target, int(failure), int(at), float(distance), field, tier_index)
    if stands is not None and share < 1.0 and abs(paths.d[chosen, -1] - paths.d[0, 0]) > _ROUND:
        share = OUT  # who goes round does not turn back for what it costs
    plan, memory = _finish(scene, look, chosen, target, motion, decision, verdict.desired, score, settings)
    return plan, replace(memory, patience=share)


def _patience(scene: Scene, stands: Blocked | None, settings: PlannerSettings) -> float:
    """Share of the cost of leaving the lane, after the time since the last plan."""
    memory = scene.memory
    if memory is None:
        return 1.0
    return patience(stands, memory.patience, scene.start.speed, (scene.capture_ns - memory.capture_ns) * 1e-9, settings)


def plan_paper(scene: Scene, settings: PlannerSettings) -> tuple[Plan, Memory]:
    """Algorithm 1 as printed, with a floor for the slicing speed and a rule for ties."""
    previous = scene.memory.target_name if scene.memory is not None else ""
    look = _sample(scene, settings)
    start, paths, volume = scene.start, look.paths, scene.volume
    slicing = path_slicing(paths.stations, start.speed, volume.starts)
    horizon = paths.stations <= settings.horizon_s * max(start.speed, 3.0)
    risk = max_risk_searching(look.risk.risk, slicing, horizon)
    desired = speed_calculating(risk.max(axis=1), look.s_max, settings.r0, settings.r1)
    name = np.array(paths.target)
    chosen = choose(desired, name == REFERENCE, name == previous)
    motion = trajectory_generating(
        start.speed,
        start.acceleration,
        float(desired[chosen]),
        look.cap.speed[chosen],
        paths.step,
        accel=settings.accel,
        brake=settings.tier_brake[1],
        jerk=settings.jerk,
        tau=settings.tau,
        duration=settings.horizon_s,
    )
    j = int(np.argmax(risk[chosen]))
    if risk[chosen, j] > settings.r0:
        mine = np.flatnonzero((slicing == j) & horizon)
        at = paths.step * int(mine[np.argmax(look.risk.risk[chosen, j, mine])])
        obstruction = Obstruction(Path.of(paths, chosen), at, (j,))
        decision = explain(float(desired[chosen]), start.speed, obstruction, volume, look.footprint, "law")
    else:
        decision = _decide_cap(look, chosen, float(desired[chosen]), start.speed)
    return _finish(scene, look, chosen, float(desired[chosen]), motion, decision, desired, desired, settings)


def _sample(scene: Scene, settings: PlannerSettings) -> _Sampled:
    """Paths, the risk on them and what caps their speed."""
    start, road = scene.start, scene.road
    frenet = frenet_start(road.reference, start, None if scene.memory is None or scene.memory.s < 0 else scene.memory.s)
    s0 = frenet[0]
    here = float(road.lanes.limit[road.lanes.index(s0)])
    s_max = min(here, road.route_limit, settings.max_speed)
    reach = min(max(s_max, 1.0), start.speed + 5.0)
    horizon = max(settings.horizon_s * reach, 1.5 * start.speed + start.speed**2 / 3.0 + 12.0, 30.0)
    step = min(max(horizon / (settings.stations - 1), settings.step_min), settings.step_max)
    horizon = step * (settings.stations - 1)
    s: F64 = np.asarray(s0 + 0.5 * step * np.arange(3 * settings.stations), dtype=np.float64)
    candidates, lengths, fresh = targets(road.lanes, s, frenet[1], start.speed, settings, scene.memory, scene.travelled)
    paths = path_sampling(
        road.reference,
        s,
        frenet,
        candidates,
        lengths,
        step=step,
        points=settings.stations,
        max_curvature=settings.max_curvature,
    )
    footprint = _footprint(scene, step, settings)
    off = _beside_lane(road.lanes, paths)
    moved: F64 = np.abs(off[:, -1] - off[:, 0])
    leaves = moved > _LEAVES
    risk = path_risk(
        scene.volume,
        footprint,
        paths.x,
        paths.y,
        paths.heading,
        step,
        leaves=leaves,
        r_hit=settings.r_hit,
        r0=settings.r0,
    )
    risk = without(risk, _pushers(scene, paths, footprint, moved, settings), ~leaves)
    road_end = _road_end(scene, paths, _tracks_of(paths))
    cap = _cap(scene, paths, risk.known, road_end, settings)
    # who is there already is not stopped harder than need be
    paths = replace(paths, end=np.where(road_end > 0.0, np.minimum(paths.end, road_end), paths.end))
    wanted: F64 = np.full(len(candidates), s_max)
    return _Sampled(frenet, candidates, fresh, paths, footprint, risk, cap, wanted, scene.volume, moved, road_end)


def _beside_lane(lanes: RouteLanes, paths: Paths) -> F64:
    """Offset of paths from the lane in which the ego is, where that is known, otherwise from the reference line."""
    here = int(lanes.index(paths.s[0, 0]))
    own = [t for t in lanes.tracks if t.first <= here <= t.last and abs(float(t.centre[here]) - paths.d[0, 0]) < 1.8]
    if not own:
        return paths.d
    track = min(own, key=lambda t: abs(float(t.centre[here]) - float(paths.d[0, 0])))
    return np.asarray(paths.d - track.centre[lanes.index(paths.s)])


def _pushers(scene: Scene, paths: Paths, footprint: Footprint, moved: F64, settings: PlannerSettings) -> frozenset[int]:
    """Who would run into the ego from behind if it went on as it does; `moved`: how far paths leave their lane [n]."""
    k = int(np.argmin(np.where(moved > _LEAVES, 1e3, moved) - 1e-3 * paths.length))
    t: F64 = np.asarray(DT * np.arange(round(settings.horizon_s / DT) + 1), dtype=np.float64)
    path = Path.of(paths, k)
    x, y, heading, _ = path.at(scene.start.speed * t)
    return pushers(scene.volume, footprint, x, y, heading, t, settings.r_hit)


_CREEP = 0.01
"""So much more may somebody beside press in from plan to plan [E_max]: what is drifted into is not let be."""


def _footprint(scene: Scene, step: float, settings: PlannerSettings) -> Footprint:
    """The outline; who is beside or behind nearer than touching already may stay so near, for braking frees nobody."""
    start = scene.start
    behind = settings.gap_behind + settings.headway_behind * start.speed
    footprint = Footprint.of(scene.ego, settings.footprint_spacing, settings.flank_margin, behind, step)
    x, y = footprint.at(np.array([start.x]), np.array([start.y]), np.array([start.heading]))
    now = scene.volume.sample_at(x, y, np.zeros(1, dtype=np.intp))[0].astype(np.float64)
    beside = footprint.margin > 0.0
    worst = float(np.max(now, initial=0.0, where=beside)) + 0.05 - settings.r_hit
    if scene.memory is not None:
        worst = min(worst, max(scene.memory.margin, settings.flank_margin) + _CREEP)
    return replace(footprint, margin=np.where(beside, np.maximum(footprint.margin, worst), 0.0))


_END_BRAKE = 1.3
"""With which the ego stops before the road ends [m/s²]."""


def _way_to(paths: Paths, s: float) -> F64:
    """Distance along each path to where it passes s of the reference line; far if it does not [n] [m]."""
    beyond = paths.s >= s
    i = np.argmax(beyond, axis=1)
    rows = np.arange(len(i))
    before = np.maximum(i - 1, 0)
    a, b = paths.s[rows, before], paths.s[rows, i]
    w = np.clip((s - a) / np.maximum(b - a, 1e-9), 0.0, 1.0)
    return np.where(beyond.any(axis=1), paths.step * (before + w * (i > 0)), 1e6)


def _road_end(scene: Scene, paths: Paths, tracks: npt.NDArray[np.intp]) -> F64:
    """How far each path may be driven until the front bumper is where its lane, or all do, end [n] [m]; else far.

    A path through a goal that is driven through is not slowed for what lies beyond: there the drive is over.
    """
    road, to_front = scene.road, 0.5 * (scene.ego.wheelbase + scene.ego.length)
    end: F64 = np.full(len(paths.x), 1e6)
    for k in np.unique(tracks[tracks >= 0]):
        last = road.lanes.tracks[k].last
        if road.lanes.ends(last):
            mine = tracks == k
            end[mine] = _way_to(paths, road.lanes.stations[last] - to_front)[mine]
    if not np.isfinite(road.lanes.end):
        return end
    whole = _way_to(paths, road.lanes.end - to_front)
    goal_s, goal_d, radius = _goal(scene)
    if road.goal.stop or not paths.s[0, 0] < goal_s < road.lanes.end:
        return np.asarray(np.minimum(end, whole))
    at = np.argmax(paths.s >= goal_s, axis=1)
    there = np.where((paths.s >= goal_s).any(axis=1), at, paths.s.shape[1] - 1)
    through = np.abs(paths.d[np.arange(len(at)), there] - goal_d) <= radius
    return np.asarray(np.minimum(end, np.where(through, 1e6, whole)))


def _cap(scene: Scene, paths: Paths, known: F64, road_end: F64, settings: PlannerSettings) -> Cap:
    road, half = scene.road, 0.5 * scene.ego.wheelbase
    limit = np.minimum(road.lanes.limit[road.lanes.index(paths.s)], min(road.route_limit, settings.max_speed))
    curve = curve_speed(paths.curvature, paths.step, settings.lateral_accel, settings.max_curvature_rate)
    limit = brake_before(limit, paths.step, settings.curve_brake)
    curve = brake_before(np.minimum(curve, 1e3), paths.step, settings.curve_brake)
    stations, last = paths.stations, paths.step * (paths.x.shape[1] - 1)
    goal = np.full_like(limit, np.inf)
    if road.goal.stop:
        goal = stop_at(_way_to(paths, road.goal_s - half), stations, settings.curve_brake)
    # the end of what is known: of the line, of the grid, of what can be steered
    end = np.minimum(_way_to(paths, road.reference.length - half), np.where(paths.end < last, paths.end, 1e6))
    end = np.minimum(end, np.where(known < last, known, 1e6))
    horizon = stop_at(end, stations, settings.horizon_brake)
    horizon = np.minimum(horizon, stop_at(road_end, stations, _END_BRAKE))
    return Cap.of([limit, curve, goal, horizon])


def _tracks_of(paths: Paths) -> npt.NDArray[np.intp]:
    """Which of the road's tracks each path follows; −1: none [n]."""
    return np.array([track_index(name) for name in paths.target], dtype=np.intp)


def _goal(scene: Scene) -> tuple[float, float, float]:
    """(s, d, radius) of the goal for the rear axle [m]."""
    road = scene.road
    return road.goal_s - 0.5 * scene.ego.wheelbase, road.goal_d, road.goal.radius


def _squeeze(look: _Sampled, start: Start) -> F64:
    """How near others come beside each path on the whole of the next 2 s if the speed stays [n] [E_max]."""
    risk, volume = look.risk.risk, look.volume
    slices = np.arange(int(volume.slice_at(2.0)) + 1)
    station = np.rint(start.speed * np.maximum(volume.starts[slices], 0.0) / look.paths.step).astype(np.intp)
    return np.asarray(risk[:, slices, np.minimum(station, risk.shape[2] - 1)].mean(axis=1), dtype=np.float64)


def _filtered(desired: float, tier: Tier, scene: Scene, settings: PlannerSettings) -> float:
    """The target speed that is driven: small changes come in gradually, very low ones are rest."""
    before = scene.memory.target_speed if scene.memory is not None else scene.start.speed
    target = desired
    if tier.index == 0 and abs(desired - before) < settings.target_band:
        # who is nearly as fast as that is in no haste: a moment's rise is not driven up and down again
        steady = max(before, scene.start.speed) < desired < scene.start.speed + settings.target_steady
        target = before + (settings.target_rise if steady else settings.target_filter) * (desired - before)
    standing = scene.start.speed < 0.1
    if desired < settings.stop_below or (
        standing and before < settings.stop_below and desired < settings.restart_above
    ):
        return 0.0
    return target


def _one(
    field: Field, start: Start, path: int, target: float, hold: float, tier: Tier, settings: PlannerSettings
) -> Rollouts:
    return roll_out(field, start, np.array([path]), np.array([target]), np.array([hold]), tier, settings)


def _decide(
    scene: Scene,
    look: _Sampled,
    chosen: int,
    target: float,
    failure: int,
    at: int,
    distance: float,
    field: Field,
    tier: int,
) -> Decision:
    speed, paths, volume = scene.start.speed, look.paths, scene.volume
    slow = target < float(look.s_max[chosen]) - 0.3
    if failure == 0 or not slow:
        return _decide_cap(look, chosen, target, speed)
    kind = FAILURES[failure]
    if kind in ("tight", "swerve"):
        ends = kind == "tight" and look.paths.end[chosen] >= look.road_end[chosen]
        return explain_cap(target, speed, "horizon" if ends else "curve", distance)
    j = int(volume.slice_at(at * DT))
    i = min(int(distance / paths.step), field.points - 1)
    if kind == "law":
        near = look.risk.risk[chosen, j : j + 2, i : i + 2]
        place = float(paths.step * (i + int(np.argmax(near.max(axis=0)))))
    elif kind == "stays":
        place = float(field.stays[chosen * field.points + i]) + field.gap_stays + 0.3
        j = 0
    else:
        contact = field.contact if tier < 2 else field.ahead
        place = float(contact.distance[chosen, j, i]) + 0.3
    obstruction = Obstruction(Path.of(paths, chosen), min(place, paths.step * (field.points - 1)), (j, j + 1))
    return explain(target, speed, obstruction, volume, look.footprint, kind)


def _decide_cap(look: _Sampled, chosen: int, target: float, speed: float) -> Decision:
    """Nothing of the risk limits it: which cap does, within the next seconds."""
    near = look.paths.stations <= 3.0 * max(speed, 2.0)
    cap = np.where(near, look.cap.speed[chosen], np.inf)
    i = int(np.argmin(cap))
    cause = CAUSES[int(look.cap.cause[chosen, i])]
    reached = min(target, float(cap[i]))
    if cause == "limit" and cap[i] >= target - 0.3:
        return Decision(sentence=f"{verb(reached, speed)}: the road is free", term="limit")
    return explain_cap(reached, speed, cause, float(look.paths.stations[i]))


def _finish(
    scene: Scene,
    look: _Sampled,
    chosen: int,
    target: float,
    motion: Motion,
    decision: Decision,
    desired: F64,
    score: F64,
    settings: PlannerSettings,
) -> tuple[Plan, Memory]:
    """The chosen path again with fine points, the profile, the tail and everything that is told about them."""
    ego, paths = scene.ego, look.paths
    wheelbase = ego.wheelbase
    fine = 4
    step = paths.step / fine
    s: F64 = np.asarray(look.frenet[0] + 0.5 * step * np.arange(3 * settings.stations * fine), dtype=np.float64)
    name = paths.target[chosen]
    lines = kinds(scene.road.lanes, s, look.frenet[1], scene.start.speed, settings, name)
    target_line = next(t for t in lines if t.name == name)
    path = Path.of(
        build_paths(
            scene.road.reference,
            s,
            look.frenet,
            [target_line],
            paths.length[chosen : chosen + 1],
            step=step,
            points=settings.stations * fine,
            max_curvature=settings.max_curvature,
        ),
        0,
    )
    profile = motion.until(settings.profile_s)
    tail = stopping_tail(path, profile, scene.volume, look.footprint, settings)
    half = 0.5 * wheelbase
    few = np.unique(np.linspace(0, settings.stations - 1, settings.candidate_points).astype(np.intp))
    cx, cy = paths.x[:, few], paths.y[:, few]
    ch = paths.heading[:, few]
    plan = Plan(
        mode="drive",
        reason=decision.sentence,
        planner=settings.name,
        valid_for=settings.valid_for,
        profile=trajectory_of(path, profile, wheelbase),
        tail=trajectory_of(path, tail, wheelbase),
        desired_speed=float(target),
        chosen=chosen,
        candidates=Candidates(
            x=cx + half * np.cos(ch),
            y=cy + half * np.sin(ch),
            desired_speed=np.ascontiguousarray(desired, dtype=np.float64),
            score=np.ascontiguousarray(score, dtype=np.float64),
        ),
        slice_risk=_slice_risk(scene, look, chosen, motion),
        decision=decision,
    )
    memory = Memory(
        scene.capture_ns,
        path,
        profile,
        tail,
        settings.valid_for,
        paths.target[chosen],
        float(target),
        float(paths.length[chosen]),
        look.frenet[0],
        float(look.footprint.margin.max()),
    )
    return plan, memory


def _slice_risk(scene: Scene, look: _Sampled, chosen: int, motion: Motion) -> SliceRisk:
    """Highest risk that the motion meets in each slice it reaches, and where the ego's centre then is."""
    paths, volume = look.paths, scene.volume
    station = np.clip(np.rint(motion.distance / paths.step).astype(np.intp), 0, paths.x.shape[1] - 1)
    slices = volume.slice_at(motion.t)
    felt = look.risk.risk[chosen]
    if scene.published is not None:
        px, py, heading = (q[chosen : chosen + 1] for q in (paths.x, paths.y, paths.heading))
        felt = path_risk(scene.published, look.footprint, px, py, heading, paths.step).risk[0]
    risk = felt[slices, station]
    t, value, x, y = [], [], [], []
    half = 0.5 * scene.ego.wheelbase
    for j in np.unique(slices):
        mine = np.flatnonzero(slices == j)
        k = int(mine[np.argmax(risk[mine])])
        i = int(station[k])
        t.append(float(volume.starts[j]))
        value.append(float(risk[k]))
        x.append(float(paths.x[chosen, i] + half * np.cos(paths.heading[chosen, i])))
        y.append(float(paths.y[chosen, i] + half * np.sin(paths.heading[chosen, i])))
    return SliceRisk(t=np.array(t), risk=np.array(value), x=np.array(x), y=np.array(y))
