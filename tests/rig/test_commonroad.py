"""CommonRoad files as worlds: a small one written here in both format versions, and all recorded ones."""

import os
from pathlib import Path

import numpy as np
import pytest

from common import codec
from common.geometry import Polyline, distance_between_rectangles, rectangle_corners
from common.messages import ObjectClass
from rig.settings import RigSettings
from rig.sources import ScenarioError, load_scenario

DATA = Path(os.environ.get("FOREFIELD_DATA", "../shared/data")) / "commonroad"
RECORDED = sorted(DATA.glob("*.xml"))


def bound(tag: str, y: float, marking: str, x0: float, x1: float) -> str:
    points = "".join(f"<point><x>{x}</x><y>{y}</y></point>" for x in np.linspace(x0, x1, 5))
    return f"<{tag}>{points}{f'<lineMarking>{marking}</lineMarking>' if marking else ''}</{tag}>"


def lanelet(id: int, y: float, x0: float, x1: float, more: str, left: str = "dashed", right: str = "solid") -> str:
    edges = bound("leftBound", y + 1.75, left, x0, x1) + bound("rightBound", y - 1.75, right, x0, x1)
    return f'<lanelet id="{id}">{edges}{more}</lanelet>'


def state(tag: str, t: int, x: float, y: float, v: float, heading: float = 0.0) -> str:
    return (
        f"<{tag}><position><point><x>{x}</x><y>{y}</y></point></position><orientation><exact>{heading}</exact>"
        f"</orientation><time><exact>{t}</exact></time><velocity><exact>{v}</exact></velocity></{tag}>"
    )


def obstacle(id: int, kind: str, x: float, y: float, v: float, new: bool, steps: int = 60, dt: float = 0.1) -> str:
    shape = "<shape><rectangle><length>4.4</length><width>1.7</width></rectangle></shape>"
    states = "".join(state("state", i, x + v * i * dt, y, v) for i in range(1, steps + 1))
    body = f"<type>{kind}</type>{shape}{state('initialState', 0, x, y, v)}<trajectory>{states}</trajectory>"
    if new:
        return f'<dynamicObstacle id="{id}">{body}</dynamicObstacle>'
    return f'<obstacle id="{id}"><role>dynamic</role>{body}</obstacle>'


GOAL = (
    "<position><rectangle><length>6</length><width>3</width><orientation>0</orientation>"
    "<center><x>170</x><y>3.5</y></center></rectangle></position>"
)
LIGHT = (
    '<trafficLight id="900"><cycle><cycleElement><duration>20</duration><color>red</color></cycleElement>'
    "<cycleElement><duration>500</duration><color>green</color></cycleElement></cycle>"
    "<position><point><x>100</x><y>0</y></point></position><active>true</active></trafficLight>"
)
SIGN = (
    '<trafficSign id="800"><trafficSignElement><trafficSignID>274</trafficSignID>'
    "<additionalValue>11.0</additionalValue></trafficSignElement></trafficSign>"
)


