"""A second host: a network namespace of this machine, and the cable to it. Needs root."""

from __future__ import annotations

import os
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress

from evaluation.faults.result import FaultError


class Cable:
    """The only way between this host and the other. Made by `second_host`."""

    def __init__(self, tag: int) -> None:
        self.name = f"ff-there-{tag}"
        """The other host's."""
        self.near, self.far = f"ff{tag}a", f"ff{tag}b"
        """Its ends."""
        net = f"10.213.{20 + tag % 200}"
        self.here, self.there = f"{net}.1", f"{net}.2"
        """Addresses at its ends."""

    @property
    def endpoint(self) -> str:
        """Where a router over there listens."""
        return f"tcp/{self.there}:7447"

    @property
    def within(self) -> tuple[str, ...]:
        """What stands before a command to run it there."""
        return ("ip", "netns", "exec", self.name)

    def cut(self) -> int:
        """Take the cable out; returns when [ns]. Proven: nothing gets through.

        Raises:
            FaultError: something does.
        """
        _run("ip", "link", "set", self.near, "down")
        cut = time.monotonic_ns()
        if self.reaches():
            raise FaultError("the cable is out, and the other host still answers")
        return cut

    def heal(self) -> int:
        """Put it in again; returns when [ns]."""
        _run("ip", "link", "set", self.near, "up")
        return time.monotonic_ns()

    def throttle(self, rate: str) -> int:
        """Cut the bandwidth, both ways, such as to `1mbit`; returns when [ns]."""
        shape = ("root", "tbf", "rate", rate, "burst", "32kbit", "latency", "400ms")
        _run("tc", "qdisc", "add", "dev", self.near, *shape)
        _run(*self.within, "tc", "qdisc", "add", "dev", self.far, *shape)
        return time.monotonic_ns()

    def unthrottle(self) -> int:
        """Full bandwidth again; returns when [ns]."""
        _run("tc", "qdisc", "del", "dev", self.near, "root")
        _run(*self.within, "tc", "qdisc", "del", "dev", self.far, "root")
        return time.monotonic_ns()

    def received_bytes(self) -> int:
        """How many bytes came from there so far."""
        with open(f"/sys/class/net/{self.near}/statistics/rx_bytes", encoding="ascii") as f:  # noqa: PTH123
            return int(f.read())

    def reaches(self) -> bool:
        """Whether the route to the other host can be used now."""
        found = subprocess.run(
            ["ip", "route", "get", self.there, "from", self.here], capture_output=True, text=True, check=False
        )
        return found.returncode == 0 and self.near in found.stdout


@contextmanager
def second_host() -> Iterator[Cable]:
    """Another host, joined to this one by a cable; gone when the `with` ends.

    Raises:
        FaultError: network namespaces are not allowed here.
    """
    cable = Cable(os.getpid())
    try:
        try:
            _run("ip", "netns", "add", cable.name)
            _run("ip", "link", "add", cable.near, "type", "veth", "peer", "name", cable.far, "netns", cable.name)
            _run("ip", "address", "add", f"{cable.here}/24", "dev", cable.near)
            _run("ip", "link", "set", cable.near, "up")
            _run("ip", "-n", cable.name, "address", "add", f"{cable.there}/24", "dev", cable.far)
            _run("ip", "-n", cable.name, "link", "set", cable.far, "up")
            _run("ip", "-n", cable.name, "link", "set", "lo", "up")
        except (OSError, FaultError) as e:
            raise FaultError(f"no network namespaces here: {e}") from None
        yield cable
    finally:
        for command in (("ip", "link", "delete", cable.near), ("ip", "netns", "delete", cable.name)):
            with suppress(OSError, FaultError):
                _run(*command)


def _run(*command: str) -> None:
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        raise FaultError(f"{' '.join(command)}: {done.stderr.strip() or f'code {done.returncode}'}")
