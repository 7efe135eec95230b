"""What a bench does for days: it waits as long as it was told, and keeps no more than it needs."""

from __future__ import annotations

import gc
import time
import weakref
from types import SimpleNamespace
from typing import Any

import pytest
from typer.testing import CliRunner

from rig import application, session
from rig.application import app
from rig.launcher import LaunchError


class Chatty:
    """Statuses on a bus on which something arrives all the time: no wait lasts. Services are up after a while."""

    def __init__(self, up_after_s: float) -> None:
        self.bus = SimpleNamespace(wait=lambda _: True)
        self._up = time.monotonic() + up_after_s

    def update(self) -> None:
        """Nothing more is heard."""

    def state(self, _: str) -> str:
        return "ready" if time.monotonic() >= self._up else "starting"

    def words(self, _: str) -> str:
        return "starting"


def wait(statuses: Any, timeout_s: float) -> None:
    session._wait_for_others(statuses, timeout_s, {"bus": {"connect": ["tcp/somewhere"]}})


def test_services_elsewhere_are_waited_for_as_long_as_it_says_however_much_arrives():
    wait(Chatty(0.3), 30.0)


def test_services_elsewhere_that_never_come_are_named():
    with pytest.raises(LaunchError, match=r"not up at tcp/somewhere after 0\.1 s \(predictor: starting"):
        wait(Chatty(1e9), 0.1)


class Report(dict[str, Any]):
    """A report that can be watched."""


@pytest.mark.parametrize("outcomes", [["completed"] * 3, ["failed", "completed", "completed"]])
def test_a_loop_keeps_only_the_report_of_the_last_drive_and_remembers_a_failure(monkeypatch, outcomes):
    alive: list[int] = []
    made: list[weakref.ref[Report]] = []

    def play(scenario: object, tree: object, options: object, show: object, done: Any, beside: object) -> None:
        for outcome in outcomes:
            report = Report(outcome=outcome)
            made.append(weakref.ref(report))
            done(report)
            del report
            gc.collect()
            alive.append(sum(r() is not None for r in made))

    monkeypatch.setattr(session, "play", play)
    monkeypatch.setattr(application, "_conclude", lambda *_: None)
    result = CliRunner().invoke(app, ["run", "--scenario", "straight", "--loop"])
    assert alive == [1, 1, 1], result.output
    assert result.exit_code == (1 if "failed" in outcomes else 0)
