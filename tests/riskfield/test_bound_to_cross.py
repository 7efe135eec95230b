"""A closed line holds for whoever can stop before it; who no longer can drives on."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from common.messages import NO_BRAKE, Lane, Map, Obstacle
from services.riskfield.selection import bound_to_cross
from services.riskfield.settings import RiskfieldSettings
from tests.riskfield.scenes import ego

BRAKE = RiskfieldSettings().hardest_brake
LENGTH = ego().length
SPEED = st.floats(0.0, 30.0)
HEADING = st.floats(-3.1, 3.1)


def lines(ahead: float, heading: float = 0.0, beside: float = 0.0) -> Map:
    """A stop line across, so far from the front bumper of an ego at the origin [m]."""
    c, s = np.cos(heading), np.sin(heading)
    x, y = ahead + LENGTH / 2, np.array([-1.75, 1.75]) + beside
    return Map(obstacles=[Obstacle(id=7, kind="stop_line", points=np.stack((c * x - s * y, s * x + c * y), axis=1))])


@given(SPEED, HEADING, st.floats(0.05, 60.0))
def test_a_line_that_can_be_stopped_before_holds(v: float, heading: float, spare: float):
    ahead = v**2 / (2 * BRAKE) + spare - 0.05
    assert bound_to_cross(lines(ahead, heading), [7], ego(heading=heading, speed=v), BRAKE) == []


@given(st.floats(4.0, 30.0), HEADING, st.floats(0.0, 0.9))
def test_a_line_that_no_brake_stops_before_is_left_out_with_the_reason(v: float, heading: float, share: float):
    ahead = share * (v**2 / (2 * BRAKE) - 0.4)
    (found,) = bound_to_cross(lines(ahead, heading), [7], ego(heading=heading, speed=v), BRAKE)
    assert (found.id, found.reason) == (7, NO_BRAKE)


@given(SPEED, st.floats(-3.0, 20.0))
def test_open_lines_lines_beside_and_closed_lanes_are_never_left_out(v: float, ahead: float):
    me = ego(speed=v)
    assert bound_to_cross(lines(ahead), [], me, BRAKE) == []
    assert bound_to_cross(lines(ahead, beside=3.6), [7], me, BRAKE) == []
    x = ahead + LENGTH / 2
    across, side = np.array([[x, 0.0], [x + 30.0, 0.0]]), np.array([0.0, 1.75])
    lane = Lane(id=7, centre=across, left=across + side, right=across - side)
    assert bound_to_cross(Map(lanes=[lane]), [7], me, BRAKE) == []


@given(st.floats(0.0, 2.0), st.floats(-LENGTH, 5.0))
def test_who_is_slow_stays_before_or_on_the_line(v: float, ahead: float):
    assert bound_to_cross(lines(ahead), [7], ego(speed=v), BRAKE) == []


@given(st.floats(4.0, 20.0), st.floats(0.05, 0.95))
def test_who_is_on_the_line_at_speed_drives_off_it(v: float, share: float):
    assert bound_to_cross(lines(-share * LENGTH), [7], ego(speed=v), BRAKE)
    assert bound_to_cross(lines(-LENGTH - 0.1), [7], ego(speed=v), BRAKE) == []
