"""What the secured profile costs: `python -m tests.security.cost` sends `ego` and a whole risk volume over both.

Interleaved, one message at a time, from put to arrival; medians.
"""

from __future__ import annotations

import json
import statistics
import tempfile
import threading
from contextlib import ExitStack
from pathlib import Path

import numpy as np

from common import topics
from common.bus import Bus, BusSettings, Publisher, open_bus, router
from common.clock import monotonic
from common.messages import Grid, Header, Message
from tests import samples
from tests.security.bench import VEHICLE, bench

ROUNDS = 200
ROWS, COLUMNS, H = 640, 160, 0.25  # cells, cells, m: the default grid, 160 × 40 m


class Wire:
    """One topic from its writer to a reader, and how long a message takes."""

    def __init__(self, publisher: Publisher, reader: Bus, message: Message) -> None:
        self.publisher, self.message = publisher, message
        self.took_ms: list[float] = []
        self._arrived = threading.Event()
        reader.watch(publisher.topic, self._hear)

    def _hear(self, header: Header, now_ns: int) -> None:
        self.took_ms.append((now_ns - header.sent_ns) * 1e-6)
        self._arrived.set()

    def send(self) -> None:
        self._arrived.clear()
        self.publisher.put(self.message, capture_ns=monotonic())
        if not self._arrived.wait(5.0):
            raise SystemExit(f"{self.publisher.topic.suffix} did not arrive")


def volume() -> Message:
    """A risk volume of the default size, 2.7 MB."""
    rng = np.random.default_rng(1)
    grid = Grid(x=-30.0, y=-20.0, heading=0.0, rows=ROWS, columns=COLUMNS, h=H)
    values = rng.random((13, ROWS, COLUMNS), np.float32).astype(np.float16)
    dominant = np.zeros((13, ROWS // 4, COLUMNS // 4), np.uint8)
    return samples.risk(grid=grid, volume=values, dominant=dominant)


def main() -> None:
    """Measure and print."""
    with ExitStack() as stack:
        secured = stack.enter_context(bench(Path(stack.enter_context(tempfile.TemporaryDirectory()))))
        plain = BusSettings(connect=(stack.enter_context(router()),))
        wires: dict[str, Wire] = {}
        for profile in ("plain", "secured"):
            vehicle, riskfield, planner = (
                stack.enter_context(
                    open_bus(secured.settings(role) if profile == "secured" else plain, VEHICLE, role, wait_s=20)
                )
                for role in ("vehicle", "riskfield", "planner")
            )
            wires[f"ego {profile}"] = Wire(vehicle.publisher(topics.EGO), planner, samples.ego())
            wires[f"risk {profile}"] = Wire(riskfield.publisher(topics.RISK), planner, volume())
        for wire in wires.values():
            while not wire.publisher._raw.matching_status.matching:
                pass
        for _ in range(ROUNDS):
            for wire in wires.values():
                wire.send()
        print(json.dumps({name: round(statistics.median(wire.took_ms), 2) for name, wire in wires.items()}))


if __name__ == "__main__":
    main()