def scenario(
    new: bool = True,
    goal: str = GOAL,
    obstacles: str | None = None,
    light: bool = False,
    dt: float = 0.1,
    x0: float = 10.0,
) -> str:
    """Two lanes to the east, each of two lanelets: 1 → 2 on the right (y = 0), 3 → 4 to its left (y = 3.5)."""
    stop = "<stopLine><lineMarking>solid</lineMarking><trafficLightRef ref='900'/></stopLine>" if light else ""
    lamp = "<trafficLightRef ref='900'/>" if light else ""
    sign = "<trafficSignRef ref='800'/>" if new else "<speedLimit>11.0</speedLimit>"
    urban = "<laneletType>urban</laneletType>" if new else ""
    beside = '<adjacent{} ref="{}" drivingDir="same"/>'
    lanes = (
        lanelet(
            1, 0.0, 0, 100, f'<successor ref="2"/>{beside.format("Left", 3)}{stop}{urban}{sign}{lamp}', right="curb"
        )
        + lanelet(2, 0.0, 100, 300, f'<predecessor ref="1"/>{beside.format("Left", 4)}{urban}', right="")
        + lanelet(3, 3.5, 0, 100, f'<successor ref="4"/>{beside.format("Right", 1)}{urban}', right="dashed")
        + lanelet(4, 3.5, 100, 300, f'<predecessor ref="3"/>{beside.format("Right", 2)}{urban}', "no_marking", "dashed")
    )
    if not new:
        lanes = lanes.replace("<lineMarking>curb</lineMarking>", "").replace(
            "<lineMarking>no_marking</lineMarking>", ""
        )
    others = obstacle(50, "car", 40, 0, 8, new, dt=dt) + obstacle(51, "pedestrian", 60, -4, 1, new, dt=dt)
    start = state("initialState", 0, x0, 0.2, 9.0).replace(
        "</initialState>",
        "<yawRate><exact>0</exact></yawRate><slipAngle><exact>0</exact></slipAngle></initialState>",
    )
    problem = (
        f'<planningProblem id="70">{start}<goalState>{goal}<time><intervalStart>40</intervalStart>'
        "<intervalEnd>60</intervalEnd></time></goalState></planningProblem>"
    )
    tags = "<scenarioTags><urban/></scenarioTags>" if new else ""
    location = (
        "<location><geoNameId>-999</geoNameId><gpsLatitude>0</gpsLatitude><gpsLongitude>0</gpsLongitude></location>"
        if new
        else ""
    )
    return (
        f'<?xml version="1.0"?><commonRoad commonRoadVersion="{"2020a" if new else "2018b"}"'
        f' benchmarkID="DEU_Test-1_1_T-1" author="a" affiliation="b" source="c" date="2024-01-01"'
        f' timeStepSize="{dt}" tags="urban">'
        f"{location}{tags}{lanes}{SIGN if new else ''}{LIGHT if light else ''}"
        f"{others if obstacles is None else obstacles}{problem}</commonRoad>"
    )


def write(folder: Path, text: str) -> str:
    path = folder / "small.xml"
    path.write_text(text, "utf-8")
    return str(path)


@pytest.mark.parametrize("new", [True, False], ids=["2020a", "2018b"])
def test_both_versions_give_the_same_world(tmp_path: Path, new: bool) -> None:
    s = load_scenario(write(tmp_path, scenario(new)))
    assert (s.ego0.x, s.ego0.y, s.ego0.speed) == (10.0, 0.2, 9.0)
    assert s.duration_s == pytest.approx(6.0)
    assert s.map is not None
    assert [k.id for k in s.map.lanes] == [1, 2, 3, 4]
    first = s.map.lanes[0]
    assert first.successors == [2]
    assert (first.left_neighbour, first.left_same_direction, first.right_neighbour) == (3, True, None)
    assert first.speed_limit == pytest.approx(11.0)
    now = s.objects_at(1.0)
    assert list(now.id) == [50, 51]
    assert list(now.cls) == [ObjectClass.CAR, ObjectClass.PEDESTRIAN]
    assert now.x == pytest.approx([48.0, 61.0])
    assert now.vx == pytest.approx([8.0, 1.0])
    assert s.objects_at(0.0).vx == pytest.approx([8.0, 1.0])
    for message in (s.map, s.route, s.ego0, now):
        codec.check(message)


def test_boundaries_are_what_their_marking_says_and_never_a_barrier_without_one(tmp_path: Path) -> None:
    s = load_scenario(write(tmp_path, scenario()))
    assert s.map is not None
    assert [(k.left_type, k.right_type) for k in s.map.lanes] == [
        ("dashed", "kerb"),
        ("dashed", "unknown"),
        ("dashed", "dashed"),
        ("virtual", "dashed"),
    ]


