"""Row 10: the wall clock jumps by an hour and steps by milliseconds.

The router and the services run with a wall clock of their own that is shifted under them (a small library preloaded
into each of them; the monotonic clock stays), the vehicle with the machine's: two hosts whose clocks are an hour apart.
"""

from __future__ import annotations

import ast
import hashlib
import json
import mmap
import os
import shutil
import struct
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np

from common import codec
from common.messages import Ego, Objects, Plan
from common.topics import PLAN
from evaluation.faults.result import FaultError, Figure, Row, Say, Scale, Verdict
from evaluation.faults.stack import Stack, stack
from evaluation.faults.watch import MISSED_MS, Heard, until
from rig.launcher import SERVICES

NUMBER = 10
TARGET = "the same plans; no false stale"
HOUR_NS = 3_600_000_000_000
STEP_NS = 1_000_000
OLD_MS = 290.0
"""A safe stop is due at 300 ms; the planner's own period lies within the rest [ms]."""
SOURCE = Path(__file__).with_name("shifted_clock.c")
ROOT = Path(__file__).parents[2]
SCENARIO, DRIVEN_S = "slow_pedestrian", 4.0
READS_A_FILES_AGE = {"common/heartbeat.py"}
"""A container's healthcheck compares the wall clock with a file's time; it decides about nothing else."""


class WallClock:
    """The wall clock of processes that are started with `within`."""

    def __init__(self, folder: Path) -> None:
        library, self._path = folder / "shifted_clock.so", folder / "shift"
        compiler = shutil.which("cc") or shutil.which("gcc") or shutil.which("clang")
        if compiler is None:
            raise FaultError("shifting a wall clock needs a C compiler (Debian: apt-get install gcc libc6-dev)")
        command = [compiler, "-O2", "-shared", "-fPIC", "-o", str(library), str(SOURCE), "-ldl"]
        made = subprocess.run(command, capture_output=True, text=True, check=False)
        if made.returncode:
            raise FaultError(f"the shifted clock does not compile: {made.stderr[-300:]}")
        self._path.write_bytes(bytes(8))
        self._file = self._path.open("r+b")
        self._shared = mmap.mmap(self._file.fileno(), 8)
        self.library = str(library)
        self.environment = {"LD_PRELOAD": self.library, "CLOCK_SHIFT": str(self._path)}

    @property
    def within(self) -> tuple[str, ...]:
        """The command before a process that gets this clock."""
        return ("env", *(f"{k}={v}" for k, v in self.environment.items()))

    def shift(self, ns: int) -> None:
        """From now on it is so far off [ns]."""
        self._shared[:8] = struct.pack("<q", ns)

    def seen_ns(self) -> int:
        """How far off a new process finds it [ns]."""
        command = [*self.within, sys.executable, "-c", "import time; print(time.time_ns())"]
        begin = time.time_ns()
        told = int(subprocess.run(command, capture_output=True, text=True, check=True).stdout)
        return told - (begin + time.time_ns()) // 2

    def runs_in(self, pid: int) -> bool:
        """Whether a process has it."""
        return self.library in Path(f"/proc/{pid}/maps").read_text()

    def close(self) -> None:
        """Done."""
        self._shared.close()
        self._file.close()


@contextmanager
def wall_clock() -> Iterator[WallClock]:
    """A wall clock to shift.

    Raises:
        FaultError: there is no C compiler, or the clock does not work.
    """
    with tempfile.TemporaryDirectory() as folder:
        clock = WallClock(Path(folder))
        try:
            for ns in (HOUR_NS, -HOUR_NS, 0):
                clock.shift(ns)
                if not abs(clock.seen_ns() - ns) < 2_000_000_000:
                    raise FaultError(f"a clock that should be {ns} ns off is {clock.seen_ns()} ns off")
            yield clock
        finally:
            clock.close()


