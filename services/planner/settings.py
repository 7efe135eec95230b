"""Settings of the planner, section `[planner]`: typed, with unit and default."""

from __future__ import annotations

from typing import Annotated, Literal

from msgspec import Meta

from common.config import Settings

Positive = Annotated[float, Meta(gt=0.0, le=1e4)]
NotNegative = Annotated[float, Meta(ge=0.0, le=1e4)]
Fraction = Annotated[float, Meta(gt=0.0, le=1.0)]


class PlannerSettings(Settings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Everything that may be set about the planner. SI units."""

    name: Literal["default", "paper"] = "default"  # which search over the risk volume
    max_speed: Positive = 40.0  # highest speed ever wanted, whatever route and map allow [m/s]

    # candidate paths
    offsets: tuple[float, ...] = (0.0, 0.5, -0.5, 1.0, -1.0, 1.6, -1.6, 2.3, -2.3, 3.2, -3.2)
    """Final lateral offsets from the reference line [m]; centres of neighbouring lanes come on top."""
    lengths: tuple[tuple[float, float], ...] = ((9.0, 2.2), (15.0, 3.5), (24.0, 5.0))
    """Length of the lateral move: max(first [m], second [s] · speed)."""
    stations: Annotated[int, Meta(ge=20, le=400)] = 72  # points of each path
    step_min: Positive = 0.75  # shortest distance between them [m]
    step_max: Positive = 2.2  # longest [m]
    max_curvature: Positive = 0.24  # of the rear axle's path [1/m]
    max_curvature_rate: Positive = 0.30  # [1/(m s)]
    footprint_spacing: Positive = 0.9  # largest distance between samples of the footprint's outline [m]

    # what risk means
    r0: NotNegative = 0.20  # up to here the speed law leaves S_max [E_max]
    r1: Positive = 0.90  # from here on it gives 0 [E_max]
    r_hit: Positive = 0.80  # contact: 0.3 m from a car [E_max]
    along: Fraction = 0.9  # share of the speed of one who goes along beside, which may be driven however near he is
    flank_margin: NotNegative = 0.15
    """Beside the ego contact counts from r_hit + this: 0.15 m from a car, for braking makes no room there [E_max]."""

    # gap, headway, horizon: the planner's own
    gap: NotNegative = 3.0  # kept to what stands ahead [m]
    headway: NotNegative = 1.2  # [s]
    closing: NotNegative = 1.5  # who comes towards the ego when the horizon ends must be so far away [s]
    gap_round: NotNegative = 8.0
    """Kept to what stands in the lane while there is a way round it that is not free yet: room to steer out [m]."""
    gap_behind: NotNegative = 1.0  # to who follows where the ego pulls out before him [m] …
    headway_behind: NotNegative = 0.25  # … and this times its speed [s]
    stop_brake: Positive = 4.0  # b_stop: deceleration that the stop-speed map counts on [m/s²]
    horizon_brake: Positive = 2.5  # with which the ego can stop before the first unknown point [m/s²]

    # comfort
    accel: Positive = 1.35  # a_max [m/s²]
    lateral_accel: Positive = 1.03  # a_lat of the curve speed [m/s²]
    curve_brake: Positive = 1.0  # deceleration before curves, lower limits, the goal [m/s²]
    jerk: Positive = 1.45  # in normal driving [m/s³]
    tau: Positive = 1.0  # time constant of the speed controller [s]
    target_filter: Fraction = 0.25  # share of a small change of the target speed taken each period
    target_rise: Fraction = 0.1  # share of a small rise, where the ego is nearly as fast as that …
    target_steady: NotNegative = 0.5  # … less than this below it [m/s]
    target_band: NotNegative = 1.5  # changes larger than this are taken at once [m/s]
    stop_below: NotNegative = 0.4  # target speeds below this are 0 [m/s]
    restart_above: NotNegative = 1.0  # target speed at which a standing ego starts [m/s]

    # braking tiers: comfort, firm, hard, emergency
    tier_brake: tuple[float, float, float, float] = (1.38, 3.0, 5.0, 8.0)  # [m/s²]
    tier_jerk: tuple[float, float, float, float] = (1.45, 4.0, 12.0, 30.0)  # [m/s³]
    tier_lateral: tuple[float, float, float, float] = (1.15, 2.0, 3.5, 4.5)  # largest lateral acceleration [m/s²]
    crawl: NotNegative = 1.5  # whoever is beside, up to this speed it may be kept [m/s]
    release_from: Positive = 1.5  # a brake harder than this [m/s²] …
    release_jerk: Positive = 10.0  # … is let go fast [m/s³]
    hold_s: Positive = 1.5  # how long the target is held before the checked stop [s]
    horizon_s: Positive = 6.0  # [s]

    # choice of the path, in m/s of desired speed
    tier_cost: NotNegative = 6.0
    squeeze_cost: NotNegative = 10.0  # for each E_max of mean risk beside, where contact beside cannot be avoided
    stop_off_centre_cost: NotNegative = 8.0
    mean_offset_cost: NotNegative = 0.3  # for each metre
    end_offset_cost: NotNegative = 0.15  # for each metre
    length_cost: NotNegative = 0.05  # shortest length, falling to 0 for the longest
    change_cost: NotNegative = 1.2  # hysteresis: quite another target than the one before, unless the reference line
    stay_cost: NotNegative = 0.8  # going on in the lane in which the ego is where the route leaves it
    goal_cost: NotNegative = 4.0  # a path past the goal, where changing to it takes all the time that is left
    neighbour_cost: NotNegative = 0.5  # leaving the own lane for one of the same direction
    unknown_side_cost: NotNegative = 1.5  # leaving it where no map tells what is there
    oncoming_cost: NotNegative = 4.0  # leaving it for one of the opposite direction
    queue_cost: NotNegative = 8.0  # leaving it for one of the opposite direction where others stand in line
    patience_speed: Positive = 5.0  # slower than this before what stands alone in the lane, the ego waits [m/s] …
    patience: Positive = 5.0  # … and so long after it the costs of leaving the lane have fallen to a fifth [s]
    off_road_cost: NotNegative = 8.0  # leaving it where the map has no lane
    lane_margin: NotNegative = 0.15  # the outline may reach this far over the own lane's edge for nothing [m]

    # plan
    valid_for: Positive = 0.3  # the profile may be driven until then [s]
    profile_s: Positive = 4.0  # length of the profile [s]
    tail_brakes: tuple[float, ...] = (2.5, 4.0, 8.0)  # the first that keeps the tail free is taken [m/s²]
    follow_distance: Positive = 0.3  # replan from the previous plan's state if the ego is this near to it [m]
    follow_speed: Positive = 0.5  # and this near in speed [m/s]
    lead_speed: NotNegative = 0.1  # so far that state may be off the ego's own velocity, along and across [m/s]
    lead_accel: NotNegative = 0.5  # off its acceleration, along and across [m/s²]
    lead_side: NotNegative = 0.1  # and beside it [m]
    max_risk_age: Positive = 0.3  # [s], transit included
    max_ego_age: Positive = 0.2  # [s]
    candidate_points: Annotated[int, Meta(ge=2, le=200)] = 36  # points of each candidate in the message

    # validator
    max_accel: Positive = 3.0  # [m/s²]
    max_brake: Positive = 8.5  # [m/s²]
    max_lateral_accel: Positive = 5.0  # [m/s²]
    safe_stop_brake: Positive = 3.0  # [m/s²]; the emergency tier's where that would meet something
