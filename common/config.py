"""Typed configuration: built-in defaults < TOML file < environment < `--set`; an unknown key is an error.

One tree serves everything: `[bus]`, `[service]`, `[risk]`, `[predictor]`, `[riskfield]`, `[planner]`, `[viz]`,
`[rig]` and the top-level `vehicle`. Each process converts the sections it needs to its own frozen struct.

- file: `--config FILE` or the variable `FOREFIELD_CONFIG`;
- environment: `FOREFIELD__PLANNER__MAX_SPEED=15` sets `planner.max_speed`; `FOREFIELD__VEHICLE=van7` sets `vehicle`;
- command line: `--set planner.max_speed=15`. Values are read as TOML values, anything else as text.
"""

from __future__ import annotations

import os
import tomllib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, TypeVar

import msgspec

SECTIONS = ("bus", "service", "risk", "predictor", "riskfield", "planner", "viz", "rig")
ENVIRONMENT_PREFIX = "FOREFIELD__"

Tree = dict[str, Any]
S = TypeVar("S", bound=msgspec.Struct)


class ConfigError(ValueError):
    """A configuration that cannot be used; the text says where and what to do."""


class Settings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Base of every section: immutable, every key has a default, unknown keys are errors."""


def load(path: Path | None = None, settings: Iterable[str] = (), environment: Mapping[str, str] | None = None) -> Tree:
    """Merge file, environment and `KEY=VALUE` settings into one tree.

    Raises:
        ConfigError: no such file, not TOML, an unknown section, or a setting that is not KEY=VALUE.
    """
    env = os.environ if environment is None else environment
    if path is None and env.get("FOREFIELD_CONFIG"):
        path = Path(env["FOREFIELD_CONFIG"])
    tree = _read(path) if path is not None else {}
    for name, value in sorted(env.items()):
        if name.startswith(ENVIRONMENT_PREFIX):
            _put(
                tree,
                name.removeprefix(ENVIRONMENT_PREFIX).lower().split("__"),
                _value(value),
                f"variable {name}",
            )
    for setting in settings:
        key, equals, value = setting.partition("=")
        if not equals or not key.strip():
            raise ConfigError(f"--set {setting!r}: write KEY=VALUE, for example planner.max_speed=15")
        _put(tree, key.strip().split("."), _value(value.strip()), f"--set {setting}")
    for key, value in tree.items():
        if key == "vehicle":
            continue
        if key not in SECTIONS:
            raise ConfigError(f"unknown section or key {key!r}; known: vehicle, {', '.join(SECTIONS)}")
        if not isinstance(value, dict):
            raise ConfigError(f"{key!r} is a section: write {key}.NAME = VALUE")
    return tree


def section(tree: Tree, name: str, kind: type[S]) -> S:
    """Convert one section to its settings.

    Raises:
        ConfigError: an unknown key, a wrong type or a value out of range; the text names the key.
    """
    try:
        return msgspec.convert(tree.get(name, {}), kind)
    except msgspec.ValidationError as e:
        known = ", ".join(f.name for f in msgspec.structs.fields(kind))
        raise ConfigError(f"[{name}] {e}. Known keys: {known}") from None


def vehicle(tree: Tree) -> str:
    """Name of the vehicle, the second part of every key."""
    name = tree.get("vehicle", "ego")
    if not isinstance(name, str):
        raise ConfigError(f"vehicle must be a name, got {name!r}")
    return name


def as_toml(tree: Tree) -> str:
    """Write a tree as TOML, so that a child process can be given exactly this configuration."""

    return "\n".join(_toml_lines(tree, "")) + "\n"


def _toml_lines(tree: Tree, path: str) -> list[str]:
    lines = [
        f"{k} = {msgspec.json.encode(v).decode()}" for k, v in tree.items() if not isinstance(v, dict) and v is not None
    ]
    for name, values in tree.items():
        if isinstance(values, dict):
            lines += ["", f"[{path}{name}]", *_toml_lines(values, f"{path}{name}.")]
    return lines


def _read(path: Path) -> Tree:
    try:
        with path.open("rb") as f:
            return tomllib.load(f)
    except FileNotFoundError:
        raise ConfigError(f"{path}: no such configuration file") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as e:
        raise ConfigError(f"{path}: not valid TOML: {e}") from None
    except OSError as e:
        raise ConfigError(f"{path}: {e.strerror}") from None


def _value(text: str) -> Any:
    try:
        return tomllib.loads(f"v = {text}")["v"]
    except tomllib.TOMLDecodeError:
        return text


def _put(tree: Tree, keys: list[str], value: Any, where: str) -> None:
    for i, key in enumerate(keys[:-1]):
        tree = tree.setdefault(key, {})
        if not isinstance(tree, dict):
            raise ConfigError(f"{where}: {'.'.join(keys[: i + 1])} is not a section")
    tree[keys[-1]] = value
