"""Traffic that reacts: the record to the letter while nobody is in the way, no driving into the ego otherwise."""

import msgspec
import numpy as np
import pytest

from common import codec
from common.geometry import distance_between_rectangles, rectangle_corners
from common.messages import ObjectClass
from evaluation.planning import corridor
from evaluation.planning.reactive import Reactive
from rig.sources import building, load_scenario
from rig.sources.building import BEHIND_M, Draw, along, drive, one_way, travelled


def _follower(speed: float = 10.0, lanes: int = 1, behind: float = 40.0, cls: ObjectClass = ObjectClass.CAR):
    """A road with one who comes from behind the ego, in its lane, at a constant recorded speed."""
    road = one_way(Draw(0), 400.0, lanes=lanes)
    car = along(1, cls, road.line, BEHIND_M - behind + travelled(20.0, [(0, speed)]))
    return drive("made", "", road, 20.0, 0.0, 100.0, [car])


def _play(scenario, ego_at, until: float):
    """Traffic beside an ego that moves as told; every state of the others at 10 Hz, and one in between."""
    traffic, found = Reactive(scenario), []
    for k in range(round(until * 10) + 1):
        t = k * 0.1 + (0.06 if k == 35 else 0.0)
        ego = ego_at(t)
        traffic.advance(t, ego)
        found.append((t, ego, traffic.objects_at(t)))
    return found


def _clear(found) -> float:
    return min(
        float(
            distance_between_rectangles(
                rectangle_corners(e.x, e.y, e.heading, e.length, e.width), corridor.bodies(o)
            ).min()
        )
        for _, e, o in found
        if len(o.id)
    )


@pytest.mark.parametrize("name", ["demo", "unprotected_left", "queue"])
def test_with_nobody_in_the_way_everybody_follows_his_record_to_the_letter(name: str):
    s = load_scenario(name)
    far = msgspec.structs.replace(s.ego0, x=1e4, y=1e4)
    for t, _, o in _play(s, lambda t: far, min(s.duration_s, 12.0)):
        recorded = s.objects_at(t)
        assert list(o.id) == list(recorded.id)
        for column in ("x", "y", "vx", "vy"):
            np.testing.assert_allclose(getattr(o, column), getattr(recorded, column), atol=1e-9)


@pytest.mark.parametrize("cls", [ObjectClass.CAR, ObjectClass.TRUCK, ObjectClass.MOTORCYCLE, ObjectClass.BICYCLE])
def test_who_comes_from_behind_stops_behind_a_standing_ego_and_stays_there(cls: ObjectClass):
    s = _follower(speed=6.0 if cls == ObjectClass.BICYCLE else 10.0, cls=cls)
    found = _play(s, lambda t: s.ego0, 18.0)
    assert _clear(found) > 0.5
    o = found[-1][2]
    assert float(np.hypot(o.vx[0], o.vy[0])) < 0.1
    assert s.ego0.x - s.ego0.length / 2 - (o.x[0] + o.length[0] / 2) < 5.0


def test_he_drives_on_when_the_way_is_free_again_but_never_faster_than_recorded():
    s = _follower()
    away = msgspec.structs.replace(s.ego0, y=s.ego0.y + 50.0)
    found = _play(s, lambda t: s.ego0 if t < 8.0 else away, 18.0)
    speeds = np.array([float(np.hypot(o.vx[0], o.vy[0])) for _, _, o in found])
    t = np.array([f[0] for f in found])
    assert speeds[(t > 7.5) & (t < 8.0)].max() < 0.5
    assert speeds[-1] > 8.0
    assert speeds.max() < 10.0 + 1e-6


def test_stuck_behind_a_standing_ego_he_changes_to_the_free_lane_beside():
    s = _follower(lanes=2)
    found = _play(s, lambda t: s.ego0, 18.0)
    assert _clear(found) > 0.3
    assert found[-1][2].x[0] > s.ego0.x


def test_a_walker_does_not_wait_for_a_moving_ego_but_does_not_walk_into_a_standing_one():
    road = building.two_way(Draw(0), 300.0)
    walk = travelled(15.0, [(0, 1.3)])
    walker = building.crossing(1, ObjectClass.PEDESTRIAN, road.line, BEHIND_M, 8.0, 12.0, walk)
    s = drive("made", "", road, 15.0, 0.0, 100.0, [walker])
    assert _clear(_play(s, lambda t: s.ego0, 14.0)) > 0.1
    near = msgspec.structs.replace(s.ego0, vx=5.0)
    assert _clear(_play(s, lambda t: near, 14.0)) == 0.0


def test_what_is_seen_of_reactive_traffic_keeps_the_contract():
    s = load_scenario("lane_ends", seed=3)
    for t, _, o in _play(s, lambda t: s.ego0, 10.0)[::7]:
        codec.check(o)
        assert len(np.unique(o.id)) == len(o.id), t
