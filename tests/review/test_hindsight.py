"""Prediction error in hindsight: the distance between what was predicted and what then happened, of the same object."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

pytest.importorskip("rerun")

from common.messages import FRAME_S, Method
from evaluation.review.hindsight import errors, table
from evaluation.review.recording import Foreseen, Recording, Seen, States
from viz.account import HORIZONS_S

FRAMES = 100
H = np.array(HORIZONS_S)


def recording(seen: list[Seen], foreseen: list[Foreseen]) -> Recording:
    none = np.zeros(0)
    return Recording(
        (Path("made.rrd"),), "made", {}, States(*[none] * 8), (4.5, 1.8), seen, foreseen, [], {}, {}, (none, none), 1.0,
        1.5, (0.0, 0.0),
    )  # fmt: skip


def frame(t: float, ids: list[int], x: list[float], y: list[float], v: tuple[float, float]) -> Seen:
    n, f = len(ids), np.float32
    ones = np.ones(n, f)
    return Seen(
        t, np.array(ids), np.ones(n, np.uint8), np.array(x), np.array(y), 0 * ones, v[0] * ones, v[1] * ones, ones, ones
    )


def straight(v: tuple[float, float], jitter: np.ndarray | None = None) -> list[Seen]:
    at = np.arange(FRAMES) * FRAME_S + (0 if jitter is None else jitter)
    return [frame(float(t), [7], [v[0] * t], [v[1] * t], v) for t in at]


def guess(t: float, method: Method, dx: np.ndarray, dy: np.ndarray) -> Foreseen:
    return Foreseen(t, np.array([7]), np.array([method], np.uint8), dx[None].astype(np.float32), dy[None])


@given(
    v=st.tuples(st.floats(-20, 20), st.floats(-20, 20)).filter(lambda v: np.hypot(*v) > 1.0),
    wrong=st.tuples(st.floats(-9, 9), st.floats(-9, 9)),
    method=st.sampled_from(list(Method)),
)
@settings(max_examples=40, deadline=None)
def test_a_prediction_that_is_wrong_by_a_known_amount_has_that_error(v, wrong, method) -> None:
    made = [guess(k * FRAME_S, method, v[0] * H + wrong[0], v[1] * H + wrong[1]) for k in range(30)]
    ((name, moving), by_horizon), = errors(recording(straight(v), made)).items()  # fmt: skip
    assert (name, moving) == (method.name.lower(), True)
    for e in by_horizon:
        assert len(e.method) == 30
        assert np.allclose(e.method, np.hypot(*wrong), atol=1e-3)
        assert np.allclose(e.constant_velocity, 0.0, atol=1e-3)


def test_frames_that_come_a_little_late_count_and_those_that_never_came_do_not() -> None:
    v = (10.0, 0.0)
    jitter = np.random.default_rng(0).uniform(-0.01, 0.01, FRAMES)
    seen = [s for k, s in enumerate(straight(v, jitter)) if k != 20]
    made = [guess(s.t, Method.CTRA, v[0] * H, v[1] * H) for s in seen[:41]]
    by_horizon = errors(recording(seen, made))["ctra", True]
    assert [len(e.method) for e in by_horizon] == [40, 40, 41, 41, 41, 39]  # frame 20 is missed at 1 and 2 s, …
    assert max(e.method.max() for e in by_horizon) < 0.25  # 10 m/s for twice 10 ms


def test_whoever_has_left_is_not_compared_and_nobody_is_taken_for_another() -> None:
    v = (5.0, 0.0)
    seen = straight(v)
    gone = [
        frame(s.t, [8], [s.x[0] + 100.0], [0.0], v) if s.t > 4.0 else s for s in seen
    ]  # another id at another place  # fmt: skip
    by_horizon = errors(recording(gone, [guess(0.0, Method.LSTM, v[0] * H, v[1] * H)]))["lstm", True]
    assert [len(e.method) for e in by_horizon] == [1, 1, 1, 1, 0, 0]
    rows = table(errors(recording(gone, [guess(0.0, Method.LSTM, v[0] * H, v[1] * H)])))
    assert [r["horizon_s"] for r in rows] == [1.0, 2.0, 3.0, 4.0]


def test_an_empty_recording_has_no_errors() -> None:
    assert errors(recording([], [])) == {}
    assert table({}) == []
