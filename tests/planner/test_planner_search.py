"""The search: what is riskier is never driven faster."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from services.planner.bezier import Start
from services.planner.footprint import PathRisk
from services.planner.rollout import Field, Rollouts, Tier, roll_out
from services.planner.search import last_to_meet, search
from services.planner.settings import PlannerSettings
from services.planner.speed import Cap, speed_law
from services.planner.volume import Volume

SETTINGS = PlannerSettings()
POINTS, STEP = 72, 1.2
STARTS = np.arange(13) * 0.5


def field_of(risk: np.ndarray, s_max: float = 14.0) -> Field:
    n = len(risk)
    cap = Cap(np.full((n, POINTS), 60.0), np.zeros((n, POINTS), dtype=np.intp))
    known = np.full(n, 1e3)
    stays = np.minimum(risk[:, 0], risk[:, 4]).astype(np.float32)
    path = PathRisk(risk.astype(np.float32), stays, known)
    volume = Volume(None, 0, STARTS)  # type: ignore[arg-type]
    return Field.of(path, volume, cap, known, np.full(n, s_max), STEP, SETTINGS)


def desired(risk: np.ndarray, speed: float) -> tuple[np.ndarray, np.ndarray]:
    """Tier and desired speed of each path."""
    n = len(risk)
    v = search(field_of(risk), Start(0, 0, 0, 0, speed, 0), SETTINGS, np.zeros(n), lambda rest: np.zeros_like(rest))
    return np.where(v.passed, v.tier, 9), v.desired


def blobs(rng: np.random.Generator, n: int) -> np.ndarray:
    risk = np.zeros((n, 13, POINTS))
    for k in range(n):
        for _ in range(rng.integers(0, 4)):
            j, i = rng.integers(0, 13), rng.integers(0, POINTS)
            risk[k, j : j + rng.integers(1, 8), i : i + rng.integers(1, 12)] += rng.random() * 1.2
    return risk


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**31), st.floats(0, 14))
def test_raising_risk_never_raises_the_desired_speed_of_a_path_nor_calms_its_braking(seed: int, speed: float):
    rng = np.random.default_rng(seed)
    low = blobs(rng, 1)
    high = low + blobs(rng, 1) * rng.random()
    tier_low, v_low = desired(low, speed)
    tier_high, v_high = desired(high, speed)
    assert tier_high[0] >= tier_low[0]
    if tier_high[0] == tier_low[0]:
        assert v_high[0] <= v_low[0] + 1e-9


def test_no_risk_leaves_s_max_and_a_wall_leaves_nothing():
    _, free = desired(np.zeros((1, 13, POINTS)), 8.0)
    assert free[0] == 14.0
    risk = np.zeros((1, 13, POINTS))
    risk[:, :, 3:] = 1.0
    tier, v = desired(risk, 8.0)
    assert tier[0] == 9
    assert v[0] == 0.0


def test_comfort_comes_first_then_firm_then_emergency():
    tiers = []
    for wall in (40, 22, 12, 5):
        risk = np.zeros((1, 13, POINTS))
        risk[:, :, int(wall / STEP) :] = 1.0
        tiers.append(int(desired(risk, 9.0)[0][0]))
    assert tiers == sorted(tiers)
    assert tiers[0] == 0
    assert tiers[-1] > tiers[0]


def rolled(tier: int, speed: float, target: float, hold: float, acceleration: float = 0.0) -> Rollouts:
    return roll_out(
        field_of(np.zeros((1, 13, POINTS))),
        Start(0, 0, 0, 0, speed, acceleration),
        np.array([0]),
        np.array([target]),
        np.array([hold]),
        Tier.all(SETTINGS)[tier],
        SETTINGS,
    )


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 5), st.floats(0, 25), st.floats(0, 25), st.sampled_from([0.0, 1.5, np.inf]), st.floats(-1.4, 1.0))
def test_rollouts_keep_the_limits_of_their_tier(
    tier: int, speed: float, target: float, hold: float, acceleration: float
):
    r = rolled(tier, speed, target, hold, acceleration)
    limit = Tier.all(SETTINGS)[tier]
    assert np.all(r.speed >= 0.0)
    assert np.all(np.diff(r.distance[0]) >= -1e-12)
    assert r.acceleration.min() >= -limit.brake - 1e-9
    assert r.acceleration.max() <= SETTINGS.accel + 1e-9
    moving = (r.speed[0, 1:] > 0) & (r.speed[0, :-1] > 0)
    jerk = np.diff(r.acceleration[0])[moving] / 0.1
    assert jerk.size == 0 or jerk.min() >= -limit.jerk - 1e-6
    if np.isfinite(hold) and speed < limit.brake * (6.0 - hold) - 4.0 and target <= speed:
        assert r.speed[0, -1] == 0.0


@given(st.floats(0, 3), st.floats(0, 3))
def test_the_speed_law_falls(a: float, b: float):
    low, high = speed_law(np.array([max(a, b), min(a, b)]), 14.0, 0.2, 0.9)
    assert 0.0 <= low <= high <= 14.0


@given(
    steps=st.lists(st.integers(1, 62), min_size=1, max_size=40),
    moved=st.lists(st.floats(0.0, 12.0), min_size=40, max_size=40),
)
def test_who_can_only_brake_does_not_swerve_for_less_than_a_slice(steps: list[int], moved: list[float]) -> None:
    when, side = np.array(steps), np.array(moved[: len(steps)])
    chosen = last_to_meet(when, side)
    assert when[chosen] >= when.max() - 5
    as_late = when >= when.max() - 5
    assert side[chosen] <= side[as_late].min() + 0.1
    assert last_to_meet(np.array([10, 15, 16]), np.array([0.0, 3.2, 8.0])) == 1  # more than a slice is worth it
    assert last_to_meet(np.array([11, 16, 16]), np.array([0.0, 3.2, 8.0])) == 0
