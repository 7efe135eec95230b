"""Situations among those who drive the ego's way: following, changing lanes, merging, passing.

The ego's lane runs along x at y = 0; its front is at x = `FRONT` at t = 0. h: hazardous if nominal.
"""

from __future__ import annotations

import numpy as np

from common.geometry import Polyline
from common.messages import F64, Map, ObjectClass
from evaluation.hazards.episode import Actor, Episode, grid
from evaluation.hazards.script import Draw, actor, shift, standing, straight, travelled
from rig.sources import roads
from rig.world import EGO_SIZE

LANE = 3.5
"""Width of a lane [m]."""
FRONT = EGO_SIZE[0] / 2
"""The ego's front bumper at t = 0 [m]."""
LINE = straight(-300.0, 0.0, 900.0, 0.0)
"""Centre of the ego's lane."""
LONG_S = 10.0
"""How long an episode lasts [s]."""


def road(lanes: int, ego_lane: int, limit: float) -> Map:
    """Lanes one way along x; the ego's is number `ego_lane` from the right."""
    line = np.array([(-300.0, -ego_lane * LANE), (900.0, -ego_lane * LANE)])
    return Map(lanes=roads.one_way(line, lanes, LANE, limit))


def episode(
    name: str, draw: Draw, map: Map, speed: float, actors: list[Actor], onset_s: float | None, path: Polyline = LINE
) -> Episode:
    """An episode in which the ego's centre starts 300 m along its path."""
    return Episode(name, map, path, speed, 300.0, LONG_S, tuple(actors), onset_s, draw.values)


def lane_change(t: F64, draw: Draw, start: float, duration: float, d0: float, d1: float) -> F64:
    """Offset of somebody who changes lanes from d0 to d1 [m], swaying a little."""
    return d0 + shift(t, start, duration, d1 - d0) + draw.wander(t)


def cut_in_short(draw: Draw) -> Episode:
    """h: a slower car in the next lane changes in front of the ego, so close that it would be run into."""
    t, v, size = grid(LONG_S), draw("speed", 20.0, 12.0, 28.0), draw.car()
    slower, side = draw("slower", 5.0, 3.0, 8.0), draw.side("side")
    start, duration = draw("start", 2.0, 1.5, 3.0), draw("duration", 3.0, 2.5, 4.5)
    gap = slower * draw("closes_in", 3.5, 2.6, 5.0)  # at the start of the lane change, bumper to bumper
    rear = FRONT + gap + slower * start
    s = 300.0 + rear + size[0] / 2 + travelled(t, [(0.0, v - slower)])
    car = actor(ObjectClass.CAR, size, LINE, s, lane_change(t, draw, start, duration, side * LANE, 0.0))
    return episode("cut_in_short", draw, road(3, 1, 33.0), v, [car], start)


def cut_in_wide(draw: Draw) -> Episode:
    """A slightly slower car changes into the ego's lane at a good distance and then speeds up."""
    t, v, size = grid(LONG_S), draw("speed", 20.0, 12.0, 28.0), draw.car()
    slower, side = draw("slower", 2.0, 0.0, 3.5), draw.side("side")
    start, duration = draw("start", 2.0, 1.5, 3.0), draw("duration", 3.0, 2.5, 4.5)
    gap = v * draw("time_gap", 1.8, 1.4, 2.4)
    until = start + 0.6 * duration  # then it speeds up with 1.5 m/s²
    rear = FRONT + gap + slower * start
    speeds = [(until, v - slower), (until + (slower + 1.0) / 1.5, v + 1.0)]
    s = 300.0 + rear + size[0] / 2 + travelled(t, speeds)
    car = actor(ObjectClass.CAR, size, LINE, s, lane_change(t, draw, start, duration, side * LANE, 0.0))
    return episode("cut_in_wide", draw, road(3, 1, 33.0), v, [car], None)


