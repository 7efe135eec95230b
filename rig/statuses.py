"""What the services last said about themselves."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable

from common.bus import Bus
from common.messages import Stamped, Status
from common.topics import STATUS_OF

SKIPPED = ("overwritten",)
"""Reasons by which a good message was not used because a newer one came; all others are refusals."""
NOT_MESSAGES = ("sent",)
"""Counters of a topic that are not about messages left unused."""


class Statuses:
    """Listens to `status/…` of some services."""

    def __init__(self, bus: Bus, names: Iterable[str]) -> None:
        self.bus = bus
        self._inboxes = {name: bus.inbox(STATUS_OF[name]) for name in names}

    def update(self) -> None:
        """Take what arrived."""
        for inbox in self._inboxes.values():
            inbox.take()

    def latest(self) -> dict[str, Stamped[Status]]:
        """The last status of each service that was heard."""
        return {name: inbox.latest for name, inbox in self._inboxes.items() if inbox.latest is not None}

    def state(self, name: str) -> str:
        """Its last state; `silent` before the first."""
        stamped = self._inboxes[name].latest
        return "silent" if stamped is None else str(stamped.value.state)

    def words(self, name: str) -> str:
        """Its last state and reason."""
        stamped = self._inboxes[name].latest
        return "has said nothing yet" if stamped is None else f"{stamped.value.state}, {stamped.value.reason}"

    def counters(self) -> dict[str, Counter[str]]:
        """`topic:reason` counters by service."""
        return {name: Counter(stamped.value.counters) for name, stamped in self.latest().items()}


def by_topic(counters: Iterable[Counter[str]], topics: Iterable[str]) -> tuple[dict[str, dict[str, int]], ...]:
    """Sort `topic:reason` counters into (refused, skipped), each {topic: {reason: times}}, all receivers together."""
    refused: dict[str, dict[str, int]] = {}
    skipped: dict[str, dict[str, int]] = {}
    known = set(topics)
    for name, n in sum(counters, Counter()).items():
        topic, _, reason = name.rpartition(":")
        if topic not in known or reason in NOT_MESSAGES or n <= 0:
            continue
        target = skipped if reason in SKIPPED else refused
        target.setdefault(topic, {})[reason] = n
    return refused, skipped
