# ruff: noqa: C408
"""The riskfield from messages to message: grid, which sources count, the road, slots, slice times."""

from __future__ import annotations

import math
import time

import numpy as np
import pytest
from msgspec.structs import replace

from common import codec, topics
from common.messages import NO_SLOT, Closures, Header, Lane, Map, Obstacle
from common.risk import RiskParameters
from services.riskfield.core import RiskField
from services.riskfield.grid import cell_centres, grid_around, into_grid, needed_ahead
from services.riskfield.settings import RiskfieldSettings
from services.riskfield.static_layer import StaticLayer
from tests.riskfield.scenes import ego, prediction, stamped, straight_road

RISK = RiskParameters()
SMALL = RiskfieldSettings(ahead=40, ahead_most=40, behind=30, width=24, h=0.5, slices=3, dtype="float32")


@pytest.fixture(scope="module")
def field():
    return RiskField(SMALL, RISK, "cpu")


def step(field, rows, me=None, world=None, closed=(), t_offset=0.0):
    return field.step(stamped(prediction(rows)), stamped(me or ego()), world, Closures(ids=list(closed)), t_offset)


def at(r, x, y, j=0):
    """M of slice j at the cell that holds a point of the map."""
    i, k = np.floor(into_grid(r.grid, np.array([x, y])) / r.grid.h).astype(int)
    return float(r.volume[j, i, k])


