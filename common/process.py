"""What every process of ours does beside its work: it ends when asked, and it reports how it is."""

from __future__ import annotations

import logging
import os
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

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


class Ending:
    """Set by SIGTERM and Ctrl-C; wakes the bus, and ends the process at the deadline if anything hangs."""

    def __init__(self) -> None:
        self.stop = threading.Event()
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
        leave = threading.Timer(EXIT_DEADLINE_S, _leave)
        leave.daemon = True
        leave.start()


def _leave() -> None:
    log.error("still busy %.1f s after being asked to stop: leaving", EXIT_DEADLINE_S)
    os._exit(0)


@contextmanager
def reporting(health: Health, status: Publisher, settings: ServiceSettings) -> Iterator[None]:
    """Send the status and touch the heartbeat from a thread of its own, so that long steps do not silence them."""
    stop = threading.Event()
    thread = threading.Thread(target=_report, args=(health, status, settings, stop), daemon=True)
    thread.start()
    try:
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
    heartbeat = Path(settings.heartbeat) if settings.heartbeat else None
    last = told = False
    while not last:
        last = stop.is_set()
        if heartbeat is not None and health.turning:
            try:
                heartbeat.touch()
                told = False
            except OSError as e:
                if not told:
                    log.warning("heartbeat: %s", e)
                told = True
        try:
            status.put(health.status(), capture_ns=monotonic())
        except Exception:  # a report must not end the reports
            log.exception("status not sent")
        stop.wait(1.0 / settings.status_hz)
