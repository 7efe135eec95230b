"""What every process of ours does beside its work: it ends when asked, and it reports how it is."""

from __future__ import annotations

import logging
import os
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Annotated, NoReturn

from msgspec import Meta

from common import logs, metrics
from common.bus import Bus, Publisher
from common.clock import monotonic
from common.config import Settings
from common.health import Health

log = logging.getLogger("forefield")

EXIT_DEADLINE_S = 2.5
"""After SIGTERM the process is gone this much later, whatever hangs [s]."""


class ServiceSettings(Settings, frozen=True):
    """Section `[service]`, the same for every process."""

    heartbeat: str = ""
    """File touched while the loop turns, for the container's healthcheck; empty: none."""
    status_hz: float = 2.0
    """Rate of the status message [Hz]."""
    log_level: str = "INFO"
    log_format: logs.Format = "auto"
    """`auto`: colours on a terminal, plain lines elsewhere; `json` for machines (images set it), `text`, `pretty`."""
    metrics_port: Annotated[int, Meta(ge=0, le=65000)] = 0
    """First port of the metrics for Prometheus (`common.metrics` says whose is which); 0: none."""
    metrics_address: str = "127.0.0.1"
    """Where the metrics are served; anything else opens them to the network."""


class Ending:
    """Set by SIGTERM and Ctrl-C; wakes the bus, and ends the process at the deadline [s] if anything hangs."""

    def __init__(self, deadline_s: float = EXIT_DEADLINE_S) -> None:
        self.stop = threading.Event()
        self._deadline_s = deadline_s
        self._wake: list[Bus] = []
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, self._end)

    def wakes(self, bus: Bus) -> None:
        """End the `wait` of this bus too."""
        self._wake.append(bus)

    def _end(self, *_: object) -> None:
        self.stop.set()
        for bus in self._wake:
            bus.interrupt()
        leave = threading.Timer(self._deadline_s, _leave, (self._deadline_s,))
        leave.daemon = True
        leave.start()


class Heart:
    """Touches the file that `common.heartbeat` looks at; where it cannot, it says so once and goes on."""

    def __init__(self, file: Path | None) -> None:
        self._file = file
        self._told = False

    def beat(self) -> None:
        """Touch the file, if there is one to touch."""
        if self._file is None:
            return
        try:
            self._file.touch()
            self._told = False
        except OSError as e:
            if not self._told:
                log.warning("heartbeat: %s", e)
            self._told = True


def leave(code: int) -> NoReturn:
    """End this process now; everything of ours is closed already.

    What the interpreter and its libraries would still clear up goes with the process: half a second of work with torch
    or Warp loaded, seconds on a busy machine.
    """
    logging.shutdown()
    for stream in (sys.stdout, sys.stderr):
        with suppress(OSError, ValueError):
            stream.flush()
    os._exit(code)


def _leave(deadline_s: float) -> None:
    log.error("still busy %.1f s after being asked to stop: leaving", deadline_s)
    os._exit(0)


@contextmanager
def reporting(health: Health, status: Publisher, settings: ServiceSettings) -> Iterator[None]:
    """Send the status and touch the heartbeat from a thread of its own, so that long steps do not silence them.

    Raises:
        ConfigError: the metrics cannot be served.
    """
    stop = threading.Event()
    thread = threading.Thread(target=_report, args=(health, status, settings, stop), daemon=True)
    thread.start()
    service = status.topic.suffix.rpartition("/")[2]
    try:
        with metrics.serving(health, service, settings.metrics_port, settings.metrics_address):
            yield
        if health.state != "stopping":
            health.say("stopping", "asked to stop")
    except BaseException as e:
        health.say("stopping", f"{type(e).__name__}: {e}")
        raise
    finally:
        stop.set()
        thread.join(timeout=1.0)


def _report(health: Health, status: Publisher, settings: ServiceSettings, stop: threading.Event) -> None:
    heart = Heart(Path(settings.heartbeat) if settings.heartbeat else None)
    last = False
    while not last:
        last = stop.is_set()
        if health.turning:
            heart.beat()
        try:
            status.put(health.status(), capture_ns=monotonic())
        except Exception:  # a report must not end the reports
            log.exception("status not sent")
        stop.wait(1.0 / settings.status_hz)
