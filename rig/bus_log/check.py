"""Repeats a recorded drive: the inputs that each step had go through the services' own steps again, in their order.

Every message of a service names what its step had before it (`Header.step`): messages by boot and seq, the times at
which they were true on the service's clock, the time at which the step began. So the check needs no bus, no clock and
no luck. A service that was already running when the recording began holds a state that the recording does not tell;
it is compared from where that state no longer matters (`SETTLES`).
"""

from __future__ import annotations

import hashlib
import importlib
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from typing import Any

from common import codec, topics
from common.codec import RefusedError
from common.config import Tree
from common.health import Health
from common.messages import Header, Message, Plan, Stamped, StepInputs
from common.service import Inputs, Output, Service, Step
from common.topics import Delivery, Topic
from rig.bus_log.compare import Difference, difference
from rig.bus_log.envelope import Recorded
from rig.bus_log.reader import BusLog

MODULES = {
    "predictor": "services.predictor.__main__",
    "riskfield": "services.riskfield.__main__",
    "planner": "services.planner.__main__",
}
SETTLES: dict[str, int | None] = {"predictor": 45, "riskfield": 1, "planner": None}
"""After so many steps nothing from before them matters; None: only after a plan that waits, which forgets the last."""
BEHIND_NS = 1_500_000_000
"""An output is repeated when the recording has gone on by this much: its inputs may have been heard after it [ns]."""
KEPT_NS = 5_000_000_000
"""How long messages are kept [ns]; latched ones are kept for good."""
KEPT_AT_LEAST = 5
"""Messages of a topic that are kept however old they are."""

Key = tuple[str, str, int]


@dataclass
class Checked:
    """What became of one service's messages."""

    service: str
    compared: int = 0
    skipped: int = 0
    """Repeated, or not, without being compared."""
    why_skipped: str = ""
    first: tuple[int, Difference] | None = None
    """Seq and place of the first difference."""
    different: int = 0

    @property
    def is_good(self) -> bool:
        """Whether something was compared, and all of it agreed."""
        return self.compared > 0 and not self.different


class _Slot:
    """Stands in for an inbox: it holds what the step had."""

    def __init__(self, topic: Topic, latest: Stamped[Any] | None) -> None:
        self.topic, self.latest = topic, latest

    def fresh(self, now_ns: int) -> Stamped[Any] | None:
        """The message unless it is older than its topic allows."""
        limit = self.topic.max_age_s
        if self.latest is None or (limit is not None and not self.latest.age_s(now_ns) <= limit):
            return None
        return self.latest


@dataclass
class _Repeater:
    """One service, run again."""

    service: Service
    checked: Checked
    build: Callable[[], Step]
    step: Step
    boot: str = ""
    seq: int = -1
    settled: int | None = 0
    """At least 0: its state is that of the recording; below: steps until it is; None: unknown."""


@dataclass
class _Memory:
    """What was heard lately, decoded once: services take a map that is the same object as the same map."""

    recorded: dict[Key, Recorded] = field(default_factory=dict)
    order: dict[str, deque[Key]] = field(default_factory=dict)
    decoded: dict[Key, Stamped[Any]] = field(default_factory=dict)
    standing: dict[tuple[str, bytes], tuple[bytes, list[Message]]] = field(default_factory=dict)
    """Latched bodies, by topic and digest, each once however often it was sent; and what they say, once it was read."""

    def add(self, message: Recorded, header: Header) -> None:
        key = (message.topic.suffix, header.boot, header.seq)
        if message.topic.delivery is Delivery.LATCHED:
            body, _ = self.standing.setdefault(_digest(message), (message.payload, []))
            self.recorded[key] = replace(message, payload=body)
            return
        self.recorded[key] = message
        order = self.order.setdefault(message.topic.suffix, deque())
        order.append(key)
        # the last ones stay however old they are: a step may hold on to what fell silent
        while len(order) > KEPT_AT_LEAST and self.recorded[order[0]].time_ns < message.time_ns - KEPT_NS:
            old = order.popleft()
            self.recorded.pop(old, None)
            self.decoded.pop(old, None)

    def value(self, key: Key) -> Message:
        """The decoded body.

        Raises:
            KeyError: it is not there.
            RefusedError: it cannot be read.
        """
        if key not in self.decoded:
            recorded = self.recorded[key]
            header = recorded.header()
            self.decoded[key] = Stamped(
                self._read(recorded, header), 0, 0, header.cause, header.source, header.boot, header.seq
            )
        message: Message = self.decoded[key].value
        return message

    def _read(self, recorded: Recorded, header: Header) -> Message:
        if recorded.topic.delivery is not Delivery.LATCHED:
            return codec.decode_body(recorded.topic, header, recorded.payload)
        _, known = self.standing[_digest(recorded)]
        if not known:
            known.append(codec.decode_body(recorded.topic, header, recorded.payload))
        return known[0]

    def stamped(self, key: Key, capture_ns: int, now_ns: int) -> Stamped[Any]:
        self.value(key)
        known = self.decoded[key]
        return Stamped(known.value, capture_ns, now_ns, known.cause, known.source, known.boot, known.seq, known.work_ns)


