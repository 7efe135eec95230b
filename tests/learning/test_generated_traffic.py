"""Generated traffic: a table that the readers take, the same from the same seed, another from another."""

from __future__ import annotations

import numpy as np
import pytest

from evaluation import generate_traffic
from evaluation.sumo_networks import networks
from evaluation.trajectory_windows import recordings

pytestmark = pytest.mark.slow


@pytest.fixture
def one_network(monkeypatch):
    pytest.importorskip("libsumo", reason="Eclipse SUMO is in the extra `traffic`")
    monkeypatch.setattr(generate_traffic, "given_networks", list)
    monkeypatch.setattr(generate_traffic, "WARM_UP_S", 10.0)
    monkeypatch.setattr(generate_traffic, "networks", lambda *a: [n for n in networks(*a) if n.name == "signals"])


def test_the_same_seed_gives_the_same_table_to_the_byte(one_network, tmp_path):
    tables = [tmp_path / f"{k}.csv.gz" for k in range(3)]
    for table, seed in zip(tables, (1, 1, 2), strict=True):
        done = generate_traffic.generate(table, seed=seed, seconds=3.0)
        assert done.runs == 1 and done.rows > 0
    first, again, other = (t.read_bytes() for t in tables)
    assert first == again != other


def test_its_tracks_move_as_vehicles_do(one_network, tmp_path):
    generate_traffic.generate(tmp_path / "t.csv.gz", seed=3, seconds=6.0)
    (recording,) = recordings(tmp_path / "t.csv.gz")
    assert recording.name.startswith("sumo_signals") and len(recording.tracks) > 5
    steps = np.concatenate([np.hypot(np.diff(t.x), np.diff(t.y)) for t in recording.tracks])
    assert steps.max() <= generate_traffic.STEP_MAX_M and steps.max() > 0.3
    assert all(3.0 < t.length < 15.0 for t in recording.tracks)
