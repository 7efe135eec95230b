"""Who plans: the three cores under a planner's name, or somebody who drives alone from what is perceived.

Names: `default` and `paper` are the planner's own two searches; `current-only` is the default on a field that is held
as it is at t = 0, the ablation of the paper's thesis; `idm` follows the route by Treiber's car-following model.
Other people's planners: `commonroad-reactive` and `frenetix` run on a Python of their own (`peers/`), and a package
that registers a factory of an `Alone` as an entry point of the group `forefield.planners` joins under its own name.
None of them is a dependency of ours.
"""

from __future__ import annotations

from dataclasses import dataclass
from importlib import metadata
from typing import Protocol

import msgspec
import numpy as np

from common import config
from common.config import ConfigError
from common.messages import Closures, Ego, Map, Objects, Plan, Prediction, Risk, Route, Stamped
from common.risk import RiskParameters
from services.planner.core import Planner
from services.planner.settings import PlannerSettings
from services.predictor.core import Predictor
from services.predictor.learned import load_learned
from services.predictor.settings import PredictorSettings
from services.riskfield.core import RiskField
from services.riskfield.settings import RiskfieldSettings

OURS = ("default", "paper", "current-only")
ALONE = ("idm",)
PEERS = ("commonroad-reactive", "frenetix")
"""On their own Python."""
GROUP = "forefield.planners"
"""Entry points by which other planners join."""


class Field(Protocol):
    """What makes a risk volume of a prediction."""

    def step(
        self,
        prediction: Stamped[Prediction],
        ego: Stamped[Ego],
        map: Map | None,
        closures: Closures,
        t_offset: float,
    ) -> Risk:
        """One volume."""
        ...


class Alone(Protocol):
    """A planner that needs no risk: it sees the road users themselves.

    One that waits for others may say in an attribute `took_ms` how long its last plan took itself (NaN: it did not plan
    anew), and count in `failures` what went wrong in single cycles.
    """

    def plan(
        self, ego: Stamped[Ego], objects: Stamped[Objects], map: Map | None, route: Route, closures: Closures
    ) -> Plan:
        """A plan whose times count from the ego's capture."""
        ...


@dataclass(frozen=True)
class Cores:
    """The three services' cores, fresh for one run."""

    predictor: Predictor
    riskfield: Field
    planner: Planner

    @staticmethod
    def of(tree: config.Tree, *, hold_field: bool = False) -> Cores:
        """Build and warm up the cores from a configuration tree; `hold_field`: the field of t = 0 in every slice."""
        risk = config.section(tree, "risk", RiskParameters)
        field_settings = config.section(tree, "riskfield", RiskfieldSettings)
        riskfield = RiskField(field_settings, risk, field_settings.device)
        riskfield.warm_up()
        settings = config.section(tree, "predictor", PredictorSettings)
        predictor = Predictor(settings, risk, load_learned(settings, risk)[0])
        planner = Planner(config.section(tree, "planner", PlannerSettings))
        planner.warm_up()
        return Cores(predictor, HeldField(riskfield) if hold_field else riskfield, planner)


@dataclass(frozen=True)
class HeldField:
    """The ablation: what the field is at t = 0 holds in every slice, as if nobody moved on."""

    inner: Field

    def step(
        self,
        prediction: Stamped[Prediction],
        ego: Stamped[Ego],
        map: Map | None,
        closures: Closures,
        t_offset: float,
    ) -> Risk:
        """The volume with its first slice repeated."""
        risk = self.inner.step(prediction, ego, map, closures, t_offset)
        first = np.zeros(len(risk.slice_times), dtype=np.intp)
        return msgspec.structs.replace(
            risk,
            volume=np.ascontiguousarray(risk.volume[first]),
            dominant=np.ascontiguousarray(risk.dominant[first]),
        )


def known() -> tuple[str, ...]:
    """Every planner's name that can be used here."""
    return (*OURS, *ALONE, *PEERS, *_joined())


def _joined() -> dict[str, metadata.EntryPoint]:
    return {p.name: p for p in metadata.entry_points(group=GROUP) if p.name not in (*OURS, *ALONE, *PEERS)}


def check(name: str) -> None:
    """Whether a planner can be used here, before hours are spent.

    Raises:
        ConfigError: it cannot, and what to do.
    """
    from evaluation.planning.peers import driver

    if name not in known():
        raise ConfigError(f"--planner {name!r}: there are {', '.join(known())}")
    if name in PEERS:
        driver.check(name)


def driver(name: str, tree: config.Tree) -> Cores | Alone:
    """Fresh for one drive.

    Raises:
        ConfigError: nobody of this name.
    """
    from evaluation.planning.idm_driver import IdmDriver
    from evaluation.planning.peers.driver import peer

    if name in OURS:
        own = "paper" if name == "paper" else "default"
        tree = {**tree, "planner": {**tree.get("planner", {}), "name": own}}
        return Cores.of(tree, hold_field=name == "current-only")
    if name == "idm":
        return IdmDriver()
    if name in PEERS:
        return peer(name, tree)
    joined = _joined()
    if name in joined:
        made: Alone = joined[name].load()()
        return made
    raise ConfigError(f"--planner {name!r}: there are {', '.join(known())}")
