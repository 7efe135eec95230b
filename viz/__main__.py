"""viz as a process: everything on the bus, drawn into a recording. Nothing waits for it.

`python -m viz [--record OUT.rrd] [--serve PORT] [--scenario NAME]`
"""

from __future__ import annotations

import argparse
import logging
import sys
import threading
from collections.abc import Callable
from typing import Any

from common import config, logs, topics
from common.bus import Bus, BusSettings, Inbox, NoRouterError, open_bus
from common.clock import monotonic
from common.config import ConfigError, Tree
from common.health import Health
from common.messages import Stamped
from common.process import Ending, ServiceSettings, reporting
from viz.blueprint import blueprint
from viz.scene import Scene
from viz.settings import VizSettings
from viz.sinks import Recorder, SinkError, recording

log = logging.getLogger("forefield")

END_S = 12.0
"""After SIGTERM viz is gone this much later at the latest [s]: a long recording has a long footer to write."""
TURN_S = 0.25
"""Longest wait before a look at who has fallen silent [s]."""
EVERY = 100
"""What was driven and why is kept whole: so many of `ego` and `plan` may wait while a volume is drawn."""


def main(arguments: list[str] | None = None) -> int:
    """Record and serve what the services see and decide, until SIGTERM or Ctrl-C."""
    parser = argparse.ArgumentParser(prog="python -m viz", description=main.__doc__)
    parser.add_argument("--record", metavar="OUT.rrd", help="file or folder to write (setting viz.record)")
    parser.add_argument("--serve", type=int, metavar="PORT", help="port for a live viewer (setting viz.serve)")
    parser.add_argument("--scenario", metavar="NAME", help="name stored in the recording (setting viz.scenario)")
    options = parser.parse_args(arguments)
    try:
        tree = config.load()
        service = config.section(tree, "service", ServiceSettings)
        given = {k: v for k in ("record", "serve", "scenario") if (v := getattr(options, k)) is not None}
        tree = {**tree, "viz": {**tree.get("viz", {}), **given}}
        settings = config.section(_with_comfort(tree), "viz", VizSettings)
        logs.begin("viz", service.log_level, service.log_format)
        return run(tree, service, settings)
    except NoRouterError as e:
        log.info("stopped: %s", e)
        return 0
    except (ConfigError, SinkError) as e:
        print(f"viz: {e}", file=sys.stderr)
        return 2


def _with_comfort(tree: Tree) -> Tree:
    """Where the planner's settings are known and viz' own say nothing else, its comfort is what is drawn."""
    planner = tree.get("planner", {})
    tiers = planner.get("tier_brake") or [None]
    known = {"comfort_accel": planner.get("accel"), "comfort_brake": tiers[0], "comfort_jerk": planner.get("jerk")}
    default = VizSettings()
    viz = dict(tree.get("viz", {}))
    for name, value in known.items():
        if value is not None and viz.get(name, getattr(default, name)) == getattr(default, name):
            viz[name] = value
    return {**tree, "viz": viz}


def run(tree: Tree, service: ServiceSettings, settings: VizSettings) -> int:
    """Open the bus and the recording, draw until told to stop."""
    ending = Ending(END_S)
    health = Health("viz", monotonic)
    bus_settings = config.section(tree, "bus", BusSettings)
    with open_bus(bus_settings, config.vehicle(tree), "viz", health=health, stop=ending.stop) as bus:
        ending.wakes(bus)
        logs.about(vehicle=bus.vehicle, boot=bus.boot)
        bus.liveliness("viz")
        with (
            reporting(health, bus.publisher(topics.STATUS_OF["viz"]), service),
            recording(settings, settings.scenario, blueprint(), tree) as recorder,
        ):
            _draw(bus, health, Scene(recorder, settings), ending.stop, recorder)
    return 0


def _draw(bus: Bus, health: Health, scene: Scene, stop: threading.Event, recorder: Recorder | None = None) -> None:
    # in the order in which one message needs another: objects begin a frame, a plan looks for its volume
    order: list[tuple[Inbox, Callable[[Stamped[Any]], None]]] = [
        (bus.inbox(topics.MAP), scene.map),
        (bus.inbox(topics.ROUTE), scene.route),
        (bus.inbox(topics.CLOSURES), scene.closures),
        (bus.inbox(topics.EGO, keep=EVERY), scene.ego),
        (bus.inbox(topics.OBJECTS), scene.objects),
        (bus.inbox(topics.PREDICTION), scene.prediction),
        (bus.inbox(topics.RISK), scene.risk),
        (bus.inbox(topics.PLAN, keep=EVERY), scene.plan),
        *((bus.inbox(topic), scene.status) for name, topic in topics.STATUS_OF.items() if name != "viz"),
    ]
    health.say("ready", "drawing")
    while not stop.is_set():
        bus.wait(TURN_S)
        health.turned()
        for inbox, draw in order:
            for _ in range(inbox.waiting):
                stamped = inbox.take()
                if stamped is None:
                    continue
                try:
                    draw(stamped)
                except Exception as e:
                    health.count(f"{inbox.topic.suffix}:draw_{type(e).__name__}")
                    health.detail["last_error"] = f"{inbox.topic.suffix}: {type(e).__name__}: {e}"
                    log.exception("%s not drawn", inbox.topic.suffix)
        scene.silence(monotonic())
        if recorder is not None:
            recorder.tend()
            _tell(health, recorder)


def _tell(health: Health, recorder: Recorder) -> None:
    trouble = recorder.trouble
    if health.say("degraded" if trouble else "ready", trouble or "drawing") and trouble:
        log.warning("%s", trouble)
    for name, dropped in recorder.dropped.items():
        new = dropped - health.counters[f"{name}:rows_dropped"]
        if new:
            health.count(f"{name}:rows_dropped", new)
    health.detail.update(recorder.detail)


if __name__ == "__main__":
    raise SystemExit(main())
