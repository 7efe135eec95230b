"""What each named manoeuvre must look like: one criterion each, judged from the world, never from the planner's view.

A criterion returns what is wrong in a few words; empty: nothing. Every manoeuvre must also stay on the road and have no
collision at fault. Most must reach their goal; what else they must do stands here.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from common.geometry import Polyline, distance_between_rectangles, rectangle_corners
from common.messages import F64
from evaluation.planning import corridor
from evaluation.planning.recorder import Recorder
from rig.world import Scenario

Entry = dict[str, Any]
Criterion = Callable[[Scenario, Recorder, Entry], str]


def judge(family: str, scenario: Scenario, record: Recorder, entry: Entry) -> str:
    """What is wrong with a drive through this manoeuvre; empty: it passes."""
    if entry["collision_at_fault"]:
        return f"collision at fault: {entry['collisions'][0]['why']}"
    if entry["off_road"]:
        return f"{entry['off_road_m']} m off the road"
    if family not in NEEDS_NO_GOAL and not entry["goal"]:
        return "the goal is not reached"
    return CRITERIA[family](scenario, record, entry) if family in CRITERIA else ""


# --- what there is to look at ---


def speeds(record: Recorder) -> F64:
    """Driven speed at each state [m/s]."""
    return np.array([e.speed for e in record.ego])


def offsets(scenario: Scenario, record: Recorder) -> F64:
    """Offset of the ego's centre from the route at each frame [m]."""
    at = np.array([(record.ego[row].x, record.ego[row].y) for row in record.at_frame])
    return np.asarray(Polyline.of(scenario.route.reference).project(at)[1])


def clearances(record: Recorder) -> F64:
    """Distance to the nearest body at each frame [m]."""
    found = []
    for k, row in enumerate(record.at_frame):
        e, o = record.ego[row], record.frames[k]
        if not len(o.id):
            found.append(math.inf)
            continue
        mine = rectangle_corners(e.x, e.y, e.heading, e.length, e.width)
        found.append(float(distance_between_rectangles(mine, corridor.bodies(o)).min()))
    return np.array(found)


def gaps(scenario: Scenario, record: Recorder) -> F64:
    """Gap to the one ahead on the route at each frame [m]; infinite: nobody within 80 m."""
    line = Polyline.of(scenario.route.reference)
    found = []
    for k, row in enumerate(record.at_frame):
        e, o = record.ego[row], record.frames[k]
        s = float(line.project(np.array([e.x, e.y]))[0])
        velocity = np.stack((o.vx, o.vy), axis=-1)
        found.append(corridor.leader(line, s, e.length / 2, e.width / 2, corridor.bodies(o), velocity, 80.0).gap)
    return np.array(found)


def at_frames(record: Recorder) -> F64:
    """Driven speed at each frame [m/s]."""
    return np.array([record.ego[row].speed for row in record.at_frame])


def times(record: Recorder) -> F64:
    """Time of each frame [s]."""
    return np.array([record.t[row] for row in record.at_frame])


def front_to(scenario: Scenario, record: Recorder, id: int) -> F64:
    """Distance along the route from the ego's front to an obstacle's line at each frame [m]; negative: beyond it."""
    assert scenario.map is not None
    line = Polyline.of(scenario.route.reference)
    at = next(s for s, i, _ in corridor.stops_along(line, scenario.map, 1.0) if i == id)
    centre = np.array([(record.ego[row].x, record.ego[row].y) for row in record.at_frame])
    return np.asarray(at - line.project(centre)[0] - record.ego[0].length / 2)


# --- the criteria ---


def _comfortable_turn(scenario: Scenario, record: Recorder, entry: Entry) -> str:
    """Lateral acceleration as a passenger likes it, near the line."""
    if entry["max_accel_lat"] > 2.0:
        return f"lateral acceleration {entry['max_accel_lat']} m/s² in a turn"
    off = float(np.abs(offsets(scenario, record)).max())
    return f"{off:.1f} m beside the line" if off > 2.0 else ""


def _free_road(scenario: Scenario, record: Recorder, entry: Entry) -> str:
    """As fast as the IDM, without hunting."""
    if (entry["efficiency"] or 0.0) < 0.95:
        return f"{entry['efficiency']:.0%} of the IDM's way"
    return f"{entry['sign_changes_per_min']} sign changes a minute" if entry["sign_changes_per_min"] > 5 else ""


def _headway(scenario: Scenario, record: Recorder, entry: Entry) -> str:
    """Time gap ≥ 0.8 s at speed, gap ≥ 1.5 m always."""
    gap, v = gaps(scenario, record), at_frames(record)
    fast = v > 5.0
    if (gap < 1.5).any():
        return f"only {gap.min():.1f} m behind the lead"
    headway = float((gap[fast] / v[fast]).min()) if fast.any() else math.inf
    return f"headway {headway:.2f} s" if headway < 0.8 else ""


def _steady_following(scenario: Scenario, record: Recorder, entry: Entry) -> str:
    """Headway, and as far as the IDM."""
    wrong = _headway(scenario, record, entry)
    if wrong:
        return wrong
    share = entry["efficiency"] or 0.0
    return f"{share:.0%} of the IDM's way" if share < 0.85 else ""


def _stands_behind(scenario: Scenario, record: Recorder, entry: Entry) -> str:
    """Standing behind somebody: 1.5 to 8 m."""
    gap, v = gaps(scenario, record), at_frames(record)
    stood = (v < 0.1) & (times(record) > 2.0) & (gap < 60.0)
    if (gap < 1.0).any():
        return f"only {gap.min():.1f} m behind the lead"
    if not stood.any():
        return ""
    near, far = float(gap[stood].min()), float(np.median(gap[stood]))
    return f"stands {near:.1f} m behind" if near < 1.5 else f"stands {far:.1f} m behind" if far > 9.0 else ""


