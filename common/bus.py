"""The bus: the only file that imports zenoh.

Latest-only inboxes (a callback that swaps one slot and counts what it overwrites), latched topics for late joiners
and late publishers, publishers that write the header, liveliness, and a loopback router for runs on one machine.
Decoding happens in the receiver's own thread, in `Inbox.take`: nothing that arrives can hurt a Zenoh thread.
"""

from __future__ import annotations

import hashlib
import json
import logging
import math
import secrets
import socket
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import zenoh

from common import bus_config, codec
from common.age import TransitClock
from common.bus_config import BusSettings as BusSettings
from common.bus_config import Secured
from common.clock import Clock, monotonic
from common.codec import RefusedError
from common.config import ConfigError
from common.health import Health
from common.messages import Cause, Header, Message, Stamped, StepInputs
from common.order import Order
from common.topics import VERSION_MAJOR, VERSION_MINOR, Delivery, Topic, alive_key, checked_vehicle, key

log = logging.getLogger("forefield.bus")

OLDEST_NS = 2**61
"""No age is counted beyond this [ns]: what is told of a latched message must fit into headers again."""


class NoRouterError(Exception):
    """The router was not reached before the caller stopped waiting."""


def _client(settings: BusSettings) -> zenoh.Config:
    if settings.zenoh_config:
        path = Path(settings.zenoh_config)
        if not path.is_file():
            raise ConfigError(f"bus.zenoh_config: {path}: no such file")
        try:
            return zenoh.Config.from_file(str(path))
        except zenoh.ZError as e:
            raise ConfigError(f"bus.zenoh_config: {path}: {e}") from None
    return zenoh.Config.from_json5(json.dumps(bus_config.client(settings)))


class Inbox:
    """The newest message of one topic, or the newest few in order. Made by `Bus.inbox`; used by one thread."""

    def __init__(
        self, topic: Topic, health: Health, clock: Clock, wake: threading.Event, transit: TransitClock, keep: int = 1
    ) -> None:
        self.topic = topic
        self.latest: Stamped[Any] | None = None
        self._monitor = health.input(topic)
        self._health = health
        self._clock = clock
        self._wake = wake
        self._transit = transit
        self._order = Order()
        self._lock = threading.Lock()
        self._slots: deque[tuple[zenoh.Sample, int]] = deque(maxlen=keep)
        self._standing: tuple[bytes, Message] | None = None

    def arrive(self, sample: zenoh.Sample) -> None:
        """Put it in a slot, the oldest's if none is free; called from a Zenoh thread."""
        now = self._clock()
        with self._lock:
            overwritten = len(self._slots) == self._slots.maxlen
            self._slots.append((sample, now))
            self._monitor.arrived(now)
        if overwritten:
            self._health.count(f"{self.topic.suffix}:overwritten")
        self._wake.set()

    @property
    def waiting(self) -> int:
        """How many messages are kept that were not taken yet."""
        return len(self._slots)

    def take(self) -> Stamped[Any] | None:
        """The oldest message kept that was not taken yet; None if there is none or it is refused (and counted)."""
        with self._lock:
            if not self._slots:
                return None
            slot = self._slots.popleft()
        try:
            self.latest = self._read(*slot)
        except RefusedError as e:
            self._monitor.refused()
            self._health.count(f"{self.topic.suffix}:{e.reason}")
            log.debug("%s refused: %s", self.topic.suffix, e)
            return None
        except Exception as e:  # a mistake of ours: whatever arrives, it must not end the process
            self._monitor.refused()
            self._health.count(f"{self.topic.suffix}:failed_{type(e).__name__}")
            log.exception("%s could not be read", self.topic.suffix)
            return None
        self._monitor.accepted(self.latest.capture_ns)
        return self.latest

    def superseded(self) -> None:
        """Of the last two messages taken nobody looked at the older: it was overwritten, and counts as nothing else."""
        self._monitor.superseded()
        self._health.count(f"{self.topic.suffix}:overwritten")

    def fresh(self, now_ns: int) -> Stamped[Any] | None:
        """The last good message if it is not older than its topic allows."""
        limit = self.topic.max_age_s
        if self.latest is None or (limit is not None and not self.latest.age_s(now_ns) <= limit):
            return None
        return self.latest

    def _read(self, sample: zenoh.Sample, received_ns: int) -> Stamped[Any]:
        if sample.kind != zenoh.SampleKind.PUT:
            raise RefusedError("not_a_put")
        attachment = sample.attachment
        if attachment is not None and len(attachment) > self.topic.max_header_bytes:
            raise RefusedError("header_too_large", f"{len(attachment)} bytes")
        if len(sample.payload) > self.topic.max_bytes:
            raise RefusedError("too_large", f"{len(sample.payload)} bytes, at most {self.topic.max_bytes}")
        header = codec.decode_header(self.topic, None if attachment is None else attachment.to_bytes())
        self._order.check(header)
        excess_ns = self._transit.excess_ns(header.source, header.boot, header.sent_ns, received_ns)
        age_ns = min(header.age_ns + excess_ns, OLDEST_NS)
        capture_ns = received_ns - age_ns
        limit = self.topic.max_age_s
        # who keeps several wants each as it came; who keeps one wants it now
        now = self._clock() if self._slots.maxlen == 1 else received_ns
        if limit is not None and not (now - capture_ns) * 1e-9 <= limit:
            raise RefusedError("stale", f"{(now - capture_ns) * 1e-6:.0f} ms, at most {limit * 1e3:.0f} ms")
        message = self._body(header, sample.payload.to_bytes())
        self._order.accept(header)
        return Stamped(
            message, capture_ns, received_ns, header.cause, header.source, header.boot, header.seq, header.work_ns
        )

    def _body(self, header: Header, payload: bytes) -> Message:
        """What a payload says; what stands (a map) and is only said again remains the object that it was.

        So who makes something of a map may know it by identity, however often it is sent.
        """
        if self.topic.delivery is not Delivery.LATCHED:
            return codec.decode_body(self.topic, header, payload)
        digest = hashlib.blake2b(payload, digest_size=32).digest()
        if self._standing is None or self._standing[0] != digest:
            self._standing = digest, codec.decode_body(self.topic, header, payload)
        return self._standing[1]


