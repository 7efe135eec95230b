"""Settings of the predictor, section `[predictor]`."""

from __future__ import annotations

from typing import Annotated, Literal

from msgspec import Meta

from common.config import Settings

Policy = Literal["paper", "learned-first", "learned-on-lanes", "map-first", "kinematic"]

Positive = Annotated[float, Meta(gt=0.0, le=1e3)]


class HistorySettings(Settings, frozen=True, kw_only=True):
    """What counts as the same object seen again."""

    gap_s: Annotated[float, Meta(gt=0.0, le=3.0)] = 1.0
    """A shorter gap is interpolated; tracks unseen for longer are forgotten and start anew [s]."""
    step_slack_m: Positive = 1.0
    """Noise of a measured position [m]."""
    step_drift_mps: Positive = 5.0
    """Error of the velocity with which a step is foretold [m/s]."""
    step_acceleration_mps2: Positive = 15.0
    """Strongest acceleration of any road user [m/s²]."""
    vehicle_speed_mps: Positive = 90.0
    """Fastest first step of a vehicle whose velocity is not known yet [m/s]."""
    bicycle_speed_mps: Positive = 25.0
    pedestrian_speed_mps: Positive = 12.0
    size_ratio: Annotated[float, Meta(gt=1.0, le=100.0)] = 1.5
    """A length or width that changes by more than this factor (and by more than `size_slack_m`) is another object."""
    size_slack_m: Positive = 0.6


class KinematicSettings(Settings, frozen=True, kw_only=True):
    """Constant velocity, and constant turn rate and acceleration."""

    velocity_steps: Annotated[int, Meta(ge=3, le=10)] = 3
    """The current velocity of cars, trucks and buses is the mean of so many backward steps of 0.1 s."""
    other_steps: Annotated[int, Meta(ge=3, le=10)] = 5
    """The same for all others; no data that may choose it holds any of them, so it is the yardstick's."""
    standing_mps: Positive = 0.2
    """Mean speed over the last second up to which an object stands; its velocity fades in up to twice this [m/s]."""
    turn_from_mps: Positive = 1.0
    """Below this speed no turn rate is believed; it fades in up to twice this [m/s]."""
    turn_rate_max: Positive = 1.0
    """Bound of the turn rate [rad/s]."""
    turn_rate_min: Annotated[float, Meta(ge=0.0, le=10.0)] = 0.1
    """A smaller turn rate is taken for noise [rad/s]."""
    turn_sure: Positive = 1e3
    """A turn rate beyond this is believed from the last second alone [rad/s]; 0.35 warns earlier of who turns across,
    and costs about 1 % of the mean error where positions are noisy. As set: never."""
    turn_decay_s: Annotated[float, Meta(gt=0.0, le=1e9)] = 2.0
    """Time constant with which a turn fades [s]; a very large one gives the constant turn rate."""
    lateral_max_mps2: Positive = 6.0
    """Bound of speed × turn rate [m/s²]."""
    acceleration_min_mps2: Annotated[float, Meta(ge=0.0, le=10.0)] = 0.1
    """A smaller acceleration is taken for noise [m/s²]."""
    acceleration_max_mps2: Positive = 4.0
    deceleration_max_mps2: Positive = 9.0
    acceleration_decay_s: Positive = 1.0
    """Time constant with which an acceleration fades [s]."""
    braking_sure_mps2: Positive = 1e3
    """A deceleration beyond this is believed from the last second alone [m/s²]; as set: never."""
    braking_from_mps2: Positive = 1.5
    """A deceleration beyond this starts to be held until the object rests instead of fading [m/s²]."""
    braking_held_mps2: Positive = 3.0
    """A deceleration beyond this is held wholly [m/s²]."""


class MapSettings(Settings, frozen=True, kw_only=True):
    """Following the lanes of the map."""

    heading_tolerance: Annotated[float, Meta(gt=0.0, le=1.5)] = 0.8
    """Largest angle between an object on a lane and the lane [rad]."""
    swerve_max: Positive = 1e3
    """An object whose turn rate differs by more from what the lane's curve asks for leaves the lane [rad/s]; as set:
    the turn rate alone never says so."""
    swerve_scale: Positive = 0.2
    """A turn rate that differs by so much from what a lane asks for counts, in the choice of the lane, as much as
    half a lane's width beside it [rad/s]. Large: position and direction alone choose, as the turn rate comes late."""
    body_yaw: Annotated[float, Meta(ge=0.0, le=1.0)] = 0.0
    """Share of the body's yaw in the direction by which an object's lane is chosen; the rest is the course of its
    positions, which comes some 0.2 s later but needs no measured yaw."""
    margin_m: Annotated[float, Meta(ge=0.0, le=10.0)] = 0.5
    """How far outside its lane an object's centre may be and still follow it [m]."""
    lateral_mps2: Positive = 3.0
    """Lateral acceleration that drivers accept in a curve [m/s²]."""
    braking_mps2: Positive = 1.5
    """Deceleration with which drivers slow for a curve or a lower limit [m/s²]."""
    settle_s: Positive = 1.0
    """Time constant with which small lateral motion within the lane ends [s]."""
    lane_change_mps: Positive = 0.4
    """Lateral speed from which a lane change is believed [m/s]."""
    branch_s: Positive = 3.0
    """The last second's motion decides at branches that are nearer than this; farther ones are taken straight [s]."""


class LearnedSettings(Settings, frozen=True, kw_only=True):
    """Which network the learned policies use."""

    weights: Annotated[str, Meta(max_length=1000)] = ""
    """Folder of weights with its `model.json`; empty: the shipped ones."""
    network: Annotated[str, Meta(max_length=64)] = ""
    """Its name in the card, such as `lstm_paper`; empty: the card's default."""
    spread: bool = False
    """Whether predictions tell their spread, where the card of the weights has one; 0 for all other methods."""


class PredictorSettings(Settings, frozen=True, kw_only=True):
    """Section `[predictor]`."""

    policy: Policy = "learned-on-lanes"
    """Which method predicts which object: see `selection`."""
    past_frames: Annotated[int, Meta(ge=1, le=29)] = 10
    """Frames of the path already driven that travel with the prediction."""
    history: HistorySettings = HistorySettings()
    kinematic: KinematicSettings = KinematicSettings()
    map: MapSettings = MapSettings()
    learned: LearnedSettings = LearnedSettings()
