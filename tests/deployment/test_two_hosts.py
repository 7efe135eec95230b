"""Two hosts (network namespaces with a cable between them), a router on each: the link is cut, and healed."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.processes import end_with_the_test
from tests.waiting import until

ROOT = Path(__file__).parents[2]
CAR, EDGE = "10.213.7.1", "10.213.7.2"


def ip(*arguments: str) -> None:
    subprocess.run(["ip", *arguments], check=True, capture_output=True)


class Hosts:
    """Two namespaces, and the processes in them."""

    def __init__(self, tag: str) -> None:
        self.names = {CAR: f"ff-car-{tag}", EDGE: f"ff-edge-{tag}"}
        self.processes: list[subprocess.Popen[str]] = []
        self.made: list[str] = []

    def build(self) -> None:
        for name in self.names.values():
            ip("netns", "add", name)
            self.made.append(name)
        car, edge = self.names.values()
        ip("link", "add", "cable", "netns", car, "type", "veth", "peer", "name", "cable", "netns", edge)
        for address, name in self.names.items():
            ip("-n", name, "address", "add", f"{address}/24", "dev", "cable")
            ip("-n", name, "link", "set", "cable", "up")
            ip("-n", name, "link", "set", "lo", "up")

    def start(self, address: str, *command: str, **environment: str) -> subprocess.Popen[str]:
        process = subprocess.Popen(
            ["ip", "netns", "exec", self.names[address], sys.executable, "-m", *command],
            cwd=ROOT, env={**os.environ, **environment}, text=True, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL,
            preexec_fn=end_with_the_test,
        )  # fmt: skip
        self.processes.append(process)
        return process

    def cable(self, state: str) -> None:
        ip("-n", self.names[CAR], "link", "set", "cable", state)

    def close(self) -> None:
        for process in self.processes:
            process.kill()
            process.communicate()
        for name in self.made:
            ip("netns", "delete", name)


@pytest.fixture
def hosts() -> Iterator[Hosts]:
    hosts = Hosts(str(os.getpid()))
    try:
        try:
            hosts.build()
        except (OSError, subprocess.CalledProcessError) as e:
            pytest.skip(f"no network namespaces here: {e}")
        yield hosts
    finally:
        hosts.close()


def test_what_the_vehicle_says_is_heard_at_the_edge_again_after_the_link_was_cut(hosts: Hosts) -> None:
    for address, extra in ((EDGE, ()), (CAR, ("--upstream", f"tcp/{EDGE}:7447"))):
        hosts.start(address, "common.router", "--listen", f"tcp/{address}:7447", *extra)
    at = {a: {"FOREFIELD__BUS__CONNECT": f'["tcp/{a}:7447"]'} for a in (CAR, EDGE)}
    hosts.start(CAR, "tests.deployment.talker", "send", **at[CAR])
    hearer = hosts.start(EDGE, "tests.deployment.talker", "hear", **at[EDGE])
    heard: list[tuple[int, float, float]] = []

    def listen() -> None:
        assert hearer.stdout is not None
        for line in hearer.stdout:
            seq, age = line.split()
            heard.append((int(seq), float(age), time.monotonic()))

    threading.Thread(target=listen, daemon=True).start()
    until(lambda: len(heard) > 10, within_s=40, what="the vehicle, at the edge")

    hosts.cable("down")
    until(lambda: time.monotonic() - heard[-1][2] > 1.0, within_s=20, every_s=0.05, what="silence: the link is cut")
    last_seq, cut = heard[-1][0], len(heard)
    hosts.cable("up")
    began = time.monotonic()
    until(lambda: len(heard) > cut + 10, within_s=30, what="the vehicle again")
    print(f"heard again {heard[cut][2] - began:.2f} s after the link was healed")
    seqs = [seq for seq, _, _ in heard]
    assert seqs == sorted(set(seqs)), "nothing twice, nothing backwards"
    assert heard[cut][0] > last_seq + 5, "what was said meanwhile is lost, not queued"
    assert max(age for _, age, _ in heard[cut:]) < 1.0, "nothing from before the cut is used"
