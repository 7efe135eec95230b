"""Manoeuvres where lanes become one: a ramp, a lane that ends."""

from __future__ import annotations

import msgspec
import numpy as np

from common.geometry import Polyline
from common.messages import F64, Lane
from rig.sources import roads
from rig.sources.building import BEHIND_M, LIMIT, REST_M, Draw, Road, along, connector, drive, travelled
from rig.sources.on_road import CAR, TRUCK
from rig.world import Scenario

WIDTH = 3.5


def narrowing(draw: Draw, shift_m: float, over_m: float, spare_m: float, length_m: float, limit: float) -> Road:
    """A right lane that ends beside a left one that goes on.

    The ego's line changes to the left one between arc lengths `shift_m` and `shift_m + over_m`; the right lane tapers
    away over the 40 m before `shift_m + over_m + spare_m`.
    """
    moved, ends = shift_m + over_m, shift_m + over_m + spare_m
    x = np.linspace(0.0, over_m, 41)
    u = x / over_m
    points = [(0.0, 0.0), *zip(shift_m + x, WIDTH * u**3 * (10.0 - 15.0 * u + 6.0 * u * u), strict=True)]
    points += [(f, WIDTH) for f in np.arange(moved + 2.0, length_m, 2.0)]
    line = Polyline.of(draw.places(points)).resampled(1.0)
    whole = Polyline.of(draw.line(0.0, length_m))

    def part(a: float, b: float) -> F64:
        return whole.cut(a, b).resampled(1.0).points

    last = roads.lane(12, part(shift_m, ends), 0.0, limit=limit, left_lane=2)
    lanes = [
        roads.lane(1, part(0.0, shift_m), 0.0, limit=limit, successors=[12, 40], left_lane=2),
        _tapered(draw, last, shift_m, ends),
        roads.lane(
            2, part(0.0, ends), WIDTH, limit=limit, left="road_edge", right="dashed", right_lane=1, successors=[3]
        ),
        roads.lane(3, part(ends, length_m), WIDTH, limit=limit, left="road_edge"),
        msgspec.structs.replace(connector(40, line.cut(shift_m, moved).points, [2, 3]), speed_limit=limit),
    ]
    return Road(lanes, line, lane_ids=(1, 40, 2, 3), ways={"main": Polyline.of(draw.line(0.0, length_m, WIDTH))})


def _tapered(draw: Draw, lane: Lane, begin: float, ends: float) -> Lane:
    """The lane with its right edge coming in over its last 40 m, half a metre of it left at the end."""
    f = np.arange(begin, ends + 0.5, 1.0)
    right = -WIDTH / 2 + (WIDTH - 0.5) * np.clip((f - (ends - 40.0)) / 40.0, 0.0, 1.0)

    def at(left: F64) -> F64:
        return np.ascontiguousarray(draw.places(list(zip(f, left, strict=True))))

    return msgspec.structs.replace(lane, right=at(right), centre=at((right + WIDTH / 2) / 2), right_type="road_edge")


def ramp_merge(draw: Draw) -> Scenario:
    """From a ramp into a stream of faster cars, within the length of the ramp's lane."""
    goal, duration, limit = 260.0, 32.0, 16.7
    road = narrowing(draw, BEHIND_M + 60.0, 50.0, 60.0, BEHIND_M + goal + 2 * REST_M, limit)
    way, speed = road.ways["main"], draw.about(14.5, 0.7)
    s = BEHIND_M + draw.about(20.0, 8.0)
    cars = []
    for k, gap in enumerate((0.0, draw.about(34.0, 4.0), draw.about(36.0, 4.0), draw.about(60.0, 6.0))):
        s -= gap
        cls = TRUCK if k == 1 else CAR
        cars.append(along(k + 1, cls, way, s + travelled(duration, [(0, speed)])))
    return drive("ramp_merge", "Merging from a ramp", road, duration, draw.about(12.0, 1.0), goal, cars, limit=limit)


def lane_ends(draw: Draw) -> Scenario:
    """The ego's lane ends; a car drives beside it."""
    goal, duration = 220.0, 30.0
    road = narrowing(draw, BEHIND_M + 60.0, 40.0, 40.0, BEHIND_M + goal + 2 * REST_M, LIMIT)
    way, speed = road.ways["main"], draw.about(11.5, 0.6)
    s = BEHIND_M + draw.about(0.0, 8.0)
    cars = [
        along(k + 1, CAR, way, s + ahead + travelled(duration, [(0, speed)]))
        for k, ahead in enumerate((0.0, draw.about(38.0, 4.0), draw.about(-40.0, 5.0)))
    ]
    return drive("lane_ends", "A lane ends", road, duration, draw.about(12.0, 1.0), goal, cars)
