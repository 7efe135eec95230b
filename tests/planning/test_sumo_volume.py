"""SUMO's networks as our maps, and its traffic around an ego that it does not drive."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from common import codec
from common.geometry import Polyline
from common.messages import Closures

sumolib = pytest.importorskip("sumolib")

from evaluation.planning.sumo_roads import SumoRoads  # noqa: E402

NET = """<net version="1.20" junctionCornerDetail="5">
  <location netOffset="0,0" convBoundary="0,0,200,0" origBoundary="0,0,200,0" projParameter="!"/>
  <edge id=":b_0" function="internal">
    <lane id=":b_0_0" index="0" speed="10" length="10" shape="95,-4.8 105,-4.8"/>
    <lane id=":b_0_1" index="1" speed="10" length="10" shape="95,-1.6 105,-1.6"/>
  </edge>
  <edge id="in" from="a" to="b" priority="1">
    <lane id="in_0" index="0" speed="13.9" length="95" shape="0,-4.8 95,-4.8"/>
    <lane id="in_1" index="1" speed="13.9" length="95" shape="0,-1.6 95,-1.6"/>
  </edge>
  <edge id="out" from="b" to="c" priority="1">
    <lane id="out_0" index="0" speed="13.9" length="95" shape="105,-4.8 200,-4.8"/>
    <lane id="out_1" index="1" speed="13.9" length="95" shape="105,-1.6 200,-1.6"/>
  </edge>
  <tlLogic id="b" type="static" programID="0" offset="0"><phase duration="30" state="Gr"/></tlLogic>
  <junction id="a" type="dead_end" x="0" y="0" incLanes="" intLanes="" shape="0,0 0,-6.4"/>
  <junction id="b" type="traffic_light" x="100" y="0" incLanes="in_0 in_1" intLanes=":b_0_0 :b_0_1"
            shape="95,0 105,0 105,-6.4 95,-6.4">
    <request index="0" response="00" foes="00" cont="0"/>
    <request index="1" response="00" foes="00" cont="0"/>
  </junction>
  <junction id="c" type="dead_end" x="200" y="0" incLanes="out_0 out_1" intLanes="" shape="200,-6.4 200,0"/>
  <connection from="in" to="out" fromLane="0" toLane="0" via=":b_0_0" tl="b" linkIndex="0" dir="s" state="o"/>
  <connection from="in" to="out" fromLane="1" toLane="1" via=":b_0_1" tl="b" linkIndex="1" dir="s" state="o"/>
  <connection from=":b_0" to="out" fromLane="0" toLane="0" dir="s" state="M"/>
  <connection from=":b_0" to="out" fromLane="1" toLane="1" dir="s" state="M"/>
</net>
"""


@pytest.fixture
def roads(tmp_path: Path) -> SumoRoads:
    path = tmp_path / "small.net.xml"
    path.write_text(NET)
    return SumoRoads.read(path)


def test_a_network_becomes_a_map_that_keeps_the_contract(roads: SumoRoads):
    codec.check(roads.map)
    lanes = {k.id: k for k in roads.map.lanes}
    right, left = lanes[roads.ids["in_0"]], lanes[roads.ids["in_1"]]
    assert right.left_neighbour == left.id and left.right_neighbour == right.id
    assert right.successors == [roads.ids[":b_0_0"]]
    assert lanes[roads.ids[":b_0_0"]].successors == [roads.ids["out_0"]]
    assert (right.right_type, right.left_type, left.left_type) == ("road_edge", "dashed", "road_edge")
    assert lanes[roads.ids[":b_0_0"]].left_type == "virtual"
    d = Polyline.of(right.centre).project(np.vstack((right.left, right.right)))[1]
    assert sorted({round(float(v), 3) for v in d}) == [-1.6, 1.6]


def test_a_light_is_a_stop_line_at_the_end_of_its_lane(roads: SumoRoads):
    assert len(roads.map.obstacles) == 2
    for stop in roads.map.obstacles:
        assert stop.kind == "stop_line"
        assert np.allclose(stop.points[:, 0], 95.0)
        assert roads.links[stop.id][0].light == "b"


def test_only_the_lane_that_has_red_is_closed(roads: SumoRoads):
    from evaluation.planning.sumo_traffic import SumoTraffic
    from rig.world import ego_at

    nobody = SimpleNamespace(
        vehicle=SimpleNamespace(getIDList=lambda: ()),
        trafficlight=SimpleNamespace(getRedYellowGreenState=lambda light: "Gr"),
    )
    traffic = SumoTraffic(nobody, roads, "me", ego_at(60.0, -4.8, 0.0, 8.0), {"out"})
    red = [id for id, links in roads.links.items() if links[0].index == 1]
    assert traffic.closures_at(0.0) == Closures(ids=red)


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_some_hundred_metres_in_sumo_are_driven_and_measured():
    pytest.importorskip("libsumo")
    from evaluation.planning import command
    from rig import configuration

    result = command.run(configuration.load(None, []), planners=["idm"], sumo_km=0.1, seed=3)
    summary = result["summary"]["idm"]
    assert summary["errors"] == 0
    assert summary["driven_km"] >= 0.1
    assert summary["at_fault_per_1000_km_bound"] > 1000.0
    assert {e["yardstick"] for e in result["scenarios"]["idm"].values()} == {"sumo"}
