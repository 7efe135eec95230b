"""Manoeuvres along a road: following, overtaking, standing in line, being blocked."""

from __future__ import annotations

import numpy as np

from common.messages import FRAME_S, ObjectClass
from rig.sources import roads
from rig.sources.building import (
    BEHIND_M,
    LIMIT,
    REST_M,
    Draw,
    Road,
    along,
    barrier,
    crossing,
    drive,
    one_way,
    shifting,
    standing,
    stop_line,
    travelled,
    two_way,
)
from rig.world import Closure, Scenario

CAR, TRUCK, PEDESTRIAN, BICYCLE = ObjectClass.CAR, ObjectClass.TRUCK, ObjectClass.PEDESTRIAN, ObjectClass.BICYCLE
LIGHT = 90
"""Id of a stop line."""
INTRUSION_M = 1.75 + 0.9 - 0.3
"""A car whose centre is nearer to a lane's than this reaches 0.3 m into it [m]."""
EGO_LENGTH_M = 4.5
"""And that of a car: between two centres when the bumpers touch [m]."""


def straight(draw: Draw) -> Scenario:
    """An empty road of two lanes."""
    speed = draw.about(10.0, 3.0)
    road = two_way(draw, BEHIND_M + 200.0 + REST_M)
    return drive("straight", "Empty straight road", road, 22.0, speed, 200.0)


def following(draw: Draw) -> Scenario:
    """A car ahead in a one-lane street slows down, speeds up again; there is no way past it."""
    goal, duration = 150.0, 30.0
    road = one_way(draw, BEHIND_M + goal + 3 * REST_M)
    slow = draw.about(4.0, 1.0)
    lead = travelled(duration, [(0, 9), (6, 9), (9, slow), (14, slow), (19, 10), (30, 10)])
    car = along(1, CAR, road.line, BEHIND_M + draw.about(28.0, 5.0) + lead)
    title = "Following a car that slows down and speeds up"
    return drive("following", title, road, duration, draw.about(11.0, 1.0), goal, [car])


def stop_and_go(draw: Draw) -> Scenario:
    """Behind a car that stops twice and goes on, in a one-lane street."""
    goal, duration = 110.0, 38.0
    road = one_way(draw, BEHIND_M + goal + 3 * REST_M)
    top, wait = draw.about(6.0, 1.0), draw.about(9.0, 1.5)
    speeds = [(0, top), (4, top), (7, 0), (wait, 0), (wait + 4, top), (wait + 7, top), (wait + 10, 0), (wait + 12, 0)]
    lead = travelled(duration, [*speeds, (wait + 17, 9), (duration, 9)])
    car = along(1, CAR, road.line, BEHIND_M + draw.about(18.0, 3.0) + lead)
    return drive("stop_and_go", "Stop and go behind a car", road, duration, draw.about(6.5, 1.0), goal, [car])


def hard_braking_lead(draw: Draw) -> Scenario:
    """The car ahead brakes to a standstill as hard as it can, waits and drives on."""
    goal, duration = 140.0, 32.0
    road = one_way(draw, BEHIND_M + goal + 3 * REST_M)
    speed, begin, brake = draw.about(12.0, 1.0), draw.about(3.0, 1.0), draw.about(6.5, 1.0)
    halt = begin + speed / brake
    lead = travelled(duration, [(0, speed), (begin, speed), (halt, 0), (halt + 5, 0), (halt + 12, 10), (duration, 10)])
    car = along(1, CAR, road.line, BEHIND_M + draw.about(24.0, 3.0) + lead)
    return drive("hard_braking_lead", "The lead brakes hard", road, duration, speed, goal, [car])


def cut_in(draw: Draw) -> Scenario:
    """A slower car from the lane to the left moves close in front of the ego.

    As close as can be asked of anybody to avoid: where it intrudes, an ego at the limit is not below the time to
    collision of UN Regulation 157, 5.2.5.2.
    """
    goal, duration = 210.0, 28.0
    road = one_way(draw, BEHIND_M + goal + 2 * REST_M, lanes=2)
    speed, gap = draw.about(10.5, 0.8), draw.about(16.0, 2.0)
    beside = shifting(duration, draw.about(2.0, 0.7), draw.about(3.5, 0.7), 3.5, 0.0)
    closing = max(LIMIT - speed, 0.0)
    intrudes = FRAME_S * int(np.argmax(beside < INTRUSION_M))
    gap = max(gap, EGO_LENGTH_M + closing * (intrudes + closing / (2.0 * 6.0) + 0.35))
    way = BEHIND_M + gap + travelled(duration, [(0, speed), (6, speed), (14, 12), (duration, 12)])
    return drive(
        "cut_in", "Cut-in", road, duration, draw.about(13.0, 0.6), goal, [along(1, CAR, road.line, way, beside)]
    )


