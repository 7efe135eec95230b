"""The commands of recordings: view, repair, record, replay.

What they need beyond the bench (rerun-sdk, mcap) is imported only by the command that needs it.
"""

from __future__ import annotations

import os
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console
from rich.markup import escape
from rich.progress import Progress
from rich.table import Table

from common import config
from common.bus import BusSettings, open_bus
from common.config import ConfigError, Tree
from common.topics import MIB, TOPICS, Topic
from rig import configuration, viewing
from rig.exits import exits, say, writable
from rig.launcher import LaunchError
from rig.options import Config, Sets

if TYPE_CHECKING:
    from rig.bus_log.reader import BusLog

Connect = Annotated[
    str, typer.Option("--connect", help="The router, such as tcp/127.0.0.1:7447; default: bus.connect.")
]
Only = Annotated[
    str, typer.Option("--only", help="Topics, such as ego,objects,map,route,closures; default: all.", metavar="TOPICS")
]


def register(app: typer.Typer) -> None:
    """Add the commands to the program."""
    app.command()(view)
    app.command()(repair)
    app.command()(record)
    app.command()(replay)


def view(
    files: Annotated[list[Path] | None, typer.Argument(help="Recordings (.rrd); pieces of one drive together.")] = None,
    live: Annotated[bool, typer.Option("--live", help="Show what a running viz serves (run --live PORT).")] = False,
    connect: Annotated[str, typer.Option("--connect", help="Where it serves.", metavar="HOST:PORT")] = viewing.LIVE,
    web: Annotated[bool, typer.Option("--web", help="In a browser: serve the web viewer, print its address.")] = False,
    port: Annotated[int, typer.Option("--port", help="For --web; 0: a free one.", min=0, max=65535)] = 0,
) -> None:
    """Open recordings, or a running system, in the Rerun viewer."""
    with exits():
        found = viewing.viewing(files or (), live=live, connect=connect, web=web, port=port)
        if found.url:
            say("open this in a browser on this machine; Ctrl-C ends it:")
            print(found.url)
        sys.stdout.flush()
        sys.stderr.flush()
        os.execv(found.command[0], found.command)


def repair(
    file: Annotated[Path, typer.Argument(help="A recording that was cut off by a crash (.rrd or .mcap).")],
    out: Annotated[
        Path | None, typer.Option("--out", help="Write there; default: replace FILE.", metavar="OUT")
    ] = None,
) -> None:
    """Mend a recording whose writer was killed: cut off what is torn, write the index."""
    with exits():
        if not file.is_file():
            raise ConfigError(f"{file}: no such recording")
        target = out or file
        writable("--out", target)
        if file.suffix == ".mcap":
            _mend_bus(file, target)
            return
        from viz.repair import RepairError
        from viz.repair import repair as mend

        try:
            done = mend(file, target)
        except RepairError as e:
            raise ConfigError(str(e)) from None
        if done.was_whole:
            say(f"{escape(str(file))} is whole: nothing to mend")
        else:
            say(f"{done.rows} rows kept, {done.lost_bytes} bytes at the end were torn")
        Console().print(str(target), soft_wrap=True, highlight=False, markup=False)


