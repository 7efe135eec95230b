"""A long run that is stopped goes on where it was, with the same figures as in one go."""

from __future__ import annotations

import itertools
import json
import operator
import re
from pathlib import Path

import pytest

from common.config import ConfigError
from evaluation.planning import command
from evaluation.planning.engines import in_order
from rig import configuration

THREE = ["right_turn#5", "dead_end", "right_turn#6"]
TIMES = re.compile("cycle_ms|wall_s")


def _run(path: Path | None, **more):
    return command.run(configuration.load(None, []), planners=["idm"], checkpoint=path, **{"sources": THREE, **more})


def _figures(value):
    if isinstance(value, dict):
        return {k: _figures(v) for k, v in value.items() if not TIMES.search(k)}
    return value


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> tuple[dict, list[str]]:
    path = tmp_path_factory.mktemp("checkpoint") / "run.jsonl"
    return _run(path), path.read_text().splitlines()


def test_a_run_that_was_killed_goes_on_and_drives_only_what_is_missing(whole, tmp_path: Path, monkeypatch):
    result, lines = whole
    path = tmp_path / "run.jsonl"
    path.write_text("\n".join(lines[:3]) + "\n" + lines[3][:100])  # killed in the middle of a line
    driven = []
    outcomes = command.outcomes
    monkeypatch.setattr(command, "outcomes", lambda tasks, **more: (driven.extend(tasks), outcomes(tasks, **more))[1])
    again = _run(path)
    assert [task.name for task in driven] == THREE[2:]
    assert _figures(again) == _figures(result)
    assert len(path.read_text().splitlines()) == 4
    driven.clear()
    _run(path)
    assert not driven


def test_what_has_not_been_driven_by_every_planner_is_driven_again(whole, tmp_path: Path, monkeypatch):
    path = tmp_path / "run.jsonl"
    path.write_text("\n".join(whole[1]) + "\n")
    asked = []
    monkeypatch.setattr(command, "outcomes", lambda tasks, **more: (asked.extend(tasks), iter(()))[1])
    command.run(configuration.load(None, []), sources=THREE, planners=["idm", "default"], checkpoint=path)
    assert [task.name for task in asked] == THREE


@pytest.mark.parametrize(
    ("more", "settings", "said"),
    [
        ({"seed": 1}, [], "another seed"),
        ({"traffic": "replay"}, [], "other scenarios"),
        ({}, ["planner.max_speed=3.0"], "other settings"),
    ],
)
def test_another_run_does_not_go_on_with_it(whole, tmp_path: Path, more, settings, said):
    path = tmp_path / "run.jsonl"
    path.write_text(whole[1][0] + "\n")
    with pytest.raises(ConfigError, match=said):
        command.run(configuration.load(None, settings), sources=THREE, planners=["idm"], checkpoint=path, **more)


def test_other_code_does_not_go_on_with_it(whole, tmp_path: Path):
    first = json.loads(whole[1][0])
    path = tmp_path / "run.jsonl"
    path.write_text(json.dumps({**first, "code": "0123"}) + "\n")
    with pytest.raises(ConfigError, match="has changed"):
        _run(path)


@pytest.mark.parametrize("text", ["hello\n", "[1]\n", '{"schema": "x"}\n', "\x00\x01\n"])
def test_a_file_that_is_none_of_ours_is_refused_and_left_alone(tmp_path: Path, text: str):
    path = tmp_path / "notes.txt"
    path.write_text(text)
    with pytest.raises(ConfigError, match="no checkpoint"):
        _run(path)
    assert path.read_text() == text


@pytest.mark.parametrize("jobs", [1, 2])
def test_pieces_come_in_their_order_and_known_ones_are_not_computed_again(jobs: int):
    known = {1: -1, 2: -2, 5: -5}
    found = itertools.islice(in_order(lambda k: (k, known.get(k, 0)), operator.neg, jobs), 7)
    assert list(found) == [(k, -k, not known.get(k, 0)) for k in range(7)]
