"""Training converges, resumes to the same weights, and windows keep to their recordings."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from common.risk import RiskParameters
from evaluation import train_predictor as training
from evaluation.training import MIRROR, Options, batch_of, fit, learnable
from evaluation.trajectory_windows import Recording, joined, recordings, windows
from rig.world import ScenarioError
from services.predictor.lstm import Architecture
from services.predictor.weight_files import CARD, load

sys.path.insert(0, str(Path(__file__).parent))
from made import HEADER, table, traffic, turning

P = RiskParameters()
TINY = Options(steps=60, batch=32, warm_up=5, average=0.9, rate=5e-3)


@pytest.fixture(scope="module")
def turns():
    """Everyone turns left: easy to learn."""
    tracks = tuple(turning(110, 6.0 + i, 0.25, y0=20.0 * i, heading=float(i), name=f"t{i}", slow=0.3) for i in range(6))
    return windows([Recording("rec0", "made", tracks)], P, stride=4)


def test_a_short_training_learns_a_turn(turns):
    fitted = fit(Architecture(hidden=8), turns, None, TINY, validation=turns)
    assert fitted.curve[-1][2] < 0.5 * float((batch_of(turns, "residual", None, TINY).target ** 2).sum(-1).mean())


def test_an_interrupted_training_goes_on_to_the_same_weights(turns, tmp_path):
    options = Options(**{**TINY.__dict__, "steps": 120})
    whole = fit(Architecture(hidden=8), turns, None, options)
    file = tmp_path / "c"
    fit(Architecture(hidden=8), turns, None, options, checkpoint=file, stop_at=100)
    steps = []
    resumed = fit(Architecture(hidden=8), turns, None, options, checkpoint=file, progress=lambda *a: steps.append(a[0]))
    assert steps == [120]
    for a, b in zip(whole.network.parameters(), resumed.network.parameters(), strict=True):
        torch.testing.assert_close(a, b, rtol=0, atol=1e-6)


def test_a_checkpoint_of_other_options_is_not_used(turns, tmp_path):
    file = tmp_path / "c"
    fit(Architecture(hidden=8), turns, None, TINY, checkpoint=file)
    steps = []
    fit(Architecture(hidden=8), turns, None, Options(**{**TINY.__dict__, "seed": 1}), checkpoint=file,
        progress=lambda *a: steps.append(a[0]))  # fmt: skip
    assert steps == [60]


def test_short_futures_carry_no_loss_where_nothing_is_known():
    data = windows([traffic(k=55)], P, stride=5, future_least=10)
    assert (data.known < 60).all() and (data.known >= 10).all()
    batch = batch_of(data, "residual", None, TINY)
    assert not batch.weight[np.arange(60) >= data.known[:, None]].any()
    assert (batch.weight[:, :10] > 0).all()


def test_the_mirror_mirrors_the_nine_points():
    left = Recording("r", "s", (turning(95, 8.0, 0.0, name="a"), turning(95, 8.0, 0.0, name="b", y0=3.5)))
    right = Recording("r", "s", (turning(95, 8.0, 0.0, name="a"), turning(95, 8.0, 0.0, name="b", y0=-3.5)))
    a, b = (windows([r], P, stride=100).signals[0] for r in (left, right))
    assert not np.allclose(a[:, :9], b[:, :9])
    np.testing.assert_allclose(a[:, MIRROR], b[:, :9], atol=1e-6)


def test_windows_never_reach_across_recordings_or_tracks(tmp_path):
    """The same track name in two recordings, far apart: no window holds both."""
    a, b = traffic("A", n=2, k=95), traffic("B", n=2, k=95, seed=5)
    far = Recording(
        "B", "made", tuple(type(t)(t.name, t.cls, t.length, t.width, 95, t.x + 1e4, t.y, t.heading) for t in b.tracks)
    )
    found = recordings(table(tmp_path / "mixed.csv.gz", [a, far]))
    data = windows(found, P, stride=1)
    assert {r.name for r in found} == {"A", "B"} and len(data) == 2 * 2 * 6
    span = np.concatenate((data.x, data.future[..., 0]), axis=1)
    assert (span.max(axis=1) - span.min(axis=1) < 500.0).all()
    assert all((data.x[i, 0] > 5e3) == (data.names[data.recording[i]] == "B") for i in range(len(data)))
    twice = joined([data, data])
    assert len(np.unique(twice.track)) == 2 * len(np.unique(data.track)) and len(twice.names) == 4


def test_the_split_is_by_recording_and_held_out_sites_are_never_trained_on(tmp_path):
    a = table(tmp_path / "north.csv", [traffic(f"n{i}", n=2, k=100, seed=i) for i in range(5)])
    b = table(tmp_path / "south.csv", [traffic(f"s{i}", n=2, k=100, seed=9 + i) for i in range(5)])
    data = training.read([a, b], ["south"], P, 10)
    assert set(np.array(data.recorded.sites)[data.recorded.recording]) == {"north"}
    assert set(np.array(data.validation.sites)[data.validation.recording]) == {"south"}
    data = training.read([a, b], [], P, 10)
    kept, held = (set(np.array(d.names)[d.recording]) for d in (data.recorded, data.validation))
    assert held == {"n4", "s4"} and not kept & held
    with pytest.raises(ValueError, match="no site 'west'"):
        training.read([a, b], ["west"], P, 10)


def test_a_folder_of_weights_says_what_it_is(tmp_path):
    file = table(tmp_path / "made.csv", [traffic(f"r{i}", k=110, seed=i) for i in range(5)])
    data = training.read([file], [], P, 10)
    out = tmp_path / "w"
    wanted = training.plans(["lstm", "lstm_no_risk"], 8, 20)
    card = training.train(data, wanted, out, Options(steps=20, batch=16), shrink=(1.0, 0.5), device="cpu",
                          about={"command": "this"})  # fmt: skip
    assert json.loads((out / CARD).read_text()) == card
    assert load(out).name == "lstm" and not load(out, "lstm_no_risk").network.architecture.risk
    assert card["command"] == "this" and card["data"]["held_out"] == ["made"]
    assert (out / "training.png").stat().st_size > 1000
    assert set(card["networks"]["lstm"]["held_out"]["60"]) == {"ade", "fde", "ade_ratio", "fde_ratio"}
    with pytest.raises(ValueError, match="no network 'gru'"):
        training.plans(["gru"], 8, 20)


def test_only_moving_vehicles_are_learned_from():
    data = windows([traffic()], P, stride=10)
    ped = data.take(np.arange(3))
    walkers = type(ped)(**{**ped.__dict__, "cls": np.full(3, 6, np.uint8)})
    assert len(learnable(data)) > 0 and len(learnable(walkers)) == 0


ROW = "r,{track},car,{frame},{t},{x},0,,,0,4.5,1.8\n"


def rows(n=5, **changes):
    lines = []
    for f in range(n):
        values = {"track": "a", "frame": f, "t": f / 10, "x": f}
        values.update({k: v for k, v in changes.items() if f == n - 1})
        lines.append(ROW.format(**values))
    return HEADER + "".join(lines)


@pytest.mark.parametrize(
    ("text", "line", "reason"),
    [
        (HEADER.replace("frame,", ""), 1, "missing columns"),
        (rows(t=0.9), 6, "10 Hz"),
        (rows(x="nan"), 6, "nan"),
        (rows(frame=3, t=0.3), 6, "twice"),
        (rows(x="far"), 6, "far"),
        (rows() + "r,a,car,5\n", 7, "values"),
    ],
)
def test_a_bad_table_is_refused_with_file_line_and_reason(tmp_path, text, line, reason):
    file = tmp_path / "bad.csv"
    file.write_text(text)
    with pytest.raises(ScenarioError) as e:
        recordings(file)
    assert str(file) in str(e.value) and e.value.line == line and reason in str(e.value)
