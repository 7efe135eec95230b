"""commonroad-reactive-planner with its default settings, run on its own Python.

Different from its defaults: dimensions are those of the ego, the wanted speed is told, kinematics are checked in one
process. It plans on from its last plan as long as the ego is on it, as its own runner does.
"""

from __future__ import annotations

import logging
import math
from typing import Any

import numpy as np
import road
from commonroad_clcs.config import CLCSParams
from commonroad_rp.reactive_planner import ReactivePlanner
from commonroad_rp.state import ReactivePlannerState
from commonroad_rp.utility.config import ReactivePlannerConfiguration
from commonroad_rp.utility.utils_coordinate_system import CoordinateSystem
from serving import Line, NoTrajectoryError, serve

TINY = 1e-6
"""At exactly 0 m/s it asks the planning problem, which there is none, for a speed [m/s]."""


class Reactive:
    """One drive."""

    name = "commonroad-reactive-planner"

    def __init__(self, start: Line) -> None:
        config = ReactivePlannerConfiguration()
        config.debug.multiproc = False
        config.debug.logging_level = "CRITICAL"
        e, v = start["ego"], config.vehicle
        v.length, v.width = e["length"], e["width"]
        v.wb_front_axle = v.wb_rear_axle = e["wheelbase"] / 2
        v._update_computed_params()
        config.scenario = road.scenario(start)
        self.period_s = config.planning.replanning_frequency * config.planning.dt
        self._half, self._wheelbase = e["wheelbase"] / 2, e["wheelbase"]
        self._standing = road.boundary(start, config.scenario)
        self._line = CoordinateSystem(np.array(start["route"]), clcs_params=CLCSParams())
        self._planner = ReactivePlanner(config)
        self._last: tuple[Any, ...] | None = None

    def plan(self, asked: Line) -> Line:
        """One planning cycle."""
        planner, again, curvilinear = self._planner, asked["again"], None
        low = planner.config.planning.low_vel_mode_threshold
        if again is not None and self._last is not None and again < len(self._last[1]):
            trajectory, along, across, was_low = self._last
            s = trajectory.state_list[again]
            s.time_step = 0
            if was_low == (s.velocity < low):  # it means other things by the same numbers below that speed
                curvilinear = (along[again], across[again])
        else:
            s = self._state(asked["ego"])
        planner._low_vel_mode = s.velocity < low
        planner.reset(
            initial_state_cart=s, initial_state_curv=curvilinear,
            collision_checker=road.checker(self._standing, asked), coordinate_system=self._line,
        )  # fmt: skip
        planner.set_desired_velocity(desired_velocity=asked["wanted"], current_speed=max(s.velocity, TINY))
        found = planner.plan()
        if found is None:
            kinematic = planner.infeasible_count_kinematics >= planner.total_count_samples
            raise NoTrajectoryError("no sample is drivable" if kinematic else "every drivable sample collides")
        self._last = (*found, planner._low_vel_mode)
        states = found[0].state_list
        heading = np.array([k.orientation for k in states])
        p = np.array([k.position for k in states])
        steer = np.array([k.steering_angle for k in states])
        return {
            "t": (0.1 * np.arange(len(states))).tolist(),
            "x": (p[:, 0] + self._half * np.cos(heading)).tolist(),
            "y": (p[:, 1] + self._half * np.sin(heading)).tolist(),
            "heading": heading.tolist(),
            "speed": [float(k.velocity) for k in states],
            "acceleration": [float(k.acceleration) for k in states],
            "curvature": (np.tan(steer) / self._wheelbase).tolist(),
        }

    def _state(self, e: Line) -> ReactivePlannerState:
        c, s = math.cos(e["heading"]), math.sin(e["heading"])
        return ReactivePlannerState(
            time_step=0, position=np.array([e["x"] - self._half * c, e["y"] - self._half * s]), velocity=e["speed"],
            orientation=e["heading"], acceleration=e["acceleration"], yaw_rate=e["yaw_rate"],
            steering_angle=math.atan2(self._wheelbase * e["yaw_rate"], max(e["speed"], 0.1)),
        )  # fmt: skip


if __name__ == "__main__":
    logging.disable(logging.CRITICAL)
    serve(Reactive)
