"""The human's own path under our comfort limits."""

import numpy as np
import pytest

from evaluation.planning.yardstick import ACCEL, BRAKE, JERK, comfortably


def _record(v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    s = np.concatenate(([0.0], np.cumsum(v * 0.1)))
    return np.stack((s, np.zeros_like(s)), axis=-1), s


def test_a_gentle_drive_is_as_fast_in_comfort():
    p, s = _record(np.full(100, 10.0))
    t, far = comfortably(p, s)
    assert t[-1] == pytest.approx(far[-1] / 10.0, rel=0.01)


def test_who_accelerates_hard_is_farther_than_comfort_allows():
    p, s = _record(np.minimum(1.0 + 4.0 * 0.1 * np.arange(120), 15.0))
    t, far = comfortably(p, s)
    recorded = np.interp(6.0, np.arange(len(s)) * 0.1, s)
    assert np.interp(6.0, t, far) < 0.85 * recorded
    v = np.diff(far) / np.diff(t)
    a = np.diff(v) / np.diff(t)[1:]
    assert a.max() < ACCEL * 1.1
    assert a.min() > -BRAKE * 1.1
    assert np.abs(np.diff(a) / np.diff(t)[2:]).max() < JERK * 1.1


def test_a_sharp_bend_is_taken_as_slowly_as_is_comfortable():
    angle = np.linspace(0.0, np.pi, 79)
    p = np.column_stack((20.0 * np.sin(angle), 20.0 * (1.0 - np.cos(angle))))
    s = 20.0 * angle
    t, far = comfortably(p, s)  # recorded at 8 m/s; 1.2 m/s² are 4.9 m/s
    v = np.diff(far) / np.diff(t)
    assert np.median(v) == pytest.approx(4.9, abs=0.25)


def test_who_waits_in_the_record_waits_in_comfort_too():
    v = np.concatenate((np.full(40, 5.0), np.linspace(5.0, 0.0, 40), np.zeros(100), np.linspace(0.0, 5.0, 60)))
    p, s = _record(v)
    t, far = comfortably(p, s)
    assert t[-1] >= 23.0
    assert far[-1] == pytest.approx(s[-1], abs=0.6)
