"""A second host: a network namespace of this machine, and the cable to it. Needs root."""

from __future__ import annotations

import os
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress

from evaluation.faults.result import FaultError

HERE, THERE = "10.213.8.1", "10.213.8.2"
NEAR, FAR = "fffault0", "fffault1"


class Cable:
    """The only way between this host and the other. Made by `second_host`."""

    def __init__(self, name: str) -> None:
        self.name = name
        """The other host's."""

    @property
    def within(self) -> tuple[str, ...]:
        """What stands before a command to run it there."""
        return ("ip", "netns", "exec", self.name)

    def cut(self) -> int:
        """Take the cable out; returns when [ns]. Proven: nothing gets through.

        Raises:
            FaultError: something does.
        """
        _run("ip", "link", "set", NEAR, "down")
        cut = time.monotonic_ns()
        if self.reaches():
            raise FaultError("the cable is out, and the other host still answers")
        return cut

    def heal(self) -> int:
        """Put it in again; returns when [ns]."""
        _run("ip", "link", "set", NEAR, "up")
        return time.monotonic_ns()

    def throttle(self, rate: str) -> int:
        """Cut the bandwidth, both ways, such as to `1mbit`; returns when [ns]."""
        shape = ("root", "tbf", "rate", rate, "burst", "32kbit", "latency", "400ms")
        _run("tc", "qdisc", "add", "dev", NEAR, *shape)
        _run(*self.within, "tc", "qdisc", "add", "dev", FAR, *shape)
        return time.monotonic_ns()

    def unthrottle(self) -> int:
        """Full bandwidth again; returns when [ns]."""
        _run("tc", "qdisc", "del", "dev", NEAR, "root")
        _run(*self.within, "tc", "qdisc", "del", "dev", FAR, "root")
        return time.monotonic_ns()

    def received_bytes(self) -> int:
        """How many bytes came from there so far."""
        with open(f"/sys/class/net/{NEAR}/statistics/rx_bytes", encoding="ascii") as f:  # noqa: PTH123
            return int(f.read())

    def reaches(self) -> bool:
        """Whether the route to the other host can be used now."""
        found = subprocess.run(["ip", "route", "get", THERE, "from", HERE], capture_output=True, text=True, check=False)
        return found.returncode == 0 and NEAR in found.stdout


@contextmanager
def second_host() -> Iterator[Cable]:
    """A host at `THERE`, joined to this one (`HERE`) by a cable; gone when the `with` ends.

    Raises:
        FaultError: network namespaces are not allowed here.
    """
    cable = Cable(f"ff-there-{os.getpid()}")
    try:
        try:
            _run("ip", "netns", "add", cable.name)
            _run("ip", "link", "add", NEAR, "type", "veth", "peer", "name", FAR, "netns", cable.name)
            _run("ip", "address", "add", f"{HERE}/24", "dev", NEAR)
            _run("ip", "link", "set", NEAR, "up")
            _run("ip", "-n", cable.name, "address", "add", f"{THERE}/24", "dev", FAR)
            _run("ip", "-n", cable.name, "link", "set", FAR, "up")
            _run("ip", "-n", cable.name, "link", "set", "lo", "up")
        except (OSError, FaultError) as e:
            raise FaultError(f"no network namespaces here: {e}") from None
        yield cable
    finally:
        for command in (("ip", "link", "delete", NEAR), ("ip", "netns", "delete", cable.name)):
            with suppress(OSError, FaultError):
                _run(*command)


def _run(*command: str) -> None:
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        raise FaultError(f"{' '.join(command)}: {done.stderr.strip() or f'code {done.returncode}'}")
