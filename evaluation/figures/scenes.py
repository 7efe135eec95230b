"""What the figures show: a car that turns left at a junction, and a road with traffic; asked through the real cores."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from common.geometry import Polyline
from common.messages import FRAME_S, Ego, Map, ObjectClass, Objects, Obstacle, Prediction, Risk, Stamped
from common.risk import RiskParameters
from evaluation.hazards.across import oncoming_left_turn
from evaluation.hazards.episode import STEP_S, Actor, grid
from evaluation.hazards.script import Draw, actor, shift, straight, travelled
from rig.sources import roads
from rig.world import EGO_SIZE, ego_at
from services.predictor.core import Predictor
from services.predictor.settings import PredictorSettings
from services.riskfield.core import RiskField
from services.riskfield.settings import RiskfieldSettings

HISTORY = 30
"""Frames that the predictor has seen before the figure's moment."""


@dataclass(frozen=True)
class Scene:
    """One moment: what was predicted and the volume that follows from it."""

    ego: Ego
    prediction: Prediction
    risk: Risk
    map: Map | None


def seen(actors: list[Actor], k: int) -> Objects:
    """What is perceived at point k of the time grid."""
    back = round(FRAME_S / STEP_S)

    def of(name: str) -> np.ndarray:
        return np.array([float(getattr(a, name)[k]) for a in actors])

    return Objects(
        id=np.arange(1, len(actors) + 1),
        cls=np.array([a.cls for a in actors], dtype=np.uint8),
        x=of("x"),
        y=of("y"),
        heading=of("heading"),
        vx=np.array([(a.x[k] - a.x[k - back]) / FRAME_S for a in actors]),
        vy=np.array([(a.y[k] - a.y[k - back]) / FRAME_S for a in actors]),
        length=np.array([a.length for a in actors]),
        width=np.array([a.width for a in actors]),
        mass=np.zeros(len(actors)),
    )


def scene(actors: list[Actor], t: float, map: Map | None, static: bool, ego: Ego, settings: RiskfieldSettings) -> Scene:
    """Predict at time t of the grid after three seconds of history, and compute the volume; `static`: with the map."""
    predictor = Predictor(PredictorSettings(), RiskParameters())
    per = round(FRAME_S / STEP_S)
    now = round((t + 3.0) / STEP_S)
    for i in range(HISTORY, -1, -1):
        k = now - i * per
        if k < per:
            continue
        capture = round((k * STEP_S + 1000.0) * 1e9)
        prediction = predictor.step(Stamped(seen(actors, k), capture, capture), None, map)
    stamped = Stamped(prediction, capture, capture)
    field = RiskField(settings, RiskParameters(), "cpu")
    risk = field.step(stamped, Stamped(ego, capture, capture), map if static else None, None)
    return Scene(ego, prediction, risk, map)


def turning() -> Scene:
    """A car in the middle of a left turn; the ego stands far away, so that u is the car's own speed."""
    episode = oncoming_left_turn(Draw())
    car = episode.actors[0]
    t = 4.9
    k = round((t + 3.0) / STEP_S)
    ego = ego_at(float(car.x[k]) - 22.0, float(car.y[k]) - 6.5, 0.0, 0.0)
    settings = RiskfieldSettings(
        ahead=34.0, ahead_most=34.0, behind=2.0, width=24.0, h=0.1, slices=1, dtype="float32", device="cpu"
    )
    return scene([car], t, episode.map, False, ego, settings)


def road_map() -> Map:
    """Three lanes with a barrier on each side."""
    lanes = roads.one_way(np.array([(-300.0, -3.5), (900.0, -3.5)]), 3, 3.5, 22.0)
    edge = 1.5 * 3.5 + 0.8
    barriers = [
        Obstacle(id=100 + i, kind="barrier", points=np.array([(-300.0, y), (900.0, y)]))
        for i, y in enumerate((-edge, edge))
    ]
    return Map(lanes=lanes, obstacles=barriers)


def traffic(t: float = 1.2) -> Scene:
    """On a road of three lanes: a truck ahead on the right, a car changing into the ego's lane, others."""
    times = grid(6.0)
    line = straight(-300.0, 0.0, 900.0, 0.0)
    v = 15.0

    def along(cls: ObjectClass, size: tuple[float, float], x: float, speed: float, d: object) -> Actor:
        return actor(cls, size, line, 300.0 + x + v * t - speed * t + travelled(times, [(0.0, speed)]), np.asarray(d))

    actors = [
        along(ObjectClass.CAR, (4.6, 1.8), 24.0, 11.0, 3.5 + shift(times, 0.0, 3.4, -3.5)),
        along(ObjectClass.TRUCK, (12.0, 2.5), 38.0, 10.0, -3.5),
        along(ObjectClass.CAR, (4.4, 1.8), 62.0, 14.0, 3.5),
        along(ObjectClass.MOTORCYCLE, (2.2, 0.8), 14.0, 13.0, -3.3),
        along(ObjectClass.CAR, (4.5, 1.8), -9.0, 19.0, 3.5),
    ]
    settings = RiskfieldSettings(
        ahead=100.0,
        ahead_most=100.0,
        behind=16.0,
        width=13.0,
        h=0.1,
        slices=13,
        slice_s=0.5,
        dtype="float32",
        device="cpu",
    )
    return scene(actors, t, road_map(), True, ego_at(v * t, 0.0, 0.0, v), settings)


def ego_path() -> Polyline:
    """The ego's lane."""
    return straight(-300.0, 0.0, 900.0, 0.0)


EGO_LENGTH, EGO_WIDTH = EGO_SIZE[:2]