def test_the_route_changes_lanes_smoothly_to_the_goal_and_goes_on_beyond_it(tmp_path: Path) -> None:
    s = load_scenario(write(tmp_path, scenario()))
    line = Polyline.of(s.route.reference).resampled(0.5)
    assert line.project(np.array([10.0, 0.0]))[1] == pytest.approx(0.0, abs=0.05)
    at, off = line.project(np.array([170.0, 3.5]))
    assert abs(off) < 0.05
    assert line.length - at >= 99.0
    heading = np.unwrap(np.arctan2(*np.diff(line.points, axis=0).T[::-1]))
    assert np.abs(np.diff(heading) / 0.5).max() < 0.03
    assert s.route.lane_ids[0] == 1
    assert s.route.lane_ids[-1] == 4
    assert (s.route.goal.x, s.route.goal.y) == pytest.approx((170.0, 3.5))


def test_a_goal_given_as_lanelets_lies_on_them(tmp_path: Path) -> None:
    s = load_scenario(write(tmp_path, scenario(goal='<position><lanelet ref="4"/></position>')))
    assert s.route.goal.y == pytest.approx(3.5, abs=0.1)
    assert 100.0 < s.route.goal.x < 120.0


def test_a_goal_that_is_only_a_time_gets_a_place_and_a_warning(tmp_path: Path) -> None:
    s = load_scenario(write(tmp_path, scenario(goal="")))
    assert any("only a time" in w for w in s.warnings)
    assert 30.0 < s.route.goal.x < 100.0


def test_a_goal_that_no_lane_leads_to_is_told(tmp_path: Path) -> None:
    s = load_scenario(write(tmp_path, scenario(goal=GOAL.replace("170", "30"), x0=150.0)))
    assert any("no lanes connect" in w for w in s.warnings)


def test_red_phases_close_the_stop_line(tmp_path: Path) -> None:
    s = load_scenario(write(tmp_path, scenario(light=True)))
    assert s.map is not None
    lines = [o for o in s.map.obstacles if o.kind == "stop_line"]
    assert len(lines) == 1
    assert np.allclose(lines[0].points[:, 0], 100.0)
    assert s.closures_at(0.0).ids == [lines[0].id]
    assert s.closures_at(1.9).ids == [lines[0].id]
    assert s.closures_at(2.1).ids == []
    assert lines[0].id not in {k.id for k in s.map.lanes}


def test_a_light_through_whose_red_the_record_drives_is_left_out_by_name(tmp_path: Path) -> None:
    s = load_scenario(write(tmp_path, scenario(light=True, obstacles=obstacle(50, "car", 88, 0, 8, True))))
    assert s.closures == ()
    assert any("lanelet 1 do not fit the record" in w and "car 50" in w for w in s.warnings)


def test_the_recorded_driver_is_not_met_on_the_road(tmp_path: Path) -> None:
    own = obstacle(70, "car", 10.3, 0.2, 9, True)
    s = load_scenario(write(tmp_path, scenario(obstacles=own + obstacle(50, "car", 40, 0, 8, True))))
    assert [k.id for k in s.tracks] == [50]
    assert s.human is not None
    assert s.human.id == 70


def test_another_step_is_resampled_to_ten_hertz(tmp_path: Path) -> None:
    s = load_scenario(write(tmp_path, scenario(dt=0.2)))
    assert s.objects_at(1.0).x == pytest.approx([48.0, 61.0])
    assert s.objects_at(0.3).vx == pytest.approx([8.0, 1.0])
    assert any("resampled" in w for w in s.warnings)


def test_odd_obstacles_are_named(tmp_path: Path) -> None:
    big = obstacle(60, "car", 80, 0, 5, True).replace("4.4", "444")
    wall = obstacle(61, "constructionZone", 90, -4, 0, True)
    s = load_scenario(write(tmp_path, scenario(obstacles=big + wall)))
    assert [k.id for k in s.tracks] == [61]
    assert any("obstacle 60 left out" in w for w in s.warnings)
    assert any("61" in w and "constructionZone" in w for w in s.warnings)


