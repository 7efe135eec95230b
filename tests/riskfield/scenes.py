# ruff: noqa: C408
"""Scenes for the riskfield's tests: predictions, egos and maps, random or fixed."""

from __future__ import annotations

import numpy as np

from common.messages import (
    FRAME_S,
    HISTORY_FRAMES,
    PREDICTION_FRAMES,
    Ego,
    Lane,
    Map,
    Obstacle,
    Prediction,
    Stamped,
)

SIZES = {1: (4.5, 1.8), 2: (10.0, 2.5), 3: (12.0, 2.55), 4: (2.2, 0.8), 5: (1.8, 0.6), 6: (0.5, 0.5), 0: (4.0, 1.8)}


def stamped(value):
    return Stamped(value=value, capture_ns=0, received_ns=0)


def ego(x=0.0, y=0.0, heading=0.0, speed=10.0, **more) -> Ego:
    values = dict(
        x=x, y=y, heading=heading, vx=speed * np.cos(heading), vy=speed * np.sin(heading), acceleration=0.0,
        yaw_rate=0.0, length=4.5, width=1.8, wheelbase=2.7,
    )  # fmt: skip
    return Ego(**(values | more))


def prediction(rows, *, sigma=None) -> Prediction:
    """One object a row: dict of x, y, heading, speed, and optionally rate [rad/s], acceleration, cls, length, width."""
    n = len(rows)

    def get(key, default):
        return np.array([float(r.get(key, default)) for r in rows])

    x0, y0, heading0, speed0 = (get(k, 0.0) for k in ("x", "y", "heading", "speed"))
    rate, acceleration = get("rate", 0.0), get("acceleration", 0.0)
    cls = np.array([int(r.get("cls", 1)) for r in rows], dtype=np.uint8)
    t = np.arange(-HISTORY_FRAMES, PREDICTION_FRAMES + 1) * FRAME_S
    speed = np.maximum(speed0[:, None] + acceleration[:, None] * np.maximum(t, 0.0), 0.0)
    heading = heading0[:, None] + rate[:, None] * t
    mid = 0.5 * (heading[:, 1:] + heading[:, :-1])
    step = 0.5 * (speed[:, 1:] + speed[:, :-1]) * FRAME_S
    zero = np.zeros((n, 1))
    x = np.concatenate((zero, np.cumsum(step * np.cos(mid), 1)), 1)
    y = np.concatenate((zero, np.cumsum(step * np.sin(mid), 1)), 1)
    now = HISTORY_FRAMES
    x, y = x - x[:, now : now + 1] + x0[:, None], y - y[:, now : now + 1] + y0[:, None]
    return Prediction(
        id=np.array([int(r.get("id", 10 + k)) for k, r in enumerate(rows)], dtype=np.int64),
        cls=cls,
        x0=x0,
        y0=y0,
        heading0=heading0,
        vx0=speed0 * np.cos(heading0),
        vy0=speed0 * np.sin(heading0),
        length=np.array([float(r.get("length", SIZES[int(c)][0])) for r, c in zip(rows, cls, strict=True)]),
        width=np.array([float(r.get("width", SIZES[int(c)][1])) for r, c in zip(rows, cls, strict=True)]),
        mass=get("mass", 0.0),
        x=x[:, now + 1 :],
        y=y[:, now + 1 :],
        heading=np.remainder(heading[:, now + 1 :] + np.pi, 2 * np.pi).astype(np.float32) - np.float32(np.pi),
        speed=speed[:, now + 1 :].astype(np.float32),
        past_x=x[:, :now],
        past_y=y[:, :now],
        method=np.zeros(n, dtype=np.uint8),
        sigma=None if sigma is None else np.full((n, PREDICTION_FRAMES), sigma, dtype=np.float32),
    )


