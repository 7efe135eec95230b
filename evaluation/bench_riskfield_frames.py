"""Frames of the risk-field benchmark: a straight road of seven lanes full of road users, seen by an ego at 12 m/s.

`standard`: 13 slices of 100 × 40 m at 0.25 m, 32 road users (20 cars, 4 trucks, 8 pedestrians), 6 lane lines and 2
barriers of 50 points; `dense`: 128 road users; `fine`: cells of 0.1 m. Every third one turns, so that paths are curved.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from common.messages import (
    F64,
    FRAME_S,
    HISTORY_FRAMES,
    PREDICTION_FRAMES,
    Ego,
    Grid,
    Lane,
    Map,
    ObjectClass,
    Prediction,
)
from common.risk import RiskParameters
from common.risk_sources import DynamicSources, StaticLine, dynamic_sources, shares_at_points
from rig.world import SIZES, ego_at
from services.riskfield.grid import cell_centres, grid_around
from services.riskfield.selection import left_out
from services.riskfield.settings import RiskfieldSettings
from services.riskfield.static_layer import StaticLayer

LANES, LANE_WIDTH, POINTS = 7, 3.5, 50
BEHIND = 0.25
"""Share of the grid's length that lies behind the ego."""


@dataclass(frozen=True)
class Frame:
    """What one frame of the riskfield starts from."""

    name: str
    settings: RiskfieldSettings
    prediction: Prediction
    ego: Ego
    map: Map

    @property
    def grid(self) -> Grid:
        """Where the volume lies."""
        return grid_around(self.ego, self.settings)

    @property
    def times(self) -> list[float]:
        """Of the slices [s]."""
        return [j * self.settings.slice_s for j in range(self.settings.slices)]

    def sources(self, p: RiskParameters) -> tuple[DynamicSources, np.ndarray, tuple[StaticLine, ...]]:
        """Objects at the slices, which of them count, and lines."""
        sources = dynamic_sources(self.prediction, self.times, (self.ego.vx, self.ego.vy), p)
        counts, _ = left_out(sources, self.ego)
        return sources, counts, StaticLayer(self.map, p).within(self.grid, (), self.ego)


def make(
    name: str, objects: int = 32, h: float = 0.25, length: float = 100.0, width: float = 40.0, seed: int = 0
) -> Frame:
    """A frame with so many road users spread over a grid of so many metres."""
    settings = RiskfieldSettings(
        ahead=(1 - BEHIND) * length, ahead_most=(1 - BEHIND) * length, behind=BEHIND * length, width=width, h=h
    )
    ego = ego_at(0.0, 0.0, 0.0, 12.0)
    return Frame(name, settings, _predicted(objects, length, width, seed), ego, _road(length))


FRAMES: dict[str, Callable[[], Frame]] = {
    "standard": lambda: make("standard"),
    "dense": lambda: make("dense", objects=128),
    "fine": lambda: make("fine", h=0.1),
}


def reference(
    frame: Frame, p: RiskParameters, points: int, seed: int = 1
) -> tuple[tuple[np.ndarray, np.ndarray, np.ndarray], F64]:
    """M in float64 at randomly drawn cells: (slice, row, column), and the value there.

    Half of the cells lie anywhere, half of them where a road user is or is about to be.
    """
    rng = np.random.default_rng(seed)
    grid = frame.grid
    sources, counts, lines = frame.sources(p)
    X, Y = cell_centres(grid)
    k = np.repeat(np.arange(frame.settings.slices), points)
    i, j = rng.integers(0, grid.rows, len(k)), rng.integers(0, grid.columns, len(k))
    near = rng.random(len(k)) < 0.5
    who = rng.integers(0, len(sources.id), len(k)) if len(sources.id) else np.zeros(len(k), dtype=np.int64)
    if len(sources.id):
        ahead = rng.uniform(-10.0, 30.0, len(k))
        x = sources.x[k, who] + ahead * np.cos(sources.heading[k, who]) + rng.normal(0, 1.5, len(k))
        y = sources.y[k, who] + ahead * np.sin(sources.heading[k, who]) + rng.normal(0, 1.5, len(k))
        i = np.where(near, np.clip(((x - grid.x) / grid.h).astype(int), 0, grid.rows - 1), i)
        j = np.where(near, np.clip(((y - grid.y) / grid.h).astype(int), 0, grid.columns - 1), j)
    values = np.zeros(len(k))
    for s in range(frame.settings.slices):
        here = k == s
        shares = shares_at_points(X[i[here], j[here]], Y[i[here], j[here]], sources, s, lines, p)
        values[here] = shares.potential[counts].sum(0) + shares.kinetic[counts].sum(0) + shares.static.sum(0)
    return (k, i, j), values


