"""CommonRoad scenarios (2018b and 2020a): lanelets, recorded obstacles and one planning problem as a world to drive in.

Coordinates stay as in the file. A recorded obstacle's position is its rectangle's centre in CommonRoad; the planning
problem's initial position is taken the same way. Time 0 is the problem's initial time step; the run lasts as long as
others were recorded. The file knows no size for the ego: a car of 4.5 × 1.8 m with a wheelbase of 2.7 m is assumed.
An obstacle that stands in the ego's own place at the start is the recorded driver: kept aside as `human`.
"""

from __future__ import annotations

import contextlib
import io
import logging
import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from common.geometry import Polyline, distance_between_rectangles, rectangle_corners
from common.messages import F64, FRAME_S, Ego, Goal, Map, ObjectClass, Route
from rig.settings import RigSettings
from rig.sources import lanelets, routing
from rig.sources.motion import heading_from_motion, on_frames
from rig.sources.start import without_ego
from rig.world import SIZES, Closure, Scenario, ScenarioError, Track, ego_at

CLASSES = {
    "car": ObjectClass.CAR,
    "taxi": ObjectClass.CAR,
    "parkedVehicle": ObjectClass.CAR,
    "priorityVehicle": ObjectClass.CAR,
    "truck": ObjectClass.TRUCK,
    "train": ObjectClass.TRUCK,
    "bus": ObjectClass.BUS,
    "motorcycle": ObjectClass.MOTORCYCLE,
    "bicycle": ObjectClass.BICYCLE,
    "pedestrian": ObjectClass.PEDESTRIAN,
}
"""CommonRoad's obstacle types; every other one is `unknown`."""
GOAL_RADIUS_M = 3.0  # m, at least: recorded goals are as small as the place where one driver happened to be
OTHER_START_M = 1.5  # m of cost: lanes that hold the start nearly as well as the best one (junctions) may be chosen
SHARP_GOAL_S = 1.1  # s: a goal whose interval of time is no wider tells when the recorded driver was there
TIMED_GOAL_PACE = 0.8  # of the initial speed: where a goal that is only a time is put


def load(path: Path, settings: RigSettings) -> Scenario:
    """Read a scenario file.

    Raises:
        ScenarioError: not XML, not CommonRoad, or nothing to drive in it.
    """
    _check_xml(path)
    with _quiet() as messages:
        try:
            from commonroad.common.file_reader import CommonRoadFileReader

            file, problems = CommonRoadFileReader(str(path)).open()
        except Exception as e:  # the reader raises whatever its parts raise
            hint = "Is it a CommonRoad scenario of version 2018b or 2020a?"
            raise ScenarioError(f"commonroad-io cannot read it: {type(e).__name__}: {e}", path=path, hint=hint) from e
    warnings = _reader_warnings(messages)
    try:
        return _scenario(path, file, problems, settings, warnings)
    except ScenarioError as e:
        raise ScenarioError(e.reason, path=path, hint=e.hint) from None


