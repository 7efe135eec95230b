"""Trajectory tables: one vehicle becomes the ego, the others are objects; what is wrong is named by file and line."""

import gzip
from pathlib import Path

import numpy as np
import pytest

from common import codec
from common.geometry import Polyline
from common.messages import ObjectClass
from rig.sources import ScenarioError, load_scenario

HEAD = "rec,track,type,frame,t,x,y,vx,vy,heading,length,width"


def row(rec: str, track: str, kind: str, frame: int, x: float, y: float, rest: str = "0.0,4.6,1.9") -> str:
    return f"{rec},{track},{kind},{frame},{frame / 10:.1f},{x:.3f},{y:.3f},99,99,{rest}"


def rows(frames: int = 100) -> list[str]:
    """A: car 1 at 10 m/s with car 2 behind it and a pedestrian without size or heading; B: a car that moves less."""
    out = [row("A", "1", "car", f, 1.0 * f, 0.0) for f in range(5, frames)]
    out += [row("A", "2", "car", f, 1.0 * f - 20.0, 3.5) for f in range(frames)]
    out += [row("A", "3", "pedestrian", f, 50.0, 0.12 * f - 10.0, ",,") for f in range(20, 60)]
    out += [row("B", "1", "car", f, 0.3 * f, 7.0) for f in range(frames)]
    return out


def table(folder: Path, lines: list[str], name: str = "t.csv", head: str = HEAD) -> Path:
    path = folder / name
    text = "\n".join([head, *lines]) + "\n"
    if name.endswith(".gz"):
        path.write_bytes(gzip.compress(text.encode()))
    else:
        path.write_text(text, "utf-8")
    return path


@pytest.mark.parametrize("name", ["t.csv", "t.csv.gz"])
def test_a_recorded_vehicle_becomes_the_ego(tmp_path: Path, name: str) -> None:
    s = load_scenario(f"{table(tmp_path, rows(), name)}#A:1")
    assert s.human is not None
    assert s.ego0.x == pytest.approx(6.0)  # its second frame
    assert s.ego0.speed == pytest.approx(10.0)
    assert (s.ego0.length, s.ego0.width) == (4.6, 1.9)
    assert s.duration_s == pytest.approx(9.3)
    assert s.map is not None
    assert s.map.lanes == []
    for message in (s.map, s.route, s.ego0, s.objects_at(0.0), s.objects_at(4.44)):
        codec.check(message)


def test_the_others_of_its_recording_are_objects_and_the_ego_is_none(tmp_path: Path) -> None:
    s = load_scenario(f"{table(tmp_path, rows())}#A:1")
    assert [k.label for k in s.tracks] == ["car 2", "pedestrian 3"]
    now = s.objects_at(0.0)
    assert now.x == pytest.approx([-14.0])
    assert now.vx == pytest.approx([10.0])  # not the 99 of the file
    assert len(s.objects_at(2.0).id) == 2


def test_missing_headings_and_sizes_come_from_motion_and_class(tmp_path: Path) -> None:
    s = load_scenario(f"{table(tmp_path, rows())}#A:1")
    walker = s.tracks[1]
    assert walker.cls == ObjectClass.PEDESTRIAN
    assert walker.heading == pytest.approx(np.full(40, np.pi / 2))
    assert (walker.length, walker.width) == (0.5, 0.5)


def test_the_route_is_the_recorded_path_extended_and_its_goal_the_recorded_end(tmp_path: Path) -> None:
    lines = [row("A", "1", "car", f, 60 * np.sin(f / 60), 60 - 60 * np.cos(f / 60), ",,") for f in range(90)]
    s = load_scenario(str(table(tmp_path, lines)))
    line = Polyline.of(s.route.reference)
    driven = np.array([(60 * np.sin(f / 60), 60 - 60 * np.cos(f / 60)) for f in range(90)])
    assert np.abs(line.project(driven)[1]).max() < 0.15
    assert line.length > 89 + 100
    assert (s.route.goal.x, s.route.goal.y) == pytest.approx(tuple(driven[-1]), abs=1e-3)