def source_at(r, x, y, j=0):
    i, k = np.floor(into_grid(r.grid, np.array([x, y])) / r.grid.h).astype(int)
    slot = r.dominant[j, i // 4, k // 4]
    return None if slot == NO_SLOT else r.slots[slot]


# grid


@pytest.mark.parametrize("speed", [0.0, 5.0, 13.9, 25.0, 36.0, 40.0])
def test_the_grid_reaches_what_the_speed_needs_and_thirty_metres_behind(speed):
    me = ego(100.0, -50.0, 2.0, speed)
    grid = grid_around(me, RiskfieldSettings())
    assert grid.rows % 4 == 0
    assert grid.columns % 4 == 0
    assert grid.rows * grid.h - 30.0 >= needed_ahead(speed) == 1.5 * speed + speed**2 / 3 + 6.5
    assert into_grid(grid, np.array([me.x, me.y])) == pytest.approx([30.0, 20.0])


def test_the_default_grid_is_160_by_40_metres():
    grid = grid_around(ego(speed=10.0), RiskfieldSettings())
    assert (grid.rows * grid.h, grid.columns * grid.h, grid.h) == (160.0, 40.0, 0.25)


def test_cells_lie_where_the_message_says():
    grid = grid_around(ego(3.0, 4.0, 1.0), SMALL)
    x, y = cell_centres(grid)
    assert into_grid(grid, np.stack((x, y), -1))[7, 9] == pytest.approx([7.5 * 0.5, 9.5 * 0.5])
    # i grows forward, j to the left
    assert np.arctan2(y[1, 0] - y[0, 0], x[1, 0] - x[0, 0]) == pytest.approx(1.0)
    assert np.arctan2(y[0, 1] - y[0, 0], x[0, 1] - x[0, 0]) == pytest.approx(1.0 + np.pi / 2)


def test_at_a_speed_where_the_grid_grows_nothing_is_allocated_again_and_again():
    core = RiskField(RiskfieldSettings(width=24, h=0.5, slices=2), RISK, "cpu")
    rows, made = set(), []
    for k in range(12):
        r = step(core, [dict(x=20.0)], ego(speed=17.0 if k % 2 else 17.2))
        rows.add(r.grid.rows)
        del r
        made.append(core._field.fresh_volumes)
    assert len(rows) == 2
    assert made[-1] == made[3] <= 4


def test_only_the_grids_of_the_last_two_sizes_keep_their_memory():
    core = RiskField(RiskfieldSettings(width=24, h=0.5, slices=2), RISK, "cpu")
    for speed in (10.0, 18.0, 22.0, 26.0, 30.0):
        step(core, [dict(x=20.0)], ego(speed=speed))
    assert len(core._field._volumes._rings) == 2


# objects


def test_an_object_peaks_where_it_is_and_moves_with_the_slices(field):
    r = step(field, [dict(x=10.0, y=2.0, speed=8.0, id=77)], ego(speed=8.0))
    assert r.problem() == ""
    for j, x in enumerate((10.0, 14.0, 18.0)):
        assert at(r, x, 2.0, j) == pytest.approx(1.0, abs=1e-3)
    assert source_at(r, 10.0, 2.0).id == 77
    assert source_at(r, 10.0, 2.0).term == "potential"


def test_the_lobe_ahead_of_an_oncoming_car_is_named_kinetic(field):
    r = step(field, [dict(x=30.0, y=0.0, heading=math.pi, speed=15.0, id=5)], ego(speed=15.0))
    assert at(r, 15.0, 0.0) > 0.3
    assert (source_at(r, 15.0, 0.0).id, source_at(r, 15.0, 0.0).term) == (5, "kinetic")


def test_an_offset_shifts_the_slices_in_time(field):
    row = dict(x=0.0, y=4.0, speed=10.0)
    late, fresh = step(field, [row], t_offset=0.2), step(field, [dict(row, x=2.0)])
    assert late.t_offset == 0.2
    assert late.slice_times == fresh.slice_times == [0.0, 0.5, 1.0]
    assert late.volume == pytest.approx(fresh.volume, abs=1e-3)


def test_without_objects_and_map_the_field_is_empty_and_names_nobody(field):
    r = step(field, [])
    assert np.all(r.volume == 0.0)
    assert np.all(r.dominant == NO_SLOT)
    assert r.slots == []
    assert r.problem() == ""


def test_a_follower_is_left_out_with_its_reason_and_rear_traffic_beside_stays(field):
    rows = [dict(id=1, x=-12.0, y=0.5, speed=14.0), dict(id=2, x=-12.0, y=3.6, speed=14.0)]
    r = step(field, rows, ego(speed=10.0))
    assert [(e.id, e.reason) for e in r.left_out] == [(1, "follower")]
    assert at(r, -12.0, 3.6) > 0.9
    assert at(r, -4.0, 0.0) < 0.3
    assert {s.id for s in r.slots} == {2}


@pytest.mark.parametrize(
    ("row", "why"),
    [
        (dict(x=-4.0), "not wholly behind the rear bumper"),
        (dict(x=-12.0, y=2.0), "beside"),
        (dict(x=-12.0, heading=0.9), "crossing"),
        (dict(x=-12.0, heading=math.pi), "driving away"),
        (dict(x=12.0), "ahead"),
    ],
)
def test_only_a_follower_is_left_out(field, row, why):
    assert step(field, [dict(speed=10.0) | row]).left_out == [], why


def test_who_has_run_into_the_ego_from_behind_is_a_follower_still_and_who_is_run_into_is_not(field):
    struck = dict(x=-3.0, y=0.4)
    assert [e.id for e in step(field, [dict(id=3, speed=12.0) | struck], ego(speed=8.0)).left_out] == [3]
    assert step(field, [dict(id=3, speed=5.0) | struck], ego(speed=8.0)).left_out == []
    assert step(field, [dict(id=3, x=-3.0, y=2.6, speed=12.0)], ego(speed=8.0)).left_out == []


def test_a_follower_is_recognised_whatever_the_egos_heading(field):
    heading = 2.5
    x, y = 50 - 12 * np.cos(heading), 60 - 12 * np.sin(heading)
    r = step(field, [dict(x=x, y=y, heading=heading + 0.3 - 2 * np.pi, speed=9.0)], ego(50, 60, heading))
    assert len(r.left_out) == 1


def test_far_coordinates_lose_no_precision(field):
    rows = [dict(x=12.0, y=1.0, heading=0.3, speed=7.0, rate=0.2), dict(x=25.0, y=-3.0, heading=2.0, speed=1.4, cls=6)]
    far = [dict(r, x=r["x"] + 6.9e5, y=r["y"] + 5.3e6) for r in rows]
    near = step(field, rows, ego(0.3, 0.2, 0.1), straight_road())
    road = Map(
        lanes=[
            replace(lane, centre=lane.centre + SHIFT, left=lane.left + SHIFT, right=lane.right + SHIFT)
            for lane in straight_road().lanes
        ]
    )
    away = step(field, far, ego(0.3 + 6.9e5, 0.2 + 5.3e6, 0.1), road)
    assert np.abs(near.volume - away.volume).max() < 2e-5


SHIFT = np.array([6.9e5, 5.3e6])


def test_an_object_far_off_the_grid_costs_nothing_and_an_oncoming_one_still_reaches_in(field):
    alone = step(field, [dict(x=10.0, y=1.0, speed=5.0)])
    with_far = step(field, [dict(x=10.0, y=1.0, speed=5.0), dict(x=400.0, y=300.0, speed=5.0)])
    assert np.array_equal(alone.volume, with_far.volume)
    oncoming = step(field, [dict(x=90.0, y=0.0, heading=math.pi, speed=20.0)], ego(speed=20.0))
    assert at(oncoming, 38.0, 0.0) > 0.0


# the road


def test_a_shared_lane_line_counts_once(field):
    r = step(field, [], world=straight_road())
    assert at(r, 5.0, 1.9) <= RISK.lane_line_peak + 1e-6
    one = Map(lanes=[replace(straight_road().lanes[0], left_neighbour=None)])
    assert at(r, 5.0, 1.9) == pytest.approx(at(step(field, [], world=one), 5.0, 1.9))


def test_the_same_line_drawn_by_other_lanes_in_other_pieces_counts_once(field):
    road = straight_road(points=3)
    left = road.lanes[1]
    pieces = [
        replace(left, id=50 + k, centre=c, left=a, right=b, right_neighbour=None)
        for k, (c, a, b) in enumerate(
            (left.centre[i : i + 2], left.left[i : i + 2], left.right[i : i + 2]) for i in range(2)
        )
    ]
    whole, cut = step(field, [], world=road), step(field, [], world=Map(lanes=[road.lanes[0], *pieces]))
    assert cut.volume == pytest.approx(whole.volume, abs=1e-5)


def test_a_virtual_boundary_is_nothing_and_an_untyped_one_a_lane_line_never_a_barrier(field):
    lane = straight_road(lanes=1).lanes[0]
    bare = step(field, [], world=Map(lanes=[replace(lane, left_type="virtual", right_type="virtual")]))
    assert np.all(bare.volume == 0.0)
    untyped = step(field, [], world=Map(lanes=[replace(lane, left_type="unknown", right_type="unknown")]))
    assert 0.0 < untyped.volume.max() <= RISK.lane_line_peak + 1e-6
    assert source_at(untyped, 5.0, 1.75).label == "lane_line"


@pytest.mark.parametrize("kind", ["road_edge", "kerb", "barrier"])
def test_the_roads_outer_edge_has_no_far_side(field, kind):
    r = step(field, [], world=straight_road(lanes=2, edge=kind))
    for y in (-1.9, -2.5, -5.0, -9.0, 5.5, 8.0, 11.0):
        assert at(r, 5.0, y) == pytest.approx(RISK.barrier_peak, abs=1e-3)
    for y in (-1.0, 0.0, 4.4):
        assert at(r, 5.0, y) < 0.05


def test_a_barrier_between_carriageways_falls_on_both_sides(field):
    here = straight_road(lanes=1, edge="barrier")
    beyond = straight_road(lanes=1, edge="barrier", y0=2.3, first_id=20)
    r = step(field, [], world=Map(lanes=here.lanes + beyond.lanes))
    assert at(r, 5.0, 1.75) > 1.0
    for y in (0.0, 4.0):
        assert at(r, 5.0, y) == 0.0
    assert at(r, 5.0, 7.5) == pytest.approx(RISK.barrier_peak, abs=1e-3)


def test_a_boundary_shared_by_two_lanes_is_no_outer_edge_even_without_neighbours(field):
    road = straight_road(lanes=2, edge="kerb")
    lanes = [
        replace(road.lanes[0], left_neighbour=None, left_type="kerb"),
        replace(road.lanes[1], right_neighbour=None, right_type="kerb"),
    ]
    r = step(field, [], world=Map(lanes=lanes))
    assert at(r, 5.0, 0.0) == at(r, 5.0, 3.5) == 0.0
    assert at(r, 5.0, 1.75) > 1.0


def test_a_wide_obstacle_is_at_its_peak_over_its_whole_width(field):
    wall = Obstacle(id=4, kind="barrier", points=np.array([[0.0, 5.0], [20.0, 5.0]]), width=2.0)
    r = step(field, [], world=Map(obstacles=[wall]))
    assert at(r, 10.0, 5.75) > 1.4
    assert at(r, 10.0, 6.9) == 0.0
    assert source_at(r, 10.0, 5.0).label == "barrier"


def test_a_stop_line_counts_only_while_it_is_closed(field):
    line = Obstacle(id=31, kind="stop_line", points=np.array([[12.25, -1.75], [12.25, 1.75]]))
    world = Map(obstacles=[line])
    assert np.all(step(field, [], world=world).volume == 0.0)
    closed = step(field, [], world=world, closed=[31])
    assert at(closed, 12.25, 0.1) > 1.0
    assert (source_at(closed, 12.25, 0.1).id, source_at(closed, 12.25, 0.1).label) == (31, "stop_line")
    assert np.all(step(field, [], world=world).volume == 0.0)


def test_a_closed_lane_cannot_be_entered_and_can_be_left(field):
    road = straight_road(lanes=2, x0=6.25, edge="dashed")
    open_road = step(field, [], world=road)
    closed = step(field, [], world=road, closed=[2])
    assert at(closed, 6.25, 3.25) > 1.0  # across its beginning
    assert at(closed, 15.0, 1.75) > 1.0  # from the lane beside it
    assert at(closed, 15.0, 3.5) == at(open_road, 15.0, 3.5)
    inside = step(field, [], ego(12.0, 3.5), road, closed=[2])
    assert at(inside, 15.0, 1.75) < 0.2


def test_an_unknown_closure_is_ignored(field):
    assert np.all(step(field, [], world=Map(), closed=[999]).volume == 0.0)


def test_a_map_of_thousands_of_lanes_does_not_slow_a_frame(field):
    lanes = []
    for k in range(3000):
        x = np.linspace(0.0, 60.0, 20) + 70.0 * (k % 60)
        y = 8.0 * (k // 60)
        line = [np.stack((x, np.full_like(x, y + d)), -1) for d in (0.0, 1.75, -1.75)]
        lanes.append(Lane(id=k, centre=line[0], left=line[1], right=line[2], left_type="kerb"))
    world = Map(lanes=lanes)
    me = ego(2000.0, 200.0)
    step(field, [], me, world)

    def cost(world):
        spent = []
        for _ in range(5):
            began = time.thread_time()
            step(field, [], me, world)
            spent.append(time.thread_time() - began)
        return min(spent)

    part = Map(
        lanes=[lane for lane in lanes if abs(lane.centre[0, 0] - 2000) < 400 and abs(lane.centre[0, 1] - 200) < 99]
    )
    step(field, [], me, part)
    small = cost(part)
    step(field, [], me, world)
    assert cost(world) < 1.5 * small + 2e-3


def test_disagreeing_neighbours_give_the_more_telling_type():
    lanes = straight_road().lanes
    lanes = [replace(lanes[0], left_type="virtual"), replace(lanes[1], right_type="solid")]
    labels = [(line.label, line.points[0, 1]) for line in StaticLayer(Map(lanes=lanes), RISK).lines]
    assert ("lane_line", 1.75) in labels
    lanes = [replace(lanes[0], left_type="virtual"), replace(lanes[1], right_type="unknown")]
    assert all(line.points[0, 1] != 1.75 for line in StaticLayer(Map(lanes=lanes), RISK).lines)


# the message


def header(body):
    return Header(
        schema="risk", version=(1, 0), source="riskfield" * 5, boot="b" * 16, seq=2**40, capture_ns=2**60,
        sent_ns=2**60, age_ns=2**30, body=body,
    )  # fmt: skip


def test_the_message_passes_the_codec_and_comes_back(field):
    r = step(field, [dict(x=10.0, y=2.0, speed=8.0)], world=straight_road())
    payload, body = codec.encode_body(topics.RISK, r)
    head = codec.decode_header(topics.RISK, codec.encode_header(topics.RISK, header(body)))
    back = codec.decode_body(topics.RISK, head, payload)
    assert np.array_equal(back.volume, r.volume)
    assert np.array_equal(back.dominant, r.dominant)
    assert back.slots == r.slots


def test_hundreds_of_sources_fit_the_header_and_the_rest_is_said():
    crowd = RiskField(RiskfieldSettings(slices=13, dtype="float16"), RISK, "cpu")
    rng = np.random.default_rng(0)
    rows = [
        dict(
            id=2**60 + k, x=rng.uniform(-25, 120), y=rng.uniform(-18, 18), heading=rng.uniform(-3, 3), cls=6, speed=1.5
        )
        for k in range(600)
    ]
    rows += [dict(id=2**61 + k, x=-30.0 - 0.2 * k, y=0.0, speed=12.0) for k in range(300)]
    r = crowd.step(stamped(prediction(rows)), stamped(ego()), straight_road(), None)
    assert len(r.slots) <= 255
    _, body = codec.encode_body(topics.RISK, r)
    assert len(codec.encode_header(topics.RISK, header(body))) <= 8 * 1024
    assert r.slots[-1].label == "other"
    reasons = " ".join(e.reason for e in r.left_out)
    assert "more" in reasons
    assert "share slot other" in reasons
    assert np.all((r.dominant < len(r.slots)) | (r.dominant == NO_SLOT))


def test_warm_up_compiles_before_the_first_frame():
    field = RiskField(SMALL, RISK, "cpu")
    assert field.device == "cpu"
    field.warm_up()
    began = time.perf_counter()
    step(field, [dict(x=5.0, y=3.0, speed=3.0)])
    assert time.perf_counter() - began < 1.0


def test_cuda_without_a_gpu_is_refused_with_what_to_do():
    import warp as wp

    wp.init()
    if wp.is_cuda_available():
        pytest.skip("there is a GPU here")
    with pytest.raises(RuntimeError, match=r"riskfield\.device"):
        RiskField(SMALL, RISK, "cuda")


def test_the_core_imports_neither_bus_nor_files_nor_clock():
    import subprocess
    import sys

    code = (
        "import sys; import services.riskfield.core; "
        "bad = {'zenoh', 'common.bus', 'common.service', 'common.clock', 'torch', 'rerun'} & set(sys.modules); "
        "assert not bad, bad"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=60)
