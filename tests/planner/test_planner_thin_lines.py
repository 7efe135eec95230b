"""A closed line is contact only where the bumper is nearly on it: none may lie between two poses that are looked at."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from services.planner.footprint import Footprint, path_risk
from services.planner.settings import PlannerSettings
from services.planner.volume import Volume
from tests.planner.worlds import box, ego_at, risk_of

SETTINGS = PlannerSettings()
EGO = ego_at(0.0, 0.0, 0.0, 8.0)
SMALL = {"ahead": 40.0, "behind": 10.0, "width": 8.0}
FRONT = EGO.wheelbase / 2 + EGO.length / 2  # m, before the rear axle


def met(line: float, step: float) -> tuple[np.ndarray, np.ndarray, float]:
    """Contact at poses `step` apart with a closed line across the way at `line`, where the front is [m], and r_hit."""

    def across(px: np.ndarray, py: np.ndarray) -> np.ndarray:
        return 1.5 / 0.36 * (0.6 - np.minimum(0.6, np.abs(px - line))) ** 2

    volume = Volume.of(risk_of(EGO, [], h=0.25, statics=across, **SMALL), 0, 0)
    x = step * np.arange(16)[None] - EGO.wheelbase / 2
    foot = Footprint.of(EGO, SETTINGS.footprint_spacing, SETTINGS.flank_margin, 1.0, step)
    found = path_risk(volume, foot, x, np.zeros_like(x), np.zeros_like(x), step)
    assert found.contact is not None
    assert found.ahead is not None
    return np.minimum(found.contact[0, 0], found.ahead[0, 0]), x[0] + FRONT, SETTINGS.r_hit


@settings(max_examples=40)
@given(st.floats(6.0, 11.0), st.floats(SETTINGS.step_min, SETTINGS.step_max))
def test_no_closed_line_lies_between_two_poses(line: float, step: float):
    contact, front, r_hit = met(line, step)
    hit = np.flatnonzero(contact >= r_hit)
    assert len(hit)
    assert abs(front[hit[0]] - line) <= step + 0.2


def test_points_behind_the_bumper_change_nothing_about_bodies():
    volume = Volume.of(risk_of(EGO, [box(18.0, 0.3), box(12.0, 2.4), box(30.0, -1.9, 3.0)], h=0.25, **SMALL), 0, 0)
    x = 1.1 * np.arange(26)[None] - EGO.wheelbase / 2
    zero = np.zeros_like(x)
    before, after = (
        path_risk(volume, Footprint.of(EGO, 0.9, SETTINGS.flank_margin, 1.0, stride), x, zero, zero, 1.1)
        for stride in (0.0, 1.1)
    )
    first = [int(np.argmax(r.contact[0, 0] >= SETTINGS.r_hit)) for r in (before, after)]  # type: ignore[index]
    assert first[0] == first[1] > 0
    assert np.array_equal(before.contact[0, :, : first[0]], after.contact[0, :, : first[0]])  # type: ignore[index]