def cut_out_reveals_standing_car(draw: Draw) -> Episode:
    """h: the car ahead changes lanes late; behind it a standing car comes to light in the ego's lane."""
    t, v, size = grid(LONG_S), draw("speed", 16.0, 11.0, 22.0), draw.car()
    gap, side = v * draw("time_gap", 1.4, 1.1, 1.9), draw.side("side")
    lead_length = draw("lead_length", 4.8, 4.0, 8.0)
    reach = FRONT + v * draw("reached_at", 6.5, 5.5, 8.0)  # rear of the standing car
    ahead = draw("seen_ahead", 2.3, 1.9, 2.9)  # the lead changes lanes so long before it would reach it
    start = (reach - FRONT - gap - lead_length) / v - ahead
    duration = draw("duration", 2.2, 1.8, 2.6)
    s = 300.0 + FRONT + gap + lead_length / 2 + travelled(t, [(0.0, v)])
    lead = actor(ObjectClass.CAR, (lead_length, 1.9), LINE, s, lane_change(t, draw, start, duration, 0.0, side * LANE))
    still = standing(ObjectClass.CAR, size, reach + size[0] / 2, draw("offset", 0.0, -0.3, 0.3), 0.0, t)
    return episode("cut_out_reveals_standing_car", draw, road(3, 1, 25.0), v, [lead, still], start)


def lead_leaves_by_exit(draw: Draw) -> Episode:
    """The car ahead brakes while it moves over into the exit lane on the right; the ego's lane becomes free."""
    t, v, size = grid(LONG_S), draw("speed", 20.0, 14.0, 27.0), draw.car()
    gap = v * draw("time_gap", 1.8, 1.4, 2.4)
    brake, start = draw("braking", 2.0, 1.2, 2.8), draw("start", 1.5, 1.0, 2.5)
    begin, duration = start + draw("brakes_after", 0.0, -0.5, 0.8), draw("duration", 3.0, 2.5, 3.8)
    slow = v * draw("slows_to", 0.6, 0.45, 0.75)
    s = 300.0 + FRONT + gap + size[0] / 2 + travelled(t, [(begin, v), (begin + (v - slow) / brake, slow)])
    car = actor(ObjectClass.CAR, size, LINE, s, lane_change(t, draw, start, duration, 0.0, -LANE))
    return episode("lead_leaves_by_exit", draw, road(3, 1, 33.0), v, [car], None)


def braking_lead(draw: Draw) -> Episode:
    """h: the car ahead brakes hard to a stand."""
    t, v, size = grid(LONG_S), draw("speed", 15.0, 10.0, 28.0), draw.car()
    gap = v * draw("time_gap", 1.5, 1.2, 2.2)
    start, brake = draw("start", 2.5, 1.0, 4.0), draw("braking", 5.0, 3.5, 8.0)
    builds_up = (start + 0.2, v - 0.1 * brake)
    speeds = [(start, v), builds_up, (builds_up[0] + builds_up[1] / brake, 0.0)]
    s = 300.0 + FRONT + gap + size[0] / 2 + travelled(t, speeds)
    car = actor(ObjectClass.CAR, size, LINE, s, draw.wander(t))
    return episode("braking_lead", draw, road(2, 0, 33.0), v, [car], start)


def lead_slows_and_goes_on(draw: Draw) -> Episode:
    """The car ahead brakes for a moment, then goes on as fast as before."""
    t, v, size = grid(LONG_S), draw("speed", 16.0, 10.0, 27.0), draw.car()
    gap = v * draw("time_gap", 1.8, 1.5, 2.4)
    start, brake, lasts = draw("start", 2.0, 1.0, 4.0), draw("braking", 1.8, 1.0, 2.5), draw("lasts", 1.2, 0.8, 1.6)
    low = v - brake * lasts
    speeds = [(start, v), (start + lasts, low), (start + lasts + 0.5, low), (start + lasts + 0.5 + (v - low) / 1.8, v)]
    s = 300.0 + FRONT + gap + size[0] / 2 + travelled(t, speeds)
    car = actor(ObjectClass.CAR, size, LINE, s, draw.wander(t))
    return episode("lead_slows_and_goes_on", draw, road(2, 0, 33.0), v, [car], None)


