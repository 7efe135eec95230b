"""Configuration: defaults < file < environment < --set; unknown keys and bad files are errors that say what to do."""

from __future__ import annotations

import tomllib
from pathlib import Path

import pytest

from common import config
from common.config import ConfigError, Settings


class Example(Settings, frozen=True):
    speed: float = 1.0
    name: str = "a"
    many: tuple[str, ...] = ()


def test_later_sources_win(tmp_path: Path) -> None:
    file = tmp_path / "c.toml"
    file.write_text('vehicle = "van"\n[planner]\nspeed = 2.0\nname = "file"\n')
    tree = config.load(file, ["planner.name=set"], {"FOREFIELD__PLANNER__SPEED": "3", "OTHER": "x"})
    assert config.section(tree, "planner", Example) == Example(speed=3.0, name="set")
    assert config.vehicle(tree) == "van"


def test_the_variable_names_the_file(tmp_path: Path) -> None:
    file = tmp_path / "c.toml"
    file.write_text("[viz]\nspeed = 5\n")
    assert config.load(environment={"FOREFIELD_CONFIG": str(file)})["viz"]["speed"] == 5


@pytest.mark.parametrize(
    ("setting", "says"),
    [
        ("planner.sped=2", "sped"), ("planner.speed=fast", "speed"), ("plannr.speed=2", "plannr"),
        ("speed", "KEY=VALUE"), ("planner=2", "section"),
    ],
)  # fmt: skip
def test_a_mistake_is_named(setting: str, says: str) -> None:
    with pytest.raises(ConfigError, match=says):
        config.section(config.load(settings=[setting], environment={}), "planner", Example)


def test_an_unknown_key_lists_the_known_ones() -> None:
    with pytest.raises(ConfigError, match="Known keys: speed, name, many"):
        config.section({"planner": {"sped": 1}}, "planner", Example)


@pytest.mark.parametrize("text", ["[planner", "\xff\xfe", "a = "])
def test_a_broken_file_is_named(tmp_path: Path, text: str) -> None:
    file = tmp_path / "broken.toml"
    file.write_bytes(text.encode("latin-1"))
    with pytest.raises(ConfigError, match=r"broken\.toml"):
        config.load(file, environment={})


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="no such configuration file"):
        config.load(tmp_path / "none.toml", environment={})


def test_a_tree_written_as_toml_reads_back() -> None:
    tree = {"vehicle": 'a"b', "planner": {"speed": 1.5, "many": ["x", "y"], "flag": True}, "viz": {"n": 3}}
    assert tomllib.loads(config.as_toml(tree)) == tree
