"""Settings of the bench, section `[rig]`: the vehicle's limits and what a source assumes where it is silent."""

from __future__ import annotations

from typing import Annotated

from msgspec import Meta

from common.config import Settings

Positive = Annotated[float, Meta(gt=0.0)]


class RigSettings(Settings, frozen=True, kw_only=True):
    """The vehicle (`vehicle.py`), the worlds (`sources/`)."""

    # the simulated vehicle
    max_acceleration: Positive = 3.0  # [m/s²]
    max_deceleration: Positive = 9.0  # [m/s²], a dry road
    max_jerk: Positive = 40.0  # [m/s³], build-up of a full brake in 0.2 s
    max_steer: Annotated[float, Meta(gt=0.0, lt=1.4)] = 0.6  # [rad] at the wheel; radius 3.9 m at a wheelbase of 2.7 m
    max_steer_rate: Positive = 0.6  # [rad/s] at the wheel
    hold_deceleration: Positive = 3.0  # [m/s²], braking without a plan to drive
    tracking_length_s: Positive = 0.6  # [s] × speed: length in which a lateral error decays …
    tracking_length_m: Positive = 2.5  # [m] … but at least this
    tracking_speed_gain: Annotated[float, Meta(ge=0.0)] = 1.0  # [1/s], on the speed error
    tracking_position_gain: Annotated[float, Meta(ge=0.0)] = 0.3  # [1/s²], on the position error along the path
    substep_s: Annotated[float, Meta(gt=0.0, le=0.02)] = 0.005  # [s], integration step

    # the live run
    ego_rate_hz: Annotated[float, Meta(ge=10.0, le=100.0)] = 50.0  # [Hz] of `ego`
    objects_rate_hz: Annotated[float, Meta(ge=1.0, le=50.0)] = 10.0  # [Hz] of `objects`
    ready_timeout_s: Positive = 90.0  # [s] until every service must be up; kernels are compiled in it
    settle_s: Annotated[float, Meta(ge=0.0)] = 15.0  # [s] at most, until plans rest on what the rig publishes
    run_up_s: Annotated[float, Meta(ge=0.0, le=10.0)] = 1.0  # [s] of motion before time 0
    end_at_goal: bool = True  # a run ends when the goal is reached

    # what a source assumes where the recording is silent
    default_speed_limit: Annotated[float, Meta(ge=0.0, le=100.0)] = 0.0  # [m/s] where the map has none; 0: by road kind
    urban_speed_limit: Positive = 13.9  # [m/s], 50 km/h
    motorway_speed_limit: Positive = 29.0  # [m/s], 65 mph
