"""What is far stronger than noise may be believed from one second alone; as shipped it is not."""

from __future__ import annotations

import numpy as np

from common.messages import ObjectClass, Objects, Stamped
from common.risk import RiskParameters
from services.predictor.core import Predictor
from services.predictor.settings import KinematicSettings, PredictorSettings


def predicted(x: np.ndarray, y: np.ndarray, settings: PredictorSettings) -> np.ndarray:
    """Where the last frame's prediction ends after 3 s; one car, one row a frame of 0.1 s."""
    predictor = Predictor(settings, RiskParameters())
    heading = np.arctan2(np.gradient(y), np.gradient(x))
    for k in range(1, len(x)):
        objects = Objects(
            id=np.array([1]),
            cls=np.array([ObjectClass.CAR], dtype=np.uint8),
            x=x[k : k + 1],
            y=y[k : k + 1],
            heading=heading[k : k + 1],
            vx=np.diff(x)[k - 1 : k] / 0.1,
            vy=np.diff(y)[k - 1 : k] / 0.1,
            length=np.array([4.5]),
            width=np.array([1.8]),
            mass=np.zeros(1),
        )
        at = round((k + 100) * 1e8)
        prediction = predictor.step(Stamped(objects, at, at), None, None)
    return np.array([prediction.x[0, 29], prediction.y[0, 29]])


def turning(rate: float, turned_s: float) -> tuple[np.ndarray, np.ndarray]:
    """5 m/s straight on, then for the last `turned_s` a turn at `rate` [rad/s]."""
    t = np.arange(0.0, 3.0, 0.1)
    course = rate * np.maximum(t - (t[-1] - turned_s), 0.0)
    return np.cumsum(0.5 * np.cos(course)), np.cumsum(0.5 * np.sin(course))


def test_a_strong_turn_is_believed_sooner_where_it_is_wished():
    x, y = turning(0.8, 1.0)
    usual = predicted(x, y, PredictorSettings())
    sure = predicted(x, y, PredictorSettings(kinematic=KinematicSettings(turn_sure=0.35)))
    goes_on = 0.8 * (1.0 + np.arange(1, 31) * 0.1)
    truth = np.array([x[-1] + 0.5 * np.cos(goes_on).sum(), y[-1] + 0.5 * np.sin(goes_on).sum()])
    assert np.hypot(*(sure - truth)) < 0.7 * np.hypot(*(usual - truth))


def test_a_gentle_turn_is_judged_as_always():
    x, y = turning(0.2, 1.0)
    sure = predicted(x, y, PredictorSettings(kinematic=KinematicSettings(turn_sure=0.35)))
    np.testing.assert_array_equal(sure, predicted(x, y, PredictorSettings()))


def test_strong_braking_is_believed_sooner_where_it_is_wished():
    t = np.arange(0.0, 3.0, 0.1)
    v = 12.0 - 5.0 * np.maximum(t - 2.0, 0.0)
    x, y = np.cumsum(v) * 0.1, np.zeros(len(t))
    usual = predicted(x, y, PredictorSettings())
    sure = predicted(x, y, PredictorSettings(kinematic=KinematicSettings(braking_sure_mps2=2.0)))
    stops = x[-1] + v[-1] ** 2 / (2 * 5.0)
    assert abs(sure[0] - stops) < 0.7 * abs(usual[0] - stops)
