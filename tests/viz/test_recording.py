"""A recording holds what was seen, where and when it was, and can be opened after a clean end."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rerun")

from rerun.chunk import RrdReader

from common.messages import Closures, Map, Objects, Plan, Prediction, Stamped
from tests.viz import synthetic
from tests.viz.reading import carrying, heat, origin, record, rows
from viz.blueprint import blueprint
from viz.scene import Scene
from viz.settings import VizSettings
from viz.sinks import SinkError, recording

FRAMES = 12
UTM = {"x0": 612_345.0, "y0": 5_812_345.0}
RERUN = Path(sys.executable).with_name("rerun")


@pytest.fixture(scope="module")
def drive():
    return synthetic.Drive(angle=0.6, rows=320, columns=80, h=0.5, **UTM)


@pytest.fixture(scope="module")
def recorded(tmp_path_factory, drive) -> Path:
    return record(tmp_path_factory.mktemp("viz") / "drive.rrd", drive, FRAMES)


def test_the_file_is_finished_and_the_tool_says_so(recorded):
    done = subprocess.run([RERUN, "rrd", "verify", recorded], capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0, done.stderr


def test_the_blueprint_lies_in_the_file(recorded):
    reader = RrdReader(recorded)
    assert len(reader.recordings()) == 1
    assert len(reader.blueprints()) == 1


def test_every_part_of_the_scene_is_there(recorded):
    entities = {str(chunk.entity_path) for chunk in RrdReader(recorded).stream()}
    expected = {
        "/about", "/why", "/health", "/world/ego", "/world/objects/box", "/world/prediction", "/world/risk/now",
        "/world/plan/candidates", "/world/plan/profile", "/world/plan/tail", "/world/closed", "/world/route/goal",
        "/world/map/surface", "/slice/risk", "/slice/ego", "/stack/plan/profile", "/stack/prediction", "/risk/exact",
        "/plot/speed/ego", "/plot/speed/desired", "/plot/speed/limit", "/plot/latency/end_to_end",
        "/plot/max_risk/slices",
    }  # fmt: skip
    assert expected <= entities
    assert carrying(recorded, "StateChange:state") >= {"drive", "ready", "waiting"}
    assert any("following the route" in text for text in carrying(recorded, "TextLog:text"))
    layers = {e for e in entities if e.startswith("/stack/risk/slice_")}
    assert {f"/stack/risk/slice_{j:02d}" for j in range(synthetic.SLICES)} <= layers


@pytest.mark.parametrize("entity", ["/world/objects/box", "/world/prediction", "/world/risk/now"])
def test_each_frame_has_its_own_objects_prediction_and_risk(recorded, entity):
    assert [frame for frame, _ in rows(recorded, entity)] == list(range(FRAMES))


def test_the_field_lies_on_the_objects_in_every_frame(recorded, drive):
    here = origin(recorded)
    for frame, found in rows(recorded, "/world/risk/now"):
        levels, centres = heat(found)
        objects = drive.objects(frame * 0.1)
        middle = np.abs(drive.others(frame * 0.1)[1]) < 1.0  # away from the road's edges, whose field is as high
        assert middle.any()
        for x, y in zip(objects.x[middle], objects.y[middle], strict=True):
            near = np.hypot(*np.moveaxis(centres - (np.array((x, y)) - here), -1, 0)) < 0.5
            assert near.any()
            assert levels[near].min() >= 150  # E_max of 1.5 E_max, less a cell's fall
    far = np.hypot(*np.moveaxis(centres - (np.array((objects.x[0], objects.y[0])) - here), -1, 0)) > 30
    assert np.median(levels[far]) < 20


def test_boxes_stand_where_the_objects_are_far_from_the_maps_origin(recorded, drive):
    here = origin(recorded)
    for frame, found in rows(recorded, "/world/objects/box"):
        drawn = np.array(found["centers"].as_py())[:, :2] + here
        objects = drive.objects(frame * 0.1)
        assert np.allclose(drawn, np.stack((objects.x, objects.y), axis=-1), atol=2e-3)


def test_the_exact_volume_is_the_one_that_was_sent(recorded, drive):
    frame, found = rows(recorded, "/risk/exact")[0]
    sent = drive.risk(frame * 0.1).volume
    stored = np.array(found["data"].as_py()[0]["buffer"], dtype=np.float16)
    assert np.array_equal(stored, sent.transpose(1, 0, 2).ravel())


def test_end_to_end_is_taken_once_for_each_cause(recorded):
    found = [found for _, found in rows(recorded, "/plot/latency/end_to_end")]
    taken = [row["scalars"].as_py()[0] for row in found if "scalars" in row]
    assert np.allclose(taken, [41.0] * FRAMES)  # received 42 ms after capture, the objects 1 ms after


def test_an_empty_world_is_drawn_too(tmp_path):
    none = np.zeros(0)
    path = tmp_path / "empty.rrd"
    settings = VizSettings(record=str(path))

    def at(value) -> Stamped:
        return Stamped(value, 10**12, 10**12 + 10**6)

    with recording(settings, "", blueprint()) as rec:
        scene = Scene(rec, settings)
        scene.map(at(Map()))
        scene.closures(at(Closures(ids=[1])))
        scene.objects(at(Objects(
            id=none.astype(np.int64), cls=none.astype(np.uint8), x=none, y=none, heading=none, vx=none, vy=none,
            length=none, width=none, mass=none,
        )))  # fmt: skip
        scene.prediction(at(Prediction(
            id=none.astype(np.int64), cls=none.astype(np.uint8), x0=none, y0=none, heading0=none, vx0=none, vy0=none,
            length=none, width=none, mass=none, x=np.zeros((0, 60)), y=np.zeros((0, 60)),
            heading=np.zeros((0, 60), np.float32), speed=np.zeros((0, 60), np.float32), past_x=np.zeros((0, 29)),
            past_y=np.zeros((0, 29)), method=none.astype(np.uint8),
        )))  # fmt: skip
        scene.plan(at(Plan(mode="waiting", reason="no ego")))
        scene.silence(10**12 + 10**10)
    assert "waiting" in carrying(path, "StateChange:state")


def test_a_folder_that_is_not_there_is_named(tmp_path):
    settings = VizSettings(record=str(tmp_path / "nowhere" / "a.rrd"))
    with pytest.raises(SinkError, match="no such folder"), recording(settings, "", blueprint()):
        pass


def test_a_frame_of_the_standard_grid_stays_small(tmp_path):
    drive = synthetic.Drive(rows=640, columns=160, h=0.25)
    path = record(tmp_path / "standard.rrd", drive, 20, exact_hz=0.0)
    frame_kib = path.stat().st_size / 1024 / 20
    assert frame_kib <= 120
    exact = record(tmp_path / "exact.rrd", drive, 20, exact_hz=1.0)
    volumes = len(rows(exact, "/risk/exact"))
    assert volumes in (2, 3)
    assert (exact.stat().st_size - path.stat().st_size) / 1024 / volumes <= 1200  # of 2600 as they are