def run(scale: Scale, seed: int, say: Say) -> Row:
    """The cores with four clocks, then the running system through three shifts."""
    verdict = Verdict()
    readers = wall_clock_readers()
    verdict.need(readers <= READS_A_FILES_AGE, f"read the wall clock: {sorted(readers - READS_A_FILES_AGE)}")
    seconds = scale.seconds(5.0, 60.0, 2.0)
    with wall_clock() as clock:
        digests = _digests(clock, say)
        verdict.need(len(set(digests.values())) == 1, f"the plans differ: {digests}")
        figures, proof = _live(clock, seconds, seed, say, verdict)
    figures = {
        "drives of the cores": len(digests), "of them with the same plans to the byte": _most(digests), **figures,
        "modules that read the wall clock": ", ".join(sorted(readers)) or "none",
    }  # fmt: skip
    fault = (
        f"wall clock +1 h, −1 h, and ±1 ms steps 50× a second under router and services, each for {seconds:g} s, the"
        " vehicle's not; the cores with each in simulated time"
    )
    return verdict.row(NUMBER, fault, TARGET, figures, proof)


def _live(
    clock: WallClock, seconds: float, seed: int, say: Say, verdict: Verdict
) -> tuple[dict[str, Figure], str]:  # fmt: skip
    with stack((), seed=seed, road=False, drive=False) as s:
        s.kill("router")  # the one of the stack has the machine's clock
        begin = time.monotonic_ns()
        for name in ("router", *SERVICES):
            s.start(name, within=clock.within)
        for name in SERVICES:
            s.wait_up(name)
        s.vehicle.put_map()
        s.vehicle.put_route()
        s.wait_drive(begin)
        s.settle()  # before anything is shifted
        in_all = [n for n in ("router", *SERVICES) if clock.runs_in(s.lives[n].pid)]
        if len(in_all) != 4:
            raise FaultError(f"only {in_all} run with the shifted clock")
        stale = _stale(s)
        gaps, stops, true, seen = [], 0, 0, []
        for name, shift in (("+1 h", HOUR_NS), ("-1 h", -HOUR_NS), ("±1 ms steps", None)):
            since = time.monotonic_ns()
            if shift is None:
                clock.shift(0)
                _stepping(clock, seconds)
            else:
                clock.shift(shift)
                seen.append(round(clock.seen_ns() * 1e-9))
                _new_road_is_heard(s)
                time.sleep(seconds)
            s.check()
            gaps.append(s.watch.gaps_ms(since))
            plans = [p for p in s.watch.heard("plan", since) if p.mode != "drive"]
            stops += len(plans)
            true += sum(_true_age_ms(s, p) > OLD_MS for p in plans)
            say(f"{name}: plan gap max {gaps[-1].max():.0f} ms, {stops} plans that do not drive so far")
        time.sleep(0.5)
        stale = _stale(s) - stale
    all_gaps = np.concatenate(gaps)
    missed = int((all_gaps > MISSED_MS).sum())
    verdict.need(stale == 0, f"{stale} messages refused as stale")
    verdict.need(stops == 0, f"{stops} plans that do not drive")
    verdict.need(missed == 0, f"{missed} plans missed")
    figures: dict[str, Figure] = {
        "plans": len(all_gaps), "plans that do not drive": stops,
        "of them resting on what was truly old, by one clock": true, "refused as stale": stale, "missed plans": missed,
        "plan gap max [ms]": float(all_gaps.max()), "latched messages heard after each jump": "all",
    }  # fmt: skip
    return figures, f"router and services run with it, a process beside them saw {seen} s"


def _true_age_ms(s: Stack, plan: Heard) -> float:
    """How old the objects were on which a plan rests, by this machine's monotonic clock alone [ms]."""
    if plan.cause is None or plan.cause.seq not in s.vehicle.objects_put_ns:
        return 0.0
    return (plan.sent_ns - s.vehicle.objects_put_ns[plan.cause.seq]) * 1e-6


def _new_road_is_heard(s: Stack) -> None:
    """Latched topics carry Zenoh's timestamps, which are wall clock: a new map must reach everyone after any jump."""
    reads = {name: [t for t in ("map", "route") if t in _inputs(s, name)] for name in SERVICES}
    before = {(n, t): _inputs(s, n)[t].received for n in SERVICES for t in reads[n]}
    s.vehicle.put_map()
    s.vehicle.put_route()
    until(
        lambda: all(_inputs(s, n)[t].received > seen for (n, t), seen in before.items()), 5.0,
        "a map and a route that were published after the clock had jumped",
    )  # fmt: skip


