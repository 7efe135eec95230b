"""What a scenario says is there, at any moment."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from common import codec
from common.messages import Goal, Map, ObjectClass, Route
from rig.world import Closure, Scenario, Track, ego_at


def scenario(*tracks: Track, closures: tuple[Closure, ...] = ()) -> Scenario:
    route = Route(reference=np.array([[0.0, 0.0], [100.0, 0.0]]), goal=Goal(x=90.0, y=0.0, radius=3.0))
    return Scenario("test", "test", "built-in", 10.0, Map(), route, ego_at(0.0, 0.0, 0.3, 10.0), tracks, closures)


def track(x: list[float], heading: list[float] | None = None, frame0: int = 0, first: bool = True) -> Track:
    n = len(x)
    return Track(
        id=7, cls=ObjectClass.CAR, length=4.0, width=2.0, frame0=frame0, x=np.array(x, dtype=float),
        y=np.arange(n) * 0.5, heading=np.zeros(n) if heading is None else np.array(heading),
        first_velocity=(1.0, 2.0) if first else None,
    )  # fmt: skip


coordinates = st.lists(st.floats(-1e5, 1e5), min_size=2, max_size=20)


@given(coordinates, st.integers(0, 30))
@settings(max_examples=50)
def test_recorded_frames_come_back_exactly(x: list[float], frame0: int) -> None:
    k = track(x, frame0=frame0)
    s = scenario(k)
    for i in range(len(x)):
        seen = s.objects_at((frame0 + i) * 0.1)
        assert seen.x[0] == k.x[i]
        assert seen.y[0] == k.y[i]


@given(coordinates, st.floats(0.0, 0.999))
@settings(max_examples=50)
def test_in_between_lies_on_the_straight_line_between_two_frames(x: list[float], w: float) -> None:
    s = scenario(track(x))
    seen = s.objects_at((len(x) - 2 + w) * 0.1)
    low, high = sorted(x[-2:])
    assert low - 1e-6 <= seen.x[0] <= high + 1e-6
    assert seen.x[0] == pytest.approx(x[-2] + w * (x[-1] - x[-2]), abs=1e-5 * max(1.0, abs(x[-1] - x[-2])))


def test_headings_are_interpolated_across_the_wrap() -> None:
    seen = scenario(track([0.0, 1.0], heading=[3.1, -3.1])).objects_at(0.05)
    assert abs(abs(seen.heading[0]) - np.pi) < 1e-9


def test_an_object_exists_only_while_recorded() -> None:
    s = scenario(track([0.0, 1.0, 2.0], frame0=5))
    there = [len(s.objects_at(t).id) for t in (0.0, 0.49, 0.5, 0.6, 0.7, 0.75, 1.0)]
    assert there == [0, 0, 1, 1, 1, 0, 0]


def test_without_a_recorded_velocity_it_exists_from_its_second_frame() -> None:
    s = scenario(track([0.0, 1.0, 2.0], first=False))
    assert len(s.objects_at(0.0).id) == 0
    assert s.objects_at(0.1).vx[0] == pytest.approx(10.0)


@given(coordinates.filter(lambda x: len(x) > 4), st.integers(1, 3))
@settings(max_examples=30)
def test_the_future_does_not_show_in_velocities(x: list[float], frame: int) -> None:
    changed = x[: frame + 1] + [v + 123.0 for v in x[frame + 1 :]]
    now, other = (scenario(track(v)).objects_at(frame * 0.1) for v in (x, changed))
    assert now.vx[0] == other.vx[0]
    assert now.vx[0] == pytest.approx((x[frame] - x[frame - 1]) / 0.1, rel=1e-9, abs=1e-6)


def test_the_run_up_leads_straight_to_the_start() -> None:
    s = scenario(track([5.0, 6.0]))
    before, now = s.objects_at(-0.5), s.objects_at(0.0)
    assert before.x[0] == pytest.approx(now.x[0] - 0.5 * now.vx[0])
    assert s.ego_before(0.0) == s.ego0
    assert s.ego_before(-1.0).x == pytest.approx(s.ego0.x - s.ego0.vx)


def test_nobody_there_is_an_empty_message_and_a_valid_one() -> None:
    seen = scenario().objects_at(3.0)
    codec.check(seen)
    assert len(seen.id) == 0


def test_closures_hold_from_their_start_until_before_their_end() -> None:
    s = scenario(closures=(Closure(3, 1.0, 2.0), Closure(4, 0.0, 9.0), Closure(3, 1.5, 3.0)))
    assert [s.closures_at(t).ids for t in (-1.0, 0.5, 1.0, 2.0, 3.0, 9.0)] == [[4], [4], [3, 4], [3, 4], [4], []]
