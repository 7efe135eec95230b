"""One end of a conversation, as a process: `python -m tests.deployment.talker send|hear`; a line for each one heard."""

from __future__ import annotations

import sys
import time

from common import config, topics
from common.bus import BusSettings, open_bus
from common.clock import monotonic
from tests import samples

PERIOD_S = 0.05


def main() -> None:
    with open_bus(config.section(config.load(), "bus", BusSettings), "ego", sys.argv[1]) as bus:
        if sys.argv[1] == "send":
            publisher = bus.publisher(topics.EGO)
            while True:
                publisher.put(samples.ego(), capture_ns=monotonic())
                time.sleep(PERIOD_S)
        inbox = bus.inbox(topics.EGO)
        while True:
            bus.wait(1.0)
            if (stamped := inbox.take()) is not None:
                print(stamped.seq, f"{stamped.age_s(monotonic()):.3f}", flush=True)


if __name__ == "__main__":
    main()
