"""The recorder of the bus over a disk that fails: `python -m evaluation.faults.recording FILE FAULT`.

It records the bus of its configuration and prints every 0.1 s, as a line of JSON, what it has written and dropped and
what troubles it. When standard input ends it closes the file and prints the same once more. Told `fault` there, its
disk fails from then on: `readonly` as a file system does that the kernel has made read-only, `slow` at 300 kB/s.
"""

from __future__ import annotations

import errno
import json
import os
import sys
import threading
import time
from pathlib import Path
from typing import Any

from common import config
from common.bus import BusSettings, open_bus
from common.topics import TOPICS
from rig.bus_log.recorder import Recorder

BYTES_PER_S = 300_000


class Disk:
    """A file whose writing goes wrong once it is told so."""

    def __init__(self, file: Any, fault: str) -> None:
        self._file, self._fault = file, fault
        self.failing = False
        self.writes = 0
        """While it was failing."""

    def write(self, data: bytes) -> int:
        """Write, or fail."""
        if self.failing:
            self.writes += 1
            if self._fault == "readonly":
                raise OSError(errno.EROFS, os.strerror(errno.EROFS))
            if self._fault == "slow":
                time.sleep(len(data) / BYTES_PER_S)
        return int(self._file.write(data))

    def __getattr__(self, name: str) -> Any:
        return getattr(self._file, name)


class FaultyPath(type(Path())):  # type: ignore[misc]
    """A path whose file lies on such a disk."""

    fault = ""
    disk: Disk | None = None

    def open(self, *arguments: Any, **more: Any) -> Any:
        """The disk, for whoever writes."""
        file = super().open(*arguments, **more)
        if arguments and "w" in arguments[0]:
            FaultyPath.disk = Disk(file, FaultyPath.fault)
            return FaultyPath.disk
        return file


def main(arguments: list[str]) -> int:
    """Record until standard input ends."""
    path, FaultyPath.fault, reserve = FaultyPath(arguments[0]), arguments[1], int(arguments[2])
    tree = config.load()
    done = threading.Event()

    def listen() -> None:
        for line in sys.stdin:
            if line.strip() == "fault" and FaultyPath.disk is not None:
                FaultyPath.disk.failing = True
        done.set()

    threading.Thread(target=listen, daemon=True).start()
    with open_bus(config.section(tree, "bus", BusSettings), config.vehicle(tree), "recorder", wait_s=10.0) as bus:
        recorder = Recorder(bus, tuple(TOPICS.values()), path, tree, reserve_bytes=reserve)
        try:
            while not done.wait(0.1):
                _tell(recorder, closed=False)
        finally:
            recorder.close()
            _tell(recorder, closed=True)
    return 0


def _tell(recorder: Recorder, closed: bool) -> None:
    disk = FaultyPath.disk
    said = {
        "written": dict(recorder.written), "dropped": dict(recorder.dropped), "trouble": recorder.trouble,
        "closed": closed, "failing_writes": 0 if disk is None else disk.writes,
    }  # fmt: skip
    print(json.dumps(said), flush=True)


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
