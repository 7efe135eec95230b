"""frenetix (the C++ core) driven as Frenetix-Motion-Planner drives it, with that planner's default settings.

The package `frenetix` generates, checks and costs trajectories; the loop around it is an application that is no
package. This file is our own loop around the package: its sampling, weights, collision checks and stopping
trajectories by the published settings (`configurations/` of TUM-AVS/Frenetix-Motion-Planner, 2024). Dimensions are
those of the ego, the wanted speed is told. It is run on its own Python.
"""

from __future__ import annotations

import math
from itertools import product
from typing import Any

import commonroad_dc.pycrcc as pycrcc
import frenetix
import frenetix.trajectory_functions as functions
import numpy as np
import road
from frenetix.trajectory_functions import cost_functions as costs
from frenetix.trajectory_functions import feasability_functions as checks
from serving import Line, NoTrajectoryError, serve

DT, PERIOD, HORIZON, LOW_SPEED = 0.1, 0.3, 3.0, 2.0
T_MIN, T_STEP, SIDE, SAMPLES = 1.1, 0.3, 3.0, 9
"""End times from 1.1 s every 0.3 s; 9 lateral offsets up to 3 m to each side; 9 end speeds."""
A_MAX, V_SWITCH, DELTA, DELTA_RATE = 11.5, 7.319, 1.066, 0.4
"""Its default vehicle, number 2 of commonroad-vehicle-models (BMW 320i)."""
WEIGHTS = {"lateral_jerk": 1.0, "longitudinal_jerk": 1.0, "distance_to_reference_path": 3.0}
VELOCITY, PREDICTION = 1.0, 200.0
VARIANCE = 0.1
"""Of positions where a prediction tells none [m²]."""
MARGIN = (0.5, 0.2)
"""By which predicted bodies are longer and wider [m]."""