@dataclass(frozen=True)
class Raw:
    """A message as it travels."""

    topic: Topic
    attachment: bytes | None
    """The packed header."""
    payload: bytes
    encoding: str
    received_ns: int
    """When it arrived, on the receiver's monotonic clock [ns]."""


class Publisher:
    """Sends one topic. Made by `Bus.publisher`."""

    def __init__(self, topic: Topic, raw: Any, source: str, boot: str, clock: Clock) -> None:
        self.topic = topic
        self._raw = raw
        self._source = source
        self._boot = boot
        self._clock = clock
        self._seq = 0
        self._lock = threading.Lock()
        self.last_work_ns = 0

    def put(
        self, message: Message, *, capture_ns: int, cause: Cause | None = None, arrived_ns: int | None = None,
        step: StepInputs | None = None,
    ) -> Cause:  # fmt: skip
        """Send a message.

        Args:
            message: the body; it passes the same checks as what arrives.
            capture_ns: when its content was true, on this process' monotonic clock [ns].
            cause: the `objects` message that it descends from.
            arrived_ns: when the input that it rests on arrived [ns]; gives `work_ns`.
            step: what the step that made it had before it.

        Returns:
            Boot and sequence number of this message: the cause of what will descend from it.

        Raises:
            RefusedError: the message breaks its contract; nothing was sent.
        """
        payload, body = codec.encode_body(self.topic, message)
        with self._lock:
            now = self._clock()
            header = Header(
                schema=self.topic.name,
                version=(VERSION_MAJOR, VERSION_MINOR),
                source=self._source,
                boot=self._boot,
                seq=self._seq,
                capture_ns=capture_ns,
                sent_ns=now,
                age_ns=max(now - capture_ns, 0),
                work_ns=0 if arrived_ns is None else max(now - arrived_ns, 0),
                cause=cause,
                step=step,
                body=body,
            )
            self._raw.put(payload, attachment=codec.encode_header(self.topic, header))
            self._seq += 1
            self.last_work_ns = header.work_ns
            return Cause(self._boot, header.seq)

    def skip(self) -> None:
        """Leave a number out: what was made but not sent is missing for whoever repeats a recording."""
        with self._lock:
            self._seq += 1

    def put_raw(self, attachment: bytes | None, payload: bytes, encoding: str) -> None:
        """Send what was recorded, as it is: nothing is checked here, the receivers do."""
        self._raw.put(payload, attachment=attachment, encoding=encoding)


