"""Whatever valid message comes is drawn, where it belongs and so that it can be read."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rerun")

from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from msgspec.structs import replace

from common import codec, topics
from common.messages import NO_SLOT, Cause, Decision, Grid, Map, Plan, Risk, Slot, Stamped, Status
from tests.viz import synthetic
from tests.viz.reading import carrying, draw, heat, origin, record, rows
from viz import decision, field, labels
from viz.blueprint import blueprint

NS = 10**12
FULL = 1.5
SMALL = {"rows": 64, "columns": 32, "h": 1.25}


def at(value, seq: int = 0, after_s: float = 0.0) -> Stamped:
    now = NS + round(after_s * 1e9)
    return Stamped(value, now, now + 10**6, Cause("synthetic0", seq), "test", "synthetic0", seq)


def texts(path: Path, entity: str) -> list[str]:
    return [text for _, found in rows(path, entity) if "labels" in found for text in found["labels"].as_py() or []]


def risk(volume: np.ndarray, dominant: np.ndarray, terms: tuple[str, ...] = ("potential", "static")) -> Risk:
    grid = Grid(x=0.0, y=0.0, heading=0.0, rows=volume.shape[1], columns=volume.shape[2], h=0.5)
    slots = [Slot(k, term, 1 if term != "static" else -1) for k, term in enumerate(terms)]
    made = Risk(
        grid=grid, slice_times=[0.5 * j for j in range(len(volume))], slots=slots, volume=volume, dominant=dominant
    )
    assert not made.problem()
    return made


# --- the field ---


@pytest.mark.filterwarnings("error")
@settings(max_examples=40, deadline=None)
@given(hnp.arrays(np.float32, (3, 5, 6), elements=st.floats(0, 6e4, width=16)), st.floats(0.1, 100.0))
def test_levels_grow_with_risk_keep_zero_and_top_and_are_alike_for_both_types(volume, full_scale):
    single, half = field.levels(volume, full_scale), field.levels(volume.astype(np.float16), full_scale)
    assert np.array_equal(single, half)
    order = np.argsort(volume, axis=None)
    assert np.all(np.diff(single.ravel()[order].astype(int)) >= 0)
    assert np.all(single[volume == 0.0] == 0) and np.all(single[volume >= full_scale] == 255)
    shown = single / 255 * full_scale
    assert np.all(
        np.abs(shown - np.minimum(volume, full_scale)) <= full_scale * (0.501 / (field.SHADES - 1) + 0.501 / 255)
    )


@pytest.mark.filterwarnings("error")
def test_what_is_not_finite_is_drawn_as_the_highest_risk():
    bad = np.array([[np.nan, np.inf, 0.0]])
    for kind in (np.float16, np.float32):
        assert field.levels(bad.astype(kind), FULL).tolist() == [[255, 255, 0]]


@settings(max_examples=40, deadline=None)
@given(st.integers(4, 19), st.integers(4, 19), st.data())
def test_exactly_the_plateau_of_what_stands_still_is_dark(i, j, data):
    volume = data.draw(hnp.arrays(np.float32, (2, i, j), elements=st.sampled_from([0.7, 1.5, 1.5, 1.5, 2.5])))
    blocks = (2, -(-i // 4), -(-j // 4))
    dominant = data.draw(hnp.arrays(np.uint8, blocks, elements=st.sampled_from([0, 1, NO_SLOT])))
    made = risk(volume, dominant)
    levels = field.levels(volume, FULL)
    shown = field.without_plateau(levels, field.static_cells(made))
    for s, a, b in np.ndindex(volume.shape):
        off_road = dominant[s, a // 4, b // 4] == 1 and volume[:, a, b].min() >= FULL  # what moves is not always there
        assert shown[s, a, b] == (0 if off_road else levels[s, a, b])


@settings(max_examples=40, deadline=None)
@given(hnp.arrays(np.uint8, st.tuples(st.integers(1, 2), st.integers(4, 13), st.integers(4, 13))), st.integers(1, 4))
def test_a_coarser_layer_shows_the_highest_of_its_cells(volume, step):
    small = field.coarser(volume, step)
    for s, a, b in np.ndindex(small.shape):
        cells = volume[s, a * step : (a + 1) * step, b * step : (b + 1) * step]
        assert small[s, a, b] == cells.max()


@settings(max_examples=8, deadline=None)
@given(st.floats(-3.1, 3.1), st.floats(-4e3, 4e3), st.integers(0, 63), st.integers(0, 31))
def test_a_hot_cell_lands_where_the_grid_says_it_is(tmp_path_factory, heading, x, i, j):
    volume = np.zeros((1, 64, 32), np.float16)
    volume[0, i, j] = 1.2
    grid = Grid(x=x, y=-x / 2, heading=heading, rows=64, columns=32, h=0.5)
    made = replace(risk(volume, np.zeros((1, 16, 8), np.uint8)), grid=grid)
    path = draw(tmp_path_factory.mktemp("hot") / "a.rrd", lambda scene: scene.risk(at(made)))
    ((_, found),) = rows(path, "/world/risk/now")
    levels, centres = heat(found)
    (where,) = centres[levels > 0] + origin(path)
    u, v = (i + 0.5) * 0.5, (j + 0.5) * 0.5
    c, s = np.cos(heading), np.sin(heading)
    assert np.allclose(where, (x + c * u - s * v, -x / 2 + s * u + c * v), atol=5e-3)


def test_the_edge_of_the_road_is_bright_the_land_behind_it_dark_and_the_exact_numbers_stay(tmp_path):
    drive = synthetic.Drive(rows=320, columns=160, h=0.25)
    path = record(tmp_path / "a.rrd", drive, 1)
    levels, centres = heat(rows(path, "/world/risk/now")[0][1])
    sent = drive.risk(0.0).volume
    assert np.all(levels[centres[..., 1] > 8.0] == 0)
    rim = levels[(centres[..., 1] > 5.0) & (centres[..., 1] < 5.25)]
    assert rim.min() > 120
    exact = rows(path, "/risk/exact")[0][1]["data"].as_py()[0]["buffer"]
    assert np.array_equal(np.array(exact, np.float16), sent.transpose(1, 0, 2).ravel()) and (sent >= FULL).mean() > 0.5


def test_through_the_time_stack_one_sees_the_road_and_what_moves_stands_out(tmp_path):
    drive = synthetic.Drive(rows=320, columns=80, h=0.5)
    path = record(tmp_path / "a.rrd", drive, 1)
    for j in (0, 6, 12):
        _, found = rows(path, f"/stack/risk/slice_{j:02d}")[0]
        form = found["format"].as_py()[0]
        assert found["opacity"].as_py()[0] < 1.0  # or the viewer would not heed the image's own transparency
        image = np.frombuffer(bytes(found["data"].as_py()[0]), np.uint8).reshape(form["height"], form["width"], 4)
        assert np.mean(image[..., 3] == 0) > 0.8
        assert image[..., 3].max() > 150
        assert np.isclose(found["translation"].as_py()[0][2], 0.5 * j * 6.0)


# --- extremes of what may come ---


def test_single_precision_and_odd_grids_are_drawn(tmp_path):
    volume = np.linspace(0, 3, 2 * 7 * 9, dtype=np.float32).reshape(2, 7, 9)
    made = risk(volume, np.full((2, 2, 3), NO_SLOT, np.uint8), terms=())
    path = draw(tmp_path / "a.rrd", lambda scene: scene.risk(at(made)), stack_step=4)
    levels, _ = heat(rows(path, "/world/risk/now")[0][1])
    assert (levels.shape == (9, 7) and levels.max() == 255 == field.levels(volume, FULL)[0].max()) or levels.max() > 120


def test_a_far_origin_loses_no_precision(tmp_path):
    drive = synthetic.Drive(angle=-2.1, x0=1e6, y0=-6e6, **SMALL)
    path = record(tmp_path / "a.rrd", drive, 2)
    here = origin(path)
    ego = drive.ego(0.0)
    _, found = rows(path, "/world/ego")[0]
    assert np.allclose(np.array(found["translation"].as_py()[0])[:2] + here, (ego.x, ego.y), atol=2e-3)
    assert np.abs(here).max() > 1e6 - 100


def test_a_drive_without_a_map_is_drawn(tmp_path):
    heard = [h for h in synthetic.messages(synthetic.Drive(**SMALL), 2) if h[0] != "map"]
    path = draw(tmp_path / "a.rrd", lambda scene: synthetic.give(scene, heard))
    assert {str(frame) for frame, _ in rows(path, "/world/plan/profile")} == {"0", "1"}
    assert not rows(path, "/world/map/surface")


def test_a_map_without_lanes_and_a_shorter_one_after_it_clear_what_stood_there(tmp_path):
    drive = synthetic.Drive()

    def give(scene):
        scene.map(at(drive.map()))
        scene.map(at(Map(), 1, 0.1))

    path = draw(tmp_path / "a.rrd", give)
    assert len(rows(path, "/world/map/barrier")) == 2
    assert rows(path, "/world/map/barrier")[-1][1]["strips"].as_py() == []


@pytest.mark.parametrize("mode", ["waiting", "safe_stop"])
def test_a_plan_without_anything_to_drive_clears_the_path(tmp_path, mode):
    drive = synthetic.Drive(**SMALL)

    def give(scene):
        synthetic.give(scene, synthetic.messages(drive, 2))
        scene.plan(at(Plan(mode=mode, reason="no objects for 300 ms"), 9, 0.3))

    path = draw(tmp_path / "a.rrd", give)
    for entity in ("/world/plan/profile", "/world/plan/tail", "/world/plan/candidates", "/stack/plan/profile"):
        assert rows(path, entity)[-1][1]["strips"].as_py() == []
    for entity in ("/world/plan/decided", "/world/plan/decided/sign", "/slice/decided/sign"):
        assert len(rows(path, entity)) == 3 and rows(path, entity)[-1][1]["positions"].as_py() == []
    assert mode in carrying(path, "StateChange:state")


def test_every_kind_of_message_that_the_codec_accepts_is_drawn_in_any_order(tmp_path):
    heard = list(synthetic.messages(synthetic.Drive(**SMALL), 2))
    for topic, message in heard:  # they are valid: the codec would send them
        codec.encode_body(topics.TOPICS[topic], message.value)
    draw(tmp_path / "a.rrd", lambda scene: synthetic.give(scene, reversed(heard)))
    draw(tmp_path / "b.rrd", lambda scene: synthetic.give(scene, sorted(heard, key=lambda h: h[0])))


def test_a_service_with_an_odd_name_says_what_it_has_to_say(tmp_path):
    status = Status(service="a b/../*", state="degraded", reason="odd", uptime_s=1.0)
    path = draw(tmp_path / "a.rrd", lambda scene: scene.status(at(status)))
    assert "degraded" in carrying(path, "StateChange:state")


def test_a_service_that_falls_silent_is_said_to_be_so_once(tmp_path):
    status = Status(service="planner", state="ready", reason="running", uptime_s=1.0)

    def give(scene):
        scene.status(at(status))
        for k in range(1, 6):
            scene.silence(NS + k * 10**9)

    path = draw(tmp_path / "a.rrd", give)
    states = [found["state"].as_py()[0] for _, found in rows(path, "/planner") if found.get("state") is not None
              and found["state"].as_py()]  # fmt: skip
    assert states == ["ready", "silent"]


# --- what is read ---


def test_the_sign_is_short_and_the_sentence_stands_in_why_and_log(tmp_path):
    drive = synthetic.Drive(**SMALL)
    path = record(tmp_path / "a.rrd", drive, 1)
    sentence = drive.plan(0.0).decision.sentence
    for place in ("/world/plan", "/stack/plan", "/slice"):
        assert set(texts(path, f"{place}/decided/sign")) == {"car 11 · 0.62"}
    assert any(sentence in text for text in carrying(path, "TextLog:text"))
    assert any(sentence in text for text in carrying(path, "TextDocument:text"))


def test_a_reason_that_is_the_decision_is_printed_once():
    plan = synthetic.Drive().plan(0.0)
    sentence = plan.decision.sentence
    assert decision.story(replace(plan, reason=sentence), None, None).count(sentence) == 1
    assert decision.story(plan, None, None).count(sentence) == 1


@pytest.mark.parametrize(
    ("fields", "sign"),
    [
        ({"source_id": 7, "source_cls": 6, "risk": 0.583}, "pedestrian 7 · 0.58"),
        ({"source_id": 3, "source_cls": -1, "term": "static", "risk": 1.2}, "line 3 · 1.20"),
        ({"term": "curve"}, "curve"),
        ({}, "decided"),
    ],
)
def test_signs_name_who_and_how_much_as_far_as_it_is_known(fields, sign):
    assert decision.brief(Decision(sentence="why", **fields)) == sign


@settings(max_examples=60, deadline=None)
@given(
    hnp.arrays(np.float64, st.tuples(st.integers(0, 40), st.just(2)), elements=st.floats(-60, 60)),
    st.floats(-3, 3),
    st.integers(0, 20),
)
def test_labels_stand_apart_nearest_first_and_whoever_has_none_stands_by_one_that_has(points, heading, most):
    x, y = points[:, 0], points[:, 1]
    kept = labels.apart(x, y, (1.0, 2.0, heading), most)
    assert len(kept) <= most and len(set(kept)) == len(kept)
    c, s = np.cos(heading), np.sin(heading)
    along, across = c * (x - 1) + s * (y - 2), c * (y - 2) - s * (x - 1)

    def cover(a, b):
        return abs(along[a] - along[b]) < labels.ALONG_M and abs(across[a] - across[b]) < labels.ACROSS_M

    assert not any(cover(a, b) for n, a in enumerate(kept) for b in kept[:n])
    if len(kept) < most:
        assert all(any(cover(a, b) for b in kept) for a in range(len(x)))
    distance = np.hypot(along, across)[kept]
    assert np.all(np.diff(distance) >= 0)


def test_a_crowd_is_drawn_whole_but_labelled_sparsely(tmp_path):
    drive = synthetic.Drive(**SMALL)
    few = drive.objects(0.0)
    n = 1024
    many = replace(
        few,
        **{name: np.resize(getattr(few, name), n) for name in few.__struct_fields__},
    )
    many = replace(many, id=np.arange(n), x=np.linspace(0, 100, n), y=np.zeros(n))
    path = draw(tmp_path / "a.rrd", lambda scene: scene.objects(at(many)))
    assert len(rows(path, "/world/objects/box")[0][1]["centers"].as_py()) == n
    assert 5 <= len(texts(path, "/world/objects/label")) <= 8


def test_heavy_things_keep_to_their_rate_even_when_they_come_unevenly(tmp_path):
    drive = synthetic.Drive(**SMALL)
    rng = np.random.default_rng(0)
    times = np.arange(60) * 0.1 + rng.uniform(-0.015, 0.015, 60)

    def give(scene):
        for k, t in enumerate(times):
            scene.risk(at(made, k, float(t)))

    made = drive.risk(0.0)
    path = draw(tmp_path / "a.rrd", give, exact_hz=1.0)
    assert 57 <= len(rows(path, "/world/risk/now")) <= 60
    assert 6 <= len(rows(path, "/risk/exact")) <= 7


def test_the_layout_names_only_what_is_drawn(tmp_path):
    path = record(tmp_path / "a.rrd", synthetic.Drive(**SMALL), 3)
    from rerun.chunk import RrdReader

    drawn = {str(chunk.entity_path) for chunk in RrdReader(path).stream()}
    shown = blueprint()

    def origins(part) -> list[str]:
        below = [o for child in getattr(part, "contents", None) or [] if not isinstance(child, str)
                 for o in origins(child)]  # fmt: skip
        return ([str(part.origin)] if getattr(part, "origin", None) is not None else []) + below

    found = origins(shown.root_container)
    assert len(found) >= 10
    for entity in found:
        prefix = "/" + entity.strip("/")
        assert prefix == "/" or any(d == prefix or d.startswith(prefix + "/") for d in drawn), entity
