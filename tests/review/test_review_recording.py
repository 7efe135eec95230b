"""A review tells of a drive what the run itself measured, from the recording alone."""

from __future__ import annotations

import json
import re
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rerun")
pytest.importorskip("jinja2")

import pyarrow as pa
import pyarrow.compute as pc
import rerun as rr
from rerun.chunk import Chunk, RrdReader
from typer.testing import CliRunner

from evaluation.review.choose import shown
from evaluation.review.command import Review, review
from evaluation.review.moments import drawn_at, moments
from evaluation.review.recording import load
from evaluation.review.tables import ReviewError
from rig.application import app
from tests.review.drives import EVIL, made, made_page

WORDS = ("t", "kind", "source_id", "term", "slice_s", "speed_from", "speed_to", "until", "mode", "sentence")


@pytest.fixture(scope="module")
def found() -> Review:
    return review(made().path)


@pytest.fixture(scope="module")
def page() -> Path:
    return made_page()


def test_every_intervention_of_the_run_is_found_with_its_source_and_no_other(found: Review) -> None:
    told = made().summary["interventions"]
    assert told, "the drive must slow down for somebody"
    assert [{k: i[k] for k in WORDS} for i in found.result["interventions"]] == [{k: i[k] for k in WORDS} for i in told]


def test_the_source_is_a_road_user_that_was_there(found: Review) -> None:
    for i in found.drive.interventions:
        there = {int(k) for seen in found.recording.seen for k in seen.id if abs(seen.t - found.drive.began - i.t) < 1}
        assert i.reason.source_id in there
        assert f" {i.reason.source_id}," in i.reason.sentence


def test_modes_comfort_and_distance_are_those_of_the_run(found: Review) -> None:
    ego, summary = made().summary["ego"], found.result["summary"]
    for name in ("max_abs_accel_lon", "max_abs_accel_lat", "max_abs_jerk", "p95_abs_jerk"):
        assert summary[name] == pytest.approx(ego[name], abs=2e-3)
    assert summary["distance_m"] == pytest.approx(ego["distance_m"], abs=0.1)
    assert summary["min_clearance_m"] == pytest.approx(ego["min_clearance_m"], abs=0.1)  # at 10 Hz instead of 50
    assert summary["min_clearance_at"]["id"] == ego["min_clearance_at"]["id"]
    for mode, seconds in made().modes.items():
        assert summary["modes_s"][mode] == pytest.approx(seconds, abs=0.05)


def test_time_zero_is_where_the_run_began(found: Review) -> None:
    assert found.drive.began == pytest.approx(1.0, abs=1e-6)  # after a second of run-up
    assert found.drive.states.t[0] == pytest.approx(0.0, abs=1e-6)
    assert found.result["interventions"][0]["recording_t"] == pytest.approx(found.result["interventions"][0]["t"] + 1.0)


def test_latencies_are_those_of_the_simulated_stages(found: Review) -> None:
    medians = {stage: q["p50"] for stage, q in found.result["latency_ms"].items()}
    assert medians == {"predictor": 10.0, "riskfield": 30.0, "planner": 20.0, "end_to_end": 60.0}


def test_the_picture_of_an_intervention_shows_the_plan_that_gives_its_reason(found: Review) -> None:
    drawn = drawn_at(found.recording.paths)
    for i in found.drive.interventions:
        chosen = shown(found.recording, found.drive, i, drawn)
        assert chosen.plan is not None and chosen.plan.said.decision is not None
        assert chosen.plan.said.decision.source_id == i.reason.source_id
        (moment,) = moments(found.recording.paths, [chosen.t])
        decision = chosen.plan.said.decision
        assert moment.decided == pytest.approx((decision.x, decision.y), abs=1e-3)
        assert moment.now is not None and moment.slice is not None and moment.profile is not None
        assert moment.slice.levels.shape == moment.now.levels.shape and moment.slice.levels.max() > 100


class _Tags(HTMLParser):
    def __init__(self) -> None:
        super().__init__()
        self.seen: list[tuple[str, dict[str, str | None]]] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.seen.append((tag, dict(attrs)))


def test_the_page_holds_everything_and_fetches_nothing(page: Path, found: Review) -> None:
    text = page.read_text("utf-8")
    tags = _Tags()
    tags.feed(text)
    assert not [tag for tag, _ in tags.seen if tag in ("script", "iframe", "object", "embed")]
    links = [v for _, a in tags.seen for k, v in a.items() if k in ("src", "href") and v]
    assert all(v.startswith(("data:", "#")) for v in links)
    assert not re.search(r"url\((?!\s*data:)", text) and "@import" not in text
    pictures = [a["src"] for tag, a in tags.seen if tag == "img"]
    assert len(pictures) == 4 + len(found.drive.interventions)
    assert all(a.get("alt") for tag, a in tags.seen if tag == "img")
    for i in found.result["interventions"]:
        assert i["sentence"] in text
    assert len(text) < 3_000_000