def _inputs(s: Stack, name: str) -> dict:  # type: ignore[type-arg]
    heard = s.watch.status(name)
    return {} if heard is None or heard.status is None else heard.status.inputs


def _stale(s: Stack) -> int:
    heard = [s.watch.status(n) for n in SERVICES]
    counters = [h.status.counters for h in heard if h is not None and h.status is not None]
    counters.append(s.bus.counters)
    return sum(n for c in counters for k, n in c.items() if k.endswith(":stale"))


def _stepping(clock: WallClock, seconds: float) -> None:
    end, shift = threading.Event(), 0
    rng = np.random.default_rng(0)
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline:
        shift += int(rng.choice([-STEP_NS, STEP_NS]))
        clock.shift(shift)
        end.wait(0.02)


# --- the cores, in simulated time ---


def _digests(clock: WallClock, say: Say) -> dict[str, str]:
    """What a drive's plans hash to with each clock."""
    found: dict[str, str] = {}
    for name, shift in (("the machine's", None), ("+1 h", HOUR_NS), ("-1 h", -HOUR_NS), ("±1 ms steps", 0)):
        environment = {**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
        environment["PYTHONPATH"] = os.pathsep.join(filter(None, (str(ROOT), environment.get("PYTHONPATH"))))
        if shift is not None:
            clock.shift(shift)
            environment |= clock.environment
        process = subprocess.Popen(
            [sys.executable, "-P", "-m", __spec__.name], stdout=subprocess.PIPE, text=True, env=environment
        )
        rng = np.random.default_rng(1)
        while name == "±1 ms steps" and process.poll() is None:
            shift = (shift or 0) + int(rng.choice([-STEP_NS, STEP_NS]))
            clock.shift(shift)
            time.sleep(0.005)
        out, _ = process.communicate()
        if process.returncode:
            raise FaultError(f"the cores with the wall clock at {name} ended with code {process.returncode}")
        said = json.loads(out.splitlines()[-1])
        found[name] = said["digest"]
        say(f"cores, wall clock {name}: {said['plans']} plans, digest {said['digest'][:12]}")
    return found


def _most(digests: dict[str, str]) -> int:
    values = list(digests.values())
    return max(values.count(v) for v in values)


def _drive() -> int:
    """Drive a scenario through the cores, and print what its plans hash to."""
    from evaluation.planning.loop import drive
    from rig.sources import load_scenario

    hashed, n = hashlib.sha256(), 0

    def watch(t: float, ego: Ego, objects: Objects, plan: Plan | None) -> None:
        nonlocal n
        if plan is not None:
            payload, _ = codec.encode_body(PLAN, plan)
            hashed.update(payload)
            n += 1

    scenario = replace(load_scenario(SCENARIO), duration_s=DRIVEN_S)
    drive(scenario, watch=watch)
    print(json.dumps({"plans": n, "digest": hashed.hexdigest()}))
    return 0


# --- the code ---

_WALL = {("time", "time"), ("time", "time_ns"), ("time", "localtime"), ("time", "gmtime"), ("time", "ctime"),
         ("time", "strftime"), ("time", "asctime"), ("datetime", "now"), ("datetime", "utcnow"), ("datetime", "today"),
         ("date", "today")}  # fmt: skip


def wall_clock_readers() -> set[str]:
    """Modules of `common` and `services` that read the wall clock, by their text."""
    found = set()
    for folder in ("common", "services"):
        for path in sorted((ROOT / folder).rglob("*.py")):
            for node in ast.walk(ast.parse(path.read_text())):
                named = isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name | ast.Attribute)
                if named and (_last(node.value), node.attr) in _WALL:  # type: ignore[attr-defined]
                    found.add(str(path.relative_to(ROOT)))
                if isinstance(node, ast.ImportFrom) and any((node.module, a.name) in _WALL for a in node.names):
                    found.add(str(path.relative_to(ROOT)))
    return found


def _last(node: ast.AST) -> str:
    return node.attr if isinstance(node, ast.Attribute) else node.id if isinstance(node, ast.Name) else ""


if __name__ == "__main__":
    raise SystemExit(_drive())
