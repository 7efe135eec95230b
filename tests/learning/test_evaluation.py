"""The commands of measurement: names and fields of their JSON, scores that are right, paired intervals."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from common.risk import RiskParameters
from evaluation import eval_ablation, prediction_scores
from evaluation import train_predictor as training
from evaluation.eval_prediction import evaluate, track_cases
from evaluation.prediction_methods import Case, Models
from evaluation.training import Options
from evaluation.trajectory_windows import windows
from rig.application import app
from services.predictor.settings import PredictorSettings

sys.path.insert(0, str(Path(__file__).parent))
from made import table, traffic

P = RiskParameters()
METHODS = {
    "constant_velocity", "ctra", "ridge", "lstm", "lstm_no_risk", "lstm_no_attention", "policy_paper",
    "policy_learned_first", "policy_default",
}  # fmt: skip
GROUPS = {"all", "moving", "vehicle_moving", "pedestrian_moving", "cycle_moving"}


@pytest.fixture(scope="module")
def weights(tmp_path_factory):
    folder = tmp_path_factory.mktemp("w")
    file = table(folder / "made.csv", [traffic(f"r{i}", k=110, seed=i) for i in range(5)])
    data = training.read([file], [], P, 10)
    names = ["lstm", "lstm_no_risk", "lstm_no_attention"]
    training.train(data, training.plans(names, 8, 5), folder, Options(steps=5, batch=16), shrink=(1.0, 1.0),
                   device="cpu", about={})  # fmt: skip
    return folder


def test_the_command_writes_the_agreed_json(weights, tmp_path):
    file = table(tmp_path / "unseen.csv.gz", [traffic(f"u{i}", k=100, seed=20 + i) for i in range(3)])
    out, picture = tmp_path / "out.json", tmp_path / "out.png"
    done = CliRunner().invoke(
        app,
        ["eval", "prediction", "--tracks", str(file), "--weights", str(weights), "--json", str(out), "--plot",
         str(picture), "--repeats", "20", "--markdown", str(tmp_path / "out.md")],
    )  # fmt: skip
    assert done.exit_code == 0, done.output
    result = json.loads(out.read_text())
    assert set(result["results"]) >= METHODS
    for groups in result["results"].values():
        assert set(groups) >= GROUPS
        for horizons in groups.values():
            assert set(horizons) == {"20", "40", "60"}
            for score in horizons.values():
                assert set(score) >= {"ade", "fde", "miss", "n", "ade_ci", "fde_ci"}
                if score["n"]:
                    assert score["ade_ci"][0] <= score["ade"] <= score["ade_ci"][1]
                else:
                    assert score["ade"] is None and score["fde_ci"] is None
        assert groups["vehicle_moving"]["60"]["n"] > 0 and groups["cycle_moving"]["60"]["n"] == 0
    assert set(result["per_recording"]) == {"u0", "u1", "u2"} and set(result["sites"]) == {"unseen"}
    assert picture.stat().st_size > 1000
    score = result["results"]["lstm"]["vehicle_moving"]["60"]
    written = (tmp_path / "out.md").read_text()
    assert f"| {score['ade']:.2f}/{score['fde']:.2f} |" in next(r for r in written.split("\n") if "`lstm`" in r)
    assert set(result["spread"]) == {"pooled", "unseen"}
    for horizon in result["spread"]["unseen"]["lstm"].values():
        assert 0 <= horizon["within"] <= 1 and horizon["n"] > 0 and horizon["spread"] > 0


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["eval", "prediction"], "--tracks FILES"),
        (["eval", "prediction", "--tracks", "nowhere.csv"], "no such file"),
        (["eval", "prediction", "--tracks", __file__, "--weights", "/nowhere"], "no such folder"),
        (["train", "predictor", "--tracks", __file__, "--out", "/tmp/x", "--networks", "gru"], "no network"),
        (["train", "predictor", "--out", "/tmp/x"], "no file"),
        (["generate", "traffic", "--out", "x.csv"], ".csv.gz"),
    ],
)
def test_bad_input_ends_with_code_2_and_says_what_is_wrong(arguments, said):
    done = CliRunner().invoke(app, arguments)
    assert done.exit_code == 2 and said in " ".join(done.output.split())


def without_column(rows):
    return [",".join(r.split(",")[:5] + r.split(",")[6:]) for r in rows]


def with_nan(rows):
    return [*rows[:7], rows[7].replace(rows[7].split(",")[5], "nan"), *rows[8:]]


def with_a_row_twice(rows):
    return [*rows[:9], rows[8], *rows[9:]]


def at_five_hertz(rows):
    return [rows[0], *rows[1::2]]


@pytest.mark.parametrize(
    ("spoilt", "line", "why"),
    [(without_column, 1, "missing columns x"), (with_nan, 8, "x is nan"), (with_a_row_twice, 10, "stands there twice"),
     (at_five_hertz, 3, "follows")],
)  # fmt: skip
@pytest.mark.parametrize("command", [["eval", "prediction"], ["train", "predictor", "--out", "w"]])
def test_a_bad_table_is_refused_with_file_line_and_reason(command, spoilt, line, why, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    file = table(tmp_path / "bad.csv", [traffic(k=100)])
    file.write_text("".join(spoilt(file.read_text().splitlines(keepends=True))))
    done = CliRunner().invoke(app, [*command, "--tracks", str(file)])
    said = " ".join(done.output.split())
    assert done.exit_code == 2 and f"bad.csv:{line}" in said and why in said, said


def test_recordings_of_one_name_from_two_files_stay_apart(weights, tmp_path):
    files = [table(tmp_path / f"{s}.csv", [traffic("same", k=100, seed=i)]) for i, s in enumerate("ab")]
    result = evaluate(track_cases(files, P, 20), Models.of(weights), PredictorSettings(), repeats=10)
    assert set(result["per_recording"]) == {"a/same", "b/same"}


def test_errors_are_mean_and_final_distance():
    data = windows([traffic()], P, stride=40)
    shifted = data.future + np.linspace(0.1, 6.0, 60)[:, None] * np.array([0.6, 0.8])
    e = prediction_scores.errors(shifted, data)
    np.testing.assert_allclose(e[:, :, 1], [[2.0, 4.0, 6.0]] * len(data), atol=1e-9)
    np.testing.assert_allclose(e[:, :, 0], [[1.05, 2.05, 3.05]] * len(data), atol=1e-9)


def test_intervals_resample_recordings_not_windows():
    """Two recordings, each of one error only: the interval spans both, however many windows there are."""
    data = windows([traffic("a", k=110), traffic("b", k=110, seed=3)], P, stride=1)
    error = np.where(data.recording[:, None, None] == 0, 1.0, 3.0) * np.ones((1, 3, 2))
    score = prediction_scores.scores(error, error, data, np.ones(len(data), dtype=bool))["60"]
    assert score["ade_ci"] == [1.0, 3.0] and score["ade_ratio_ci"] == [1.0, 1.0] and score["miss"] == 0.5
    one = windows([traffic("a", k=110)], P, stride=1)
    assert prediction_scores.scores(error[: len(one)], error[: len(one)], one, np.ones(len(one), dtype=bool))["60"][
        "resampled_by"
    ] == "track"  # fmt: skip


def test_the_policies_compose_the_methods_they_name(weights):
    data = windows([traffic()], P, stride=10)
    settings = PredictorSettings(policy="learned-first")
    result = evaluate([Case(data, None)], Models.of(weights), settings, repeats=10)["results"]
    assert result["policy_default"] == result["policy_learned_first"] == result["policy_paper"] == result["lstm"]
    assert result["policy_kinematic"] != result["lstm"]


def test_the_ablation_pairs_seeds_and_says_how_sure_it_is(tmp_path):
    file = table(tmp_path / "made.csv", [traffic(f"r{i}", k=110, seed=i) for i in range(5)])
    data = training.read([file], [], P, 10)
    test = windows([traffic(f"u{i}", k=100, seed=30 + i) for i in range(2)], P, stride=10)
    known = eval_ablation.arms("residual", 8)
    arms = {n: known[n] for n in ("full", "no_risk", "no_leader", "motion_alone")}
    result = eval_ablation.ablation(data, test, arms, Options(steps=4, batch=16), range(2), repeats=50)
    change = result["results"]["pooled"]["no_risk"]["fde_60"]
    assert change["change_ci"][0] <= change["change_percent"] <= change["change_ci"][1]
    assert 0 <= change["seeds_worse"] <= 2
    pooled = result["results"]["pooled"]
    alone, blind = pooled["motion_alone"]["ade_60"], pooled["no_leader"]["ade_60"]
    assert alone["reference"] == "no_leader"
    assert alone["change_percent"] == pytest.approx(100 * (alone["mean"] / blind["mean"] - 1))
    other = pooled["risk_of_another"]["ade_60"]
    assert other["reference"] == "full" and np.isfinite(other["change_percent"])
    json.dumps(result)
    paper = eval_ablation.arms("paper", 8)
    assert set(paper) == {"paper", "paper_no_risk", "paper_no_attention"}
    assert not paper["paper_no_risk"].risk and not paper["paper_no_attention"].attention