def record(
    out: Annotated[Path, typer.Argument(help="The file to write (.mcap).")],
    connect: Connect = "",
    only: Only = "",
    duration: Annotated[float | None, typer.Option("--duration", help="Seconds; default: until Ctrl-C.")] = None,
    config_: Config = None,
    set_: Sets = None,
) -> None:
    """Record the raw messages of a running bus, headers and all; give the services' own --config along for --check."""
    with exits(asked=True):
        from rig.bus_log.recorder import Recorder

        if out.suffix != ".mcap":
            raise ConfigError(f"{out}: the name of a recorded bus ends in .mcap")
        writable("OUT", out)
        tree = _reaching(configuration.load(config_, set_ or []), connect)
        topics = _topics(only)
        console = Console(stderr=True)
        with open_bus(config.section(tree, "bus", BusSettings), config.vehicle(tree), "recorder", wait_s=10.0) as bus:
            recorder = Recorder(bus, topics, out, tree)
            try:
                print(f"recording {len(topics)} topics of vehicle {bus.vehicle} into {out}", flush=True)
                end = None if duration is None else time.monotonic() + duration
                with console.status("") as shown:
                    while end is None or time.monotonic() < end:
                        time.sleep(0.25)
                        shown.update(_so_far(recorder.written.total(), recorder.size, recorder.trouble))
            finally:
                recorder.close()
                lost = ", ".join(f"{name} {n}" for name, n in recorder.dropped.items())
                say(
                    f"{recorder.written.total()} messages, {recorder.size / MIB:.1f} MiB in {escape(str(out))}"
                    + (f"; [yellow]not recorded:[/] {lost}" if lost else "")
                    + (f"; [red]{escape(recorder.trouble)}[/]" if recorder.trouble else "")
                )


def replay(
    file: Annotated[Path, typer.Argument(help="A recorded bus (.mcap).")],
    only: Only = "",
    rate: Annotated[float, typer.Option("--rate", help="2 is twice as fast.", min=0.01, max=100.0)] = 1.0,
    start: Annotated[float, typer.Option("--from", help="Seconds after its beginning.", min=0.0)] = 0.0,
    end: Annotated[float | None, typer.Option("--to", help="Seconds after its beginning.", min=0.0)] = None,
    connect: Connect = "",
    force: Annotated[
        bool, typer.Option("--force", help="Replay topics too whose writer runs on this bus: it is shut out by that.")
    ] = False,
    check: Annotated[
        bool, typer.Option("--check", help="No bus: repeat every step of the services and compare the results.")
    ] = False,
    config_: Config = None,
    set_: Sets = None,
) -> None:
    """Put a recorded bus back on a bus, or check that the services do again what they did.

    Topics whose writer runs on that bus (a running planner's plan and status, and so on) are refused without --force,
    and the replay stops when somebody begins to write one of them.
    To who hears them the replay is that service started anew, and the service an old one until it is started again.
    """
    with exits(asked=True):
        from rig.bus_log.reader import BusLog, BusLogError

        try:
            log = BusLog.open(file)
        except BusLogError as e:
            raise ConfigError(str(e)) from None
        if log.is_torn:
            say(f"[yellow]{escape(str(file))} is torn[/]: its end is missing; `forefield repair` writes an index")
        for name, n in log.dropped.items():
            say(f"[yellow]{n} messages of {escape(name)} were not recorded[/]: the disk or the machine was too slow")
        if check:
            good = _check(log, configuration.load(config_, set_ or []) if config_ or set_ else None)
        else:
            tree = _reaching(configuration.load(config_, set_ or []), connect)
            good = _play(log, tree, _topics(only), rate, start, end, force)
        for name, why in log.unknown.items():
            say(f"[yellow]{escape(name)} was left out[/]: {escape(why)}")
        for name, n in log.refused.items():
            say(f"[yellow]{n} × {escape(name)}[/]: not what it should be, left out")
        if not good:
            raise typer.Exit(1)


def _mend_bus(file: Path, target: Path) -> None:
    from rig.bus_log.mend import mend
    from rig.bus_log.reader import BusLogError

    try:
        kept = mend(file, target)
    except (BusLogError, OSError) as e:
        raise ConfigError(str(e)) from None
    say(f"{escape(str(file))} is whole: nothing to mend" if kept is None else f"{kept} messages kept")
    Console().print(str(target), soft_wrap=True, highlight=False, markup=False)


