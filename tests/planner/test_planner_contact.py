"""Contact within a slice: one and the same source moves on, of others the nearer holds; who goes along may be near."""

from __future__ import annotations

import numpy as np
import pytest

from services.planner.beside import beside_law
from services.planner.contact import Contact
from services.planner.speed import FAR
from services.planner.volume import NOBODY

STARTS = np.arange(4) * 0.5
POINTS = 40


def contact(places: list[float | None], names: list[int]) -> Contact:
    """A source that begins at a station of each slice and reaches four stations further."""
    risk = np.zeros((1, 4, POINTS), dtype=np.float32)
    who = np.full((1, 4, POINTS), NOBODY, dtype=np.uint8)
    for j, (place, name) in enumerate(zip(places, names, strict=True)):
        if place is not None:
            risk[0, j, int(place) : int(place) + 4] = 1.0
            who[0, j, int(place) : int(place) + 4] = name
    return Contact.of(risk, who, STARTS, 0.8, 1.0)


def test_the_contact_of_one_source_moves_on_within_a_slice():
    c = contact([20, 24, 28, 32], [3, 3, 3, 3])
    assert np.allclose(c.rate[0, :3, 0], 8.0)
    assert np.allclose(c.away[0, :, 0], 8.0)
    for j in range(3):
        assert np.isclose(c.distance[0, j, 0] + 0.5 * c.rate[0, j, 0], c.distance[0, j + 1, 0])


@pytest.mark.parametrize(
    ("places", "names"),
    [([20, 24, 28, 32], [1, 2, 1, 2]), ([20, 24, 28, 32], [NOBODY] * 4), ([30, 20, None, 20], [1, 2, 2, 1])],
)
def test_of_different_or_unknown_sources_the_nearer_one_holds(places: list[float | None], names: list[int]):
    c = contact(places, names)
    assert np.all(c.rate[0, :, 0] == 0.0)
    assert np.all(c.away[0, :, 0] == 0.0)
    own = [FAR if p is None else p for p in places]
    for j in range(3):
        assert c.distance[0, j, 0] <= min(own[j], own[j + 1])


def test_one_that_crosses_does_not_move_away():
    c = contact([None, 20, None, None], [1, 1, 1, 1])
    assert np.all(c.distance[0, :2, 0] <= 20.0)
    assert np.all(c.away == 0.0)


def law_beside(back: list[float], length: float = 6.0, risk: float = 0.7, name: int = 1) -> np.ndarray:
    """What a source with a stretch of `length` stations from `back` on, on the left, allows at S_max = 14 m/s."""
    sides = np.zeros((2, 1, 4, POINTS), dtype=np.float32)
    who = np.full(sides.shape, NOBODY, dtype=np.uint8)
    for j, b in enumerate(back):
        i = slice(max(int(b), 0), int(b + length))
        sides[0, 0, j, i], who[0, 0, j, i] = risk, name
    return np.minimum(*beside_law(sides, who, STARTS, 1.0, 14.0, 0.2, 0.9, 0.9))[0]


def test_beside_one_who_goes_along_almost_his_speed_may_be_driven():
    law = law_beside([-2.0, 2.0, 6.0, 10.0])  # at 8 m/s
    assert np.isclose(law.min(), 0.9 * 8.0, atol=0.6)


@pytest.mark.parametrize(
    "back",
    [[10.0, 10.0, 10.0, 10.0], [20.0, 16.0, 12.0, 8.0]],
    ids=["stands", "comes"],
)
def test_past_one_who_stands_or_comes_the_law_holds(back: list[float]):
    assert np.isclose(law_beside(back).min(), 14.0 * 0.2 / 0.7, atol=1e-4)


def test_a_stretch_that_widens_moves_nobody_and_unknown_sources_get_no_relief():
    sides = np.zeros((2, 1, 4, POINTS), dtype=np.float32)
    who = np.full(sides.shape, NOBODY, dtype=np.uint8)
    for j in range(4):
        i = slice(20 - 3 * j, 22 + 3 * j)
        sides[1, 0, j, i], who[1, 0, j, i] = 0.7, 1
    assert np.isclose(beside_law(sides, who, STARTS, 1.0, 14.0, 0.2, 0.9, 0.9)[0].min(), 4.0, atol=1e-4)
    assert np.isclose(law_beside([-2.0, 2.0, 6.0, 10.0], name=NOBODY).min(), 4.0, atol=1e-4)


def test_who_comes_into_the_way_moves_as_he_does_once_there():
    """A gap between cars that go by: the next one is not a wall in the slice in which he arrives."""
    c = contact([30, 20, 25, 30], [1, 2, 2, 2])
    assert c.distance[0, 0, 0] == pytest.approx(20.0, abs=1.0)
    assert c.away[0, 0, 0] == pytest.approx(10.0)
    assert contact([30, 20, 20, 20], [1, 2, 2, 2]).away[0, 0, 0] == 0.0
