"""Where worlds come from: built-in scenarios, CommonRoad files, trajectory tables."""

from __future__ import annotations

import difflib
import os
from pathlib import Path

from rig.settings import RigSettings
from rig.sources import generated
from rig.world import Scenario, ScenarioError

__all__ = ["Scenario", "ScenarioError", "builtin_scenarios", "load_scenario", "recorded_scenarios"]


def builtin_scenarios() -> dict[str, str]:
    """Name and one-line description of every built-in scenario."""
    return {name: (make.__doc__ or "").strip().splitlines()[0] for name, make in generated.SCENARIOS.items()}


def recorded_scenarios() -> dict[str, Path]:
    """CommonRoad files below `$FOREFIELD_DATA/commonroad`, by name; empty where the variable is not set."""
    data = os.environ.get("FOREFIELD_DATA")
    folder = Path(data) / "commonroad" if data else None
    return {p.stem: p for p in sorted(folder.glob("*.xml"))} if folder is not None and folder.is_dir() else {}


def load_scenario(
    name_or_path: str, *, seed: int = 0, ego_track: int | None = None, settings: RigSettings | None = None
) -> Scenario:
    """Find a scenario: a built-in name, a CommonRoad file or its name, or a table `FILE.csv[.gz][#REC[:TRACK]]`.

    `seed` varies a built-in scenario. `ego_track` chooses the recorded vehicle that the ego replaces (tables).

    Raises:
        ScenarioError: there is no such scenario, or it cannot be read; the text says where, why and what to do.
    """
    settings = RigSettings() if settings is None else settings
    if name_or_path in generated.SCENARIOS:
        return generated.generate(name_or_path, seed)
    file, _, selection = name_or_path.partition("#")
    path = Path(file)
    if path.name.endswith((".csv", ".csv.gz")):
        from rig.sources.tables import load as load_table

        return load_table(_existing(path), selection, ego_track, settings)
    if path.suffix != ".xml":
        path = recorded_scenarios().get(name_or_path, path)
    if path.suffix == ".xml":
        from rig.sources.commonroad import load as load_commonroad

        return load_commonroad(_existing(path), settings)
    raise ScenarioError(f"no scenario {name_or_path!r}", hint=_suggestion(name_or_path))


def _existing(path: Path) -> Path:
    if path.is_file():
        return path
    raise ScenarioError("no such file", path=path, hint=_suggestion(path.stem))


def _suggestion(name: str) -> str:
    recorded = list(recorded_scenarios())
    close = difflib.get_close_matches(name, [*generated.SCENARIOS, *recorded], n=3, cutoff=0.4)
    guess = f"Did you mean {' or '.join(close)}? " if close else ""
    where = (
        f"{len(recorded)} recorded ones in FOREFIELD_DATA"
        if recorded
        else "set FOREFIELD_DATA to the folder above commonroad/ to use recorded ones by name"
    )
    return f"{guess}Built-in: {', '.join(generated.SCENARIOS)}; {where}; or give a CommonRoad .xml or a table .csv[.gz]"