def queue_end(draw: Draw) -> Episode:
    """h: the standing end of a queue in the ego's lane, the last car still rolling out."""
    t, v, size = grid(LONG_S), draw("speed", 18.0, 9.0, 25.0), draw.car()
    rest = FRONT + v * draw("reached_at", 6.5, 5.0, 8.0)
    brake, stops = draw("last_braking", 2.0, 1.5, 3.0), draw("last_stops", 1.5, -2.0, 3.5)
    speed = draw("last_speed", 6.0, 2.0, 8.0)
    s = travelled(t, [(stops - speed / brake, speed), (stops, 0.0)])
    s = 300.0 + rest + size[0] / 2 + s - s[-1]
    cars = [actor(ObjectClass.CAR, size, LINE, s)]
    for k in (1, 2):
        cars.append(standing(ObjectClass.CAR, (4.5, 1.8), rest + size[0] + 4.5 / 2 + 2.0 + 6.8 * (k - 1), 0.0, 0.0, t))
    return episode("queue_end", draw, road(2, 0, 25.0), v, cars, None)


def stopped_car_on_shoulder(draw: Draw) -> Episode:
    """A car stands on the shoulder, close to the lane."""
    t, v, size = grid(LONG_S), draw("speed", 20.0, 8.0, 28.0), draw.car()
    x = FRONT + v * draw("reached_at", 6.0, 4.0, 7.5)
    y = -(EGO_SIZE[1] + size[1]) / 2 - draw("clearance", 1.0, 0.7, 1.8)
    car = standing(ObjectClass.CAR, size, x + size[0] / 2, y, draw("angle", 0.0, -0.06, 0.06), t)
    return episode("stopped_car_on_shoulder", draw, road(2, 0, 33.0), v, [car], None)


def merge_side_swipe(draw: Draw) -> Episode:
    """h: beside the ego a car comes over from the ramp as if the ego were not there."""
    t, v, size = grid(LONG_S), draw("speed", 22.0, 14.0, 28.0), draw.car()
    relative = draw("relative_speed", 0.5, -0.8, 0.8)
    start, duration = draw("start", 2.5, 1.0, 3.5), draw("duration", 6.0, 5.2, 8.0)
    beside = draw("ahead", 2.0, -2.0, 4.0) - relative * (start + duration / 2)  # ahead of the ego half way over
    s = 300.0 + beside + travelled(t, [(0.0, v + relative)])
    car = actor(ObjectClass.CAR, size, LINE, s, lane_change(t, draw, start, duration, -LANE, 0.0))
    return episode("merge_side_swipe", draw, road(3, 1, 33.0), v, [car], start)


def overtaken_in_next_lane(draw: Draw) -> Episode:
    """A much faster car passes in the next lane and stays there."""
    t, v, size = grid(LONG_S), draw("speed", 20.0, 12.0, 26.0), draw.car()
    faster, beside = draw("faster", 8.0, 3.0, 12.0), draw("beside_at", 4.0, 2.0, 6.0)
    offset = LANE + draw("offset", 0.0, -0.45, 0.3)
    s = 300.0 - faster * beside + travelled(t, [(0.0, v + faster)])
    car = actor(ObjectClass.CAR, size, LINE, s, offset + draw.wander(t))
    return episode("overtaken_in_next_lane", draw, road(3, 1, 36.0), v, [car], None)


def truck_drifts(draw: Draw) -> Episode:
    """h: while the ego passes it, a truck drifts over the lane line."""
    t, v = grid(LONG_S), draw("speed", 22.0, 17.0, 28.0)
    size = draw("length", 12.0, 8.0, 16.0), draw("width", 2.5, 2.3, 2.6)
    slower, start = draw("slower", 5.0, 3.0, 8.0), draw("start", 1.5, 1.0, 2.5)
    lateral = draw("lateral_speed", 0.5, 0.35, 0.55)
    touch = start + (LANE - (size[1] + EGO_SIZE[1]) / 2) / lateral + 0.3
    rear = (
        FRONT - draw("beside", 4.0, 1.5, 8.0) + slower * touch
    )  # the ego's front is so far past its rear at the touch
    s = 300.0 + rear + size[0] / 2 + travelled(t, [(0.0, v - slower)])
    d = -LANE + np.clip(lateral * (t - start - 0.3), 0.0, 2.5) + draw.wander(t)
    truck = actor(ObjectClass.TRUCK, size, LINE, s, np.convolve(np.pad(d, 15, "edge"), np.ones(31) / 31, "valid"))
    return episode("truck_drifts", draw, road(3, 1, 33.0), v, [truck], start)


