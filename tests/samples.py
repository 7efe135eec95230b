"""One valid message of every kind, for tests."""

from __future__ import annotations

from typing import Any

import numpy as np

from common import messages as m


def ego(**changes: Any) -> m.Ego:
    fields: dict[str, Any] = {
        "x": 0.0, "y": 0.0, "heading": 0.0, "vx": 10.0, "vy": 0.0, "acceleration": 0.0, "yaw_rate": 0.0,
        "length": 4.5, "width": 1.8, "wheelbase": 2.7,
    }  # fmt: skip
    return m.Ego(**{**fields, **changes})


def objects(n: int = 3, **changes: Any) -> m.Objects:
    fields: dict[str, Any] = {
        "id": np.arange(n), "cls": np.full(n, m.ObjectClass.CAR, np.uint8), "x": 20.0 + 15.0 * np.arange(n),
        "y": np.zeros(n), "heading": np.zeros(n), "vx": np.full(n, 8.0), "vy": np.zeros(n),
        "length": np.full(n, 4.5), "width": np.full(n, 1.8), "mass": np.zeros(n),
    }  # fmt: skip
    return m.Objects(**{**fields, **changes})


def lane(lane_id: int = 1, y: float = 0.0, length: float = 200.0, **changes: Any) -> m.Lane:
    x = np.linspace(-50.0, length, 26)

    def line(offset: float) -> m.F64:
        return np.column_stack((x, np.full_like(x, y + offset)))

    fields: dict[str, Any] = {"id": lane_id, "centre": line(0.0), "left": line(1.75), "right": line(-1.75),
                              "speed_limit": 13.9}  # fmt: skip
    return m.Lane(**{**fields, **changes})


def world() -> m.Map:
    return m.Map(
        lanes=[
            lane(1, right_type="road_edge", left_neighbour=2),
            lane(2, 3.5, left_type="road_edge", right_neighbour=1),
        ],
        obstacles=[m.Obstacle(id=9, kind="stop_line", points=np.array([[80.0, -1.75], [80.0, 1.75]]))],
    )


def route() -> m.Route:
    x = np.linspace(-50.0, 200.0, 51)
    return m.Route(
        reference=np.column_stack((x, np.zeros_like(x))), goal=m.Goal(x=150.0, y=0.0, radius=5.0), lane_ids=[1],
        speed_limit=13.9,
    )  # fmt: skip


def closures() -> m.Closures:
    return m.Closures(ids=[9])


def prediction(n: int = 3, **changes: Any) -> m.Prediction:
    o = objects(n)
    t = m.FRAME_S * np.arange(1, m.PREDICTION_FRAMES + 1)
    past = -m.FRAME_S * np.arange(10, 0, -1)
    fields: dict[str, Any] = {
        "id": o.id, "cls": o.cls, "x0": o.x, "y0": o.y, "heading0": o.heading, "vx0": o.vx, "vy0": o.vy,
        "length": o.length, "width": o.width, "mass": o.mass,
        "x": o.x[:, None] + o.vx[:, None] * t, "y": o.y[:, None] + o.vy[:, None] * t,
        "heading": np.zeros((n, 60), np.float32), "speed": np.full((n, 60), 8.0, np.float32),
        "past_x": o.x[:, None] + o.vx[:, None] * past, "past_y": o.y[:, None] + o.vy[:, None] * past,
        "method": np.zeros(n, np.uint8),
    }  # fmt: skip
    return m.Prediction(**{**fields, **changes})


def risk(rows: int = 40, columns: int = 24, slices: int = 13, **changes: Any) -> m.Risk:
    volume = np.zeros((slices, rows, columns), np.float16)
    volume[:, rows // 2 : rows // 2 + 4, columns // 2 : columns // 2 + 4] = 0.9
    dominant = np.full((slices, -(-rows // 4), -(-columns // 4)), m.NO_SLOT, np.uint8)
    dominant[:, rows // 8, columns // 8] = 0
    fields: dict[str, Any] = {
        "grid": m.Grid(x=-10.0, y=-columns / 4, heading=0.0, rows=rows, columns=columns, h=0.5),
        "slice_times": [0.5 * j for j in range(slices)], "slots": [m.Slot(7, "potential", 1)],
        "left_out": [m.LeftOut(8, "follows the ego")], "volume": volume, "dominant": dominant,
    }  # fmt: skip
    return m.Risk(**{**fields, **changes})


def trajectory(t0: float = 0.0, n: int = 31, v0: float = 10.0, a: float = 0.0) -> m.Trajectory:
    t = t0 + 0.1 * np.arange(n)
    v = np.maximum(v0 + a * (t - t0), 0.0)
    x = np.concatenate(([0.0], np.cumsum(0.05 * (v[1:] + v[:-1]))))
    zero = np.zeros(n)
    return m.Trajectory(t=t, x=x, y=zero, heading=zero, curvature=zero, speed=v, acceleration=np.full(n, a))


def plan(**changes: Any) -> m.Plan:
    fields: dict[str, Any] = {
        "mode": "drive", "reason": "free", "planner": "default", "profile": trajectory(),
        "tail": trajectory(0.3, 41, 10.0, -2.5), "desired_speed": 10.0, "chosen": 0,
        "candidates": m.Candidates(x=np.zeros((2, 5)), y=np.zeros((2, 5)), desired_speed=np.array([10.0, 8.0]),
                                   score=np.array([1.0, 0.5])),
        "slice_risk": m.SliceRisk(t=0.5 * np.arange(13), risk=np.zeros(13), x=np.zeros(13), y=np.zeros(13)),
        "decision": m.Decision(sentence="free road", term="limit"),
    }  # fmt: skip
    return m.Plan(**{**fields, **changes})


def status(service: str = "planner") -> m.Status:
    return m.Status(service=service, state="ready", reason="driving", uptime_s=3.0,
                    inputs={"ego": m.InputHealth(alive=True, rate_ok=True, valid=True, age_s=0.02)},
                    counters={"risk:stale": 2}, work_ms={"p50": 3.0})  # fmt: skip


ALL = {
    "ego": ego, "objects": objects, "map": world, "route": route, "closures": closures, "prediction": prediction,
    "risk": risk, "plan": plan, "status/planner": status,
}  # fmt: skip
