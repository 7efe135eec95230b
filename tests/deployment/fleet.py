"""Many vehicles' small topics through one router: `python -m tests.deployment.fleet --vehicles 20 --seconds 10`.

The router is a process of its own; for each vehicle one session sends `ego` (50 Hz) and `objects` (10 Hz, 32 road
users) and another sends `plan` (20 Hz), and each hears what the other sends. Prints what was offered and carried, how
long messages took on the way, and the router's share of one core.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import threading
import time
from collections import Counter
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np

from common import topics
from common.bus import Bus, BusSettings, Publisher, free_port, open_bus
from common.clock import monotonic
from common.messages import Header
from tests import samples
from tests.processes import end_with_the_test

RATES_HZ = {"ego": 50, "objects": 10, "plan": 20}
TICK_S = 0.01


class Line:
    """One topic of one vehicle: what was sent and what was heard of it."""

    def __init__(self, publisher: Publisher, hearer: Bus, message: Any) -> None:
        self.publisher, self.message = publisher, message
        self.heard: list[int] = []
        self.transit_ms: list[float] = []
        self.foreign = 0
        self.sent = 0
        hearer.watch(publisher.topic, self.arrived)

    def arrived(self, header: Header, now_ns: int) -> None:
        if header.boot != self.publisher._boot:
            self.foreign += 1
        self.heard.append(header.seq)
        self.transit_ms.append((now_ns - header.sent_ns) * 1e-6)

    def send(self) -> None:
        self.publisher.put(self.message, capture_ns=monotonic())
        self.sent += 1


def measure(vehicles: int, seconds: float) -> dict[str, Any]:
    """Run it; figures of all vehicles together."""
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    router = subprocess.Popen(
        [sys.executable, "-m", "common.router", "--listen", endpoint], stderr=subprocess.DEVNULL,
        preexec_fn=end_with_the_test,
    )  # fmt: skip
    try:
        with ExitStack() as stack:
            lines: list[Line] = []
            for n in range(vehicles):
                settings = BusSettings(connect=(endpoint,))
                car, brain = (
                    stack.enter_context(open_bus(settings, f"v{n}", who, wait_s=20)) for who in ("vehicle", "planner")
                )
                lines += [
                    Line(car.publisher(topics.EGO), brain, samples.ego()),
                    Line(car.publisher(topics.OBJECTS), brain, samples.objects(32)),
                    Line(brain.publisher(topics.PLAN), car, samples.plan()),
                ]
            while not all(line.publisher._raw.matching_status.matching for line in lines):
                time.sleep(0.02)
            before, began = _cpu_s(router.pid), time.monotonic()
            _drive(lines, began, seconds)
            took, used = time.monotonic() - began, _cpu_s(router.pid) - before
            deadline = time.monotonic() + 5.0
            while sum(line.sent - len(line.heard) for line in lines) and time.monotonic() < deadline:
                time.sleep(0.02)
    finally:
        router.terminate()
        router.wait(10)
    transit = np.concatenate([line.transit_ms for line in lines])
    sent: Counter[str] = Counter()
    for line in lines:
        sent[line.publisher.topic.suffix] += line.sent
    return {
        "vehicles": vehicles,
        "seconds": round(took, 2),
        "sent": dict(sent),
        "messages_per_s": round(sum(sent.values()) / took),
        "lost": sum(line.sent - len(set(line.heard)) for line in lines),
        "foreign": sum(line.foreign for line in lines),
        "transit_ms": {p: round(float(np.percentile(transit, float(p[1:]))), 2) for p in ("p50", "p99")},
        "router_cores": round(used / took, 2),
    }


def _drive(lines: list[Line], began: float, seconds: float) -> None:
    stop = threading.Event()
    k = 0
    while (now := k * TICK_S) < seconds:
        stop.wait(max(began + now - time.monotonic(), 0.0))
        for i, line in enumerate(lines):
            every = round(1.0 / RATES_HZ[line.publisher.topic.suffix] / TICK_S)
            if (k + i) % every == 0:  # vehicles do not speak all at once
                line.send()
        k += 1


def _cpu_s(pid: int) -> float:
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--vehicles", type=int, default=20)
    parser.add_argument("--seconds", type=float, default=10.0)
    options = parser.parse_args()
    print(json.dumps(measure(options.vehicles, options.seconds)))


if __name__ == "__main__":
    main()
