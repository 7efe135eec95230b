"""The predictor as a whole: valid messages whatever arrives, policies, the path already driven, its cost."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from common.codec import check
from common.messages import SPEED_LIMIT, XY_LIMIT, Lane, Map, Method, Objects
from common.risk import RiskParameters
from services.predictor.core import Predictor
from services.predictor.kinematic import Motion
from services.predictor.selection import POLICIES, Known, choose
from services.predictor.settings import PredictorSettings
from tests.predictor.scenes import drive, lane, line, objects_of, predictor, stamped, straight


def values(n, low, high):
    """Numbers of the whole range a message allows, extremes often."""
    return hnp.arrays(
        np.float64, n, elements=st.one_of(st.sampled_from([low, high, 0.0 if low <= 0 else low]), st.floats(low, high))
    )


@st.composite
def messages(draw):
    n = draw(st.integers(0, 6))
    near = draw(st.booleans())
    xy = 50.0 if near else XY_LIMIT
    return Objects(
        id=np.array(draw(st.lists(st.integers(0, 8), min_size=n, max_size=n, unique=True)), dtype=np.int64),
        cls=draw(hnp.arrays(np.uint8, n, elements=st.integers(0, 6))),
        x=draw(values(n, -xy, xy)),
        y=draw(values(n, -xy, xy)),
        heading=draw(values(n, -100, 100)),
        vx=draw(values(n, -SPEED_LIMIT, SPEED_LIMIT)),
        vy=draw(values(n, -SPEED_LIMIT, SPEED_LIMIT)),
        length=draw(values(n, 0.05, 100)),
        width=draw(values(n, 0.05, 100)),
        mass=draw(values(n, 0, 1e6)),
    )


@st.composite
def maps(draw):
    xy = draw(st.sampled_from([60.0, 1e4, XY_LIMIT]))

    def points():
        return hnp.arrays(np.float64, (draw(st.integers(2, 5)), 2), elements=st.floats(-xy, xy))

    ids = st.integers(0, 4)
    lanes = [
        Lane(
            id=draw(ids),
            centre=draw(points()),
            left=draw(points()),
            right=draw(points()),
            speed_limit=draw(st.floats(0.0, SPEED_LIMIT)),
            successors=draw(st.lists(ids, max_size=3)),
            left_neighbour=draw(st.one_of(st.none(), ids)),
            right_neighbour=draw(st.one_of(st.none(), ids)),
        )
        for _ in range(draw(st.integers(0, 4)))
    ]
    return Map(lanes=lanes)


SCENES = {
    "stream": st.lists(st.tuples(messages(), st.integers(-200_000_000, 1_500_000_000)), min_size=1, max_size=8),
    "map": st.one_of(st.none(), maps()),
    "policy": st.sampled_from(list(POLICIES)),
}


@given(**SCENES)
@settings(max_examples=50, deadline=None)
def test_whatever_valid_messages_arrive_the_prediction_is_valid(stream, map, policy):
    run(stream, map, policy)


@pytest.mark.slow
@given(**SCENES)
@settings(max_examples=1500, deadline=None)
def test_whatever_valid_messages_arrive_the_prediction_is_valid_at_length(stream, map, policy):
    run(stream, map, policy)


def run(stream, map, policy):
    p, now = predictor(policy=policy), 0
    for message, step in stream:
        check(message)
        now += step
        with np.errstate(all="raise", under="ignore"):
            prediction = p.step(stamped(message, now * 1e-9), None, map)
        check(prediction)
        np.testing.assert_array_equal(prediction.id, message.id)
        for name in ("cls", "length", "width", "mass"):
            np.testing.assert_array_equal(getattr(prediction, name), getattr(message, name))


def test_no_objects_give_an_empty_prediction():
    q = predictor().step(stamped(objects_of([]), 0.0), None, None)
    check(q)
    assert q.x.shape == (0, 60)


def test_each_object_is_predicted_as_if_alone():
    paths = [straight(10.0 * i, 3.0 * i, 0.4 * i, 1.0 + 3 * i, 0.5 * i - 1.0) for i in range(6)]
    together = drive(paths)
    for i, path in enumerate(paths):
        alone = drive([path])
        np.testing.assert_allclose(alone.x[0], together.x[i], atol=1e-9)
        assert alone.method[0] == together.method[i]


def test_the_path_already_driven_is_what_was_seen_then_straight():
    full, short = (drive([straight(0.0, 0.0, 0.3, 10.0)], frames=n) for n in (30, 4))
    back = -0.1 * np.arange(10, 0, -1) * 10.0
    for q in (full, short):
        np.testing.assert_allclose(q.past_x[0], back * np.cos(0.3), atol=1e-5)
        np.testing.assert_allclose(q.past_y[0], back * np.sin(0.3), atol=1e-5)
    assert predictor(past_frames=3).step(stamped(objects_of([(0, 0, 0, 1)]), 0.0), None, None).past_x.shape == (1, 3)


def test_an_older_message_is_predicted_without_history_and_leaves_it_alone():
    p = predictor()
    drive([straight(0.0, 0.0, 0.0, 10.0)], with_=p)  # until t = 100 s
    q = p.step(stamped(objects_of([(50.0, 0.0, 0.0, 3.0)]), 99.85), None, None)
    assert q.vx0[0] == 3.0
    q = p.step(stamped(objects_of([(1.0, 0.0, 0.0, 10.0)]), 100.1), None, None)
    assert q.vx0[0] == pytest.approx(10.0, abs=1e-5)
    assert q.past_x[0, 0] == pytest.approx(-9.0, abs=1e-5)


def known(on_lane, full, kinematic=Method.CTRA):
    return Known(np.array([on_lane]), np.array([full]), np.array([1], np.uint8), np.array([kinematic], np.uint8))


@pytest.mark.parametrize(
    ("policy", "on_lane", "full", "wanted"),
    [
        ("paper", False, True, Method.LSTM),
        ("paper", False, False, Method.CTRA),
        ("paper", True, True, Method.MAP_BASED),
        ("learned-first", True, True, Method.LSTM),
        ("learned-first", True, False, Method.MAP_BASED),
        ("learned-first", False, False, Method.CTRA),
        ("map-first", True, True, Method.MAP_BASED),
        ("map-first", False, True, Method.CTRA),
        ("kinematic", True, True, Method.CTRA),
    ],
)
def test_policies_choose_as_they_say_and_fall_back_truthfully(policy, on_lane, full, wanted):
    k = known(on_lane, full)
    assert choose(policy, k, True).method[0] == wanted
    assert not choose(policy, k, True).missed.any()
    without = choose(policy, k, False)
    assert without.missed[0] == (wanted == Method.LSTM)
    assert without.method[0] == ((Method.MAP_BASED if on_lane else Method.CTRA) if wanted == Method.LSTM else wanted)


def test_a_learned_predictor_is_asked_where_the_policy_wants_it():
    class Still:
        name = "still"
        classes = np.ones(7, dtype=bool)
        spread = None

        def observe(self, objects, frames, ego, capture_ns):
            pass

        def predict(self, objects, frames, state, wanted):
            n = int(wanted.sum())
            x, y = (np.repeat(a[wanted][:, None], 60, axis=1) for a in (objects.x, objects.y))
            return Motion(x, y, np.zeros((n, 60)), np.zeros((n, 60)))

    p = Predictor(PredictorSettings(policy="paper"), RiskParameters(), Still())
    map = Map(lanes=[lane(line(-200, 0, 200, 0), id=1)])
    q = drive([straight(0.0, 0.0, 0.0, 10.0), straight(0.0, 50.0, 0.0, 10.0)], map=map, with_=p)
    assert list(q.method) == [Method.MAP_BASED, Method.LSTM]
    np.testing.assert_array_equal(q.x[1], 0.0)
    assert "learned" not in p.detail


def test_the_status_says_when_a_learned_predictor_is_missing():
    p = predictor(policy="paper")
    q = drive([straight(0.0, 0.0, 0.0, 10.0)], with_=p)
    assert q.method[0] == Method.CONSTANT_VELOCITY
    assert p.detail["learned"] == "wanted for 1 objects, none is loaded"


def test_the_predictor_needs_neither_torch_nor_warp():
    code = (
        "import sys; sys.modules.update(torch=None, warp=None, zenoh=None, rerun=None, commonroad=None)\n"
        "import services.predictor.core"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=60)