class Bus:
    """One session on the bus. Open it with `open_bus`, in a `with`."""

    def __init__(self, session: zenoh.Session, vehicle: str, source: str, clock: Clock, health: Health) -> None:
        self.vehicle = vehicle
        self.source = source
        self.boot = secrets.token_hex(8)
        self.health = health
        self._session = session
        self._clock = clock
        self._wake = threading.Event()
        self._transit = TransitClock()
        self._held: list[Any] = []

    @property
    def counters(self) -> dict[str, int]:
        """`topic:reason` → how many messages were not used."""
        return dict(self.health.counters)

    def inbox(self, topic: Topic, *, keep: int = 1) -> Inbox:
        """Subscribe to a topic, keeping only its newest message; `keep` > 1, for who records: so many, in order."""
        inbox = Inbox(topic, self.health, self._clock, self._wake, self._transit, keep)
        self._subscribe(topic, inbox.arrive)
        return inbox

    def watch(self, topic: Topic, seen: Callable[[Header, int], None]) -> None:
        """Tell `seen`, in a Zenoh thread, header and arrival [ns] of every message of a topic; bodies stay unread.

        What stands on a latched topic is told too.
        """

        def arrive(sample: zenoh.Sample) -> None:
            now = self._clock()
            attachment = sample.attachment
            with suppress(RefusedError):  # what an inbox refuses is counted there
                seen(codec.decode_header(topic, None if attachment is None else attachment.to_bytes()), now)

        self._subscribe(topic, arrive)

    def tap(self, topic: Topic, heard: Callable[[Raw], None]) -> None:
        """Tell `heard`, in a Zenoh thread, every message of a topic as it came: unread, unchecked, none left out."""

        def arrive(sample: zenoh.Sample) -> None:
            now = self._clock()
            if sample.kind == zenoh.SampleKind.PUT:
                attachment = sample.attachment
                heard(
                    Raw(
                        topic,
                        None if attachment is None else attachment.to_bytes(),
                        sample.payload.to_bytes(),
                        str(sample.encoding),
                        now,
                    )
                )

        self._subscribe(topic, arrive)

    def _subscribe(self, topic: Topic, arrive: Callable[[zenoh.Sample], None]) -> None:
        k = key(self.vehicle, topic)
        if topic.delivery is Delivery.LATCHED:
            history = zenoh.ext.HistoryConfig(detect_late_publishers=True, max_samples=1)
            self._held.append(zenoh.ext.declare_advanced_subscriber(self._session, k, arrive, history=history))
        else:
            self._held.append(self._session.declare_subscriber(k, arrive))

    def publisher(self, topic: Topic) -> Publisher:
        """Prepare to send a topic."""
        options: dict[str, Any] = {
            "encoding": topic.encoding,
            "priority": getattr(zenoh.Priority, topic.priority.value),
            "congestion_control": zenoh.CongestionControl.BLOCK if topic.wait else zenoh.CongestionControl.DROP,
        }
        k = key(self.vehicle, topic)
        raw: Any
        if topic.delivery is Delivery.LATCHED:
            raw = zenoh.ext.declare_advanced_publisher(
                self._session, k, cache=zenoh.ext.CacheConfig(max_samples=1), publisher_detection=True, **options
            )
        else:
            raw = self._session.declare_publisher(k, express=True, **options)
        self._held.append(raw)
        return Publisher(topic, raw, self.source, self.boot, self._clock)

    def wait(self, timeout_s: float) -> bool:
        """Sleep until something arrives or the time is over; returns whether something arrived."""
        arrived = self._wake.wait(max(timeout_s, 0.0))
        self._wake.clear()
        return arrived

    def interrupt(self) -> None:
        """End a `wait` now."""
        self._wake.set()

    def liveliness(self, service: str) -> None:
        """Show the token `alive/{service}` for as long as this session is open."""
        self._held.append(self._session.liveliness().declare_token(alive_key(self.vehicle, service)))

    def alive(self) -> set[str]:
        """Services whose token is seen now."""
        found = set()
        for reply in self._session.liveliness().get(
            alive_key(self.vehicle, "any").removesuffix("any") + "*", timeout=1.0
        ):
            if reply.ok is not None:
                found.add(str(reply.ok.key_expr).rsplit("/", 1)[-1])
        return found

    def close(self) -> None:
        """Undeclare everything and close the session; errors of a link already gone are not ours to report."""
        for held in reversed(self._held):
            with suppress(zenoh.ZError):
                held.undeclare()
        self._held.clear()
        with suppress(zenoh.ZError):
            self._session.close()  # type: ignore[no-untyped-call]


