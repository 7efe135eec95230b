"""Other people's planners in our closed loop: the protocol, and that a peer that fails is counted and nothing worse."""

from __future__ import annotations

import math
import sys
from pathlib import Path

import numpy as np
import pytest

from common.config import ConfigError
from common.messages import Closures, Plan, Stamped
from evaluation.planning import command, drivers, tasks
from evaluation.planning.peers.driver import PeerDriver
from evaluation.planning.peers.process import VARIABLE, PeerError, Process
from rig import configuration
from rig.sources import load_scenario

PEER = """
import json, math, sys
cycle = 0
for line in sys.stdin:
    asked = json.loads(line)
    if asked["do"] == "start":
        print(json.dumps({"name": "fake", "period_s": 0.3}), flush=True)
        continue
    cycle += 1
    e, v = asked["ego"], 8.0
    t = [0.1 * k for k in range(31)]
    answer = {
        "ms": 7.5, "t": t, "x": [e["x"] + v * s * math.cos(e["heading"]) for s in t],
        "y": [e["y"] + v * s * math.sin(e["heading"]) for s in t], "heading": [e["heading"]] * 31, "speed": [v] * 31,
        "acceleration": [0.0] * 31, "curvature": [0.0] * 31,
    }
    CHANGE
    print(json.dumps(answer), flush=True)
"""


def _peer(folder: Path, change: str = "pass") -> PeerDriver:
    script = folder / f"peer{abs(hash(change))}.py"
    script.write_text(PEER.replace("CHANGE", change))
    return PeerDriver([sys.executable, str(script)], {}, patience_s=60.0)


def _plans(peer: PeerDriver, seconds: float = 2.0, step_s: float = 0.05) -> list[tuple[float, Plan]]:
    """The peer's plans for an ego that drives 8 m/s straight on."""
    scenario = load_scenario("straight")
    found = []
    for k in range(round(seconds / step_s)):
        t = k * step_s
        ego = scenario.ego_before(0.0)
        x, y = ego.x + 8.0 * t * math.cos(ego.heading), ego.y + 8.0 * t * math.sin(ego.heading)
        ego = type(ego)(
            x=x, y=y, heading=ego.heading, vx=8.0 * math.cos(ego.heading), vy=8.0 * math.sin(ego.heading),
            acceleration=0.0, yaw_rate=0.0, length=ego.length, width=ego.width, wheelbase=ego.wheelbase,
        )  # fmt: skip
        now = 10**9 + round(t * 1e9)
        seen = 10**9 + round(math.floor(t / 0.1 + 1e-9) * 1e8)
        objects = Stamped(scenario.objects_at(math.floor(t / 0.1 + 1e-9) * 0.1), seen, seen)
        plan = peer.plan(Stamped(ego, now, now), objects, scenario.map, scenario.route, Closures())
        assert not plan.problem()
        found.append((t, plan))
    return found


def test_a_peer_plans_as_often_as_it_says_and_its_trajectory_is_driven_in_between(tmp_path: Path):
    peer = _peer(tmp_path)
    times = []
    for t, plan in _plans(peer, 1.2):
        assert plan.mode == "drive" and plan.profile is not None and plan.tail is not None
        assert plan.profile.t[0] == pytest.approx(0.0, abs=1e-9)  # where the ego is now, whenever it was planned
        assert plan.tail.speed[-1] == 0.0
        times.append(t)
    assert len(times) == 24
    assert not peer.failures


def test_its_own_time_counts_and_only_where_it_planned(tmp_path: Path):
    peer, took = _peer(tmp_path), []
    inner = peer.plan
    peer.plan = lambda *a: (inner(*a), took.append(peer.took_ms))[0]  # type: ignore[method-assign]
    _plans(peer, 0.9)
    assert [k for k, ms in enumerate(took) if not math.isnan(ms)] == [0, 6, 12]
    assert took[0] == 7.5


