"""The resolved configuration of a run: every key of every section spelled out, checked before any process starts."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal, get_args

import msgspec

from common import config
from common.bus import BusSettings
from common.config import ConfigError, Settings, Tree
from common.process import ServiceSettings
from common.risk import RiskParameters
from common.topics import checked_vehicle
from rig.settings import RigSettings
from services.planner.settings import PlannerSettings
from services.predictor.settings import PredictorSettings
from services.riskfield.settings import RiskfieldSettings
from viz.settings import VizSettings

Device = Literal["auto", "cpu", "cuda"]

SETTINGS: dict[str, type[Settings]] = {
    "bus": BusSettings,
    "service": ServiceSettings,
    "risk": RiskParameters,
    "predictor": PredictorSettings,
    "riskfield": RiskfieldSettings,
    "planner": PlannerSettings,
    "viz": VizSettings,
    "rig": RigSettings,
}


def resolve(tree: Tree) -> Tree:
    """Every section as its settings type understands it, defaults included.

    Raises:
        ConfigError: names the key that cannot be used.
    """
    try:
        vehicle = checked_vehicle(config.vehicle(tree))
    except ValueError as e:
        raise ConfigError(str(e)) from None
    sections = {name: msgspec.to_builtins(config.section(tree, name, kind)) for name, kind in SETTINGS.items()}
    return {"vehicle": vehicle, **sections}


def load(path: Path | None, settings: list[str], device: str | None = None) -> Tree:
    """Read defaults, file, environment and `--set`, then `--device`; resolve.

    Raises:
        ConfigError: anything that cannot be used.
    """
    tree = config.load(path, settings)
    if device is not None:
        if device not in get_args(Device):
            raise ConfigError(f"--device {device!r}: use one of {', '.join(get_args(Device))}")
        for name, kind in SETTINGS.items():
            if "device" in (f.name for f in msgspec.structs.fields(kind)):
                tree = with_keys(tree, name, device=device)
    return resolve(tree)


def with_keys(tree: Tree, section: str, **values: Any) -> Tree:
    """The same tree with some keys of one section replaced."""
    return {**tree, section: {**tree.get(section, {}), **values}}
