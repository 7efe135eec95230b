"""The system under fault: a router and the services as real processes on loopback, the vehicle and a listener here."""

from __future__ import annotations

import gc
import signal
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

from common.bus import Bus, BusSettings, free_port, open_bus
from common.config import Tree, as_toml
from common.topics import Topic
from evaluation.faults.result import FaultError
from evaluation.faults.vehicle import Vehicle
from evaluation.faults.watch import Heard, Watch, until
from rig.configuration import resolve
from rig.launcher import MODULES, SERVICES, Child, start

VEHICLE = "faults"
UP_S = 90.0
"""Until a service must be up [s]: its kernels may have to be compiled first."""
DRIVE_S = 60.0
"""Until the first plan that drives [s]."""
STATUS_HZ = 10.0
"""Five times the default, so that when a service is ready is known to a tenth of a second."""


@dataclass(frozen=True)
class Life:
    """One life of a process, from its start."""

    name: str
    pid: int
    since_ns: int
    child: Child
    config: IO[bytes]


class Stack:
    """Starts, stops and kills processes and knows when they are up. Made by `stack`; used from the main thread."""

    def __init__(self, bus: Bus, vehicle: Vehicle, watch: Watch, tree: Tree, port: int) -> None:
        self.bus, self.vehicle, self.watch, self.tree, self.port = bus, vehicle, watch, tree, port
        self.lives: dict[str, Life] = {}
        """The processes that run, by name."""

    @property
    def endpoint(self) -> str:
        """Where the router listens."""
        return f"tcp/127.0.0.1:{self.port}"

    def start(
        self, name: str, *arguments: str, within: Sequence[str] = (), settings: Mapping[str, Any] | None = None
    ) -> Life:
        """Start `router`, another one (`edge`), a service, `viz`, or a module by its name.

        Args:
            name: what to start; the name of any other module is that module.
            arguments: its arguments.
            within: a command before it, such as `ip netns exec NAME`.
            settings: `section.key` → value, other than the stack's own.
        """
        if name in self.lives:
            raise ValueError(f"{name} runs already")
        config, log = tempfile.TemporaryFile(), tempfile.TemporaryFile()  # noqa: SIM115 - closed with its life
        config.write(as_toml(with_settings(self.tree, settings or {})).encode())
        config.flush()
        if name == "router" and not arguments:
            arguments = ("--listen", self.endpoint)
        module = {**MODULES, "router": "common.router", "edge": "common.router"}.get(name, name)
        since = time.monotonic_ns()
        child = start(name, (module, *arguments), config, log, within=within)
        self.lives[name] = Life(name, child.process.pid, since, child, config)
        return self.lives[name]

    def kill(self, name: str) -> Life:
        """SIGKILL, and proof that the process is gone.

        Raises:
            FaultError: it was not ours to kill any more: it had ended by itself.
        """
        life = self._alive(name)
        life.child.process.kill()
        life.child.process.wait(10.0)
        if life.child.process.returncode != -signal.SIGKILL or Path(f"/proc/{life.pid}").exists():
            raise FaultError(f"{name} was not killed: code {life.child.process.returncode}")
        return self._forget(name)

    def terminate(self, name: str, within_s: float) -> tuple[float, int]:
        """SIGTERM; returns how long it took to end [s], and its exit code; one that does not end is killed (-9)."""
        life = self._alive(name)
        begin = time.monotonic()
        life.child.process.terminate()
        with suppress(Exception):
            life.child.process.wait(within_s)
        took = time.monotonic() - begin
        if life.child.process.poll() is None:
            life.child.process.kill()
            life.child.process.wait(10.0)
        self._forget(name)
        return took, int(life.child.process.returncode)

    def pause(self, name: str) -> None:
        """SIGSTOP, and proof that the process stands still (state T)."""
        life = self._alive(name)
        life.child.process.send_signal(signal.SIGSTOP)
        until(lambda: process_state(life.pid) == "T", 5.0, f"{name} stopped")

    def resume(self, name: str) -> None:
        """SIGCONT, and proof that it runs again."""
        life = self._alive(name)
        if process_state(life.pid) != "T":
            raise FaultError(f"{name} did not stand still to the end of its pause")
        life.child.process.send_signal(signal.SIGCONT)
        until(lambda: process_state(life.pid) != "T", 5.0, f"{name} running again")

    def wait_up(self, name: str, within_s: float = UP_S) -> Heard:
        """Until this life of a service says that it is up (not merely starting)."""
        life = self.lives[name]
        end = time.monotonic() + within_s
        while True:
            self.check()
            with suppress(FaultError):
                return self.watch.up(name, life.since_ns, min(1.0, within_s), not_boot=self._boot_before(name))
            if time.monotonic() > end:
                raise FaultError(f"{name} was not up within {within_s:g} s; its log ends:\n{life.child.tail()}")

    def wait_drive(self, since_ns: int = 0, within_s: float = DRIVE_S) -> Heard:
        """Until a plan to drive comes (after a moment)."""
        return self.watch.mode("drive", since_ns or time.monotonic_ns(), within_s)

    def settle(self, seconds: float = 1.0, within_s: float = DRIVE_S) -> None:
        """Until the vehicle has been driving, and nothing but plans to drive came, for some seconds."""

        def steady() -> bool:
            self.check()
            now = time.monotonic_ns()
            plans = self.watch.heard("plan", now - int(seconds * 1e9))
            ticks = self.vehicle.since(now - int(seconds * 1e9))
            driving = all(p.mode == "drive" for p in plans) and len(plans) > 10 * seconds
            return driving and bool(ticks) and min(t.speed for t in ticks) > 0.5

        until(steady, within_s, f"{seconds:g} s of driving without a stop", every_s=0.05)

    def check(self) -> None:
        """Raise if the vehicle died, or a process that nobody killed."""
        if self.vehicle.error is not None:
            raise FaultError(f"the simulated vehicle failed: {self.vehicle.error!r}")
        for name, life in self.lives.items():
            code = life.child.process.poll()
            if code is not None:
                raise FaultError(f"{name} ended by itself with code {code}; its log ends:\n{life.child.tail()}")

    def close(self) -> None:
        """End every process."""
        for life in self.lives.values():
            if life.child.process.poll() is None:
                life.child.process.send_signal(signal.SIGCONT)
                life.child.process.kill()
        for name in list(self.lives):
            self.lives[name].child.process.wait(10.0)
            self._forget(name)

    def _alive(self, name: str) -> Life:
        life = self.lives[name]
        code = life.child.process.poll()
        if code is not None:
            raise FaultError(f"{name} had ended by itself with code {code}; its log ends:\n{life.child.tail()}")
        return life

    def _forget(self, name: str) -> Life:
        life = self.lives.pop(name)
        life.config.close()
        life.child.log.close()
        return life

    def _boot_before(self, name: str) -> str:
        before = self.watch.heard(f"status/{name}", 0, self.lives[name].since_ns)
        return before[-1].boot if before else ""


