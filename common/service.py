"""The one loop every service runs: inputs in, one step, one message out; health, SIGTERM, exit.

The shell around a core. It takes the newest of each input, runs the step when its trigger arrived or its period is
over, and sends what the step returns. It never dies of what arrives: an exception of a step is counted by name,
logged, and declared as `degraded`. A `FatalError` (a poisoned GPU context) ends the process; its supervisor starts
a new one.
"""

from __future__ import annotations

import gc
import logging
import re
import sys
import threading
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any

from common import config, logs
from common.bus import Bus, BusSettings, Inbox, NoRouterError, Publisher, open_bus
from common.clock import monotonic
from common.codec import RefusedError
from common.config import ConfigError, Tree
from common.health import Health
from common.messages import Cause, Message, Stamped, State, StepInputs, Used
from common.process import Ending, ServiceSettings, leave, reporting
from common.rhythm import Rhythm, sooner_ns
from common.topics import STATUS_OF, Topic

log = logging.getLogger("forefield")


class FatalError(Exception):
    """The process cannot go on and must be restarted by its supervisor."""


@dataclass(frozen=True)
class Output:
    """What a step wants sent."""

    message: Message
    capture_ns: int
    """When its content was true, own monotonic clock [ns]."""
    cause: Cause | None
    arrived_ns: int
    """When the input it rests on arrived, or when the step began [ns]."""
    state: State = "ready"
    reason: str = "running"
    again_ns: int | None = None
    """When something that was used becomes too old [ns]: the next step is due then, and this is not sent after it."""
    step: StepInputs | None = None
    """Filled in by the loop: what the step had before it."""


@dataclass(frozen=True)
class Idle:
    """Nothing to send, and why."""

    reason: str
    state: State = "waiting"


@dataclass(frozen=True)
class Inputs:
    """The newest accepted message of each topic at the moment of a step."""

    inboxes: Mapping[str, Inbox]
    now_ns: int
    new: frozenset[str]
    """Suffixes of the topics of which a message was accepted since the last step."""

    def latest(self, topic: Topic) -> Stamped[Any] | None:
        """The last good message, however old."""
        return self.inboxes[topic.suffix].latest

    def fresh(self, topic: Topic) -> Stamped[Any] | None:
        """The last good message unless it is older than its topic allows."""
        return self.inboxes[topic.suffix].fresh(self.now_ns)

    def named(self) -> StepInputs:
        """The messages before this step, so that it can be repeated from a recording."""
        return StepInputs(
            self.now_ns,
            [
                Used(name, message.boot, message.seq, message.capture_ns, name in self.new)
                for name, inbox in self.inboxes.items()
                if (message := inbox.latest) is not None
            ],
        )


Step = Callable[[Inputs], Output | Idle]
Send = Callable[[Output, int], None]
"""Takes a result, and when it was wanted: when its input arrived or its time had come, whichever was first [ns]."""


@dataclass(frozen=True)
class Service:
    """What makes one service: its inputs, its output, and when it steps."""

    name: str
    subscribes: tuple[Topic, ...]
    publishes: Topic
    trigger: Topic
    """A new message of this topic makes a step due at once."""
    period_s: float
    """So does this much time since the last step [s]."""
    build: Callable[[Tree, Health], Step]
    """Reads the configuration, warms up, returns the step. May raise ConfigError."""
    sends_aside: bool = False
    """Large messages are packed and sent by a second thread while the next step runs."""
    grace_s: float = 0.0
    """A trigger that is late by no more than this is waited for [s]."""

    def rhythm(self) -> Rhythm:
        """When it steps; triggers are expected at the middle of their topic's rates."""
        rates = self.trigger.rate_hz
        interval = None if rates is None else round(2e9 / sum(rates))
        return Rhythm(round(self.period_s * 1e9), interval, round(self.grace_s * 1e9))


def main(service: Service) -> int:
    """Run a service as a process and end it: 0 stopped, 1 fatal, 2 bad configuration.

    Returns its exit code only where the process must still clear up: bad configuration, Zenoh's shared memory.
    """
    try:
        tree = config.load()
        settings = config.section(tree, "service", ServiceSettings)
        logs.begin(service.name, settings.log_level, settings.log_format)
        code = run(service, tree, settings)
        if not config.section(tree, "bus", BusSettings).shared_memory:  # Zenoh removes its files when we exit in full
            leave(code)
        return code
    except NoRouterError as e:
        log.info("stopped: %s", e)
        return 0
    except ConfigError as e:
        print(f"{service.name}: {e}", file=sys.stderr)
        return 2


