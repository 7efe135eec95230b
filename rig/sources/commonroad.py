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

from common.geometry import distance_between_rectangles, rectangle_corners
from common.messages import FRAME_S, Ego, Map
from rig.settings import RigSettings
from rig.sources import goals, lanelets, obstacles
from rig.sources.start import without_ego
from rig.world import Closure, Scenario, ScenarioError, Track, ego_at

SHARP_GOAL_S = 1.1  # s: a goal whose interval of time is no wider tells when the recorded driver was there


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
    tracks = obstacles.tracks_of(file, dt, step0, warnings)
    tracks, human = without_ego(tracks, ego0, warnings)
    goal_end = max(_last_step(s.time_step) for s in problem.goal.state_list) - step0
    last = max((k.last for k in tracks if len(k.x) > 1), default=round(goal_end * dt / FRAME_S))
    tracks = [obstacles.to_the_end(k, last) for k in tracks]
    duration = last * FRAME_S
    if duration < 1.0:
        raise ScenarioError(f"only {duration:.1f} s of traffic are recorded")
    fallback, kind = _fallback_limit(file, path, settings)
    map = lanelets.read_map(file.lanelet_network, fallback, warnings)
    if kind:
        unsigned = sum(k.speed_limit == fallback for k in map.lanes)
        if unsigned == len(map.lanes):
            warnings.append(f"the map has no speed limits: {fallback:g} m/s ({kind}) is assumed")
    route = goals.route_to(map, problem, ego0, goal_end * dt, warnings)
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
