"""Lanes go straight on where the route changes them: whoever finds no gap stays in his lane and does not brake."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest

from common.messages import Goal, Lane, Map, Route
from services.planner.lanes import RouteLanes
from services.planner.reference import ReferenceLine
from services.planner.settings import PlannerSettings
from tests.planner.worlds import box, drive, ego_at, lane

pytestmark = pytest.mark.long

FEW = PlannerSettings(offsets=(0.0, 0.6, -0.6), lengths=((9.0, 2.2), (24.0, 5.0)))


def changing(start: float = 40.0, span: float = 45.0, length: float = 400.0) -> Route:
    """Along y = 0, then over to y = 3.5."""
    x = np.arange(-20.0, length, 2.0)
    w = np.clip((x - start) / span, 0.0, 1.0)
    y = 3.5 * w**3 * (10 - 15 * w + 6 * w**2)
    return Route(
        reference=np.stack((x, y), axis=1),
        goal=Goal(x=length - 5.0, y=3.5, radius=3.0),
        speed_limit=9.0,
        lane_ids=[1, 2],
    )


def two_lanes() -> Map:
    return Map(
        lanes=[
            lane(1, 0.0, limit=9.0, left_neighbour=2, left_same_direction=True),
            lane(2, 3.5, limit=9.0, right_neighbour=1, right_same_direction=True),
        ]
    )


def pieces(joints: tuple[float, ...]) -> list[Lane]:
    """Lane 1 cut into pieces that follow one another."""
    whole = lane(1, 0.0)
    out: list[Lane] = []
    ends = (-31.0, *joints, 500.0)
    for k in range(len(ends) - 1):
        x = np.linspace(max(ends[k], -30.0), min(ends[k + 1], 430.0), 30)
        lines = [np.stack((x, np.full_like(x, y)), axis=1) for y in (0.0, 1.75, -1.75)]
        out.append(
            Lane(
                id=10 + k,
                centre=lines[0],
                left=lines[1],
                right=lines[2],
                speed_limit=whole.speed_limit,
                successors=[11 + k] if k < len(ends) - 2 else [],
            )
        )
    return out


def test_a_lane_goes_straight_on_where_the_route_leaves_it():
    reference = ReferenceLine.of(changing().reference)
    tracks = RouteLanes.of(reference, changing(), two_lanes()).tracks
    assert len(tracks) == 2
    s = np.arange(len(tracks[0].centre))
    for track, y in zip(sorted(tracks, key=lambda t: float(t.centre[-1])), (0.0, 3.5), strict=True):
        p = reference.at(s)
        assert np.allclose(p.y + track.centre * np.cos(p.heading), y, atol=0.1)
        assert np.abs(track.bend).max() < 0.02


@pytest.mark.parametrize("joints", [(50.0,), (30.0, 60.0, 61.5)])
def test_lanes_that_follow_one_another_are_one_track(joints: tuple[float, ...]):
    reference = ReferenceLine.of(changing().reference)
    tracks = RouteLanes.of(reference, changing(), Map(lanes=pieces(joints))).tracks
    assert len(tracks) == 1
    assert tracks[0].last - tracks[0].first > 350


def test_whoever_finds_no_gap_stays_in_his_lane_and_goes_on():
    queue = [box(-9.0 + 9.0 * k, 3.5, 9.0, id=k + 1) for k in range(-1, 5)]
    d = drive(queue, changing(), ego_at(10.0, 0.0, 0.0, 9.0), seconds=8.0, settings=FEW, road=two_lanes(), ahead=80.0)
    assert set(d.modes) == {"drive"}
    assert min(d.clearance) > 0.5
    assert d.speed.min() > 6.5
    assert d.acceleration.min() > -1.6


def test_whoever_finds_a_gap_changes_with_the_route():
    others = [box(-30.0, 3.5, 9.0), box(60.0, 3.5, 9.0, id=2)]
    d = drive(others, changing(), ego_at(10.0, 0.0, 0.0, 9.0), seconds=9.0, settings=FEW, road=two_lanes(), ahead=80.0)
    assert abs(d.y[-1] - 3.5) < 0.5
    assert d.acceleration.min() > -1.6
    assert d.speed.min() > 6.5


def ending(length: float = 110.0) -> Map:
    """Lane 1 ends; lane 2 beside it goes on."""
    x = np.linspace(-30.0, length, 60)
    lines = [np.stack((x, np.full_like(x, y)), axis=1) for y in (0.0, 1.75, -1.75)]
    short = Lane(
        id=1, centre=lines[0], left=lines[1], right=lines[2], speed_limit=12.0, left_neighbour=2,
        left_same_direction=True,
    )  # fmt: skip
    return Map(lanes=[short, lane(2, 3.5, limit=12.0, right_neighbour=1, right_same_direction=True)])


def test_where_the_lane_ends_speed_is_fitted_to_a_gap_instead_of_waiting_at_the_end():
    others = [box(8.0 - 36.0 * k, 3.5, 11.0, id=k + 1) for k in range(4)]
    route = msgspec.structs.replace(changing(start=35.0, span=40.0), speed_limit=12.0)
    d = drive(others, route, ego_at(5.0, 0.0, 0.0, 10.0), seconds=11.0, settings=FEW, road=ending(), ahead=90.0)
    assert abs(d.y[-1] - 3.5) < 0.6
    assert d.speed.min() > 4.0
    assert min(d.clearance) > 0.2
