"""A recording with a grace time: the record to the letter, then people who drive on and look where they go."""

from dataclasses import replace

import msgspec
import numpy as np

from common.geometry import Polyline, distance_between_rectangles
from common.messages import ObjectClass
from evaluation.planning import corridor
from evaluation.planning.prolonged import AT_LEAST_S, prolonged
from evaluation.planning.reactive import Reactive
from rig.sources import load_scenario
from rig.sources.building import BEHIND_M, Draw, along, drive, one_way, travelled

RECORDED_S = 6.0


def _world(*cars, length: float = 400.0):
    """A straight road with cars given by (id, metres ahead of the ego, speed), recorded for a few seconds."""
    road = one_way(Draw(0), length)
    tracks = [
        along(i, ObjectClass.CAR, road.line, BEHIND_M + ahead + travelled(RECORDED_S, [(0, speed)]))
        for i, ahead, speed in cars
    ]
    return drive("made", "", road, RECORDED_S, 0.0, 100.0, tracks)


def _played(scenario, recorded_s: float):
    traffic, found = Reactive(scenario, recorded_s), []
    far = msgspec.structs.replace(scenario.ego0, x=1e4, y=1e4)
    for k in range(round(scenario.duration_s * 10) + 1):
        traffic.advance(k * 0.1, far)
        found.append(traffic.objects_at(k * 0.1))
    return found


def test_until_its_end_the_record_is_what_it_was_and_then_everybody_goes_on_at_his_last_speed():
    s = load_scenario("roundabout")
    cut = replace(s, duration_s=8.0, tracks=tuple(_until(k, 80) for k in s.tracks if k.frame0 < 60))
    longer = prolonged(cut)
    assert longer.duration_s == 8.0 + AT_LEAST_S
    for a, b in zip(cut.tracks, longer.tracks, strict=True):
        np.testing.assert_array_equal(b.x[: len(a.x)], a.x)
        np.testing.assert_array_equal(b.y[: len(a.y)], a.y)
        speed = np.hypot(np.diff(b.x), np.diff(b.y))[len(a.x) :] / 0.1
        if len(speed) and a.last == 80:
            last = float(np.hypot(a.x[-1] - a.x[-6], a.y[-1] - a.y[-6])) / 0.5
            np.testing.assert_allclose(speed, last, atol=0.35 + 0.05 * last)


def _until(track, last: int):
    n = min(len(track.x), last - track.frame0 + 1)
    return replace(track, x=track.x[:n], y=track.y[:n], heading=track.heading[:n])


def test_who_left_before_the_end_does_not_come_back_and_who_stood_stands():
    s = _world((1, 30.0, 10.0), (2, 60.0, 0.0))
    gone = _until(s.tracks[0], 30)
    longer = prolonged(replace(s, tracks=(gone, s.tracks[1])))
    assert longer.tracks[0].last == 30
    assert np.ptp(longer.tracks[1].x) < 1e-6 and longer.tracks[1].last * 0.1 >= longer.duration_s - 0.1


def test_beyond_the_record_nobody_drives_through_one_who_stands():
    s = _world((1, 0.0, 10.0), (2, 110.0, 0.0))
    found = _played(prolonged(s), s.duration_s)
    for o in found:
        if len(o.id) == 2:
            a, b = corridor.bodies(o)
            assert float(distance_between_rectangles(a, b[None])[0]) > 0.3
    assert float(np.hypot(found[-1].vx, found[-1].vy).max()) < 0.2


def test_on_a_bent_road_they_stay_on_it():
    s = load_scenario("left_turn")
    line = Polyline.of(s.route.reference)
    car = along(9, ObjectClass.CAR, line, BEHIND_M + travelled(6.0, [(0, 8.0)]))
    k = prolonged(replace(s, duration_s=6.0, tracks=(car,))).tracks[0]
    assert float(np.ptp(k.heading)) > 1.2  # it has turned
    away = np.abs(line.project(np.stack((k.x, k.y), axis=-1))[1])
    assert float(away.max()) < 1.0
