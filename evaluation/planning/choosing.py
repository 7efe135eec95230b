"""Which scenarios are driven: names, files, folders, or random variants of the named ones."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from common.config import ConfigError
from evaluation.planning.prolonged import prolonged
from evaluation.planning.traffic import Kind
from rig.settings import RigSettings
from rig.sources import ScenarioError, builtin_scenarios, load_scenario, tables
from rig.sources.generated import REPLAYED
from rig.world import Scenario

ENDINGS = (".xml", ".csv", ".csv.gz")


@dataclass(frozen=True)
class Choice:
    """One scenario to drive: how it is found, and as what it counts."""

    name: str
    source: str
    seed: int = 0
    family: str = ""
    """The named manoeuvre; empty: a recording."""


@dataclass(frozen=True)
class Loaded:
    """A world, and how its others move."""

    choice: Choice
    scenario: Scenario
    traffic: Kind
    recorded_s: float = math.inf
    """From then on the others' motion is made up (`prolonged`) [s]."""

    def with_traffic(self, kind: Kind | None) -> Loaded:
        """The others as asked for, otherwise reactive unless they must not be; recordings with a grace time then.

        A replay is the record and nothing else: it ends with it.
        """
        default: Kind = "replay" if self.choice.family in REPLAYED else "reactive"
        kind = kind or default
        if kind == "replay" or self.choice.family:
            return replace(self, traffic=kind)
        return replace(self, traffic=kind, scenario=prolonged(self.scenario), recorded_s=self.scenario.duration_s)


def choices(sources: Sequence[str], variants: int, seed: int) -> list[Choice]:
    """What is asked for; without anything, every built-in scenario.

    Raises:
        ConfigError: a folder without scenarios, or a name twice.
    """
    named = list(builtin_scenarios())
    if variants:
        rng = np.random.default_rng([seed, 7])
        order = [named[i % len(named)] for i in range(variants)]
        seeds = rng.choice(2**31 - 1, size=variants, replace=False) + 1
        return [Choice(f"{n}#{s}", n, int(s), n) for n, s in zip(order, seeds, strict=True)]
    found = []
    for source in sources or named:
        if source in named:
            found.append(Choice(source, source, seed, source))
        elif "#" in source and source.split("#")[0] in named and source.split("#")[1].isdigit():
            name, _, number = source.partition("#")
            found.append(Choice(source, name, int(number), name))
        elif Path(source).is_dir():
            files = sorted(p for p in Path(source).iterdir() if p.name.endswith(ENDINGS))
            if not files:
                raise ConfigError(f"--scenarios {source}: no .xml, .csv or .csv.gz in this folder")
            found += [Choice(_stem(p), str(p)) for p in files]
        else:
            found.append(Choice(_stem(Path(source)), source))
    names = [c.name for c in found]
    twice = sorted({n for n in names if names.count(n) > 1})
    if twice:
        raise ConfigError(f"--scenarios: {', '.join(twice)} stands there twice")
    return found


def _stem(path: Path) -> str:
    file, _, selection = path.name.partition("#")
    for ending in ENDINGS:
        file = file.removesuffix(ending)
    return f"{file}#{selection}" if selection else file


def loaded(
    found: Sequence[Choice], kind: Kind | None, settings: RigSettings, failed: Callable[[str, str], None]
) -> list[Loaded]:
    """Load them all; one that cannot be loaded is told to `failed` and left out."""
    worlds = []
    for c in found:
        try:
            scenario = load_scenario(c.source, seed=c.seed, settings=settings)
        except ScenarioError as e:
            failed(c.name, str(e))
            continue
        except Exception as e:  # a reader's own surprise must not stop the others
            failed(c.name, f"{type(e).__name__}: {e}")
            continue
        worlds.append(Loaded(c, scenario, "replay").with_traffic(kind))
    return worlds


def replaced_vehicles(
    files: Sequence[str], count: int, seed: int, settings: RigSettings, failed: Callable[[str, str], None]
) -> list[Loaded]:
    """Of each trajectory table `count` recorded vehicles, drawn by `seed`, each replaced by the ego once."""
    worlds = []
    for file in files:
        path = Path(file)
        try:
            if not path.is_file():
                raise ScenarioError("no such file", path=path)
            rows = tables.read(path)
            fit = tables.drivable(rows)
            if not fit:
                raise ScenarioError("no car, truck or bus drives far enough to be replaced", path=path)
        except ScenarioError as e:
            failed(_stem(path), str(e))
            continue
        drawn = np.random.default_rng([seed, 11]).permutation(len(fit))[:count]
        for i in sorted(int(k) for k in drawn):
            ego = fit[i]
            name = f"{_stem(path)}#{ego.rec}:{ego.name}"
            try:
                scenario = tables.replacing(path, rows, ego, settings)
            except ScenarioError as e:
                failed(name, str(e))
                continue
            worlds.append(Loaded(Choice(name, name), scenario, "replay"))
    return worlds
