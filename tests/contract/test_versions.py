"""Processes of two versions on one bus: minor versions understand each other, another major is refused by name."""

from __future__ import annotations

import json
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from common import topics
from common.bus import Bus, BusSettings, Inbox, open_bus, router
from common.clock import monotonic
from tests import samples
from tests.processes import group
from tests.waiting import until

ROOT = Path(__file__).parents[2]
MAJOR, MINOR = topics.VERSION_MAJOR, topics.VERSION_MINOR


class Pair:
    """A vehicle of this version, and a process of another beside it."""

    def __init__(self, bus: Bus, out: Any) -> None:
        self.bus = bus
        self.objects = bus.publisher(topics.OBJECTS)
        self.prediction: Inbox = bus.inbox(topics.PREDICTION)
        self.told: dict[str, Any] = {"answers": 0, "counters": {}}
        threading.Thread(target=self._listen, args=(out,), daemon=True).start()

    def answered(self, code: float) -> bool:
        """Send objects; whether an answer to them was accepted here."""
        self.objects.put(samples.objects(x=np.full(3, code)), capture_ns=monotonic())
        self.prediction.take()
        return self.prediction.latest is not None and self.prediction.latest.value.x0[0] == code

    def _listen(self, out: Any) -> None:
        for line in out:
            self.told = json.loads(line)


@contextmanager
def beside(major: int, minor: int) -> Iterator[Pair]:
    with router() as endpoint, open_bus(BusSettings(connect=(endpoint,)), "versions", "vehicle") as bus:
        command = [sys.executable, "-m", "tests.contract.other_version", endpoint, str(major), str(minor)]
        with group(command, cwd=ROOT, stdout=-1) as process:
            yield Pair(bus, process.stdout)


def refusals(counters: dict[str, int]) -> set[str]:
    """Names of what was not used, but for what newer messages overwrote."""
    return {name for name, n in counters.items() if n and not name.endswith(":overwritten")}


@pytest.mark.parametrize("minor", [MINOR - 1, MINOR, MINOR + 1])
def test_minor_versions_understand_each_other_in_both_directions(minor: int) -> None:
    with beside(MAJOR, minor) as pair:
        until(lambda: pair.answered(7.0), within_s=60, every_s=0.1, what="an answer of the other version")
        until(lambda: pair.told["answers"] > 0, within_s=30, what="the other's word")
        assert not refusals(pair.bus.counters) and not refusals(pair.told["counters"])


@pytest.mark.parametrize("major", [MAJOR - 1, MAJOR + 1])
def test_another_major_is_refused_by_name_in_both_directions(major: int) -> None:
    with beside(major, 0) as pair:

        def refused_both() -> bool:
            assert not pair.answered(7.0)
            return bool(pair.told["counters"].get("objects:version") and pair.bus.counters.get("prediction:version"))

        until(refused_both, within_s=60, every_s=0.1, what="a refusal by either")
        assert pair.told["answers"] == 0 and refusals(pair.told["counters"]) == {"objects:version"}
        assert refusals(pair.bus.counters) == {"prediction:version"}