class Frenetix:
    """One drive."""

    name = "frenetix"
    period_s = PERIOD

    def __init__(self, start: Line) -> None:
        e = start["ego"]
        self._size, self._wheelbase = (e["length"], e["width"]), e["wheelbase"]
        self._standing = road.boundary(start, road.scenario(start))
        self._line = frenetix.CoordinateSystemWrapper(np.array(start["route"]))
        self._last: tuple[Any, bool] | None = None

    def plan(self, asked: Line) -> Line:
        """One planning cycle."""
        state, lon, lat = self._start(asked)
        low = state["speed"] < LOW_SPEED
        handler = self._handler(asked, state["heading"], low)
        top = min(state["speed"] + A_MAX / 7.0 * HORIZON, 36.0)
        speeds = {*np.linspace(max(0.01, state["speed"] - 0.5 * A_MAX * HORIZON), top, SAMPLES), lon[1]}
        times = {*np.round(np.arange(T_MIN, HORIZON + DT, T_STEP), 2), HORIZON}
        sides = {*np.linspace(-SIDE, SIDE, SAMPLES), lat[0]}
        matrix = np.array(
            [[0.0, t, *lon, v, 0.0, *lat, d, 0.0, 0.0] for t, v, d in product(sorted(times), speeds, sides)]
        )
        handler.generate_trajectories(matrix, low)
        handler.evaluate_all_current_functions(True)
        drivable = [k for k in handler.get_sorted_trajectories() if k.feasible]
        if not drivable:
            raise NoTrajectoryError("no sample is drivable")
        checker = road.checker(self._standing, asked, MARGIN)
        chosen = next((k for k in drivable if not self._collides(k, checker)), None)
        stopping = chosen is None
        if chosen is None:  # its emergency mode "stopping": the slowest end speed, soonest, nearest to where it is
            by = {(k.sampling_parameters[5], k.sampling_parameters[1], k.sampling_parameters[10]): k for k in drivable}
            chosen = by[min(by, key=lambda k: (k[0], k[1], abs(k[2] - lat[0])))]
        self._last = (chosen, low)
        c, n = chosen.cartesian, len(chosen.cartesian.x)
        heading, half = np.array(c.theta), self._wheelbase / 2
        return {
            "stopping": stopping,
            "t": (DT * np.arange(n)).tolist(),
            "x": (np.array(c.x) + half * np.cos(heading)).tolist(),
            "y": (np.array(c.y) + half * np.sin(heading)).tolist(),
            "heading": heading.tolist(),
            "speed": np.maximum(c.v, 0.0).tolist(),
            "acceleration": np.array(c.a).tolist(),
            "curvature": np.array(c.kappa).tolist(),
        }

    def _start(self, asked: Line) -> tuple[Line, list[float], list[float]]:
        """State to plan from: as the last plan has it, or as the ego is; along and across the line."""
        again, e, half = asked["again"], asked["ego"], self._wheelbase / 2
        if again is not None and self._last is not None and again < len(self._last[0].cartesian.x):
            last, was_low = self._last
            c, k = last.cartesian, last.curvilinear
            at = {
                "x": float(c.x[again]), "y": float(c.y[again]), "heading": float(c.theta[again]),
                "speed": max(float(c.v[again]), 0.0), "acceleration": float(c.a[again]), "kappa": float(c.kappa[again]),
            }  # fmt: skip
            if was_low == (at["speed"] < LOW_SPEED):
                lon = [k.s[again], k.s_dot[again], k.s_ddot[again]]
                return at, lon, [k.d[again], k.d_dot[again], k.d_ddot[again]]
        else:
            at = {
                "x": e["x"] - half * math.cos(e["heading"]), "y": e["y"] - half * math.sin(e["heading"]),
                "heading": e["heading"], "speed": max(e["speed"], 0.0), "acceleration": e["acceleration"],
                "kappa": e["yaw_rate"] / max(e["speed"], 0.1),
            }  # fmt: skip
        found = frenetix.compute_initial_state(
            self._line,
            frenetix.CartesianPlannerState(
                np.array([at["x"], at["y"]]), at["heading"], at["speed"], at["acceleration"],
                math.atan(self._wheelbase * at["kappa"]),
            ),
            self._wheelbase,
            at["speed"] < LOW_SPEED,
        )  # fmt: skip
        return at, list(np.array(found.x0_lon)), list(np.array(found.x0_lat))

    def _handler(self, asked: Line, heading: float, low: bool) -> Any:
        handler = frenetix.TrajectoryHandler(dt=DT)
        for check in (
            checks.CheckYawRateConstraint(DELTA, self._wheelbase, False),
            checks.CheckAccelerationConstraint(V_SWITCH, A_MAX, False),
            checks.CheckCurvatureConstraint(DELTA, self._wheelbase, False),
            checks.CheckCurvatureRateConstraint(self._wheelbase, DELTA_RATE, False),
        ):
            handler.add_feasability_function(check)
        handler.add_cost_function(costs.CalculateLateralJerkCost("lateral_jerk", WEIGHTS["lateral_jerk"]))
        handler.add_cost_function(
            costs.CalculateLongitudinalJerkCost("longitudinal_jerk", WEIGHTS["longitudinal_jerk"])
        )
        reference = "distance_to_reference_path"
        handler.add_cost_function(costs.CalculateDistanceToReferencePathCost(reference, WEIGHTS[reference]))
        handler.add_function(functions.FillCoordinates(low, heading, self._line, HORIZON))
        others = {i: self._predicted(i, o) for i, o in enumerate(asked["others"])}
        body = (*self._size, self._wheelbase / 2)
        handler.add_cost_function(costs.CalculateCollisionProbabilityFast("prediction", PREDICTION, others, *body))
        handler.add_cost_function(
            costs.CalculateVelocityOffsetCost("velocity_offset", VELOCITY, asked["wanted"], DT, T_MIN, False, 2)
        )
        return handler

    @staticmethod
    def _predicted(id: int, o: Line) -> Any:
        spread = np.zeros((6, 6), order="F")
        spread[0, 0] = spread[1, 1] = VARIANCE
        n = round(HORIZON / DT) + 1
        path = [
            frenetix.PoseWithCovariance(
                np.array([x, y, 0.0]), np.array([0.0, 0.0, math.sin(h / 2), math.cos(h / 2)]), spread
            )
            for x, y, h in zip(o["x"][:n], o["y"][:n], o["heading"][:n], strict=True)
        ]
        return frenetix.PredictedObject(id, path, o["length"] + MARGIN[0], o["width"] + MARGIN[1])

    def _collides(self, k: Any, checker: Any) -> bool:
        c, half = k.cartesian, self._wheelbase / 2
        moving = pycrcc.TimeVariantCollisionObject(0)
        for x, y, h in zip(c.x, c.y, c.theta, strict=True):
            at = (h, x + half * math.cos(h), y + half * math.sin(h))
            moving.append_obstacle(pycrcc.RectOBB(self._size[0] / 2, self._size[1] / 2, *at))
        return bool(checker.collide(moving))


if __name__ == "__main__":
    serve(Frenetix)