def pedestrian_alongside(draw: Draw) -> Episode:
    """A pedestrian walks along the edge of the lane, with or against the traffic."""
    t, v = grid(LONG_S), draw("speed", 12.0, 6.0, 15.0)
    walk = draw("walk", 1.4, 0.9, 2.0) * draw.side("way")
    x = FRONT + (v - walk) * draw("reached_at", 5.5, 3.5, 7.5)
    y = -EGO_SIZE[1] / 2 - 0.25 - draw("clearance", 1.0, 0.7, 1.8)
    line = straight(-300.0, y, 900.0, y) if walk > 0 else straight(900.0, y, -300.0, y)
    s = (300.0 + x if walk > 0 else 900.0 - x) + travelled(t, [(0.0, abs(walk))])
    person = actor(ObjectClass.PEDESTRIAN, (0.5, 0.5), line, s, 0.5 * draw.wander(t))
    return episode("pedestrian_alongside", draw, road(2, 0, 13.9), v, [person], None)


def door_zone_cyclist(draw: Draw) -> Episode:
    """h: a cyclist beside parked cars swerves into the lane around a door that opens."""
    t, v = grid(LONG_S), draw("speed", 10.0, 7.5, 13.0)
    ride, start = draw("ride", 4.5, 3.5, 5.5), draw("start", 2.5, 1.5, 3.5)
    lateral, duration = draw("swerve", 1.8, 1.5, 2.2), draw("duration", 1.8, 1.5, 2.4)
    reach = start + draw("reached_after", 3.2, 2.6, 4.2)
    rear = FRONT + (v - ride) * reach
    y = -draw("beside", 2.5, 2.3, 2.7)
    cyclist = actor(
        ObjectClass.BICYCLE, (1.8, 0.6), LINE, 300.0 + rear + 0.9 + travelled(t, [(0.0, ride)]),
        y + shift(t, start, duration, lateral),
    )  # fmt: skip
    door = rear + 0.9 + ride * (start + duration)
    return episode("door_zone_cyclist", draw, road(2, 0, 13.9), v, [cyclist, *_parked(t, door)], start)


def cyclist_straight(draw: Draw) -> Episode:
    """A cyclist rides straight on beside parked cars; there is room to pass."""
    t, v = grid(LONG_S), draw("speed", 10.0, 7.5, 13.0)
    ride = draw("ride", 4.5, 3.5, 5.5)
    rear = FRONT + (v - ride) * draw("reached_at", 5.0, 3.5, 7.0)
    y = -EGO_SIZE[1] / 2 - 0.3 - draw("clearance", 1.1, 0.8, 1.5)
    sway = draw("sway", 0.08, 0.0, 0.12) * np.sin(2 * np.pi * t / draw("sway_s", 3.0, 2.0, 5.0))
    cyclist = actor(ObjectClass.BICYCLE, (1.8, 0.6), LINE, 300.0 + rear + 0.9 + travelled(t, [(0.0, ride)]), y + sway)
    return episode("cyclist_straight", draw, road(2, 0, 13.9), v, [cyclist, *_parked(t, rear + 20.0)], None)


def _parked(t: F64, x: float) -> list[Actor]:
    """Three cars parked well to the right of the lane."""
    return [standing(ObjectClass.CAR, (4.5, 1.8), x + 5.0 + 6.0 * k, -4.2, 0.0, t) for k in (-1, 0, 1)]