def test_without_a_choice_the_vehicle_driven_farthest_is_taken(tmp_path: Path) -> None:
    path = table(tmp_path, rows())
    assert load_scenario(str(path)).detail == {"file": "t.csv", "rec": "A", "track": "2"}
    assert load_scenario(f"{path}#B").detail["rec"] == "B"
    assert load_scenario(f"{path}#A", ego_track=1).detail["track"] == "1"


def changed(column: int, value: str, at: int = 3) -> list[str]:
    lines = rows()
    cells = lines[at].split(",")
    cells[column] = value
    lines[at] = ",".join(cells)
    return lines


BAD = {
    "a word for a number": (changed(5, "far"), 5, "x 'far' is not a number"),
    "not finite": (changed(6, "nan"), 5, "y is nan"),
    "infinite": (changed(5, "inf"), 5, "x is inf"),
    "nothing": (changed(5, ""), 5, "not a number"),
    "a heading that is nan": (changed(9, "nan"), 5, "heading is nan"),
    "a wrong rate": (changed(4, "17.0"), 5, "not 10 Hz"),
    "a fraction of a frame": (changed(3, "8.5"), 5, "not a whole number"),
    "no length": (changed(10, "0.0"), 5, "length of 0 m"),
    "another type": (changed(2, "bus"), 5, "'bus' was 'car' before"),
    "too few values": (changed(11, "1.9,7"), 5, "13 values, expected 12"),
    "a jump": (changed(5, "5000"), 5, "jumps"),
    "a row twice": ([*rows()[:4], rows()[3], *rows()[4:]], 6, "stands there twice"),
    "a gap": ([*rows()[:4], *rows()[6:]], 6, "follows"),
}


@pytest.mark.parametrize("case", sorted(BAD))
def test_what_is_wrong_is_named_with_file_line_and_reason(tmp_path: Path, case: str) -> None:
    lines, line, reason = BAD[case]
    path = table(tmp_path, lines)
    with pytest.raises(ScenarioError) as e:
        load_scenario(str(path))
    assert (e.value.path, e.value.line) == (str(path), line)
    assert reason in e.value.reason
    assert str(e.value).startswith(f"{path}:{line}: ")


def test_two_hertz_are_refused_with_what_to_do(tmp_path: Path) -> None:
    lines = [row("A", "1", "car", f, 5.0 * f, 0.0).replace(f",{f / 10:.1f},", f",{f / 2:.1f},", 1) for f in range(20)]
    with pytest.raises(ScenarioError, match="not 10 Hz") as e:
        load_scenario(str(table(tmp_path, lines)))
    assert "10 Hz" in e.value.hint


def test_missing_columns_are_named(tmp_path: Path) -> None:
    path = table(tmp_path, [], head="rec,track,type,frame,x,y")
    with pytest.raises(ScenarioError, match="missing columns t") as e:
        load_scenario(str(path))
    assert e.value.line == 1


@pytest.mark.parametrize(
    ("selection", "reason"),
    [("#C", "no recording 'C'"), ("#A:9", "no track '9'"), ("#:1", "stands in 2 recordings")],
)
def test_a_choice_that_does_not_exist_is_refused(tmp_path: Path, selection: str, reason: str) -> None:
    with pytest.raises(ScenarioError, match=reason):
        load_scenario(f"{table(tmp_path, rows())}{selection}")


def test_no_rows_nobody_moving_and_no_gzip_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ScenarioError, match="no rows"):
        load_scenario(str(table(tmp_path, [])))
    parked = [row("A", "1", "car", f, 3.0, 0.0) for f in range(90)]
    with pytest.raises(ScenarioError, match="moves 20 m"):
        load_scenario(str(table(tmp_path, parked)))
    (tmp_path / "bad.csv.gz").write_text("rec,track\n")
    with pytest.raises(ScenarioError, match="cannot be read"):
        load_scenario(str(tmp_path / "bad.csv.gz"))