def run(service: Service, tree: Tree, settings: ServiceSettings) -> int:
    """Open the bus, warm up, loop until SIGTERM or Ctrl-C."""
    ending = Ending()
    health = Health(service.name, monotonic)
    bus_settings = config.section(tree, "bus", BusSettings)
    with open_bus(bus_settings, config.vehicle(tree), service.name, health=health, stop=ending.stop) as bus:
        ending.wakes(bus)
        logs.about(vehicle=bus.vehicle, boot=bus.boot)
        inboxes = {t.suffix: bus.inbox(t) for t in service.subscribes}
        output = bus.publisher(service.publishes)
        bus.liveliness(service.name)
        health.say("starting", "warming up")
        with reporting(health, bus.publisher(STATUS_OF[service.name]), settings):
            try:
                step = service.build(tree, health)
                # what was loaded stays: a collection that walks through all of it takes 0.1 s, in the middle of a step
                gc.collect()
                gc.freeze()
                log.info("ready, vehicle %r", bus.vehicle)
                _loop(service, bus, health, inboxes, output, step, ending.stop)
            except FatalError as e:
                log.critical("fatal: %s", e)
                health.say("stopping", f"fatal: {e}")
                return 1
    return 0


def _loop(
    service: Service, bus: Bus, health: Health, inboxes: Mapping[str, Inbox], output: Publisher, step: Step,
    stop: threading.Event,
) -> None:  # fmt: skip
    due_ns = monotonic()
    rhythm = service.rhythm()
    new: set[str] = set()
    health.say("waiting", "waiting for " + ", ".join(t.suffix for t in service.subscribes))
    with _sender(service, health, output) as send:
        while not stop.is_set():
            bus.wait((due_ns - monotonic()) * 1e-9)
            for name, inbox in inboxes.items():
                if inbox.take() is not None:
                    if name in new:  # no step ever had the one before it
                        inbox.superseded()
                    new.add(name)
            health.turned()
            now = monotonic()
            if now < due_ns and service.trigger.suffix not in new:
                continue
            triggered = service.trigger.suffix in new
            wanted_ns = now if triggered else due_ns
            due_ns = rhythm.due_ns(now, triggered)
            inputs = Inputs(inboxes, now, frozenset(new))
            new = set()
            before = inputs.named()
            result = _step(health, step, inputs)
            if _too_late(result):  # as of now, the step knows what is too old
                health.count(f"{service.publishes.suffix}:not_sent_too_late")
                output.skip()
                inputs = Inputs(inboxes, monotonic(), frozenset())
                before = inputs.named()
                result = _step(health, step, inputs)
            if isinstance(result, Output):
                due_ns = sooner_ns(due_ns, result.again_ns, now)
                send(replace(result, step=before), min(wanted_ns, result.arrived_ns))
            else:
                _say(health, result)


def _too_late(result: Output | Idle) -> bool:
    """Whether what a result rests on became too old while it was made."""
    return isinstance(result, Output) and result.again_ns is not None and monotonic() >= result.again_ns


def _step(health: Health, step: Step, inputs: Inputs) -> Output | Idle:
    try:
        return step(inputs)
    except FatalError:
        raise
    except Exception as e:
        health.count(f"step:{type(e).__name__}")
        log.exception("step failed")
        return _failed(health, f"step failed: {type(e).__name__}: {e}")


@contextmanager
def _sender(service: Service, health: Health, output: Publisher) -> Iterator[Send]:
    """How results leave: at once, or from a thread of their own while the next step runs; never two under way."""
    if not service.sends_aside:
        yield lambda result, wanted_ns: _send(service, health, output, result, wanted_ns)
        return
    pending: list[Future[None]] = []
    with ThreadPoolExecutor(1, "send") as pool:

        def send(result: Output, wanted_ns: int) -> None:
            while pending:
                pending.pop().result()
            pending.append(pool.submit(_send, service, health, output, result, wanted_ns))

        yield send


def _send(service: Service, health: Health, output: Publisher, result: Output, wanted_ns: int) -> None:
    suffix = service.publishes.suffix
    try:
        sent = output.put(
            result.message, capture_ns=result.capture_ns, cause=result.cause, arrived_ns=result.arrived_ns,
            step=result.step,
        )  # fmt: skip
        health.worked(output.last_work_ns)
        health.count(f"{suffix}:sent")
        late_ns = monotonic() - wanted_ns
        if late_ns * 1e-9 > service.period_s:
            health.late(late_ns)
        _say(
            health,
            result,
            seq=sent.seq,
            cause=None if result.cause is None else f"{result.cause.boot}:{result.cause.seq}",
        )
    except RefusedError as e:
        health.count(f"{suffix}:not_sent_{e.reason}")
        _say(health, _failed(health, f"own {suffix} broke its contract: {e}"))
    except Exception as e:
        health.count(f"{suffix}:not_sent_{type(e).__name__}")
        log.exception("%s not sent", suffix)
        _say(health, _failed(health, f"{suffix} not sent: {type(e).__name__}: {e}"))


def _failed(health: Health, reason: str) -> Idle:
    health.detail["last_error"] = reason
    return Idle(reason, "degraded")


def _say(health: Health, result: Output | Idle, **about: Any) -> None:
    before = health.state, _numberless(health.reason)
    health.say(result.state, result.reason)
    if before != (result.state, _numberless(result.reason)):
        log.info("%s: %s", result.state, result.reason, extra=about)


def _numberless(reason: str) -> str:
    """A reason without its numbers: an age that grows is no news."""
    return _NUMBERS.sub("#", reason)


_NUMBERS = re.compile(r"[-+]?\d+(?:\.\d+)?")
