"""The commands: run, scenarios, services, health, bench pipeline; the others stand in the files *_commands.py.

Exit codes: 0 done; 1 failed (a collision at fault, a service that died, an unhealthy system); 2 bad input;
130 and 143 stopped by Ctrl-C and SIGTERM.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from common import config
from common.bus import BusSettings, open_bus
from common.config import ConfigError, Tree
from rig import (
    certificate_commands,
    configuration,
    field_commands,
    hazard_commands,
    health_table,
    planner_commands,
    planning_commands,
    prediction_commands,
    recording_commands,
    report,
    review_commands,
    session,
)
from rig.exits import exits, say, writable, write
from rig.options import Config, Json, Sets
from rig.screen import progress
from rig.settings import RigSettings
from rig.sources import builtin_scenarios, load_scenario, recorded_scenarios
from rig.statuses import Statuses

app = typer.Typer(
    help="Predictive risk fields and safe planning for vehicles: three services over Zenoh, and a bench to drive them.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)
bench = typer.Typer(help="Benchmarks, each with a JSON result.", no_args_is_help=True)
app.add_typer(bench, name="bench")
prediction_commands.register(app, bench)
hazard_commands.register(app)
field_commands.register(bench)
review_commands.register(app)
planning_commands.register(app)
planner_commands.register(bench)
certificate_commands.register(app)
recording_commands.register(app)

Device = Annotated[
    str | None,
    typer.Option("--device", help="Where risk is computed; default: as configured (auto).", metavar="auto|cpu|cuda"),
]
Record = Annotated[Path | None, typer.Option("--record", help="Record the drive for Rerun.", metavar="OUT.rrd")]
RecordBus = Annotated[
    Path | None, typer.Option("--record-bus", help="Record every message, for `replay`.", metavar="OUT.mcap")
]
Logs = Annotated[Path | None, typer.Option("--logs", help="Keep the services' logs in this folder.", metavar="FOLDER")]
Live = Annotated[int, typer.Option("--live", help="Port on which a Rerun viewer can watch; 0: none.", metavar="PORT")]


@app.command()
def run(
    scenario: Annotated[str, typer.Option("--scenario", help="Name (see `scenarios`), .xml or .csv[.gz] file.")],
    duration: Annotated[float | None, typer.Option("--duration", help="Seconds; default: all of it.", min=0.1)] = None,
    record: Record = None,
    record_bus: RecordBus = None,
    json_: Json = None,
    device: Device = None,
    config_: Config = None,
    set_: Sets = None,
    seed: Annotated[int, typer.Option("--seed", help="Varies a built-in scenario.", min=0)] = 0,
    ego_track: Annotated[int | None, typer.Option("--ego-track", help="Track that the ego replaces (tables).")] = None,
    live: Live = 0,
    loop: Annotated[bool, typer.Option("--loop", help="Again and again until stopped.")] = False,
    attach: Annotated[bool, typer.Option("--attach", help="Drive services that already run at bus.connect.")] = False,
    logs: Logs = None,
) -> None:
    """Drive one scenario in closed loop and in real time."""
    console = Console()
    with exits():
        tree = _with_viz(configuration.load(config_, set_ or [], device), record, live, attach)
        writable("--json", json_)
        beside = _bus_recorder(record_bus)
        world = load_scenario(
            scenario, seed=seed, ego_track=ego_track, settings=config.section(tree, "rig", RigSettings)
        )
        tree = configuration.with_keys(tree, "viz", scenario=f"{world.name}: {world.title}")
        for warning in world.warnings:
            say(f"[yellow]warning[/] {escape(warning)}")
        options = session.Options(duration, attach, loop, logs)
        last: session.Report = {}
        failed = False

        def done(result: session.Report) -> None:
            nonlocal last, failed
            last, failed = result, failed or result["outcome"] == "failed"
            if json_ is not None:
                write(json_, result)

        try:
            with progress(console, world.name) as show:
                session.play(world, tree, options, show, done, beside)
        finally:
            if last:
                _conclude(console, last)
        if failed:
            raise typer.Exit(1)


@app.command()
def scenarios() -> None:
    """List the scenarios that `run --scenario` knows by name."""
    console = Console()
    out = Table(title="Built-in scenarios")
    out.add_column("name", style="bold", no_wrap=True)
    out.add_column("what happens")
    for name, text in builtin_scenarios().items():
        out.add_row(name, escape(text))
    console.print(out)
    recorded = recorded_scenarios()
    if recorded:
        console.print(f"\nRecorded scenarios ($FOREFIELD_DATA, {len(recorded)} files):")
        for name in recorded:
            console.print(f"  {name}", markup=False, highlight=False)
    else:
        console.print("\nRecorded scenarios: set FOREFIELD_DATA to the folder above commonroad/, or give a file.")


@app.command()
def services(
    config_: Config = None,
    set_: Sets = None,
    device: Device = None,
    listen: Annotated[
        str, typer.Option("--listen", help="Where the router listens; 0.0.0.0 opens it to the network.")
    ] = "tcp/127.0.0.1:7447",
    record: Record = None,
    live: Live = 0,
    logs: Logs = None,
) -> None:
    """Bring up router and services for a real vehicle, until Ctrl-C."""
    with exits(asked=True):
        tree = _with_viz(configuration.load(config_, set_ or [], device), record, live, attach=False)
        with session.running(tree, session.services_for(tree), logs=logs, listen=listen) as (tree, crew):
            assert crew is not None
            vehicle = config.vehicle(tree)
            with open_bus(config.section(tree, "bus", BusSettings), vehicle, "launcher") as bus:
                statuses = Statuses(bus, [c.name for c in crew.children])
                crew.wait_ready(statuses, config.section(tree, "rig", RigSettings).ready_timeout_s)
                say(
                    f"up at {escape(listen)}: put ego, objects, map and route to forefield/{vehicle}/…, "
                    f"read forefield/{vehicle}/plan. `forefield health` shows how they are; Ctrl-C ends them."
                )
                while True:
                    crew.check()
                    threading.Event().wait(0.2)


@app.command()
def health(
    config_: Config = None,
    set_: Sets = None,
    connect: Annotated[str, typer.Option("--connect", help="The router; default: bus.connect.")] = "",
) -> None:
    """Show how a running system is; exit code 0: all three services are ready."""
    with exits():
        tree = configuration.load(config_, set_ or [])
        if connect:
            tree = configuration.with_keys(tree, "bus", connect=[connect])
        with open_bus(config.section(tree, "bus", BusSettings), config.vehicle(tree), "health", wait_s=3.0) as bus:
            statuses = health_table.ask(bus)
            Console().print(health_table.table(statuses, bus.alive()))
            good = health_table.healthy(statuses)
            if not statuses.latest():
                where = ", ".join(tree["bus"]["connect"])
                say(
                    f"nobody answers at {escape(where)} for vehicle {config.vehicle(tree)}: --connect, --set vehicle=…?"
                )
        if not good:
            raise typer.Exit(1)


@bench.command()
def pipeline(
    json_: Json = None,
    objects: Annotated[int, typer.Option("--objects", help="Road users in the scene.", min=0, max=1024)] = 32,
    frames: Annotated[int, typer.Option("--frames", help="Frames to measure.", min=20)] = 300,
    device: Device = None,
    config_: Config = None,
    set_: Sets = None,
) -> None:
    """Measure the three processes at full speed, beside the same cores one after another in one process."""
    from evaluation import bench_pipeline

    with exits():
        tree = configuration.load(config_, set_ or [], device)
        writable("--json", json_)
        result = bench_pipeline.measure(tree, objects=objects, frames=frames)
        if json_ is not None:
            write(json_, result)
        Console().print(bench_pipeline.table(result))


def _with_viz(tree: Tree, record: Path | None, live: int, attach: bool) -> Tree:
    if record is not None:
        if attach:
            raise ConfigError("--record goes with services of our own; attached, record with `python -m viz --record`")
        if record.suffix != ".rrd":
            raise ConfigError(f"--record {record}: the name of a Rerun recording ends in .rrd")
        writable("--record", record)
        tree = configuration.with_keys(tree, "viz", record=str(record.absolute()))
    return configuration.with_keys(tree, "viz", serve=live) if live else tree


def _bus_recorder(path: Path | None) -> Callable[[Tree], AbstractContextManager[None]]:
    if path is None:
        return lambda _: nullcontext()
    from rig.bus_log.drive import recorder

    if path.suffix != ".mcap":
        raise ConfigError(f"--record-bus {path}: the name of a recorded bus ends in .mcap")
    writable("--record-bus", path)
    return lambda tree: recorder(tree, path)


def _conclude(console: Console, result: dict[str, Any]) -> None:
    if result["duration_s"] > 0.0:  # otherwise it never came to a drive
        console.print(report.table(result))
    for failure in result["failures"]:
        say(f"[red]failed[/] {escape(failure)}")
    recording = result["recording"]
    if recording and Path(recording).is_file():
        console.print(f"open the recording:  forefield view {recording}", soft_wrap=True, highlight=False, markup=False)
