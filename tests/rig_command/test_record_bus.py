"""`run --record-bus`: the bus of a run in a file, whole, and nothing that outlives the run."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

pytest.importorskip("mcap")

from common import config, topics
from common.bus import BusSettings, open_bus, router
from common.clock import monotonic
from rig import application, configuration, session
from rig.application import app
from rig.bus_log.drive import recorder
from rig.bus_log.reader import BusLog
from rig.launcher import LaunchError
from tests import samples
from tests.waiting import until


def test_a_run_hands_its_bus_to_the_recorder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The drive itself is replaced: a bus, and one message on it."""

    def play(scenario: object, tree: Any, options: object, show: object, done: Any, beside: Any) -> None:
        with router() as endpoint:
            reached = configuration.with_keys(tree, "bus", connect=[endpoint])
            with beside(reached), open_bus(config.section(reached, "bus", BusSettings), "ego", "rig") as bus:
                ego = bus.publisher(topics.EGO)
                begun = file.stat().st_size

                def written() -> bool:  # what is on the way when all ends may be lost
                    ego.put(samples.ego(x=4.0), capture_ns=monotonic())
                    return file.stat().st_size > begun

                until(written, within_s=30, every_s=0.1, what="a message in the file")
            done({"outcome": "completed"})

    file = tmp_path / "drive.mcap"
    monkeypatch.setattr(session, "play", play)
    monkeypatch.setattr(application, "_conclude", lambda *_: None)
    result = CliRunner().invoke(
        app, ["run", "--scenario", "straight", "--record-bus", str(file), "--set", "rig.run_up_s=0.8"]
    )
    assert result.exit_code == 0, result.output
    log = BusLog.open(file)
    assert not log.is_torn and log.holds() == {"ego"}
    assert log.configuration["rig"]["run_up_s"] == 0.8


def test_a_bus_that_cannot_be_recorded_ends_the_run_with_the_reason(tmp_path: Path) -> None:
    with router() as endpoint:
        tree = configuration.with_keys(configuration.resolve({}), "bus", connect=[endpoint])
        with pytest.raises(LaunchError, match="no topic 'weather'"), recorder(tree, tmp_path / "a.mcap", "weather"):
            pass