def _play(
    log: BusLog, tree: Tree, topics: tuple[Topic, ...], rate: float, start: float, end: float | None, force: bool
) -> bool:
    from rig.bus_log.player import LISTEN_S, Player, TakenError

    first, last = log.span_ns()
    length = (last - first) * 1e-9
    stop = length if end is None else min(end, length)
    if start >= stop:
        raise ConfigError(f"--from {start:g}: the recording is {length:.1f} s long, and nothing lies before {stop:g} s")
    with open_bus(config.section(tree, "bus", BusSettings), config.vehicle(tree), "replay", wait_s=10.0) as bus:
        player = Player(log, bus, topics, yields=not force)
        if not force:
            time.sleep(LISTEN_S)
            _leave_to_the_living(log, topics, bus.alive(), player.others)
        with Progress(console=Console(stderr=True)) as bar:
            task = bar.add_task(f"replaying {stop - start:.1f} s", total=stop - start)
            try:
                player.play(
                    first + round(start * 1e9), first + round(stop * 1e9), rate, lambda s: bar.update(task, completed=s)
                )
            except TakenError as e:
                raise LaunchError(f"{e}; --force goes on regardless") from None
        say(", ".join(f"{name} {n}" for name, n in player.sent.items()) or "nothing of these topics is recorded there")
        log.refused.update(player.refused)
        return bool(player.sent)


def _leave_to_the_living(log: BusLog, topics: tuple[Topic, ...], alive: set[str], heard: dict[Topic, str]) -> None:
    from rig.bus_log.player import taken

    held = log.holds()
    asked = [topic for topic in topics if topic.suffix in held]
    theirs = [topic for topic in asked if topic in heard or topic in taken(asked, alive)]
    if theirs:
        rest = ",".join(topic.suffix for topic in asked if topic not in theirs)
        who = ", ".join(sorted({heard.get(t, t.writer) for t in theirs}))
        raise ConfigError(
            f"{', '.join(t.suffix for t in theirs)}: written by what runs on this bus "
            f"({who}), which a replay would shut out until it starts again; "
            + (f"replay the rest (--only {rest}), " if rest else "")
            + "stop it, or say --force"
        )


def _check(log: BusLog, given: Tree | None) -> bool:
    from rig.bus_log.check import check as repeat
    from rig.bus_log.machine import machine

    tree = given or configuration.resolve(log.configuration)
    differs = {k: (v, machine().get(k)) for k, v in log.machine.items() if machine().get(k) != v}
    first, last = log.span_ns()
    with Progress(console=Console(stderr=True)) as bar:
        task = bar.add_task("repeating", total=max(last - first, 1))
        results = repeat(log, tree, same_machine=not differs, show=lambda ns: bar.update(task, completed=ns - first))
    table = Table(title=f"{log.path.name}: " + ("the machine that recorded" if not differs else "another machine"))
    for name in ("service", "compared", "different", "not compared"):
        table.add_column(name)
    for r in results:
        why = f"{r.skipped}: {r.why_skipped}" if r.skipped else ""
        table.add_row(r.service, str(r.compared), str(r.different), escape(why))
    console = Console()
    console.print(table)
    for name, (then, now) in differs.items():
        console.print(f"{name}: recorded on {then}, here {now}", markup=False, highlight=False)
    for r in results:
        if r.first is not None:
            seq, d = r.first
            console.print(
                f"first difference: {r.service} message {seq}, {d.field}: recorded {d.recorded}, repeated {d.repeated}",
                markup=False, highlight=False, soft_wrap=True,
            )  # fmt: skip
        elif not r.compared:
            console.print(f"{r.service}: nothing could be compared", markup=False)
    return all(r.is_good for r in results)


def _topics(only: str) -> tuple[Topic, ...]:
    from rig.bus_log.envelope import topics_named

    try:
        return topics_named(only) or tuple(TOPICS.values())
    except ValueError as e:
        raise ConfigError(f"--only: {e}") from None


def _reaching(tree: Tree, connect: str) -> Tree:
    return configuration.with_keys(tree, "bus", connect=[connect]) if connect else tree


def _so_far(messages: int, size: int, trouble: str) -> str:
    return trouble or f"{messages} messages, {size / MIB:.1f} MiB · Ctrl-C ends the recording"