def _no_contact(scenario: Scenario, record: Recorder, entry: Entry) -> str:
    """Nobody is touched, whoever's fault."""
    return "a collision" if entry["collision"] else ""


def _cut_in(scenario: Scenario, record: Recorder, entry: Entry) -> str:
    """Gives room: 1 m at least, and a headway of 0.8 s within 6 s."""
    gap, v, t = gaps(scenario, record), at_frames(record), times(record)
    if float(clearances(record).min()) < 0.7:
        return f"clearance {clearances(record).min():.1f} m"
    begin = t[np.isfinite(gap) & (gap < 40)]
    later = t > (begin[0] + 6.0 if len(begin) else 0.0)
    headway = float((gap[later] / np.maximum(v[later], 1.0)).min()) if later.any() else math.inf
    return f"headway {headway:.2f} s after 6 s" if headway < 0.8 else ""


def _overtaking(scenario: Scenario, record: Recorder, entry: Entry) -> str:
    """The paper's figure: no stop, clearance kept, back in the lane."""
    if speeds(record).min() < 2.0:
        return f"slows to {speeds(record).min():.1f} m/s"
    near = float(clearances(record).min())
    if near < 0.8:
        return f"passes at {near:.2f} m"
    off = float(offsets(scenario, record)[-1])
    return f"ends {off:.1f} m beside its lane's centre" if abs(off) > 0.6 else ""


def beside_speed(record: Recorder) -> float | None:
    """Least speed while the bodies overlap along the road, as a share of the speed before [ ]."""
    track, v = [], at_frames(record)
    for k, row in enumerate(record.at_frame):
        e, o = record.ego[row], record.frames[k]
        c, s = math.cos(e.heading), math.sin(e.heading)
        ahead = c * (o.x - e.x) + s * (o.y - e.y)
        track.append(bool((np.abs(ahead) < (o.length + e.length) / 2).any()))
    beside = np.array(track)
    return float(v[beside].min() / v[0]) if beside.any() else None


def _truck(scenario: Scenario, record: Recorder, entry: Entry) -> str:
    """The paper's vehicle test: beside a truck 5 to 15 % slower."""
    share = beside_speed(record)
    if share is None:
        return "never beside the truck"
    return "" if 0.85 <= share <= 0.95 else f"{share - 1:+.0%} beside the truck"


def _car_beside(scenario: Scenario, record: Recorder, entry: Entry) -> str:
    """Beside a car no slower."""
    share = beside_speed(record)
    if share is None:
        return "never beside the car"
    return "" if share >= 0.97 else f"{share - 1:+.0%} beside the car"


def _crossing(scenario: Scenario, record: Recorder, entry: Entry) -> str:
    """Lets the one who crosses go, and goes on."""
    near = float(clearances(record).min())
    return f"passes at {near:.2f} m" if near < 0.8 else ""


def _passes(scenario: Scenario, record: Recorder, entry: Entry) -> str:
    """Nobody touched, 0.3 m kept."""
    near = float(clearances(record).min())
    return _no_contact(scenario, record, entry) or (f"passes at {near:.2f} m" if near < 0.3 else "")


def _stop_line(scenario: Scenario, record: Recorder, entry: Entry) -> str:
    """Stands before a closed line, not far from it."""
    closed = scenario.closures[0]
    front, t, v = front_to(scenario, record, closed.id), times(record), at_frames(record)
    shut = t < closed.end_s
    if front[shut].min() < 0.0:
        return f"{-front[shut].min():.1f} m beyond a closed line"
    stood = shut & (v < 0.1)
    if not stood.any():
        return ""  # arrives as it opens
    return f"stands {front[stood].min():.1f} m before the line" if front[stood].min() > 8.0 else ""


def _dead_end(scenario: Scenario, record: Recorder, entry: Entry) -> str:
    """Stands before the barrier, and says why."""
    assert scenario.map is not None
    front = front_to(scenario, record, scenario.map.obstacles[0].id)
    if at_frames(record)[-1] > 0.1:
        return f"still moves at {at_frames(record)[-1]:.1f} m/s"
    if not 0.3 <= front[-1] <= 10.0:
        return f"stands {front[-1]:.1f} m before the barrier"
    return "" if entry["end_reason"] else "stands without a reason"


NEEDS_NO_GOAL = ("dead_end",)
CRITERIA: dict[str, Criterion] = {
    "straight": _free_road,
    "following": _steady_following,
    "stop_and_go": _stands_behind,
    "hard_braking_lead": _no_contact,
    "cut_in": _cut_in,
    "slow_pedestrian": _overtaking,
    "truck_adjacent": _truck,
    "car_adjacent": _car_beside,
    "crossing_pedestrian": _crossing,
    "crossing_cyclist": _crossing,
    "left_turn": _comfortable_turn,
    "right_turn": _comfortable_turn,
    "u_turn": _comfortable_turn,
    "unprotected_left": _passes,
    "ramp_merge": _passes,
    "lane_ends": _passes,
    "roundabout": _passes,
    "red_light": _stop_line,
    "stop_line": _stop_line,
    "double_parked": _passes,
    "blocked_road": _stands_behind,
    "queue": _stands_behind,
    "narrow_street": _no_contact,
    "dead_end": _dead_end,
    "demo": _no_contact,
}
"""By the manoeuvre's name."""
