"""Sliced against full space-time evaluation: what is compared, and that nothing differs where nothing is cut."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("torch")
pytest.importorskip("warp")

from common.messages import Candidates, Plan
from evaluation.planning import space_time
from evaluation.planning.space_time import Pair
from rig import configuration


def _plan(offset: float, length: float = 30.0) -> Plan:
    x = np.linspace(0.0, length, 31)[None]
    paths = Candidates(x=x, y=np.full_like(x, offset), desired_speed=np.ones(1), score=np.ones(1))
    return Plan(mode="waiting", reason="", candidates=paths, chosen=0)


def test_a_shorter_path_along_the_same_line_is_the_same_path():
    assert space_time._apart(_plan(0.0), _plan(0.0, 12.0)) < 0.1
    assert space_time._apart(_plan(0.0), _plan(1.0)) == pytest.approx(1.0, abs=0.01)
    assert space_time._apart(_plan(0.0), Plan(mode="safe_stop", reason="")) == np.inf


def test_the_summary_says_who_is_slower():
    pairs = [Pair((5.0, 20.0), (10.0, 30.0), True, True, (v, 8.0)) for v in (7.0, 8.0, 8.2)]
    s = space_time.summary([*pairs, Pair((7.0, 30.0), (12.0, 30.0), False, True, (6.0, 8.0))])
    assert s["same_path"] == 0.75 and s["speed_within_0.5"] == 0.5
    assert s["sliced_slower_mean"] == pytest.approx((1.0 + 0.0 - 0.2 + 2.0) / 4, abs=1e-3)
    assert s["field_ms"] == [5.0, 20.0] and s["plan_ms"] == [10.0, 30.0]
    assert space_time.summary([]) == {"cycles": 0}


@pytest.mark.slow
def test_where_the_slices_are_as_fine_as_the_rollout_both_are_one():
    tree = configuration.load(None, ["riskfield.h=1.25", "riskfield.slices=61", "riskfield.slice_s=0.1"])
    found = space_time.compared(tree, ["cut_in"], 20)
    pairs = found["cut_in"]
    assert len(pairs) >= 10
    assert all(p.same_path and p.same_mode and p.speed[0] == p.speed[1] for p in pairs)