def slow_pedestrian(draw: Draw) -> Scenario:
    """A pedestrian walks in the lane along its right edge; the ego has room to pass on the left."""
    goal, duration = 130.0, 25.0
    road = two_way(draw, BEHIND_M + goal + REST_M)
    walk = travelled(duration, [(0, draw.about(1.2, 0.3))])
    walker = along(1, PEDESTRIAN, road.line, BEHIND_M + draw.about(45.0, 8.0) + walk, draw.about(-1.3, 0.15))
    title = "Overtaking a slow pedestrian at the roadside"
    return drive("slow_pedestrian", title, road, duration, draw.about(8.3, 1.0), goal, [walker])


def truck_adjacent(draw: Draw, cls: ObjectClass = TRUCK) -> Scenario:
    """At 50 km/h past a slower truck in the next lane; both centred in lanes of 3.5 m."""
    goal, duration = 300.0, 28.0
    road = one_way(draw, BEHIND_M + goal + 2 * REST_M, lanes=2)
    speed = draw.about(10.0, 0.8)
    other = along(1, cls, road.line, BEHIND_M + draw.about(35.0, 6.0) + travelled(duration, [(0, speed)]), 3.5)
    word = "truck" if cls == TRUCK else "car"
    title = f"Past a {word} in the adjacent lane at 50 km/h"
    return drive(f"{word}_adjacent", title, road, duration, LIMIT, goal, [other])


def car_adjacent(draw: Draw) -> Scenario:
    """The same past a car: no reason to slow down."""
    return truck_adjacent(draw, CAR)


def crossing_pedestrian(draw: Draw) -> Scenario:
    """A pedestrian steps off the pavement and crosses in front of the ego."""
    goal, duration = 120.0, 25.0
    road = two_way(draw, BEHIND_M + goal + REST_M)
    at = BEHIND_M + draw.about(50.0, 4.0)
    walk = travelled(duration, [(0, draw.about(1.3, 0.2))])
    walker = crossing(1, PEDESTRIAN, road.line, at, 6.5, 12.0, walk)
    return drive(
        "crossing_pedestrian", "A pedestrian crosses the road", road, duration, draw.about(10.0, 1.0), goal, [walker]
    )


def crossing_cyclist(draw: Draw) -> Scenario:
    """A cyclist crosses the road from the right without waiting."""
    goal, duration = 120.0, 25.0
    road = two_way(draw, BEHIND_M + goal + REST_M)
    at, speed = BEHIND_M + draw.about(50.0, 4.0), draw.about(4.2, 0.5)
    ride = travelled(duration, [(0, speed)])
    rider = crossing(1, BICYCLE, road.line, at, draw.about(19.0, 2.0), 110.0, ride)
    return drive("crossing_cyclist", "A cyclist crosses the road", road, duration, draw.about(10.0, 1.0), goal, [rider])


def stop_line_closed(draw: Draw) -> Scenario:
    """A barrier is down across a street; after some seconds it goes up."""
    goal, duration = 130.0, 34.0
    road = two_way(draw, BEHIND_M + goal + REST_M)
    road = stop_line(LIGHT, road, BEHIND_M + draw.about(60.0, 5.0))
    closed = Closure(LIGHT, 0.0, draw.about(14.0, 2.0))
    title = "A stop line that is closed, then opens"
    return drive("stop_line", title, road, duration, draw.about(10.0, 1.0), goal, closures=[closed])


def double_parked(draw: Draw) -> Scenario:
    """A car stands in the ego's lane; the way around it is the oncoming lane, in which two cars come."""
    goal, duration = 130.0, 36.0
    road = two_way(draw, BEHIND_M + goal + 2 * REST_M)
    at = BEHIND_M + draw.about(55.0, 4.0)
    parked = standing(1, CAR, road.line, at, duration, draw.about(-0.5, 0.15))
    way, speed = road.ways["oncoming"], draw.about(8.5, 0.7)
    meets = way.length - at  # where an oncoming car passes the parked one
    first = draw.about(4.5, 1.0)  # s, when the first does so
    cars = [
        along(2 + k, CAR, way, meets - speed * when + travelled(duration, [(0, speed)]), -3.5)
        for k, when in enumerate((first, first + draw.about(3.5, 0.5)))
    ]
    title = "Around a double-parked car, with oncoming traffic"
    return drive("double_parked", title, road, duration, draw.about(9.0, 0.7), goal, [parked, *cars])


def blocked_road(draw: Draw) -> Scenario:
    """A truck stands in a one-lane street; after a while it drives on."""
    goal, duration = 120.0, 36.0
    road = one_way(draw, BEHIND_M + goal + 4 * REST_M)
    wait = draw.about(14.0, 2.0)
    move = travelled(duration, [(0, 0), (wait, 0), (wait + 8, 9), (duration, 9)])
    truck = along(1, TRUCK, road.line, BEHIND_M + draw.about(62.0, 6.0) + move)
    return drive("blocked_road", "A blocked road", road, duration, draw.about(9.5, 1.0), goal, [truck])


