"""The scene of the pipeline benchmark: a straight road full of moving road users, the same load at any time.

Five lanes (six lines) between two barriers; the ego drives in the middle one at 10 m/s without ever being steered. The
others keep their own speeds; who leaves the window around the ego on one side comes in on the other as somebody new.
"""

from __future__ import annotations

import numpy as np

from common.messages import F64, I64, Ego, Goal, Lane, Map, ObjectClass, Objects, Obstacle, Route
from rig.world import SIZES, ego_at

EGO_SPEED = 10.0  # m/s
LANE_WIDTH = 3.5  # m
LANES = 5
ROAD_M = 6000.0  # m; ten minutes
WINDOW = (-25.0, 95.0)  # m around the ego in which everyone is
MASS = {ObjectClass.CAR: 1500.0, ObjectClass.TRUCK: 12000.0, ObjectClass.PEDESTRIAN: 75.0}


class BenchScene:
    """`n` road users, 20 cars to 4 trucks to 8 pedestrians; with `lead` one of them ahead in the ego's lane."""

    def __init__(self, n: int, seed: int = 0, *, lead: bool = True) -> None:
        rng = np.random.default_rng(seed)
        kinds = [ObjectClass.CAR] * 5 + [ObjectClass.TRUCK] + [ObjectClass.PEDESTRIAN] * 2
        self._cls = np.array([kinds[i % len(kinds)] for i in range(n)], dtype=np.uint8)
        walks = self._cls == ObjectClass.PEDESTRIAN
        lane = rng.choice([-2, -1, 1, 2], n)  # never the ego's own: nobody may be driven over
        self._x0: F64 = rng.uniform(*WINDOW, n)
        self._v: F64 = np.where(walks, 1.3 * rng.choice([-1, 1], n), EGO_SPEED + rng.uniform(-3.0, 3.0, n))
        self._y: F64 = np.where(walks, rng.choice([-1, 1], n) * 10.5, lane * LANE_WIDTH)
        first = np.flatnonzero(self._cls == ObjectClass.CAR)[: int(lead)]  # ahead in the ego's lane, as fast as the ego
        self._x0[first], self._y[first], self._v[first] = 40.0, 0.0, EGO_SPEED
        sizes = np.array([SIZES[ObjectClass(c)] for c in self._cls]).reshape(-1, 2)
        self._length, self._width = sizes[:, 0].copy(), sizes[:, 1].copy()
        self._mass: F64 = np.array([MASS[ObjectClass(c)] for c in self._cls], dtype=np.float64)

    def ego(self, t: float) -> Ego:
        """The ego at `t` [s]."""
        return ego_at(100.0 + EGO_SPEED * t, 0.0, 0.0, EGO_SPEED)

    def objects(self, t: float, ego_x: float | None = None) -> Objects:
        """Everyone else at `t` [s], around an ego at `ego_x` [m] if it is not where it should be."""
        span = WINDOW[1] - WINDOW[0]
        x = 100.0 + EGO_SPEED * t if ego_x is None else ego_x
        laps, relative = np.divmod(self._x0 + self._v * t + 100.0 - x - WINDOW[0], span)
        n = len(self._cls)
        ids: I64 = np.arange(n, dtype=np.int64) + n * (laps.astype(np.int64) + 1000)
        return Objects(
            id=ids,
            cls=self._cls,
            x=relative + WINDOW[0] + x,
            y=self._y,
            heading=np.where(self._v < 0, np.pi, 0.0),
            vx=self._v,
            vy=np.zeros(n),
            length=self._length,
            width=self._width,
            mass=self._mass,
        )

    def map(self) -> Map:
        """Five lanes, two barriers."""
        xs = np.arange(0.0, ROAD_M + 1.0, 20.0)

        def line(y: float) -> F64:
            return np.column_stack((xs, np.full_like(xs, y)))

        lanes = []
        for i in range(LANES):
            y = (i - LANES // 2) * LANE_WIDTH
            lanes.append(
                Lane(
                    id=i + 1,
                    centre=line(y),
                    left=line(y + LANE_WIDTH / 2),
                    right=line(y - LANE_WIDTH / 2),
                    left_type="dashed" if i < LANES - 1 else "solid",
                    right_type="dashed" if i > 0 else "solid",
                    speed_limit=13.9,
                    left_neighbour=i + 2 if i < LANES - 1 else None,
                    right_neighbour=i if i > 0 else None,
                )
            )
        edge = LANES * LANE_WIDTH / 2 + 0.8
        barriers = [Obstacle(id=100 + k, kind="barrier", points=line(y)) for k, y in enumerate((-edge, edge))]
        return Map(lanes=lanes, obstacles=barriers)

    def route(self) -> Route:
        """Along the middle lane to the end of the road."""
        xs = np.arange(0.0, ROAD_M + 1.0, 20.0)
        goal = Goal(x=ROAD_M, y=0.0, radius=5.0)
        return Route(reference=np.column_stack((xs, np.zeros_like(xs))), goal=goal, lane_ids=[3], speed_limit=13.9)