def test_cycles_without_a_trajectory_are_counted_and_the_last_one_is_driven_on_and_then_braked_along(tmp_path: Path):
    peer = _peer(tmp_path, 'answer = answer if cycle == 1 else {"none": "every drivable sample collides"}')
    plans = _plans(peer, 2.0)
    modes = {round(t, 2): p.mode for t, p in plans}
    assert modes[0.5] == modes[1.0] == "drive"
    assert modes[1.1] == modes[1.5] == "safe_stop"
    assert peer.failures == {"every drivable sample collides": 17}  # every 0.1 s from 0.3 s on
    stop = next(p for t, p in plans if p.mode == "safe_stop")
    assert stop.tail is not None
    assert stop.tail.speed[0] == pytest.approx(8.0)
    assert np.diff(stop.tail.speed).min() == pytest.approx(-0.3, abs=1e-6)  # 3 m/s²


def test_an_exception_in_a_cycle_is_told_by_its_name(tmp_path: Path):
    peer = _peer(tmp_path, 'answer = {"error": "ValueError: no projection"} if cycle % 2 else answer')
    _plans(peer, 0.5)
    assert set(peer.failures) == {"ValueError: no projection"}


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ("raise SystemExit('out of fuel')", "died: out of fuel"),
        ("print('hello')", "no JSON object"),
        ("answer = {'t': [0, 1]}", "no trajectory"),
        ("answer['x'] = answer['x'][:3]", "cannot be driven"),
        ("answer['x'][4] = math.nan", "cannot be driven"),
        ("answer['t'][4] = 0.0", "cannot be driven"),
    ],
)
def test_a_peer_that_dies_or_answers_nonsense_is_named(tmp_path: Path, change: str, said: str):
    with pytest.raises(PeerError, match=said):
        _plans(_peer(tmp_path, change), 0.2)


def test_a_peer_that_says_nothing_is_not_waited_for_for_ever(tmp_path: Path):
    process = Process([sys.executable, "-c", "import time; time.sleep(600)"], patience_s=0.3)
    with pytest.raises(PeerError, match="does not answer"):
        process.ask({"do": "start"})
    assert not process.alive


def test_a_drive_whose_peer_dies_counts_as_an_error_and_the_next_is_driven(monkeypatch, tmp_path: Path):
    script = tmp_path / "peer.py"
    script.write_text(PEER.replace("CHANGE", "if cycle == 5 and not __import__('os').path.exists(__file__ + '.dead'): "
                                   "open(__file__ + '.dead', 'w').close(); sys.exit('out of fuel')"))  # fmt: skip
    monkeypatch.setattr(drivers, "driver", lambda name, tree: PeerDriver([sys.executable, str(script)], tree))
    monkeypatch.setattr(tasks, "driver", drivers.driver)
    monkeypatch.setattr(drivers, "check", lambda name: None)
    monkeypatch.setattr(command, "check", drivers.check)
    result = command.run(configuration.load(None, []), sources=["straight", "dead_end"], planners=["frenetix"])
    summary, entries = result["summary"]["frenetix"], result["scenarios"]["frenetix"]
    assert (summary["n"], summary["errors"]) == (1, 1)
    assert "out of fuel" in entries["straight"]["error"]
    assert entries["dead_end"]["cycle_ms_p50"] == 7.5


def test_without_the_peers_own_python_it_is_said_how_to_get_it(monkeypatch, tmp_path: Path):
    monkeypatch.delenv(VARIABLE, raising=False)
    with pytest.raises(ConfigError, match="pip install commonroad-reactive-planner"):
        drivers.check("commonroad-reactive")
    monkeypatch.setenv(VARIABLE, str(tmp_path / "python"))
    with pytest.raises(ConfigError, match="is no file"):
        drivers.check("frenetix")


def test_a_python_without_the_peers_packages_is_said_so(monkeypatch):
    monkeypatch.setenv(VARIABLE, sys.executable)
    try:
        import frenetix  # noqa: F401
    except ImportError:
        with pytest.raises(ConfigError, match="No module named"):
            drivers.check("frenetix")