def test_words_of_a_recording_are_never_markup(page: Path) -> None:
    assert EVIL not in page.read_text("utf-8") and "alert(1)" in page.read_text("utf-8")


def call(*arguments: str | Path):
    return CliRunner().invoke(app, [str(a) for a in arguments], env={"COLUMNS": "200", "TERM": "dumb"})


def test_the_command_writes_the_json(tmp_path: Path) -> None:
    done = call("review", made().path, "--json", tmp_path / "out.json")
    assert done.exit_code == 0, done.output
    told = json.loads((tmp_path / "out.json").read_text())
    assert set(told) >= {"summary", "interventions", "latency_ms", "prediction_error"}
    assert {"t", "kind", "source_id", "term", "slice_s", "speed_from", "speed_to"} <= set(told["interventions"][0])


def other_recording(path: Path) -> None:
    with rr.RecordingStream("something_else") as rec:
        rec.save(path)
        rec.log("x", rr.Scalars(1.0))


def newer(path: Path) -> None:
    with rr.RecordingStream("forefield") as rec:
        rec.save(path)
        fields = {"schema": "forefield.account", "version": np.array([2, 0])}
        rec.log("account", rr.DynamicArchetype("Account", components=fields), static=True)


def without_account(path: Path) -> None:
    with rr.RecordingStream("forefield") as rec:
        rec.save(path)
        rec.send_property("forefield", rr.AnyValues(scenario="x", configuration="{}"))
        rec.log("x", rr.Scalars(1.0))


def nobody_drove(path: Path) -> None:
    with rr.RecordingStream("forefield") as rec:
        rec.save(path)
        fields = {"schema": "forefield.account", "version": np.array([1, 0])}
        rec.log("account", rr.DynamicArchetype("Account", components=fields), static=True)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda p: None, "no such recording"),
        (lambda p: p.write_bytes(b""), "empty"),
        (lambda p: p.write_bytes(b"<html>no recording</html>" * 50), "no Rerun recording"),
        (lambda p: p.mkdir(), "directory"),
        (lambda p: p.write_bytes(made().path.read_bytes()[:400_000]), "cut short"),
        (other_recording, "not a recording of Forefield"),
        (newer, "update Forefield"),
        (without_account, "record the drive again"),
        (nobody_drove, "no ego was heard"),
    ],
)
def test_what_cannot_be_reviewed_is_named_in_one_line(tmp_path: Path, make, words: str) -> None:
    path = tmp_path / "bad.rrd"
    make(path)
    done = call("review", path, "--json", tmp_path / "out.json")
    assert done.exit_code == 2
    assert words in done.output and "bad.rrd" in done.output
    assert len(done.output.strip().splitlines()) == 1, done.output
    assert not (tmp_path / "out.json").exists()


def test_damage_anywhere_is_an_error_and_never_a_crash(tmp_path: Path) -> None:
    whole = made().path.read_bytes()
    random = np.random.default_rng(7)
    path = tmp_path / "damaged.rrd"
    for _ in range(6):
        data = bytearray(whole)
        at = int(random.integers(1000, len(data) - 4000))
        data[at : at + 64] = random.bytes(64)
        path.write_bytes(bytes(data))
        try:
            load(path)
        except ReviewError as e:
            assert "damaged.rrd" in str(e) and "\n" not in str(e)


def test_two_pieces_are_reviewed_as_one(found: Review, tmp_path: Path) -> None:
    # cut by time, as rotation does: what stands is said again in the second piece
    cut_ns = 3_500_000_000
    parts = [tmp_path / "drive.rrd", tmp_path / "drive.0002.rrd"]
    for k, part in enumerate(parts):
        with rr.RecordingStream("forefield", recording_id="two-pieces") as rec:
            rec.save(part)
            for chunk in RrdReader(made().path).stream():
                batch = chunk.to_record_batch()
                if "t" in batch.schema.names:
                    t = batch.column("t").cast(pa.int64())
                    late = pc.greater_equal(t, cut_ns)
                    batch = batch.filter(late if k else pc.invert(late))
                    if not batch.num_rows:
                        continue
                rec.send_chunks(iter(Chunk.from_record_batch(batch)))
    both = review(*parts)
    assert both.result["interventions"] == found.result["interventions"]
    assert len(both.recording.seen) == len(found.recording.seen)
    done = call("review", parts[0], "--json", tmp_path / "out.json")
    assert done.exit_code == 0 and "drive.0002.rrd" in done.output
