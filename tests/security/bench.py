"""A secured router with certificates of its own, and ways in for those who belong and those who do not."""

from __future__ import annotations

import datetime
import json
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import zenoh
from cryptography.hazmat.primitives.asymmetric import ec

from common import bus_config, codec, topics
from common import messages as m
from common.bus import Bus, BusSettings, Inbox, Publisher, open_bus, router
from common.bus_config import Secured, TlsSettings
from common.clock import monotonic
from rig import certificates
from tests import samples
from tests.waiting import until

VEHICLE = "ego"
DAY = datetime.timedelta(days=1)


@dataclass
class Bench:
    """Certificates, and the router that believes them."""

    folder: Path
    endpoint: str = ""
    _made: int = field(default=0)

    def settings(self, role: str, endpoint: str = "") -> BusSettings:
        return BusSettings(connect=(endpoint or self.endpoint,), tls=TlsSettings.of(self.folder / role))

    def signed(self, name: str, *, expires: datetime.timedelta = DAY, hosts: tuple[str, ...] = ()) -> TlsSettings:
        """A certificate of our authority for any name and time."""
        now = datetime.datetime.now(datetime.UTC)
        authority = certificates._load(self.folder / "ca")
        key = ec.generate_private_key(ec.SECP256R1())
        certificate = certificates.sign(
            authority, key, name, now - 2 * DAY, now + expires, hosts=[certificates.host_name(h) for h in hosts]
        )
        self._made += 1
        out = self.folder / f"other-{self._made}"
        pem = {
            "ca.pem": certificates._pem(authority.certificate),
            "certificate.pem": certificates._pem(certificate),
        }
        certificates._write(out, pem, key, None)
        return TlsSettings.of(out)

    @contextmanager
    def joined(self, role: str) -> Iterator[Bus]:
        with open_bus(self.settings(role), VEHICLE, role, wait_s=20) as bus:
            yield bus


@contextmanager
def bench(folder: Path) -> Iterator[Bench]:
    certificates.make(folder, VEHICLE, DAY)
    tls = TlsSettings.of(folder / "router")
    with router(settings=BusSettings(tls=tls), secured=Secured((VEHICLE,))) as endpoint:
        yield Bench(folder, endpoint)


def attempt(settings: BusSettings, **changes: Any) -> zenoh.Session:
    """One attempt to open a session without our bus around it.

    `changes` replace keys of Zenoh's TLS section, None removes one. Raises ZError if it is not let in in time.
    """
    config = bus_config.client(settings)
    tls = config["transport"]["link"].get("tls", {}) | changes
    config["transport"]["link"]["tls"] = {k: v for k, v in tls.items() if v is not None}
    return zenoh.open(zenoh.Config.from_json5(json.dumps(config)))


def session(settings: BusSettings) -> zenoh.Session:
    """A session of somebody who is let in, however busy the machine is."""

    def opened() -> zenoh.Session | None:
        try:
            return attempt(settings)
        except zenoh.ZError:
            return None

    return until(opened, within_s=30, what="a session")


def refused(settings: BusSettings, **changes: Any) -> bool:
    """Whether a session cannot even be opened; one that opens tries to put an `ego`."""
    try:
        opened = attempt(settings, **changes)
    except zenoh.ZError:
        return True
    with opened:
        put_raw(opened, topics.EGO)
        return not list(opened.info.routers_zid())


def message(topic: topics.Topic) -> m.Message:
    return samples.ALL[topic.suffix]() if topic.suffix in samples.ALL else samples.status(topic.writer)


def raw(topic: topics.Topic, *, boot: str = "b" * 16, seq: int = 0) -> tuple[bytes, bytes]:
    """Payload and header of a good message."""
    payload, body = codec.encode_body(topic, message(topic))
    now = monotonic()
    header = m.Header(
        schema=topic.name, version=(topics.VERSION_MAJOR, topics.VERSION_MINOR), source="raw", boot=boot, seq=seq,
        capture_ns=now, sent_ns=now, age_ns=0, body=body,
    )  # fmt: skip
    return payload, codec.encode_header(topic, header)


def put_raw(opened: zenoh.Session, topic: topics.Topic, vehicle: str = VEHICLE) -> None:
    payload, header = raw(topic)
    opened.put(topics.key(vehicle, topic), payload, attachment=header)


def arrived(inbox: Inbox) -> int:
    """How many messages reached this inbox, used or not."""
    return inbox._monitor.view(monotonic()).received


def control(publisher: Publisher, inbox: Inbox) -> None:
    """The positive control: what is allowed does arrive, with nothing else in between or before it."""
    topic = publisher.topic
    if topic.delivery is topics.Delivery.LATEST:
        until(lambda: publisher._raw.matching_status.matching, what=f"a reader of {topic.suffix}")
    before = arrived(inbox)
    publisher.put(message(topic), capture_ns=monotonic())
    until(lambda: arrived(inbox) > before, what=f"the {topic.suffix} of its rightful sender")
