"""The situations: fixed, half and half, deterministic by seed; truth against cases with a known answer."""

from __future__ import annotations

import numpy as np
import pytest

from common.geometry import Polyline
from common.messages import Map, ObjectClass
from evaluation.hazards import named as situations
from evaluation.hazards.episode import Actor, Episode, grid
from evaluation.hazards.fingerprint import fingerprint
from evaluation.hazards.script import actor, standing, straight
from evaluation.hazards.truth import LAG_S, PET_HARMLESS_S, PET_HAZARD_S, truth_of

NAMED = "713860bf0d366c0014957a50e95987073e75070c5183176c73724d1bc185c3e4"
VARIANTS = "7e2b3eb2e4084901da1e32da48b49d0128c62e42b9c5409df6f9eed922f9232a"
SIZE = (4.5, 1.8)


def scene(*actors: Actor, speed: float = 10.0, duration_s: float = 8.0) -> Episode:
    return Episode("test", Map(), straight(-300.0, 0.0, 600.0, 0.0), speed, 300.0, duration_s, actors)


def test_the_24_are_half_hazardous_half_harmless_and_what_their_name_says():
    cases = situations.named()
    assert len({c.episode.name for c in cases}) == len(cases) == 24
    assert [c.truth.label for c in cases] == ["hazard"] * 12 + ["harmless"] * 12
    assert all(situations.unfit(c) is None for c in cases)


def test_the_situations_are_the_ones_that_were_fixed_before_any_threshold_was_tuned():
    assert fingerprint(situations.named()) == NAMED
    assert fingerprint(situations.variants(7, 24)) == VARIANTS


def test_variants_follow_the_seed():
    first, again, other = (fingerprint(situations.variants(s, 6)) for s in (3, 3, 4))
    assert first == again != other


def test_nobody_jumps_or_moves_faster_than_traffic_does():
    for case in [*situations.named(), *situations.variants(11, 8)]:
        for a in case.episode.actors:
            v = np.hypot(np.gradient(a.x, 0.02), np.gradient(a.y, 0.02))
            assert v.max() < 45.0, case.episode.name
            assert np.abs(np.diff(v)).max() < 0.35, case.episode.name  # 17 m/s²
            turned = np.abs(np.angle(np.exp(1j * np.diff(a.heading))))
            assert turned.max() < 0.05, case.episode.name


@pytest.mark.parametrize(("ahead", "speed"), [(50.0, 10.0), (42.0, 14.0)])
def test_contact_with_a_standing_car_comes_when_the_bumpers_meet(ahead: float, speed: float):
    t = grid(8.0)
    truth = truth_of(scene(standing(ObjectClass.CAR, SIZE, ahead, 0.0, 0.0, t), speed=speed))
    assert truth.contact and truth.label == "hazard"
    assert truth.event_s == pytest.approx((ahead - 4.5) / speed, abs=0.02)


def test_a_hard_braking_lead_is_met_when_the_gap_is_used_up():
    t, gap, brake, v = grid(8.0), 20.0, 5.0, 15.0
    x = 300.0 + 4.5 + gap + v * t - 0.5 * brake * np.maximum(t, 0.0) ** 2
    truth = truth_of(scene(actor(ObjectClass.CAR, SIZE, straight(-300.0, 0.0, 900.0, 0.0), x), speed=v))
    assert truth.event_s == pytest.approx(np.sqrt(2 * gap / brake), abs=0.03)


@pytest.mark.parametrize("late", [0.2, 0.4, 0.7, 0.9, 1.3])
def test_pet_of_a_crossing_is_the_time_between_leaving_and_entering(late: float):
    """The crossing car enters the ego's strip `late` after the ego's rear has left the crossing's."""
    t, v, u = grid(8.0), 10.0, 8.0
    ego_leaves = (50.0 + 0.9 + 2.25) / v
    s = 200.0 - 0.9 - 2.25 + u * (t - ego_leaves - late)
    car = actor(ObjectClass.CAR, SIZE, Polyline.of([(50.0, -200.0), (50.0, 200.0)]), s)
    truth = truth_of(scene(car, speed=v))
    assert not truth.contact
    if late < PET_HARMLESS_S:
        assert truth.pet_s == pytest.approx(late, abs=LAG_S)
    wanted = "hazard" if late <= PET_HAZARD_S else ("grey" if late < PET_HARMLESS_S else "harmless")
    assert truth.label == wanted
    if wanted == "hazard":
        assert truth.event_s == pytest.approx(ego_leaves + late, abs=0.15)


def test_following_at_a_steady_distance_is_told_by_its_time_gap():
    t, line = grid(8.0), straight(-300.0, 0.0, 900.0, 0.0)
    for time_gap, label in ((0.4, "hazard"), (0.8, "grey"), (1.4, "harmless")):
        lead = actor(ObjectClass.CAR, SIZE, line, 300.0 + 4.5 + 10.0 * time_gap + 10.0 * t)
        assert truth_of(scene(lead)).label == label


def test_passing_beside_is_harmless_and_its_clearance_is_known():
    t = grid(8.0)
    truth = truth_of(scene(standing(ObjectClass.CAR, SIZE, 50.0, -2.3, 0.0, t)))
    assert truth.label == "harmless" and truth.event_s is None
    assert truth.clearance_m == pytest.approx(0.5, abs=1e-6)


def test_who_is_behind_another_vehicle_is_not_seen():
    t = grid(8.0)
    line = straight(-300.0, 0.0, 900.0, 0.0)
    lead = actor(ObjectClass.CAR, SIZE, line, 300.0 + 20.0 + 10.0 * t)
    hidden = standing(ObjectClass.CAR, SIZE, 120.0, 0.0, 0.0, t)
    beside = standing(ObjectClass.CAR, SIZE, 60.0, 6.0, 0.0, t)
    seen = scene(lead, hidden, beside).objects(0)
    assert seen.id.tolist() == [1, 3]
    assert seen.vx.tolist() == pytest.approx([10.0, 0.0])