def _scenario(path: Path, file: Any, problems: Any, settings: RigSettings, warnings: list[str]) -> Scenario:
    problem = _problem(problems, warnings)
    dt = float(file.dt)
    if not 0.0 < dt <= 1.0:
        raise ScenarioError(f"a time step of {dt} s")
    step0 = int(problem.initial_state.time_step)
    ego0 = _ego(problem.initial_state)
    if abs(dt - FRAME_S) > 1e-9:
        warnings.append(f"time step {dt} s, resampled to {FRAME_S} s")
    tracks = _tracks(file, dt, step0, warnings)
    tracks, human = without_ego(tracks, ego0, warnings)
    goal_end = max(_last_step(s.time_step) for s in problem.goal.state_list) - step0
    last = max((k.last for k in tracks if len(k.x) > 1), default=round(goal_end * dt / FRAME_S))
    tracks = [_to_the_end(k, last) for k in tracks]
    duration = last * FRAME_S
    if duration < 1.0:
        raise ScenarioError(f"only {duration:.1f} s of traffic are recorded")
    fallback, kind = _fallback_limit(file, path, settings)
    map = lanelets.read_map(file.lanelet_network, fallback, warnings)
    if kind:
        unsigned = sum(k.speed_limit == fallback for k in map.lanes)
        if unsigned == len(map.lanes):
            warnings.append(f"the map has no speed limits: {fallback:g} m/s ({kind}) is assumed")
    route = _route(map, problem, ego0, goal_end * dt, warnings)
    closures = lanelets.read_lights(file.lanelet_network, map, dt, duration, route.lane_ids)
    closures = _plausible(closures, map, tracks, ego0, warnings)
    tags = sorted(str(t.value) for t in file.tags) if file.tags else []
    return Scenario(
        name=path.stem,
        title=f"{path.stem}: {', '.join(tags) or 'CommonRoad'}",
        source="commonroad",
        duration_s=round(duration, 3),
        map=map,
        route=route,
        ego0=ego0,
        tracks=tuple(tracks),
        closures=tuple(closures),
        warnings=tuple(warnings),
        human=human,
        human_goal_s=_human_at_goal(problem.goal, step0, dt),
        detail={"file": path.name},
    )


def _human_at_goal(goal: Any, step0: int, dt: float) -> float | None:
    """When the recorded driver was at a small goal [s]: files made from recordings give an interval about it.

    The middle of the interval; it is cut off where the record ends. None where it is wide or no place is given.
    """
    state = goal.state_list[0]
    shape = getattr(getattr(state, "position", None), "shapely_object", None)
    time = state.time_step
    first, last = int(getattr(time, "start", time)) - step0, int(getattr(time, "end", time)) - step0
    if shape is None or (goal.lanelets_of_goal_position or {}).get(0) or shape.length > 30.0:
        return None
    if first <= 0 or (last - first) * dt > SHARP_GOAL_S:
        return None
    return (first + last) / 2 * dt


# --- reading the file ---


def _check_xml(path: Path) -> None:
    try:
        for _, element in ElementTree.iterparse(path, events=("start",)):
            if element.tag != "commonRoad":
                raise ScenarioError(f"not a CommonRoad file: its root is <{element.tag}>", path=path, line=1)
            break
        else:
            raise ScenarioError("an empty file", path=path)
        ElementTree.parse(path)
    except ElementTree.ParseError as e:
        raise ScenarioError(f"not valid XML: {e}", path=path, line=e.position[0]) from None
    except (OSError, UnicodeDecodeError) as e:
        raise ScenarioError(f"cannot be read: {e}", path=path) from None