def queue(draw: Draw) -> Scenario:
    """Cars stand in line and move up one after another."""
    goal, duration = 95.0, 38.0
    road = one_way(draw, BEHIND_M + goal + 4 * REST_M)
    cars = []
    for k in range(4):
        begin = draw.about(9.0, 1.0) + 1.2 * (3 - k)
        creep = draw.about(2.2, 0.4)
        speeds = [(0, 0), (begin, 0), (begin + 2, creep), (begin + 7, creep), (begin + 9, 0), (begin + 13, 0)]
        move = travelled(duration, [*speeds, (begin + 18, 8), (duration, 8)])
        cars.append(along(k + 1, CAR, road.line, BEHIND_M + 55.0 + 7.0 * k + move))
    return drive("queue", "The end of a queue that moves up", road, duration, draw.about(10.0, 1.0), goal, cars)


def narrow_street(draw: Draw) -> Scenario:
    """Between parked cars, one of which opens a door."""
    goal, duration = 110.0, 34.0
    road = one_way(draw, BEHIND_M + goal + REST_M, width=7.2)
    cars = [
        standing(
            k + 1,
            CAR,
            road.line,
            BEHIND_M + 22.0 + 7.5 * (k // 2) + draw.about(0.0, 0.6),
            duration,
            side,
            backwards=back,
        )
        for k in range(16)
        for side, back in [((-2.65, False), (2.65, True))[k % 2]]
    ]
    opens = draw.about(2.5, 1.0)
    swing = travelled(duration, [(0, 0), (opens, 0), (opens + 0.1, 1.0), (opens + 0.7, 1.0), (opens + 0.8, 0.0)])
    at = BEHIND_M + 22.0 + 7.5 * 4 + draw.about(0.0, 2.0)
    door = crossing(40, ObjectClass.UNKNOWN, road.line, at, 2.25, 2.0, swing)
    title = "A narrow street with an opening door"
    return drive(
        "narrow_street", title, road, duration, draw.about(7.0, 1.0), goal, [*cars, door], limit=8.4, lane_width=7.2
    )


def dead_end(draw: Draw) -> Scenario:
    """The street is closed by a barrier; there is no way on."""
    goal, duration = 130.0, 24.0
    road = one_way(draw, BEHIND_M + goal + REST_M)
    road = barrier(91, road, BEHIND_M + draw.about(80.0, 8.0), 1.75, 1.75)
    return drive("dead_end", "A dead end", road, duration, draw.about(9.0, 1.0), goal)


def demo(draw: Draw) -> Scenario:
    """Half a minute of town: a roadside pedestrian, oncoming traffic, people crossing, a cyclist; on a gentle bend."""
    goal, duration = 230.0, 36.0
    bend = [(BEHIND_M + 70.0, 0.0, 0.0), *roads.turn(0.6, 150.0, 20.0), (goal + REST_M, 0.0, 0.0)]
    line = roads.line_of(bend, (0.0, 0.0, draw.heading))
    ego_line = roads.smooth(roads.beside(line, -1.75))
    road = Road(roads.two_way(line), ego_line)
    walk = travelled(duration, [(0, 1.1)])
    walker = along(1, PEDESTRIAN, ego_line, BEHIND_M + draw.about(40.0, 5.0) + walk, -1.35)
    oncoming = roads.smooth(ego_line.points[::-1])
    tracks = [walker]
    for k, (cls, away, speed) in enumerate([(CAR, 150.0, 10.0), (TRUCK, 230.0, 9.0), (CAR, 300.0, 10.0)]):
        s = oncoming.length - BEHIND_M - draw.about(away, 8.0) + travelled(duration, [(0, draw.about(speed, 1.0))])
        tracks.append(along(2 + k, cls, oncoming, s, -3.5))
    at = BEHIND_M + 150.0
    for k, wait in enumerate((9.0, 10.5, 12.0)):
        begin = draw.about(wait, 0.5)
        steps = travelled(duration, [(0, 0), (begin, 0), (begin + 0.4, 1.35)])
        tracks.append(crossing(5 + k, PEDESTRIAN, ego_line, at + 0.7 * (1 - k), 4.0 + 0.8 * k, 9.0, steps))
    ride = travelled(duration, [(0, draw.about(3.8, 0.3))])
    tracks.append(along(8, BICYCLE, ego_line, BEHIND_M + 175.0 + ride, -1.3))
    return drive("demo", "Half a minute of town traffic", road, duration, draw.about(9.0, 0.5), goal, tracks)