def _digest(message: Recorded) -> tuple[str, bytes]:
    return message.topic.suffix, hashlib.blake2b(message.payload, digest_size=32).digest()


def check(
    log: BusLog, tree: Tree, *, same_machine: bool, services: tuple[str, ...] = tuple(MODULES),
    show: Callable[[int], None] = lambda _: None,
) -> list[Checked]:  # fmt: skip
    """Repeat every step of a recording and compare.

    Args:
        log: the recording.
        tree: the configuration that the services had.
        same_machine: how close results must be.
        services: which.
        show: called with the log time that was reached [ns].

    Raises:
        ConfigError: a service cannot be built from the configuration.
    """
    repeaters = {}
    for name in services:
        repeater = _repeater(importlib.import_module(MODULES[name]).SERVICE, tree)
        repeaters[repeater.service.publishes.suffix] = repeater
    memory = _Memory()
    for message in _behind(log, memory, show):
        if message.topic.suffix in repeaters:
            _repeat(repeaters[message.topic.suffix], message, memory, same_machine)
    return [repeater.checked for repeater in repeaters.values()]


def _repeater(service: Service, tree: Tree) -> _Repeater:
    def build() -> Step:
        return service.build(tree, Health(service.name, lambda: 0))

    return _Repeater(service, Checked(service.name), build, build())


def _unsettled(service: Service) -> int | None:
    steps = SETTLES[service.name]
    return None if steps is None else -steps


def _behind(log: BusLog, memory: _Memory, show: Callable[[int], None]) -> Iterator[Recorded]:
    """Every message once what it rests on was surely heard."""
    waiting: deque[Recorded] = deque()
    moving = [t for t in topics.TOPICS.values() if t.name != "status"]
    for message in log.messages(moving):
        try:
            memory.add(message, message.header())
        except RefusedError as e:
            log.refused[f"{message.topic.suffix}:{e.reason}"] += 1
            continue
        waiting.append(message)
        show(message.time_ns)
        while waiting[0].time_ns <= message.time_ns - BEHIND_NS:
            yield waiting.popleft()
    yield from waiting


def _repeat(it: _Repeater, message: Recorded, memory: _Memory, same_machine: bool) -> None:
    header, checked = message.header(), it.checked
    if header.step is None:
        _skip(checked, "its header has no `step`, which names what its step had: a replay, or an older sender")
        return
    if (header.boot, header.seq) != (it.boot, it.seq + 1):
        if it.boot != header.boot and it.boot:  # the service was started again, and so is this one
            it.step = it.build()
        it.settled = 0 if header.seq == 0 else _unsettled(it.service)
    it.boot, it.seq = header.boot, header.seq
    key = (message.topic.suffix, header.boot, header.seq)
    try:
        recorded = memory.value(key)
        inputs = _inputs(it.service, header.step, memory)
    except KeyError as e:
        _skip(checked, f"not in the recording: {' '.join(map(str, e.args[0]))}")
        it.settled = _unsettled(it.service)
        return
    except RefusedError as e:
        _skip(checked, f"cannot be read: {e}")
        return
    try:
        result = it.step(inputs)
    except Exception as e:  # a service's step must not raise, whatever came before it
        checked.compared += 1
        _differs(checked, header.seq, Difference(message.topic.suffix, "a message", f"{type(e).__name__}: {e}"))
        return
    if it.settled is None or it.settled < 0:
        it.settled = None if it.settled is None else it.settled + 1
        if it.settled is None and isinstance(recorded, Plan) and recorded.mode == "waiting":
            it.settled = 0
        _skip(checked, "the service ran before the recording began, or a step of it is missing: its state is unknown")
        return
    checked.compared += 1
    if isinstance(result, Output):
        found = difference(recorded, result.message, same_machine=same_machine)
    else:
        found = Difference(message.topic.suffix, "a message", f"nothing: {result.reason}")
    if found is not None:
        _differs(checked, header.seq, found)


def _differs(checked: Checked, seq: int, found: Difference) -> None:
    checked.different += 1
    checked.first = checked.first or (seq, found)


def _inputs(service: Service, step: StepInputs, memory: _Memory) -> Inputs:
    found = {u.topic: memory.stamped((u.topic, u.boot, u.seq), u.capture_ns, step.now_ns) for u in step.used}
    slots: Any = {t.suffix: _Slot(t, found.get(t.suffix)) for t in service.subscribes}
    return Inputs(slots, step.now_ns, frozenset(u.topic for u in step.used if u.new))


def _skip(checked: Checked, why: str) -> None:
    checked.skipped += 1
    checked.why_skipped = checked.why_skipped or why
