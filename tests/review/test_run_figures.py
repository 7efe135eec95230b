"""The run figures: their four frames are found in the drive itself, and what they claim is what was driven."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from evaluation.figures.run_figures import RUN_FIGURES
from evaluation.figures.run_overtaking import BACK_M, BEGINS_M, moments
from evaluation.figures.run_scenes import run
from evaluation.figures.run_turns import crossing_moments, shares, u_turn_moments


@given(
    begin=st.floats(2.0, 5.0), high=st.floats(0.8, 3.0), back=st.floats(8.0, 10.0), ahead=st.floats(60.0, 70.0)
)  # fmt: skip
@settings(max_examples=60, deadline=None)
def test_the_frames_follow_the_manoeuvre(begin: float, high: float, back: float, ahead: float) -> None:
    t = np.arange(0.0, 14.0, 0.1)
    s = 10.0 * t
    d = high * np.clip((t - begin) / 2.0, 0, 1) * np.clip((back + 2.0 - t) / 2.0, 0, 1)
    other = ahead + 1.0 * t
    seen, moves, beside, home = (k for k, _ in moments(s, d, other))
    assert seen <= moves < beside < home
    assert abs(d[moves]) > BEGINS_M >= abs(d[moves - 1])
    assert abs(s[beside] - other[beside]) <= 0.46
    assert abs(d[home]) < BACK_M <= abs(d[home - 1])


def test_without_a_manoeuvre_there_still_are_four_frames() -> None:
    s = np.linspace(0.0, 100.0, 101)
    assert len(moments(s, np.zeros(101), np.full(101, 50.0))) == 4


@given(angle=st.sampled_from((np.pi, np.pi / 2, -np.pi / 2)), begin=st.floats(4.0, 8.0), first=st.floats(-4.0, 4.0))
@settings(max_examples=60, deadline=None)
def test_the_frames_of_a_turn_follow_the_heading_and_the_slowest_moment_comes_before_it(
    angle: float, begin: float, first: float
) -> None:
    t = np.arange(0.0, 20.0, 0.1)
    heading = first + angle * np.clip((t - begin) / 5.0, 0.0, 1.0)
    share = shares((heading + np.pi) % (2 * np.pi) - np.pi)
    speed = 5.0 + np.abs(t - begin + 1.0)
    assert share[0] == 0.0 and abs(share[-1] - 1.0) < 1e-9
    begins, half, done = (k for k, _ in u_turn_moments(speed, share))
    assert begins < half < done and abs(t[half] - begin - 2.5) <= 0.1001
    waits, crosses, across = (k for k, _ in crossing_moments(speed, share))
    assert abs(t[waits] - begin + 1.0) <= 0.1 and waits < crosses < across


@pytest.mark.slow
@pytest.mark.timeout(900)
@pytest.mark.parametrize("name", list(RUN_FIGURES))
def test_each_is_drawn_with_units(name: str, tmp_path: Path) -> None:
    figure = RUN_FIGURES[name]()
    labels = {a.get_xlabel() for a in figure.axes} | {a.get_ylabel() for a in figure.axes}
    assert {"x [m]", "y [m]"} <= labels and any("[m/s]" in label for label in labels)
    assert any(r"E_\mathrm{max}" in label for label in labels)
    figure.savefig(tmp_path / "figure.png", dpi=60)
    assert (tmp_path / "figure.png").stat().st_size > 10_000


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_the_ego_is_slower_beside_a_truck_than_beside_a_car() -> None:
    beside = {}
    for kind in ("truck", "car"):
        drive = run(f"{kind}_adjacent")
        (s, _), (other, _) = drive.along(), drive.of(drive.only_other)
        beside[kind] = float(drive.speed[np.nanargmin(np.abs(s - other))])
    assert beside["truck"] < beside["car"] - 0.5