@contextmanager
def stack(
    names: Sequence[str] = SERVICES,
    *,
    settings: Mapping[str, Any] | None = None,
    road_users: int = 32,
    seed: int = 0,
    road: bool = True,
    others: tuple[Topic, ...] = (),
    drive: bool = True,
    upstream: str = "",
    steady_s: float = 1.0,
) -> Iterator[Stack]:
    """A router, some services, a vehicle and a listener.

    Args:
        names: services to start at once.
        settings: `section.key` → value.
        road_users: how many others drive around the vehicle.
        seed: of the traffic.
        road: publish map and route at once.
        others: topics whose headers the listener reads too (a risk volume is 3 MB: only where it is wanted).
        drive: wait until everything runs and the vehicle drives.
        upstream: endpoint of another router that this one joins.
        steady_s: so long it must have driven without a stop before it counts as driving [s].

    Raises:
        FaultError: it did not come up.
    """
    # what arrives is stamped in Zenoh's threads: they must not wait for others here, nor for a collection of garbage
    sys.setswitchinterval(0.001)
    gc.collect()
    gc.freeze()
    port = free_port()
    base = with_settings(
        resolve({"vehicle": VEHICLE, "service": {"status_hz": STATUS_HZ}}),
        {"bus.connect": [f"tcp/127.0.0.1:{port}"], **(settings or {})},
    )
    with ExitStack() as clean:
        config, log = clean.enter_context(tempfile.TemporaryFile()), clean.enter_context(tempfile.TemporaryFile())
        config.write(as_toml(base).encode())
        config.flush()
        joins = ("--upstream", upstream) if upstream else ()
        router = start("router", ("common.router", "--listen", f"tcp/127.0.0.1:{port}", *joins), config, log)
        clean.callback(_end, router)
        since = time.monotonic_ns()
        bus = clean.enter_context(
            open_bus(BusSettings(connect=tuple(base["bus"]["connect"])), VEHICLE, "vehicle", wait_s=30.0)
        )
        watch = Watch(bus, others)
        vehicle = Vehicle(bus, road_users=road_users, seed=seed)
        clean.callback(vehicle.close)
        made = Stack(bus, vehicle, watch, base, port)
        made.lives["router"] = Life("router", router.process.pid, since, router, config)
        clean.callback(made.close)
        if road:
            vehicle.put_map()
            vehicle.put_route()
        for name in names:
            made.start(name)
        if drive:
            for name in names:
                made.wait_up(name)
            made.settle(steady_s, UP_S)
        yield made


def with_settings(tree: Tree, settings: Mapping[str, Any]) -> Tree:
    """A configuration with some `section.key` replaced."""
    for name, value in settings.items():
        section, _, key = name.partition(".")
        tree = {**tree, section: {**tree.get(section, {}), key: value}}
    return tree


def process_state(pid: int) -> str:
    """The kernel's letter for what a process does: R, S, D, T (stopped), Z; empty if it is gone."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except OSError:
        return ""


def _end(child: Child) -> None:
    if child.process.poll() is None:
        child.process.send_signal(signal.SIGCONT)
        child.process.kill()
    child.process.wait(10.0)
