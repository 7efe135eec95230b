"""A consumer as a process, ten times too slow: `python -m evaluation.faults.consumer SECONDS_PER_MESSAGE`.

It takes the newest risk volume, works on it for so long (asleep), and takes the next. For each it writes a line: now,
and how long the message had waited for it [ns].
"""

from __future__ import annotations

import sys
import time

from common import config
from common.bus import BusSettings, open_bus
from common.topics import OBJECTS, PLAN, RISK


def main() -> None:
    """Take, be slow, again, until ended."""
    tree = config.load()
    with open_bus(config.section(tree, "bus", BusSettings), config.vehicle(tree), "slow") as bus:
        inbox = bus.inbox(RISK)
        others = [bus.inbox(topic) for topic in (PLAN, OBJECTS)]
        while True:
            bus.wait(1.0)
            stamped = inbox.take()
            now = time.monotonic_ns()
            if stamped is not None:
                sys.stdout.write(f"{now} {now - stamped.received_ns}\n")
                sys.stdout.flush()
                time.sleep(float(sys.argv[1]))
                for other in others:
                    other.take()


if __name__ == "__main__":
    main()