def _predicted(n: int, length: float, width: float, seed: int) -> Prediction:
    rng = np.random.default_rng(seed)
    kinds = [ObjectClass.CAR] * 5 + [ObjectClass.TRUCK] + [ObjectClass.PEDESTRIAN] * 2
    cls = np.array([kinds[k % len(kinds)] for k in range(n)], dtype=np.uint8)
    walks = cls == ObjectClass.PEDESTRIAN
    speed = np.where(walks, rng.uniform(0.5, 2.0, n), rng.uniform(5.0, 18.0, n))
    x0 = rng.uniform(-BEHIND * length, (1 - BEHIND) * length, n)
    y0 = rng.uniform(-0.45 * width, 0.45 * width, n)
    heading0 = np.where(walks, rng.uniform(-np.pi, np.pi, n), rng.choice([0.0, np.pi], n) + rng.normal(0.0, 0.05, n))
    rate = np.where(np.arange(n) % 3 == 0, rng.uniform(-0.15, 0.15, n), 0.0)
    t = np.arange(-HISTORY_FRAMES, PREDICTION_FRAMES + 1) * FRAME_S
    heading = heading0[:, None] + rate[:, None] * t
    # along a circle, where the rate is 0 along its tangent
    safe = np.where(rate == 0.0, 1.0, rate)[:, None]
    straight = (rate == 0.0)[:, None]
    x = np.where(straight, np.cos(heading0)[:, None] * t, (np.sin(heading) - np.sin(heading0)[:, None]) / safe)
    y = np.where(straight, np.sin(heading0)[:, None] * t, (np.cos(heading0)[:, None] - np.cos(heading)) / safe)
    x, y = x0[:, None] + speed[:, None] * x, y0[:, None] + speed[:, None] * y
    sizes = np.array([SIZES[ObjectClass(c)] for c in cls]).reshape(-1, 2)
    now = HISTORY_FRAMES
    return Prediction(
        id=np.arange(1, n + 1),
        cls=cls,
        x0=x0,
        y0=y0,
        heading0=heading0,
        vx0=speed * np.cos(heading0),
        vy0=speed * np.sin(heading0),
        length=sizes[:, 0].copy(),
        width=sizes[:, 1].copy(),
        mass=np.zeros(n),
        x=x[:, now + 1 :],
        y=y[:, now + 1 :],
        heading=heading[:, now + 1 :].astype(np.float32),
        speed=np.repeat(speed[:, None], PREDICTION_FRAMES, axis=1).astype(np.float32),
        past_x=x[:, :now],
        past_y=y[:, :now],
        method=np.zeros(n, dtype=np.uint8),
    )


def _road(length: float) -> Map:
    x = np.linspace(-BEHIND * length - 10.0, (1 - BEHIND) * length + 10.0, POINTS)

    def line(y: float) -> F64:
        return np.column_stack((x, np.full_like(x, y)))

    lanes = []
    for k in range(LANES):
        right = (k - LANES / 2) * LANE_WIDTH
        lanes.append(
            Lane(
                id=k + 1,
                centre=line(right + LANE_WIDTH / 2),
                left=line(right + LANE_WIDTH),
                right=line(right),
                left_type="barrier" if k == LANES - 1 else "dashed",
                right_type="barrier" if k == 0 else "dashed",
                left_neighbour=None if k == LANES - 1 else k + 2,
                right_neighbour=None if k == 0 else k,
            )
        )
    return Map(lanes=lanes)