@contextmanager
def open_bus(
    settings: BusSettings,
    vehicle: str,
    source: str,
    *,
    clock: Clock = monotonic,
    health: Health | None = None,
    stop: threading.Event | None = None,
    wait_s: float = math.inf,
) -> Iterator[Bus]:
    """Open a session; the router may come later and may restart.

    Args:
        settings: section `[bus]`.
        vehicle: second part of every key.
        source: name of this process, stated in every header.
        clock: monotonic clock [ns].
        health: where arrivals and refusals are counted; a new one if None.
        stop: gives up waiting for the router once set.
        wait_s: gives up after this long [s].

    Raises:
        ConfigError: the Zenoh configuration or the vehicle's name cannot be used.
        NoRouterError: no router within `wait_s`, or `stop` was set.
    """
    try:
        checked_vehicle(vehicle)
    except ValueError as e:
        raise ConfigError(str(e)) from None
    session = _connect(settings, stop or threading.Event(), wait_s)
    bus = Bus(session, vehicle, source, clock, health or Health(source, clock))
    try:
        yield bus
    finally:
        bus.close()


def _connect(settings: BusSettings, stop: threading.Event, wait_s: float) -> zenoh.Session:
    where = settings.zenoh_config or ", ".join(settings.connect)
    end = time.monotonic() + wait_s
    told = False
    while True:
        config = _client(settings)
        try:
            return zenoh.open(config)
        except zenoh.ZError as e:
            if stop.is_set() or time.monotonic() >= end:
                raise NoRouterError(f"no router at {where}: is it running, and is bus.connect right?") from None
            if not told:
                log.warning("waiting for the router at %s (%s)", where, str(e).split(" at /")[0])
                told = True
        stop.wait(0.1)


def free_port() -> int:
    """A TCP port on loopback that is free now."""
    with socket.socket() as s:
        s.bind(("127.0.0.1", 0))
        return int(s.getsockname()[1])


@contextmanager
def router(
    port: int = 0,
    *,
    listen: str = "",
    settings: BusSettings | None = None,
    secured: Secured | None = None,
    upstream: Sequence[str] = (),
) -> Iterator[str]:
    """Run a Zenoh router in this process; yields its endpoint.

    Args:
        port: TCP port on loopback; 0: a free one.
        listen: a whole endpoint instead, such as `tcp/0.0.0.0:7447`.
        settings: lease, shared memory, TLS.
        secured: whom to let in, by certificate, each on its own topics alone; None: everyone.
        upstream: endpoints of other routers to join, such as the one at the edge; they may come and go.

    Raises:
        ConfigError: the endpoint cannot be listened on, TLS or a name cannot be used.
    """
    settings = settings or BusSettings()
    protocol = "tls" if settings.tls.wanted else "tcp"
    endpoint = listen or f"{protocol}/127.0.0.1:{port or free_port()}"
    config = bus_config.router(endpoint, settings, secured, upstream)
    try:
        session = zenoh.open(zenoh.Config.from_json5(json.dumps(config)))
    except zenoh.ZError as e:
        raise ConfigError(f"cannot listen on {endpoint}: {e}; is another router running there?") from None
    try:
        yield endpoint
    finally:
        with suppress(zenoh.ZError):
            session.close()  # type: ignore[no-untyped-call]
