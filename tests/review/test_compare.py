"""Two runs compared: a table of what changed, and one recording that holds both on a common time."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rerun")
pytest.importorskip("jinja2")

from rerun.chunk import RrdReader
from typer.testing import CliRunner

from rig.application import app
from tests.review.drives import made


def call(*arguments: str | Path):
    return CliRunner().invoke(app, [str(a) for a in arguments], env={"COLUMNS": "200", "TERM": "dumb"})


@pytest.fixture(scope="module")
def runs() -> tuple[Path, Path]:
    return made().path, made("demo", 3.0, "planner.max_speed=7").path


@pytest.fixture(scope="module")
def both(runs: tuple[Path, Path], tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict]:
    folder = tmp_path_factory.mktemp("both")
    done = call("compare", *runs, "--out", folder / "both.rrd", "--json", folder / "both.json")
    assert done.exit_code == 0, done.output
    return folder / "both.rrd", json.loads((folder / "both.json").read_text())


def test_the_setting_that_was_changed_is_named_and_no_other(both) -> None:
    assert both[1]["settings"] == {"planner.max_speed": {"a": 40.0, "b": 7.0}}
    assert both[1]["same_scenario"] is True


def test_the_table_tells_what_changed(both) -> None:
    rows = {row["name"]: row for row in both[1]["summary"]}
    assert rows["mean_speed_mps"]["b"] < rows["mean_speed_mps"]["a"]
    assert rows["mean_speed_mps"]["change"] == pytest.approx(
        rows["mean_speed_mps"]["b"] - rows["mean_speed_mps"]["a"], abs=1e-3
    )
    assert both[1]["apart"]["most_m"] > 0.5 and both[1]["apart"]["from_s"] is not None


def test_one_recording_holds_both_drives_from_the_begin_of_their_runs(both) -> None:
    reader = RrdReader(both[0])
    assert len(reader.recordings()) == 1 and len(reader.blueprints()) == 1
    seen: dict[str, list[int]] = {}
    for chunk in reader.stream().filter(content=["/a/world/ego", "/b/world/ego", "/a/world/risk/now", "/b/plan"]):
        if chunk.is_static:
            continue
        t = chunk.to_record_batch().column("t").cast("int64").to_numpy()
        seen.setdefault(chunk.entity_path, []).extend(int(v) for v in t)
    assert set(seen) == {"/a/world/ego", "/b/world/ego", "/a/world/risk/now", "/b/plan"}
    for prefix, seconds in (("a", 5.5), ("b", 3.0)):
        t = np.array(seen[f"/{prefix}/world/ego"]) * 1e-9
        assert t.min() == pytest.approx(-1.0, abs=0.11) and t.max() == pytest.approx(seconds, abs=0.11)
    entities = {chunk.entity_path for chunk in reader.stream()}
    assert "/changes" in entities and "/a/why" in entities and "/b/world/plan/profile" in entities


def test_a_run_compared_with_itself_changed_in_nothing(runs, tmp_path: Path) -> None:
    done = call("compare", runs[0], runs[0], "--json", tmp_path / "same.json")
    assert done.exit_code == 0
    told = json.loads((tmp_path / "same.json").read_text())
    assert told["settings"] == {} and told["apart"]["most_m"] == 0.0
    assert all(not row["change"] for row in told["summary"])
    assert all(pair["a"] == pair["b"] for pair in told["interventions"])


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["missing.rrd", "{a}"], "missing.rrd"),
        (["{a}", "{a}", "--out", "both.png"], "ends in .rrd"),
        (["{a}", "{a}", "--out", "{a}"], "choose another name"),
        (["{a}", "{a}", "--out", "no/such/both.rrd"], "no such folder"),
    ],
)
def test_what_cannot_be_compared_is_named_in_one_line(runs, arguments, words) -> None:
    done = call("compare", *(str(a).format(a=runs[0]) for a in arguments))
    assert done.exit_code == 2 and words in done.output
    assert len(done.output.strip().splitlines()) == 1