def straight_road(lanes=2, width=3.5, x0=-60.0, x1=160.0, points=45, edge="road_edge", y0=None, first_id=1) -> Map:
    """Parallel lanes along x, all driving the same way, outer boundaries of type `edge`."""
    x = np.linspace(x0, x1, points)
    base = -width / 2 if y0 is None else y0

    def line(y):
        return np.stack((x, np.full_like(x, y)), axis=-1)

    out = []
    for k in range(lanes):
        right, left = base + k * width, base + (k + 1) * width
        out.append(
            Lane(
                id=first_id + k,
                centre=line(0.5 * (left + right)),
                left=line(left),
                right=line(right),
                left_type=edge if k == lanes - 1 else "dashed",
                right_type=edge if k == 0 else "dashed",
                left_neighbour=None if k == lanes - 1 else first_id + k + 1,
                right_neighbour=None if k == 0 else first_id + k - 1,
            )
        )
    return Map(lanes=out)


def standard_frame(seed=0, objects=32):
    """The frame of the performance notes: 20 cars, 4 trucks, 8 pedestrians in 32; lane lines and barriers."""
    rng = np.random.default_rng(seed)
    rows = []
    for k in range(objects):
        cls = 2 if k % 8 == 0 else 6 if k % 4 == 1 else 1
        speed = rng.uniform(0.5, 2.0) if cls == 6 else rng.uniform(5.0, 18.0)
        turning = rng.uniform(-0.15, 0.15) if k % 3 == 0 else 0.0
        rows.append(
            dict(
                x=rng.uniform(-25, 125), y=rng.uniform(-18, 18), cls=cls, speed=speed, rate=turning,
                heading=rng.uniform(-np.pi, np.pi) if cls == 6 else rng.choice([0.0, np.pi]) + rng.normal(0, 0.05),
            )
        )  # fmt: skip
    road = straight_road(lanes=7, y0=-12.25, edge="barrier", points=50)
    return prediction(rows), ego(speed=12.0), road


def random_scene(rng: np.random.Generator, *, origin=(0.0, 0.0)):
    """A small random scene: a few objects of any class and motion, a bent road, a barrier; anywhere on the map."""
    ox, oy = origin
    heading = rng.uniform(-np.pi, np.pi)
    c, s = np.cos(heading), np.sin(heading)

    def place(x, y):
        return ox + c * x - s * y, oy + s * x + c * y

    rows = []
    for _ in range(rng.integers(0, 5)):
        x, y = place(rng.uniform(-30, 40), rng.uniform(-20, 20))
        rows.append(
            dict(
                x=x, y=y, heading=rng.uniform(-np.pi, np.pi), cls=rng.integers(0, 7),
                mass=rng.choice([0.0, rng.uniform(50, 120)]),
                speed=rng.choice([0.0, 0.2, rng.uniform(0, 4), rng.uniform(0, 25)]),
                rate=rng.choice([0.0, rng.uniform(-0.5, 0.5)]), acceleration=rng.uniform(-4, 2),
            )
        )  # fmt: skip
    bend = rng.uniform(-0.02, 0.02)
    x = np.sort(rng.uniform(-40, 60, rng.integers(3, 12)))

    def line(d):
        return np.stack(place(x, bend * x**2 / 2 + d), axis=-1)

    kinds = ["unknown", "virtual", "dashed", "solid", "kerb", "barrier", "road_edge"]
    road = Map(
        lanes=[
            Lane(
                id=7, centre=line(0.0), left=line(1.75), right=line(-1.75),
                left_type=str(rng.choice(kinds)), right_type=str(rng.choice(kinds)),
            )
        ],
        obstacles=[
            Obstacle(id=8, kind="barrier", points=line(rng.uniform(3, 9)), width=float(rng.uniform(0, 1.5))),
            Obstacle(id=9, kind="stop_line", points=np.stack((place(9.0, -2.0), place(9.0, 2.0)))),
        ],
    )  # fmt: skip
    me = ego(ox, oy, heading + rng.uniform(-0.5, 0.5), rng.uniform(0, 20))
    return prediction(rows, sigma=rng.choice([None, 0.3])), me, road
