"""What the world says of a drive: emergencies, drives that were lost from their first state."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from common.messages import Ego, Objects
from evaluation.planning.recorder import Recorder
from evaluation.planning.unavoidable import GRIP, unavoidable
from evaluation.planning.world_checks import GENTLE, emergencies, emergency_times

LENGTH = 4.6


def _ego(x: float, v: float) -> Ego:
    return Ego(
        x=x, y=0.0, heading=0.0, vx=v, vy=0.0, acceleration=0.0, yaw_rate=0.0, length=LENGTH, width=1.8, wheelbase=2.8
    )


def _one(x: float, y: float = 0.0, v: float = 0.0, width: float = 1.8, heading: float = 0.0) -> Objects:
    def row(value: float) -> np.ndarray:
        return np.array([value])

    return Objects(
        id=np.array([1]), cls=np.array([1], dtype=np.uint8), x=row(x), y=row(y), heading=row(heading),
        vx=row(v), vy=row(0.0), length=row(LENGTH), width=row(width), mass=row(0.0),
    )  # fmt: skip


def _record(speed: float, gap: float, lead: float = 0.0, y: float = 0.0, width: float = 1.8, n: int = 80) -> Recorder:
    """Straight on at constant speed; somebody begins `gap` before the front bumper [m] and keeps his speed."""
    record = Recorder()
    for k in range(n):
        t = 0.1 * k
        record(t, _ego(speed * t, speed), _one(LENGTH + gap + lead * t, y, lead, width), None)
    return record


@settings(max_examples=25)
@given(speed=st.floats(2.0, 15.0), share=st.floats(0.3, 3.0))
def test_an_emergency_is_where_a_gentle_brake_would_not_stop_before_who_stands(speed: float, share: float):
    needed = speed * speed / (2.0 * GENTLE)
    gap = share * needed
    found = emergencies(_record(speed, gap, n=200))
    if share < 0.95:
        assert found[0]
    if share > 1.02:
        assert not found[0]
    late = int((gap - needed) / speed / 0.1)  # the frame after which the gentle brake no longer suffices
    if late > 2:
        assert not found[: late - 1].any()
    driven_into = (gap / speed) / 0.1
    inside = np.arange(len(found))
    assert found[(inside > late + 3) & (inside < driven_into - 1)].all()


def test_who_drives_away_as_fast_as_the_ego_is_no_emergency():
    assert not emergencies(_record(12.0, 3.0, lead=12.0)).any()


def test_who_comes_from_behind_is_no_emergency():
    assert not emergencies(_record(8.0, -2 * LENGTH - 4.0, lead=14.0), until_s=0.6).any()


def test_who_stands_in_the_next_lane_is_no_emergency():
    assert not emergencies(_record(12.0, 5.0, y=3.5)).any()


def test_nothing_is_judged_after_the_first_collision():
    record = _record(10.0, 10.0)
    assert emergencies(record).any()
    assert not emergencies(record, until_s=0.0).any()


def test_an_emergency_lasts_until_its_brake_is_let_go():
    record = _record(10.0, 60.0)
    found = np.zeros(len(record.frames), dtype=bool)
    found[20] = True
    t = np.array([1.8, 1.95, 2.0, 2.9, 3.2])
    assert emergency_times(record, found, t).tolist() == [False, True, True, True, False]


@settings(max_examples=25)
@given(speed=st.floats(4.0, 15.0), share=st.floats(0.1, 2.0))
def test_a_wall_across_the_road_is_unavoidable_only_within_the_braking_distance(speed: float, share: float):
    gap = share * speed * speed / (2.0 * GRIP)
    record = _record(speed, gap, width=200.0)
    lost = unavoidable(record, gap / speed)
    if share > 1.05:
        assert not lost
    # a wall: turning gains nothing but a shorter reach of the front, of at most the overhang
    elif gap < share * speed * speed / (2.0 * GRIP) - LENGTH / 2:
        assert lost


def test_a_car_standing_right_ahead_of_a_fast_one_is_unavoidable():
    assert unavoidable(_record(10.0, 1.0), 0.1)


def test_who_could_have_swerved_has_no_excuse():
    """20 m/s, 15 m to a standing car 0.9 m to the side: 25 m of braking, but 0.9 m of swerving."""
    assert not unavoidable(_record(20.0, 15.0, y=1.2), 0.75)


def test_a_collision_later_in_the_drive_is_not_blamed_on_its_start():
    assert not unavoidable(_record(10.0, 1.0), 3.5)
    assert not unavoidable(Recorder(), 0.5)


@pytest.mark.parametrize("speed", [0.0, 5.0])
def test_who_is_touched_by_nobody_is_not_lost(speed: float):
    assert not unavoidable(_record(speed, 500.0), 1.0)
