"""The simulated vehicle drives what the plan says, within its limits, and nothing else."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from common.geometry import Polyline, wrap_angle
from common.messages import F64, Ego, Plan, Stamped, Trajectory
from rig.settings import RigSettings
from rig.vehicle import SimulatedVehicle
from rig.world import ego_at

WHEELBASE = 2.7
SETTINGS = RigSettings()
DT = 0.02


def motion(t: F64, speed: F64, acceleration: F64, s: F64, curvature: float) -> Trajectory:
    """The rear axle on an arc from the origin; rows of the rectangle's centre."""
    heading = curvature * s
    if abs(curvature) < 1e-9:
        x, y = s, np.zeros_like(s)
    else:
        x, y = np.sin(heading) / curvature, (1 - np.cos(heading)) / curvature
    return Trajectory(
        t=t, x=x + WHEELBASE / 2 * np.cos(heading), y=y + WHEELBASE / 2 * np.sin(heading), heading=heading,
        curvature=np.full(len(t), curvature), speed=speed, acceleration=acceleration,
    )  # fmt: skip


def plan(v: float, curvature: float, a: float = 0.0, valid_for: float = 3.0, brake: float = 3.0) -> Plan:
    """Accelerate with a for `valid_for`, then a tail that brakes with `brake` to a stop."""
    t = np.arange(0.0, valid_for + 1e-9, 0.1)
    speed = v + a * t
    s = v * t + a * t**2 / 2
    end_v, end_s, stop = speed[-1], s[-1], speed[-1] / brake
    u = np.linspace(0.0, stop, max(int(stop / 0.1) + 1, 3))
    tail_speed = np.maximum(end_v - brake * u, 0.0)
    tail_speed[-1] = 0.0
    tail_s = end_s + end_v * u - brake * u**2 / 2
    return Plan(
        mode="drive", reason="test", valid_for=valid_for,
        profile=motion(t, speed, np.full(len(t), a), s, curvature),
        tail=motion(valid_for + u, tail_speed, np.full(len(u), -brake), tail_s, curvature),
    )  # fmt: skip


def start(v: float, curvature: float, lateral: float = 0.0, turned: float = 0.0) -> Ego:
    e = ego_at(WHEELBASE / 2, lateral, turned, v)
    return type(e)(**{f: getattr(e, f) for f in e.__struct_fields__ if f != "yaw_rate"}, yaw_rate=v * curvature)


def run(vehicle: SimulatedVehicle, seconds: float, begin_ns: int = 0) -> list[Ego]:
    n = round(seconds / DT)
    return [vehicle.step(DT, begin_ns + round(i * DT * 1e9)) for i in range(n)]


def rear(e: Ego) -> F64:
    return np.array([e.x - WHEELBASE / 2 * np.cos(e.heading), e.y - WHEELBASE / 2 * np.sin(e.heading)])


@given(st.floats(2.0, 20.0), st.floats(-0.08, 0.08), st.floats(-0.5, 1.0))
@settings(max_examples=30, deadline=None)
def test_straights_and_curves_are_tracked_within_0_3_m(v: float, curvature: float, a: float) -> None:
    curvature = float(np.clip(curvature, -3.0 / v**2, 3.0 / v**2))  # what a tyre bears
    p = plan(v, curvature, a)
    vehicle = SimulatedVehicle(start(v, curvature), SETTINGS)
    vehicle.receive(Stamped(p, 0, 0))
    assert p.profile is not None
    for i, e in enumerate(run(vehicle, 3.0)):
        t = (i + 1) * DT
        s = v * t + a * t**2 / 2
        wanted = np.array([s, 0.0]) if abs(curvature) < 1e-9 else (
            np.array([np.sin(curvature * s), 1 - np.cos(curvature * s)]) / curvature
        )  # fmt: skip
        assert np.hypot(*(rear(e) - wanted)) < 0.3
        assert abs(e.speed - (v + a * t)) < 0.3


@given(st.floats(3.0, 25.0), st.floats(-0.5, 0.5), st.floats(-0.05, 0.05))
@settings(max_examples=30, deadline=None)
def test_an_error_at_the_start_decays(v: float, lateral: float, turned: float) -> None:
    vehicle = SimulatedVehicle(start(v, 0.0, lateral, turned), SETTINGS)
    vehicle.receive(Stamped(plan(v, 0.0, valid_for=6.0), 0, 0))
    states = run(vehicle, 6.0)
    assert abs(rear(states[-1])[1]) < 0.05
    assert abs(float(wrap_angle(states[-1].heading))) < 0.02
    assert max(abs(e.y) for e in states) < abs(lateral) + 0.05 * 25.0 * 0.6 + 0.1


