"""Bad input ends with exit code 2 and one clear line that says what to do, before any process is started."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest
from typer.testing import CliRunner

from common.bus import free_port, router
from rig import application, session
from rig.application import app
from rig.configuration import SETTINGS, resolve

RUN = ["run", "--scenario", "straight"]


def call(*arguments: str | Path):
    return CliRunner().invoke(app, [str(a) for a in arguments], env={"COLUMNS": "200", "TERM": "dumb"})


@pytest.fixture(autouse=True)
def nothing_is_started(monkeypatch: pytest.MonkeyPatch) -> None:
    def play(*_: object) -> None:
        raise AssertionError("a run was started")

    monkeypatch.setattr(session, "play", play)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["run", "--scenario", "leftturn"], ["leftturn", "left_turn"]),
        (["run", "--scenario", "no/such.xml"], ["no/such.xml", "no such file"]),
        ([*RUN, "--set", "planner"], ["planner", "KEY=VALUE"]),
        ([*RUN, "--set", "planner.max_sped=3"], ["max_sped", "max_speed"]),
        ([*RUN, "--set", "planer.max_speed=3"], ["planer", "planner"]),
        ([*RUN, "--set", "planner.max_speed=fast"], ["max_speed"]),
        ([*RUN, "--set", "rig.ego_rate_hz=1000"], ["ego_rate_hz"]),
        ([*RUN, "--set", "vehicle=a/b"], ["a/b", "letters"]),
        ([*RUN, "--config", "nowhere.toml"], ["nowhere.toml", "no such"]),
        ([*RUN, "--device", "tpu"], ["tpu", "cuda"]),
        ([*RUN, "--record", "drive.mp4"], ["drive.mp4", ".rrd"]),
        ([*RUN, "--record", "no/folder/drive.rrd"], ["no/folder", "no such folder"]),
        ([*RUN, "--record-bus", "drive.rrd"], ["drive.rrd", ".mcap"]),
        ([*RUN, "--record-bus", "no/folder/drive.mcap"], ["no/folder", "no such folder"]),
        ([*RUN, "--json", "no/folder/drive.json"], ["no/folder", "no such folder"]),
        ([*RUN, "--json", "."], ["is a folder"]),
        ([*RUN, "--attach", "--record", "drive.rrd"], ["--record"]),
        (["view", "nothing.rrd"], ["nothing.rrd", "no such recording"]),
        (["health", "--set", "bus.conect=1"], ["conect", "connect"]),
        (["services", "--listen", "tcp/256.1.1.1:99999"], ["256.1.1.1"]),
        (["services", "--set", "bus.tls.ca=x"], ["bus.tls", "--attach"]),
    ],
)  # fmt: skip
def test_bad_input_is_code_2_and_one_line(arguments, words, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    result = call(*arguments)
    assert result.exit_code == 2, result.output
    assert all(word in result.stderr for word in words), result.stderr
    assert len(result.stderr.strip().splitlines()) == 1
    assert "Traceback" not in result.output


@pytest.mark.parametrize("arguments", [["run"], [*RUN, "--duration", "-1"], [*RUN, "--seed", "x"], ["drive"]])
def test_wrong_usage_is_code_2(arguments):
    assert call(*arguments).exit_code == 2


def test_a_damaged_scenario_file_is_named(tmp_path):
    file = tmp_path / "broken.xml"
    file.write_text("<commonRoad><lanelet>")
    result = call("run", "--scenario", file)
    assert result.exit_code == 2
    assert "broken.xml" in result.stderr


def test_a_missing_extra_is_named_with_its_remedy(monkeypatch, tmp_path):
    monkeypatch.undo()
    monkeypatch.chdir(tmp_path)
    found = session.importlib.util.find_spec
    monkeypatch.setattr(
        session.importlib.util, "find_spec", lambda name, *a: None if name == "rerun" else found(name, *a)
    )
    result = call(*RUN, "--record", "drive.rrd")
    assert result.exit_code == 2
    assert "pip install 'forefield[viz]'" in result.stderr


def test_without_the_rig_extra_the_command_says_how_to_get_it():
    program = "import sys; sys.modules['typer'] = None; import rig.command; rig.command.main()"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert done.returncode == 2
    assert done.stderr == "forefield needs typer: pip install 'forefield[rig]'\n"


def test_a_file_that_sets_something_is_overridden_by_set(tmp_path):
    file = tmp_path / "f.toml"
    file.write_text("vehicle = 'van'\n[rig]\nrun_up_s = 2.5\nsettle_s = 4\n[riskfield]\ndevice = 'cpu'\n")
    tree = application.configuration.load(file, ["rig.run_up_s=0.5"])
    assert tree["vehicle"] == "van"
    assert (tree["rig"]["run_up_s"], tree["rig"]["settle_s"]) == (0.5, 4.0)
    assert tree["riskfield"]["device"] == "cpu"


def test_the_resolved_configuration_spells_out_every_key_and_resolves_to_itself():
    tree = resolve({})
    assert set(tree) == {"vehicle", *SETTINGS}
    assert all(len(tree[name]) == len(kind.__struct_fields__) for name, kind in SETTINGS.items())
    assert resolve(tree) == tree
    assert json.loads(json.dumps(tree)) == json.loads(json.dumps(resolve(json.loads(json.dumps(tree)))))


def test_scenarios_lists_what_run_knows(monkeypatch):
    monkeypatch.delenv("FOREFIELD_DATA", raising=False)
    result = call("scenarios")
    assert result.exit_code == 0
    assert all(name in result.stdout for name in application.builtin_scenarios())
    assert "FOREFIELD_DATA" in result.stdout


def test_health_of_a_bus_without_services_is_code_1_and_says_who_is_missing():
    with router() as endpoint:
        result = call("health", "--connect", endpoint)
    assert result.exit_code == 1
    assert all(name in result.stdout for name in ("predictor", "riskfield", "planner"))
    assert "nobody answers" in result.stderr


def test_health_without_a_router_ends_with_a_word():
    result = call("health", "--connect", f"tcp/127.0.0.1:{free_port()}")
    assert result.exit_code == 1
    assert "no router at tcp/127.0.0.1" in result.stderr