def test_a_static_obstacle_stands_there_all_the_time(tmp_path: Path) -> None:
    parked = (
        '<staticObstacle id="62"><type>parkedVehicle</type><shape><rectangle><length>4</length><width>2</width>'
        f"</rectangle></shape>{state('initialState', 0, 90, -1.0, 0)}</staticObstacle>"
    )
    s = load_scenario(write(tmp_path, scenario(obstacles=parked + obstacle(50, "car", 40, 0, 8, True))))
    for t in (0.0, 3.0, 6.0):
        seen = s.objects_at(t)
        assert seen.x[list(seen.id).index(62)] == 90.0


def test_the_speed_limit_of_a_map_without_one_is_a_setting(tmp_path: Path) -> None:
    text = scenario().replace("<trafficSignRef ref='800'/>", "").replace(SIGN, "")
    assert load_scenario(write(tmp_path, text)).route.speed_limit == RigSettings().urban_speed_limit
    s = load_scenario(write(tmp_path, text), settings=RigSettings(default_speed_limit=7.0))
    assert s.route.speed_limit == 7.0
    assert any("no speed limits" in w for w in s.warnings)


@pytest.mark.parametrize(
    ("text", "line", "reason"),
    [
        ("<commonRoad>\n<lanelet>\n</commonRoad>", 3, "not valid XML"),
        ("<html></html>", 1, "not a CommonRoad file"),
        ("", 1, "not valid XML"),
        ('<commonRoad commonRoadVersion="1999"></commonRoad>', None, "cannot read"),
    ],
)
def test_what_is_no_scenario_is_refused_with_file_and_reason(
    tmp_path: Path, text: str, line: int | None, reason: str
) -> None:
    path = write(tmp_path, text)
    with pytest.raises(ScenarioError) as e:
        load_scenario(path)
    assert (e.value.path, e.value.line) == (path, line)
    assert reason in str(e.value)


def test_a_file_without_a_planning_problem_is_refused(tmp_path: Path) -> None:
    text = scenario()
    cut = text[: text.index("<planningProblem")] + "</commonRoad>"
    with pytest.raises(ScenarioError, match="no planning problem"):
        load_scenario(write(tmp_path, cut))


# --- the recorded ones ---


@pytest.mark.skipif(not RECORDED, reason="no CommonRoad files: set FOREFIELD_DATA")
@pytest.mark.parametrize("path", RECORDED, ids=lambda p: p.stem)
def test_every_recorded_scenario_is_a_world_to_drive_in(path: Path) -> None:
    s = load_scenario(str(path))
    assert s.map is not None
    for message in (s.map, s.route, s.ego0, s.closures_at(0.0)):
        codec.check(message)
    for t in np.arange(-1.0, s.duration_s + 0.1, 0.5):
        codec.check(s.objects_at(float(t)))
    line = Polyline.of(s.route.reference)
    at, beside = line.project(np.array([s.ego0.x, s.ego0.y]))
    goal, off = line.project(np.array([s.route.goal.x, s.route.goal.y]))
    assert abs(beside) < 2.0
    assert abs(off) < s.route.goal.radius
    assert goal >= at - 1e-6
    assert line.length - goal > 95.0
    heading = np.unwrap(np.arctan2(*np.diff(line.resampled(0.5).points, axis=0).T[::-1]))
    assert np.abs(np.diff(heading) / 0.5).max() < np.tan(0.55) / s.ego0.wheelbase
    o = s.objects_at(0.0)
    ego = rectangle_corners(s.ego0.x, s.ego0.y, s.ego0.heading, s.ego0.length, s.ego0.width)
    others = rectangle_corners(o.x, o.y, o.heading, o.length, o.width)
    assert distance_between_rectangles(ego, others).min() > 0.0
    assert 1.0 <= s.duration_s <= 30.0


@pytest.mark.skipif(not RECORDED, reason="no CommonRoad files: set FOREFIELD_DATA")
def test_recorded_scenarios_are_found_by_name(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FOREFIELD_DATA", str(DATA.parent))
    assert load_scenario(RECORDED[0].stem).name == RECORDED[0].stem
    with pytest.raises(ScenarioError, match=f"Did you mean.*{RECORDED[0].stem[:8]}"):
        load_scenario(RECORDED[0].stem + "x")
