"""The simulated-time loop gets a recorded bus run's decisions from that run's arrival times."""

from __future__ import annotations

from pathlib import Path

import pytest

pytest.importorskip("torch")
pytest.importorskip("warp")
pytest.importorskip("mcap")

from evaluation.planning.arrivals import Run, replayed
from rig import configuration
from rig.bus_log.compare import difference
from rig.bus_log.machine import machine
from rig.bus_log.reader import BusLog

FILE = Path(__file__).parents[1] / "replay" / "reference_drive.mcap"


@pytest.fixture(scope="module")
def log() -> BusLog:
    return BusLog.open(FILE)


@pytest.fixture(scope="module")
def run(log: BusLog) -> Run:
    return Run.of(log)


def test_with_the_arrival_times_of_a_bus_run_the_loop_decides_as_that_run_did(log: BusLog, run: Run):
    same = log.machine == machine()
    found = replayed(run, configuration.resolve(log.configuration))
    assert len(run.plans) >= 80 and set(found) == set(run.plans)
    driven = [seq for seq, plan in run.plans.items() if plan.mode == "drive"]
    assert len(driven) >= 40
    for seq, recorded in run.plans.items():
        assert difference(recorded, found[seq], same_machine=same) is None, seq


def test_with_risks_that_arrive_later_it_decides_otherwise(log: BusLog, run: Run):
    found = replayed(run, configuration.resolve(log.configuration), risks_late=1)
    assert any(difference(plan, found[seq], same_machine=True) for seq, plan in run.plans.items())


def test_everything_arrives_after_it_was_begun_and_before_it_is_used(run: Run):
    for step in run.steps:
        assert step.arrives_ns > step.inputs.now_ns
    ends = {(s.stage, s.seq): s.arrives_ns for s in run.steps}
    for step in run.steps:
        for used in step.inputs.used:
            stage = {"prediction": "predictor", "risk": "riskfield"}.get(used.topic)
            if stage is not None:
                assert ends[stage, used.seq] <= step.inputs.now_ns
