"""The one table of topics: who says what to whom, how often, how large, how old it may be.

Key on the bus: `forefield/{vehicle}/{suffix}`. Everything that must agree about a topic (codec,
bus, health, access control, viz, rig, tests) reads it here and nowhere else.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from enum import Enum

from common import messages

KIB = 1024
MIB = 1024 * KIB
VEHICLE = "vehicle"
"""Who writes what no service does: our own vehicle, or the bench in its place."""
VERSION_MAJOR = 1
VERSION_MINOR = 1  # 1.1: headers name what a step had before it (`step`)


class Delivery(Enum):
    """How a topic reaches its receivers."""

    LATEST = "latest"  # one slot, newer replaces older
    LATCHED = "latched"  # a late joiner gets the last one


class Priority(Enum):
    """Zenoh priority of a topic; the names are Zenoh's."""

    REAL_TIME = "REAL_TIME"
    INTERACTIVE_HIGH = "INTERACTIVE_HIGH"
    DATA_HIGH = "DATA_HIGH"
    DATA = "DATA"
    BACKGROUND = "BACKGROUND"


@dataclass(frozen=True)
class Topic:
    """One row of the contract."""

    name: str
    """Name of the topic, also the schema's name."""
    suffix: str
    """Key behind `forefield/{vehicle}/`."""
    message: type
    """Type of the body."""
    rate_hz: tuple[float, float] | None
    """Lowest and highest expected rate [Hz]; None: on change."""
    max_age_s: float | None
    """Content older than this is refused as `stale` [s]; None: no limit."""
    max_bytes: int
    """Largest body [bytes]."""
    max_header_bytes: int
    """Largest header [bytes]."""
    delivery: Delivery
    priority: Priority
    writer: str
    """Who alone may send it: a service, or the `vehicle`."""
    readers: frozenset[str]
    """Who may hear it."""
    wait: bool = False
    """Latched topics wait for room (BLOCK), the others drop."""

    @property
    def encoding(self) -> str:
        """Encoding string stated with every payload."""
        return f"application/msgpack;forefield.{self.name}.v{VERSION_MAJOR}"


def _latest(
    name: str,
    message: type,
    rate: tuple[float, float],
    age: float | None,
    size: int,
    priority: Priority,
    flow: tuple[str, str],
    header: int = 4 * KIB,
) -> Topic:
    writer, readers = flow
    return Topic(name, name, message, rate, age, size, header, Delivery.LATEST, priority, writer, _names(readers))


def _latched(name: str, message: type, size: int, readers: str) -> Topic:
    return Topic(
        name, name, message, None, None, size, 4 * KIB, Delivery.LATCHED, Priority.DATA_HIGH, VEHICLE,
        _names(readers), True,
    )  # fmt: skip


def _names(names: str) -> frozenset[str]:
    return frozenset(names.split())


EGO = _latest(
    "ego", messages.Ego, (10.0, 100.0), 0.2, 4 * KIB, Priority.REAL_TIME,
    ("vehicle", "predictor riskfield planner viz"),
)  # fmt: skip
OBJECTS = _latest(
    "objects", messages.Objects, (8.0, 12.0), 0.3, 512 * KIB, Priority.INTERACTIVE_HIGH, ("vehicle", "predictor viz")
)
MAP = _latched("map", messages.Map, 32 * MIB, "predictor riskfield planner viz")
ROUTE = _latched("route", messages.Route, 4 * MIB, "predictor riskfield planner viz")
CLOSURES = _latched("closures", messages.Closures, 64 * KIB, "riskfield viz")
PREDICTION = _latest(
    "prediction", messages.Prediction, (8.0, 12.0), 0.3, 4 * MIB, Priority.INTERACTIVE_HIGH,
    ("predictor", "riskfield viz"),
)  # fmt: skip
RISK = _latest(
    "risk", messages.Risk, (8.0, 12.0), 0.3, 64 * MIB, Priority.INTERACTIVE_HIGH, ("riskfield", "planner viz"), 8 * KIB
)
PLAN = _latest("plan", messages.Plan, (18.0, 22.0), 0.3, 4 * MIB, Priority.REAL_TIME, ("planner", "vehicle viz"))
STATUS_OF = {
    service: Topic(
        "status",
        f"status/{service}",
        messages.Status,
        (1.0, 3.0),
        2.0,
        64 * KIB,
        4 * KIB,
        Delivery.LATEST,
        Priority.BACKGROUND,
        service,
        _names("vehicle viz"),
    )
    for service in ("predictor", "riskfield", "planner", "viz", "vehicle")
}

TOPICS: dict[str, Topic] = {
    t.suffix: t for t in (EGO, OBJECTS, MAP, ROUTE, CLOSURES, PREDICTION, RISK, PLAN, *STATUS_OF.values())
}

_VEHICLE = re.compile(r"[A-Za-z0-9_-]{1,64}")


def key(vehicle: str, topic: Topic) -> str:
    """Key of a topic on the bus.

    Raises:
        ValueError: `vehicle` is not 1 to 64 of letters, digits, `_` and `-`.
    """
    return f"forefield/{checked_vehicle(vehicle)}/{topic.suffix}"


def alive_key(vehicle: str, service: str) -> str:
    """Key of a service's liveliness token."""
    return f"forefield/{checked_vehicle(vehicle)}/alive/{service}"


def checked_vehicle(vehicle: str) -> str:
    """Return `vehicle` if it may stand in a key, otherwise raise ValueError."""
    if not _VEHICLE.fullmatch(vehicle):
        raise ValueError(f"vehicle name {vehicle!r}: use 1 to 64 letters, digits, '_' or '-'")
    return vehicle
