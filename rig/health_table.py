"""How a running system is: every service's status as a table, and as an exit code."""

from __future__ import annotations

import time

from rich.markup import escape
from rich.table import Table

from common.bus import Bus
from common.messages import InputHealth
from common.topics import STATUS_OF
from rig.launcher import SERVICES
from rig.statuses import Statuses

LISTEN_S = 2.5
"""Statuses come at 2 Hz; a service that says nothing for this long is silent [s]."""
COLOURS = {"ready": "green", "waiting": "yellow", "starting": "yellow", "degraded": "red", "stopping": "red"}


def ask(bus: Bus, listen_s: float = LISTEN_S) -> Statuses:
    """Listen until the three services were heard, or for `listen_s`."""
    statuses = Statuses(bus, STATUS_OF)
    deadline = time.monotonic() + listen_s
    least = time.monotonic() + min(0.8, listen_s)  # time for viz and the vehicle to be heard too
    while time.monotonic() < deadline:
        bus.wait(0.1)
        statuses.update()
        if time.monotonic() > least and all(name in statuses.latest() for name in SERVICES):
            break
    return statuses


def healthy(statuses: Statuses) -> bool:
    """Whether all three services say that they are ready."""
    return all(statuses.state(name) == "ready" for name in SERVICES)


def _word(i: InputHealth) -> str:
    if not i.alive:
        return "missing" if i.received else "none yet"
    return "refused" if not i.valid else "ok" if i.rate_ok else "odd rate"


def table(statuses: Statuses, alive: set[str]) -> Table:
    """One row for each service, with its inputs and what it did not use."""
    out = Table(title="Forefield")
    for name in ("service", "state", "reason", "inputs", "work p50 / p99", "not used"):
        out.add_column(name)
    latest = statuses.latest()
    for name in STATUS_OF:
        if name not in latest:
            if name in SERVICES:
                seen = "its token is seen, its status is not" if name in alive else "not running, or not on this bus"
                out.add_row(name, "[red]silent[/]", seen)
            continue
        s = latest[name].value
        inputs = [f"{topic} {f'{i.rate_hz:.0f} Hz' if i.rate_hz else ''} {_word(i)}" for topic, i in s.inputs.items()]
        unused = [f"{k} {n}" for k, n in sorted(s.counters.items()) if n and k.partition(":")[0] in s.inputs]
        work = f"{s.work_ms.get('p50', 0):.1f} / {s.work_ms.get('p99', 0):.1f} ms"
        out.add_row(
            name, f"[{COLOURS[s.state]}]{s.state}[/]", escape(s.reason), "\n".join(inputs), work, "\n".join(unused)
        )
    return out
