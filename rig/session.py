"""One `forefield run`: router, services and the closed loop brought together, and a report whatever happens."""

from __future__ import annotations

import importlib.util
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from common import config
from common.bus import BusSettings, open_bus, router
from common.config import ConfigError, Tree
from common.process import ServiceSettings, reporting
from common.topics import STATUS_OF
from rig.configuration import with_keys
from rig.launcher import SERVICES, UP, Crew, LaunchError, launch
from rig.live import LiveRun, Moment
from rig.report import report
from rig.settings import RigSettings
from rig.statuses import Statuses
from rig.stopping import StopRequest
from rig.world import Scenario

NEEDS = {"riskfield": ("warp", "riskfield"), "viz": ("rerun", "viz")}
"""Module without which a service cannot start, and the extra that brings it."""

Report = dict[str, Any]


@dataclass(frozen=True)
class Options:
    """What a run is asked to do beyond its configuration."""

    duration_s: float | None = None
    attach: bool = False
    """Services and router already run elsewhere; connect to `bus.connect`."""
    loop: bool = False
    """Again and again until told to stop."""
    logs: Path | None = None


def play(
    scenario: Scenario, tree: Tree, options: Options, show: Callable[[Moment], None], done: Callable[[Report], None],
    beside: Callable[[Tree], AbstractContextManager[None]] = lambda _: nullcontext(),
) -> None:  # fmt: skip
    """Bring everything up, drive, report, and take everything down.

    Args:
        scenario: the world.
        tree: the resolved configuration.
        options: how to run.
        show: called with what there is to see while it runs.
        done: called with the report of each drive: completed, failed, or as far as it got when it is told to stop.
        beside: what runs beside it all, given the configuration with which the services are reached.

    Raises:
        ConfigError: the configuration cannot be used on this machine.
        LaunchError: a process cannot be started.
    """
    with (
        running(tree, services_for(tree), attach=options.attach, logs=options.logs) as (tree, crew),
        beside(tree),
    ):
        while True:
            up = drive_once(scenario, tree, options, crew, show, done)
            if not options.loop or (crew is not None and not up):  # our own services do not come back by themselves
                return


def services_for(tree: Tree) -> tuple[str, ...]:
    """Which services a run starts: viz only if there is something to record or to watch."""
    viz = tree["viz"]
    return (*SERVICES, "viz") if viz["record"] or viz["serve"] else SERVICES


@contextmanager
def running(
    tree: Tree, names: tuple[str, ...], *, attach: bool = False, logs: Path | None = None, listen: str = ""
) -> Iterator[tuple[Tree, Crew | None]]:
    """Router and services, and the configuration with which they are reached; nothing of our own if attached.

    Raises:
        ConfigError: a package is missing, the router cannot listen, the logs cannot be written, or `bus.tls` is set:
            one certificate cannot be everyone's.
        LaunchError: a process cannot be started.
    """
    if attach:
        yield tree, None
        return
    for name in names:
        module, extra = NEEDS.get(name, ("", ""))
        if module and importlib.util.find_spec(module) is None:
            raise ConfigError(f"{name} needs {module}: pip install 'forefield[{extra}]'")
    bus_settings = config.section(tree, "bus", BusSettings)
    if bus_settings.tls.wanted:
        raise ConfigError(
            "bus.tls is for one process that joins a secured router (python -m common.router --secure FOLDER): "
            "run with --attach, or without bus.tls"
        )
    with router(listen=listen, settings=bus_settings) as endpoint:
        reach = endpoint.replace("/0.0.0.0:", "/127.0.0.1:").replace("/[::]:", "/[::1]:")
        tree = with_keys(tree, "bus", connect=[reach], zenoh_config="")
        with launch(tree, names, logs=logs) as crew:
            yield tree, crew


def drive_once(
    scenario: Scenario,
    tree: Tree,
    options: Options,
    crew: Crew | None,
    show: Callable[[Moment], None],
    done: Callable[[Report], None],
) -> bool:
    """Drive once and report; returns whether the services stayed up."""
    rig = config.section(tree, "rig", RigSettings)
    duration = scenario.duration_s if options.duration_s is None else min(options.duration_s, scenario.duration_s)
    bus_settings = config.section(tree, "bus", BusSettings)
    service = config.section(tree, "service", ServiceSettings)
    with (
        open_bus(bus_settings, config.vehicle(tree), "rig", wait_s=rig.ready_timeout_s) as bus,
        reporting(bus.health, bus.publisher(STATUS_OF["vehicle"]), service),
    ):
        bus.liveliness("vehicle")
        statuses = Statuses(bus, SERVICES if crew is None else [c.name for c in crew.children])
        live = LiveRun(bus, scenario, rig, statuses)
        failures: list[str] = []
        try:
            if crew is None:
                _wait_for_others(statuses, rig.ready_timeout_s, tree)
                live.drive(duration, lambda: None, show)
            else:
                crew.wait_ready(statuses, rig.ready_timeout_s)
                live.drive(duration, crew.check, show)
        except LaunchError as e:
            failures.append(str(e))
        except StopRequest:
            done(report(live, tree, failures))
            raise
    up = not failures
    done(report(live, tree, failures))
    return up


def _wait_for_others(statuses: Statuses, timeout_s: float, tree: Tree) -> None:
    deadline = time.monotonic() + timeout_s
    while True:  # whatever arrives ends a wait early: turns are no measure of time
        statuses.update()
        if all(statuses.state(name) in UP for name in SERVICES):
            return
        if time.monotonic() > deadline:
            break
        statuses.bus.wait(0.1)
    words = "; ".join(f"{n}: {statuses.words(n)}" for n in SERVICES if statuses.state(n) not in UP)
    raise LaunchError(f"services not up at {', '.join(tree['bus']['connect'])} after {timeout_s:g} s ({words})")