@contextlib.contextmanager
def _quiet() -> Iterator[list[str]]:
    """Collect what commonroad-io logs or prints instead of showing it."""
    messages: list[str] = []

    class Collector(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            messages.append(record.getMessage())

    logger = logging.getLogger("commonroad")
    handler, propagate = Collector(), logger.propagate
    logger.addHandler(handler)
    logger.propagate = False
    out = io.StringIO()
    try:
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(out):
            yield messages
    finally:
        logger.removeHandler(handler)
        logger.propagate = propagate
        messages += [line for line in out.getvalue().splitlines() if line.strip()]


def _reader_warnings(messages: list[str]) -> list[str]:
    """The reader's own warnings, one of each kind; those about renamed junction fields, which we do not use, go."""
    found: dict[str, tuple[str, int]] = {}
    for m in messages:
        if "deprecated format" in m:
            continue
        key = re.sub(r"\d+", "#", m)
        found[key] = (m, found.get(key, (m, 0))[1] + 1)
    return [m if n == 1 else f"{m} (and {n - 1} more like it)" for m, n in found.values()]


def _problem(problems: Any, warnings: list[str]) -> Any:
    found = problems.planning_problem_dict
    if not found:
        raise ScenarioError("no planning problem: nothing says where the ego starts and goes")
    first = min(found)
    if len(found) > 1:
        warnings.append(f"{len(found)} planning problems; {first} is driven, the others are left out")
    return found[first]


def _ego(state: Any) -> Ego:
    x, y = (float(v) for v in state.position)
    speed = float(state.velocity)
    acceleration = float(getattr(state, "acceleration", 0.0) or 0.0)
    return ego_at(x, y, float(state.orientation), max(0.0, speed), acceleration=float(np.clip(acceleration, -5, 3)))


def _last_step(time: Any) -> int:
    return int(getattr(time, "end", time))


def _fallback_limit(file: Any, path: Path, settings: RigSettings) -> tuple[float, str]:
    """Speed limit [m/s] of lanes without a sign: the setting, or by the scenario's own tags (a highway or not)."""
    if settings.default_speed_limit > 0:
        return settings.default_speed_limit, "rig.default_speed_limit"
    tags = {str(t.value) for t in file.tags or ()}
    types = {str(getattr(t, "value", t)) for k in file.lanelet_network.lanelets for t in k.lanelet_type or ()}
    if tags & {"highway", "interstate"} or types & {"highway", "interstate"}:
        return settings.motorway_speed_limit, "a motorway by its tags"
    return settings.urban_speed_limit, "a street by its tags"


# --- obstacles ---


def _tracks(file: Any, dt: float, step0: int, warnings: list[str]) -> list[Track]:
    tracks = []
    for o in sorted(file.obstacles, key=lambda k: k.obstacle_id):
        try:
            tracks.append(_track(o, dt, step0, warnings))
        except ValueError as e:
            warnings.append(f"obstacle {o.obstacle_id} left out: {e}")
    kept = [k for k in tracks if k.last >= 0]
    if len(kept) < len(tracks):
        warnings.append(f"{len(tracks) - len(kept)} obstacles end before the run starts")
    return kept


def _track(o: Any, dt: float, step0: int, warnings: list[str]) -> Track:
    kind = str(o.obstacle_type.value)
    cls = CLASSES.get(kind, ObjectClass.UNKNOWN)
    if kind not in CLASSES:
        warnings.append(f"obstacle {o.obstacle_id}: type {kind!r} is taken as unknown")
    states = _states(o)
    t = np.array([(s.time_step - step0) * dt for s in states])
    x, y = (np.array([float(s.position[k]) for s in states]) for k in (0, 1))
    given: list[Any] = [getattr(s, "orientation", None) for s in states]
    known = None not in given
    heading = np.array([float(h) for h in given]) if known else heading_from_motion(x, y, float(given[0] or 0.0))
    if not all(np.isfinite(v).all() for v in (x, y, heading)):
        raise ValueError("a position or heading that is not finite")
    if len(t) > 1 and not (np.diff(t) > 0).all():
        raise ValueError("its time steps do not increase")
    length, width, forward = _size(_shape(o), SIZES[cls])
    x, y = x + forward * np.cos(heading), y + forward * np.sin(heading)
    velocity = _first_velocity(states[0], float(heading[0]))
    frame0, x, y, heading = on_frames(t, x, y, heading)
    return Track(
        id=int(o.obstacle_id),
        cls=cls,
        length=length,
        width=width,
        frame0=frame0,
        x=x,
        y=y,
        heading=heading,
        first_velocity=velocity,
        label=f"{kind} {o.obstacle_id}",
    )


def _states(o: Any) -> list[Any]:
    """Every state with an exact position and time, the initial one first."""
    states = [o.initial_state]
    prediction = getattr(o, "prediction", None)
    if prediction is not None:
        trajectory = getattr(prediction, "trajectory", None)
        if trajectory is None:
            raise ValueError("its motion is a set of occupancies, not a trajectory")
        states += trajectory.state_list
    for s in states:
        if np.shape(s.position) != (2,) or not isinstance(s.time_step, int | np.integer):
            raise ValueError("a position or time that is not exact")
    return states


def _to_the_end(track: Track, last: int) -> Track:
    """One without motion (a static obstacle) stands there for the whole run."""
    if len(track.x) > 1:
        return track
    n = max(1, last - track.frame0 + 1)
    x, y, heading = (np.repeat(v, n) for v in (track.x, track.y, track.heading))
    return Track(
        track.id, track.cls, track.length, track.width, track.frame0, x, y, heading, (0.0, 0.0), label=track.label
    )


def _first_velocity(state: Any, heading: float) -> tuple[float, float] | None:
    speed: Any = getattr(state, "velocity", None)
    if not isinstance(speed, int | float | np.number):
        return None
    lateral: Any = getattr(state, "velocity_y", None)
    if lateral is not None:
        return float(speed), float(lateral)
    return float(speed) * float(np.cos(heading)), float(speed) * float(np.sin(heading))


def _shape(o: Any) -> Any:
    return o.obstacle_shape


def _size(shape: Any, otherwise: tuple[float, float]) -> tuple[float, float, float]:
    """Length, width and how far the rectangle's centre lies ahead of the position [m]."""
    if hasattr(shape, "length") and hasattr(shape, "width"):
        return _sane(float(shape.length), float(shape.width), float(getattr(shape, "origin_x_shift", 0.0) or 0.0))
    if hasattr(shape, "radius"):
        return _sane(2 * float(shape.radius), 2 * float(shape.radius), 0.0)
    vertices = getattr(shape, "vertices", None)
    if vertices is not None:
        low, high = np.min(vertices, axis=0), np.max(vertices, axis=0)
        return _sane(float(high[0] - low[0]), float(high[1] - low[1]), float(high[0] + low[0]) / 2)
    return (*otherwise, 0.0)


def _sane(length: float, width: float, forward: float) -> tuple[float, float, float]:
    if not (0.05 <= length <= 100.0 and 0.05 <= width <= 100.0):
        raise ValueError(f"a size of {length:g} × {width:g} m")
    return length, width, forward


# --- the route ---


def _route(map: Map, problem: Any, ego: Ego, time_s: float, warnings: list[str]) -> Route:
    roads = routing.Roads.of(map)
    starts = roads.at(ego.x, ego.y, ego.heading)
    starts = [k for k in starts if k[0] < starts[0][0] + OTHER_START_M]
    goal_state = problem.goal.state_list[0]
    if len(problem.goal.state_list) > 1:
        warnings.append(f"{len(problem.goal.state_list)} goal states; the first is driven to")
    listed = (problem.goal.lanelets_of_goal_position or {}).get(0, [])
    place = getattr(goal_state, "position", None)
    if listed:
        goals, centre = set(listed), None
    elif place is not None:
        centre = _centre(place)
        goals = _goal_lanes(roads, centre, getattr(goal_state, "orientation", None))
    else:
        goals, centre = set(), None
    path = _path(roads, starts, goals, ego.speed * time_s, warnings)
    if path:
        reference = np.ascontiguousarray(routing.reference(roads, path, ego.x, ego.y, ego.speed))
    else:
        ahead = np.array([np.cos(ego.heading), np.sin(ego.heading)])
        reference = np.array([ego.x, ego.y]) + np.linspace(-5.0, routing.BEYOND_M, 106)[:, None] * ahead
    line = Polyline.of(reference)
    here = float(line.project(np.array([ego.x, ego.y]))[0])
    if centre is not None:
        goal = _goal_at(centre, place, line, warnings)
    elif listed:
        goal = _goal_in_lane(roads, line, [i for i in path if i in goals], here)
    else:
        way = TIMED_GOAL_PACE * ego.speed * time_s
        x, y = line.at(min(here + max(way, 10.0), line.length))
        goal = Goal(x=float(x), y=float(y), radius=GOAL_RADIUS_M)
        warnings.append(f"the goal is only a time ({time_s:.1f} s): a point {way:.0f} m ahead stands for it")
    rest = line.length - float(line.project(np.array([goal.x, goal.y]))[0])
    if rest < routing.BEYOND_M:
        warnings.append(f"the map ends {max(rest, 0.0):.0f} m beyond the goal: the route goes straight on from there")
        more = line.at(line.length + np.arange(1.0, routing.BEYOND_M - rest + 1.0))
        reference = np.ascontiguousarray(np.vstack((reference, more)))
    driven = path or list(roads.lanes)
    limits = [roads.lanes[i].speed_limit for i in driven]
    width = float(np.median([roads.width(i) for i in driven]))
    return Route(
        reference=reference,
        goal=goal,
        lane_ids=path,
        speed_limit=max(limits),
        lane_width=float(np.clip(width, 2.0, 6.0)),
    )


def _path(
    roads: routing.Roads, starts: list[tuple[float, int]], goals: set[int], reach: float, warnings: list[str]
) -> list[int]:
    """Lanes to the goal and at least 100 m beyond it; empty: the ego starts on no lane that runs its way."""
    if not starts:
        warnings.append("the ego does not start on a lane that runs its way: the route is straight ahead")
        return []
    path = routing.lane_sequence(roads, starts, goals) if goals else None
    if path is None:
        if goals:
            warnings.append("no lanes connect the start with the goal: the route follows the lane")
        path = [starts[0][1]]
    return path + routing.following(roads, path[-1], max(routing.BEYOND_M, reach))[1:]


def _centre(place: Any) -> F64:
    return np.array(place.shapely_object.centroid.coords[0][:2], dtype=np.float64)


def _goal_lanes(roads: routing.Roads, centre: F64, orientation: Any) -> set[int]:
    """Lanes at the goal: the nearest, and others as near (lanes overlap in junctions)."""
    heading = None
    if orientation is not None and hasattr(orientation, "start"):
        heading = (float(orientation.start) + float(orientation.end)) / 2
    found = roads.at(float(centre[0]), float(centre[1]), heading) or roads.at(float(centre[0]), float(centre[1]), None)
    return {i for cost, i in found if cost < found[0][0] + 1.5}


def _goal_at(centre: F64, place: Any, line: Polyline, warnings: list[str]) -> Goal:
    shape = place.shapely_object
    reach = max(float(np.hypot(x - centre[0], y - centre[1])) for x, y in shape.exterior.coords)
    radius = float(np.clip(reach, GOAL_RADIUS_M, 20.0))
    off = abs(float(line.project(centre)[1]))
    if off > radius:
        warnings.append(f"the goal lies {off:.1f} m beside the route")
    return Goal(x=float(centre[0]), y=float(centre[1]), radius=radius)


def _goal_in_lane(roads: routing.Roads, line: Polyline, lanes: list[int], here: float) -> Goal:
    """A goal that is a lane: a point within its first 10 m (on the ego's own lane: 10 m ahead)."""
    lane = roads.lines[lanes[0]]
    enter, leave = (float(line.project(lane.points[k])[0]) for k in (0, -1))
    half = float(np.clip((leave - enter) / 2, GOAL_RADIUS_M, 10.0))
    x, y = line.at(max(enter + half, here + half))
    return Goal(x=float(x), y=float(y), radius=half)


def _plausible(closures: list[Closure], map: Map, tracks: list[Track], ego: Ego, warnings: list[str]) -> list[Closure]:
    """Leave out stop lines that the ego has already passed, and those through whose red the recorded traffic drives."""
    wrong = lanelets.contradicted(closures, map, tracks)
    for i, why in wrong.items():
        warnings.append(f"lights at lanelet {-i - 1} do not fit the record and are left out: {why}")
    body = rectangle_corners(ego.x, ego.y, ego.heading, ego.length, ego.width)
    for o in map.obstacles:
        middle = o.points.mean(axis=0)
        near = float(distance_between_rectangles(body, rectangle_corners(middle[0], middle[1], 0.0, 0.1, 0.1))) < 3.0
        ahead = np.cos(ego.heading) * (middle[0] - ego.x) + np.sin(ego.heading) * (middle[1] - ego.y)
        if near and ahead < ego.length / 2 and any(c.id == o.id for c in closures):
            wrong[o.id] = "passed"
            warnings.append(f"the ego starts beyond the stop line of lanelet {-o.id - 1}: its light is left out")
    return [c for c in closures if c.id not in wrong]
