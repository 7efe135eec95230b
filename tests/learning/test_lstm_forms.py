"""The network's forms and switches, and motion made from it: gates, shrinkage, headings."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from common.messages import ObjectClass
from common.risk import RiskParameters
from evaluation.prediction_methods import as_service
from evaluation.training import LEARNED_CLASSES, Options, batch_of
from evaluation.trajectory_windows import Recorded, Recording, windows
from services.predictor import features
from services.predictor.kinematic import constant_velocity, estimate
from services.predictor.learned import motion_of
from services.predictor.lstm import Architecture, Network
from services.predictor.settings import KinematicSettings
from services.predictor.weight_files import Loaded

sys.path.insert(0, str(Path(__file__).parent))
from made import track, traffic, turning

P = RiskParameters()


def loud(architecture, seed=0):
    """A network whose outputs are far from zero."""
    torch.manual_seed(seed)
    network = Network(architecture).eval().requires_grad_(False)
    for p in network.parameters():
        p.copy_(torch.randn_like(p) * 0.3)
    return network


def motion(network, data, shrink=(1.0, 1.0)):
    objects, frames = as_service(data)
    state = estimate(objects, frames, KinematicSettings())
    loaded = Loaded("n", network, shrink, frozenset(LEARNED_CLASSES))
    return motion_of(loaded, data.x, data.y, data.cls, data.length, data.signals, state), constant_velocity(state)


@pytest.mark.parametrize("form", ["paper", "residual"])
@pytest.mark.parametrize("risk", [True, False])
@pytest.mark.parametrize("attention", [True, False])
def test_a_switched_off_input_has_no_effect_and_a_switched_on_one_has(form, risk, attention):
    network = loud(Architecture(form=form, hidden=8, risk=risk, attention=attention))
    data = windows([traffic()], P, stride=40)
    x = torch.from_numpy(batch_of(data, form, None, Options()).x)
    context = torch.from_numpy(batch_of(data, form, None, Options()).context)
    first = 2 if form == "paper" else 4
    other = x.clone()
    other[..., first : first + 9] += 1.0
    same = torch.equal(network(x, context), network(other, context))
    assert same == (not risk)
    assert (network.attention is not None) == attention
    assert network(x, context).shape == (len(data), 60, 2)


def test_the_paper_form_is_autoregressive_and_has_the_papers_inputs():
    a = Architecture(form="paper", hidden=8)
    assert a.inputs == 11 and Architecture(form="paper", hidden=8, risk=False).inputs == 2
    network = loud(a)
    assert network.decoder.input_size == 2 + 8


def test_an_untrained_residual_network_is_constant_velocity():
    data = windows([traffic()], P, stride=20)
    moved, straight = motion(Network(Architecture(hidden=8)).eval(), data)
    np.testing.assert_allclose(moved.x, straight.x, atol=1e-9)
    np.testing.assert_allclose(moved.y, straight.y, atol=1e-9)


@pytest.mark.parametrize("form", ["paper", "residual"])
def test_what_stands_stays_whatever_the_network_says(form):
    still = track("p", np.full(100, 3.0), np.full(100, -2.0))
    crawling = turning(100, 0.3, 0.0, name="q", x0=20.0)
    data = windows([Recording("r", "s", (still, crawling))], P, stride=50)
    moved, straight = motion(loud(Architecture(form=form, hidden=8)), data)
    np.testing.assert_array_equal(moved.x, straight.x)
    np.testing.assert_array_equal(moved.y, straight.y)


def test_shrinkage_scales_the_deviation_by_speed():
    data = windows(
        [Recording("r", "s", (turning(100, 5.0, 0.0), turning(100, 20.0, 0.0, y0=60.0, name="b")))], P, stride=50
    )
    network = loud(Architecture(hidden=8))
    full, straight = motion(network, data)
    less, _ = motion(network, data, (0.8, 0.2))
    slow = np.hypot(data.x[:, 0] - data.x[:, 1], data.y[:, 0] - data.y[:, 1]) < 1.0
    np.testing.assert_allclose((less.x - straight.x)[slow], 0.8 * (full.x - straight.x)[slow], atol=1e-9)
    np.testing.assert_allclose((less.x - straight.x)[~slow], 0.2 * (full.x - straight.x)[~slow], atol=1e-9)


def test_prediction_turns_and_moves_with_the_scene():
    network = loud(Architecture(hidden=8))
    recording = traffic(n=4)
    data = windows([recording], P, stride=30)
    a, c, s = 0.7, np.cos(0.7), np.sin(0.7)
    turned = Recording("rec0", "made", tuple(
        Recorded(t.name, t.cls, t.length, t.width, t.frame0, 100 + c * t.x - s * t.y, -50 + s * t.x + c * t.y,
                 t.heading + a) for t in recording.tracks))  # fmt: skip
    m, _ = motion(network, data)
    n, _ = motion(network, windows([turned], P, stride=30))
    np.testing.assert_allclose(n.x, 100 + c * m.x - s * m.y, atol=2e-3)
    np.testing.assert_allclose(n.y, -50 + s * m.x + c * m.y, atol=2e-3)


def test_headings_follow_the_predicted_course_and_speeds_its_steps():
    data = windows([Recording("r", "s", (turning(100, 8.0, 0.25),))], P, stride=100)
    objects, frames = as_service(data)
    state = estimate(objects, frames, KinematicSettings())
    from services.predictor.learned import along

    m = along(data.future[..., 0], data.future[..., 1], state)
    np.testing.assert_allclose(m.speed, 8.0, rtol=1e-2)
    assert m.heading[0, -1] - m.heading[0, 0] == pytest.approx(0.25 * 5.9, abs=0.02)


def test_the_basis_leaves_the_present_smoothly_and_integrates_acceleration():
    b = features.basis()
    assert b.shape == (60, features.BASIS)
    t = 0.1 * np.arange(1, 61)
    np.testing.assert_allclose(b[:, 0], t, rtol=1e-5)
    # equal accelerations at all knots, reached within the first half second
    np.testing.assert_allclose(b[:, 1:].sum(1)[20:], (0.5 * t**2 - 0.25 * t + 0.5**2 / 6)[20:], rtol=2e-3)
    assert abs(b[0, 1:]).sum() < 1e-2


def test_training_and_service_agree_on_the_residual():
    data = windows([traffic()], P, stride=15)
    data = data.take(data.cls == ObjectClass.CAR)
    network = loud(Architecture(hidden=8))
    m, straight = motion(network, data)
    frame = features.OwnFrame.of(data.x, data.y, data.heading[:, 0])
    batch = batch_of(data, "residual", None, Options())
    said = network(torch.from_numpy(batch.x), torch.from_numpy(batch.context)).numpy()
    expected = frame.turned_out(said.astype(float))
    fast = np.hypot(data.x[:, 0] - data.x[:, 3], data.y[:, 0] - data.y[:, 3]) / 0.3 > 1.0
    np.testing.assert_allclose((m.x - straight.x)[fast], expected[fast, :, 0], atol=1e-4)
    np.testing.assert_allclose((m.y - straight.y)[fast], expected[fast, :, 1], atol=1e-4)
