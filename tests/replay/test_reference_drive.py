"""The reference drive: what the services answered when it was recorded, they answer now.

If predictor, riskfield or planner are meant to answer otherwise, renew it: `make reference-drive`.
"""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import pytest

pytest.importorskip("torch")
pytest.importorskip("warp")
pytest.importorskip("mcap")

import msgspec
import numpy as np

from common import codec, topics
from common.messages import Plan, Prediction, Risk
from rig import configuration
from rig.bus_log.check import Checked, check
from rig.bus_log.compare import ELSEWHERE, difference
from rig.bus_log.machine import machine
from rig.bus_log.reader import BusLog

FILE = Path(__file__).with_name("reference_drive.mcap")
RENEW = "if this is meant, renew it: make reference-drive"


@pytest.fixture(scope="module")
def log() -> BusLog:
    return BusLog.open(FILE)


@pytest.fixture(scope="module")
def checked(log: BusLog) -> list[Checked]:
    same = log.machine == machine()
    return check(log, configuration.resolve(log.configuration), same_machine=same)


def test_every_step_is_repeated_and_agrees(checked):
    for result in checked:
        assert result.compared >= 40, (result.service, result.why_skipped)
        assert result.first is None, f"{result.service}: {result.first}; {RENEW}"


def test_it_is_small_and_whole_and_holds_what_it_should(log):
    assert FILE.stat().st_size < 2**20
    assert not log.is_torn and not log.dropped
    found = Counter(m.topic.suffix for m in log.messages())
    assert found["risk"] >= 40 and found["plan"] >= 80 and found["map"] >= 1
    modes, methods = set(), set()
    for message in log.messages([topics.PLAN, topics.PREDICTION]):
        value = codec.decode_body(message.topic, message.header(), message.payload)
        if isinstance(value, Plan):
            modes.add(value.mode)
        elif isinstance(value, Prediction):
            methods |= set(value.method.tolist())
    assert {"waiting", "drive"} <= modes
    assert 3 in methods, "the network predicts too"


@pytest.mark.parametrize("service", ["predictor", "riskfield", "planner"])
def test_another_configuration_is_noticed(log, service):
    key, value = {
        "predictor": ("policy", "kinematic"),
        "riskfield": ("slice_s", 0.4),
        "planner": ("max_speed", 3.0),
    }[service]
    tree = configuration.resolve(configuration.with_keys(log.configuration, service, **{key: value}))
    (result,) = check(log, tree, same_machine=True, services=(service,))
    assert result.different > 0 and result.first is not None
    seq, found = result.first
    assert seq >= 0 and found.field.startswith(("prediction.", "risk.", "plan.")) and found.recorded != found.repeated


def first(log: BusLog, topic: topics.Topic, n: int = 0):
    messages = list(log.messages([topic]))
    return codec.decode_body(topic, messages[n].header(), messages[n].payload)


def test_the_place_of_a_difference_is_named(log):
    risk: Risk = first(log, topics.RISK, -1)
    volume = risk.volume.copy()
    at = (3, 20, 11)
    volume[at] = 0.5 if volume[at] < 0.4 else 0.1
    found = difference(risk, msgspec.structs.replace(risk, volume=volume), same_machine=True)
    assert found is not None and found.field == "risk.volume[3, 20, 11]"
    assert str(volume[at]) in found.repeated
    plan: Plan = first(log, topics.PLAN, -1)
    assert plan.profile is not None
    x = plan.profile.x.copy()
    x[4] += 1e-5
    moved = msgspec.structs.replace(plan, profile=msgspec.structs.replace(plan.profile, x=x))
    found = difference(plan, moved, same_machine=True)
    assert found is not None and found.field == "plan.profile.x[4]"
    assert difference(plan, moved, same_machine=False) is None
    stopped = msgspec.structs.replace(plan, mode="waiting")
    found = difference(plan, stopped, same_machine=False)
    assert found is not None and (found.recorded, found.repeated) == ("'drive'", "'waiting'")


def test_elsewhere_risks_may_differ_by_little_and_by_no_more(log):
    risk: Risk = first(log, topics.RISK, -1)
    full = risk.volume.astype(np.float32)
    exact = msgspec.structs.replace(risk, volume=full)
    near = msgspec.structs.replace(risk, volume=full + np.float32(0.9 * ELSEWHERE * risk.e_max))
    far = msgspec.structs.replace(risk, volume=full + np.float32(1.2 * ELSEWHERE * risk.e_max))
    assert difference(exact, near, same_machine=False) is None
    assert difference(exact, near, same_machine=True) is not None
    assert difference(exact, far, same_machine=False) is not None