@given(st.floats(0.0, 25.0), st.floats(-0.3, 0.3), st.floats(-15.0, 10.0), st.floats(-3.0, 3.0))
@settings(max_examples=40, deadline=None)
def test_no_plan_makes_it_exceed_its_limits(v: float, curvature: float, a: float, lateral: float) -> None:
    p = plan(max(v, 0.5), curvature, float(np.clip(a, -v / 3.0, 10.0)), brake=15.0)
    vehicle = SimulatedVehicle(start(v, 0.0, lateral), SETTINGS)
    vehicle.receive(Stamped(p, 0, 0))
    steer, acceleration, speed = vehicle.steer, vehicle.acceleration, vehicle.speed
    for i in range(250):
        e = vehicle.step(DT, round(i * DT * 1e9))
        assert -SETTINGS.max_deceleration - 1e-9 <= e.acceleration <= SETTINGS.max_acceleration + 1e-9
        assert abs(vehicle.steer) <= SETTINGS.max_steer + 1e-9
        assert abs(vehicle.steer - steer) <= SETTINGS.max_steer_rate * DT + 1e-9
        # at a standstill the brake lets the body settle at once
        if e.speed > 0.2:
            assert abs(e.acceleration - acceleration) <= SETTINGS.max_jerk * DT + 1e-9
        assert e.speed >= 0.0
        assert e.speed - speed <= SETTINGS.max_acceleration * DT + 1e-9
        steer, acceleration, speed = vehicle.steer, vehicle.acceleration, e.speed


def test_after_valid_for_it_drives_the_tail_and_stops_where_it_ends() -> None:
    p = plan(10.0, 0.02, valid_for=0.3, brake=4.0)
    vehicle = SimulatedVehicle(start(10.0, 0.02), SETTINGS)
    vehicle.receive(Stamped(p, 0, 0))
    states = run(vehicle, 8.0)
    assert states[round(0.28 / DT)].speed > 9.8
    assert p.tail is not None
    for t in (1.0, 2.0):
        assert states[round(t / DT) - 1].speed == pytest.approx(10.0 - 4.0 * (t - 0.3), abs=0.5)
    assert states[-1].speed == 0.0
    assert np.hypot(states[-1].x - p.tail.x[-1], states[-1].y - p.tail.y[-1]) < 0.5
    assert states[-1] == states[-50]  # and there it stands


def test_plan_time_counts_from_the_plans_capture() -> None:
    late = SimulatedVehicle(start(10.0, 0.0), SETTINGS)
    late.receive(Stamped(plan(10.0, 0.0, valid_for=0.3), -10_000_000_000, 0))
    run(late, 6.0)
    assert late.speed == 0.0  # the whole plan lay in the past: it brakes from the first moment
    assert late.x < 10.0 * 6.0 / 2


def test_without_a_plan_it_brakes_and_holds() -> None:
    vehicle = SimulatedVehicle(start(10.0, 0.0), SETTINGS)
    states = run(vehicle, 6.0)
    assert states[0].speed < 10.0
    assert states[-1].speed == 0.0
    stopping = 10.0**2 / (2 * SETTINGS.hold_deceleration)
    assert states[-1].x - WHEELBASE / 2 == pytest.approx(stopping, abs=1.0)


def test_a_waiting_plan_holds_a_standing_vehicle() -> None:
    vehicle = SimulatedVehicle(start(0.0, 0.0), SETTINGS)
    vehicle.receive(Stamped(Plan(mode="waiting", reason="no route"), 0, 0))
    assert run(vehicle, 2.0)[-1].x == WHEELBASE / 2


def test_an_older_plan_does_not_replace_a_newer_one() -> None:
    vehicle = SimulatedVehicle(start(5.0, 0.0), SETTINGS)
    new, old = Stamped(plan(5.0, 0.0), 100, 100), Stamped(plan(5.0, 0.1), 50, 120)
    vehicle.receive(new)
    vehicle.receive(old)
    assert vehicle.plan is new


def test_the_state_is_the_rectangles_centre() -> None:
    vehicle = SimulatedVehicle(start(6.0, 0.1), SETTINGS)
    vehicle.receive(Stamped(plan(6.0, 0.1), 0, 0))
    states = run(vehicle, 2.0)
    line = Polyline.of([[e.x, e.y] for e in states])
    a, b = states[50], states[51]
    moved = np.array([b.x - a.x, b.y - a.y]) / DT
    assert np.hypot(moved[0] - a.vx, moved[1] - a.vy) < 0.1
    assert line.length == pytest.approx(6.0 * np.hypot(1.0, 0.1 * WHEELBASE / 2) * (2.0 - DT), rel=0.01)
