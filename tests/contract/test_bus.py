"""Over a real Zenoh router: latest only, latched, refused by name, counted once, alive or not."""

from __future__ import annotations

import json
import threading
from collections.abc import Iterator
from contextlib import ExitStack
from typing import Any

import numpy as np
import pytest
import zenoh

from common import codec, topics
from common import messages as m
from common.bus import Bus, BusSettings, Inbox, NoRouterError, free_port, open_bus, router
from common.clock import monotonic
from common.config import ConfigError
from tests import samples
from tests.contract.test_codec import equal, header
from tests.waiting import until

MS = 1_000_000


@pytest.fixture(scope="module")
def endpoint() -> Iterator[str]:
    with router() as e:
        yield e


@pytest.fixture
def pair(endpoint: str) -> Iterator[tuple[Bus, Bus]]:
    settings = BusSettings(connect=(endpoint,))
    with open_bus(settings, "test", "sender") as a, open_bus(settings, "test", "receiver") as b:
        yield a, b


def received(inbox: Inbox, n: int) -> None:
    until(lambda: inbox._monitor.view(monotonic()).received >= n, what=f"message {n} on {inbox.topic.suffix}")


def matched(publisher: Any) -> None:
    until(lambda: publisher._raw.matching_status.matching, what="a matching subscriber")


@pytest.mark.parametrize("name", samples.ALL)
def test_every_message_crosses_the_bus_unchanged(pair: tuple[Bus, Bus], name: str) -> None:
    sender, receiver = pair
    topic = topics.TOPICS[name]
    inbox, publisher = receiver.inbox(topic), sender.publisher(topic)
    if topic.delivery is topics.Delivery.LATEST:
        matched(publisher)
    cause = m.Cause("c" * 16, 4)
    began = monotonic()
    publisher.put(samples.ALL[name](), capture_ns=began - 20 * MS, cause=cause, arrived_ns=began)
    received(inbox, 1)
    stamped = inbox.take()
    assert stamped is not None
    assert equal(stamped.value, samples.ALL[name]())
    assert (stamped.cause, stamped.source, stamped.boot, stamped.seq) == (cause, "sender", sender.boot, 0)
    assert 0.02 <= stamped.age_s(monotonic()) < 5.0
    assert inbox.take() is None, "a message is taken once"
    assert equal(inbox.latest.value, samples.ALL[name]()) if inbox.latest else False


def test_an_inbox_keeps_the_newest_and_counts_what_it_overwrites(pair: tuple[Bus, Bus]) -> None:
    sender, receiver = pair
    inbox, publisher = receiver.inbox(topics.EGO), sender.publisher(topics.EGO)
    matched(publisher)
    for i in range(50):
        publisher.put(samples.ego(x=float(i)), capture_ns=monotonic())
        received(inbox, i + 1)  # one by one: what is put faster than it travels is dropped on the way
    stamped = inbox.take()
    assert stamped is not None and stamped.value.x == 49.0 and stamped.seq == 49
    assert receiver.counters == {"ego:overwritten": 49}


def test_an_inbox_that_keeps_several_gives_them_in_order_and_loses_the_oldest(pair: tuple[Bus, Bus]) -> None:
    sender, receiver = pair
    inbox, publisher = receiver.inbox(topics.EGO, keep=8), sender.publisher(topics.EGO)
    matched(publisher)
    for i in range(20):
        publisher.put(samples.ego(x=float(i)), capture_ns=monotonic())
        received(inbox, i + 1)
    assert inbox.waiting == 8
    taken = [inbox.take() for _ in range(8)]
    assert [s.value.x for s in taken if s is not None] == [float(i) for i in range(12, 20)]
    assert inbox.waiting == 0 and inbox.take() is None
    assert receiver.counters == {"ego:overwritten": 12}


def test_what_was_kept_is_as_old_as_when_it_came(pair: tuple[Bus, Bus], endpoint: str) -> None:
    now = monotonic()
    ahead = [now]
    settings = BusSettings(connect=(endpoint,))
    sender, _ = pair
    with open_bus(settings, "test", "recorder", clock=lambda: ahead[0]) as recorder:
        one, several = recorder.inbox(topics.EGO), recorder.inbox(topics.EGO, keep=8)
        publisher = sender.publisher(topics.EGO)
        matched(publisher)
        until(lambda: publisher.put(samples.ego(), capture_ns=monotonic()) and one.waiting and several.waiting)
        ahead[0] += 10_000 * MS
        assert one.take() is None, "whoever keeps one wants it now"
        assert several.take() is not None


@pytest.mark.parametrize("late", ["subscriber", "publisher"])
def test_the_map_reaches_whoever_comes_late(endpoint: str, late: str) -> None:
    settings = BusSettings(connect=(endpoint,))
    vehicle = f"late-{late}"
    with ExitStack() as stack:
        if late == "subscriber":
            vehicle_bus = stack.enter_context(open_bus(settings, vehicle, "vehicle"))
            publisher = vehicle_bus.publisher(topics.MAP)
            publisher.put(m.Map(), capture_ns=monotonic())
            publisher.put(samples.world(), capture_ns=monotonic())
        receiver = stack.enter_context(open_bus(settings, vehicle, "planner"))
        inbox = receiver.inbox(topics.MAP)
        if late == "publisher":
            vehicle_bus = stack.enter_context(open_bus(settings, vehicle, "vehicle"))
            vehicle_bus.publisher(topics.MAP).put(samples.world(), capture_ns=monotonic() - 10**12)
        until(lambda: inbox.take() or (inbox.latest is not None), what="the latched map")
        assert inbox.latest is not None
        until(lambda: inbox.take() or len(inbox.latest.value.lanes) == 2, what="the newest map")


def test_a_map_that_is_sent_again_stays_the_object_that_it_was(pair: tuple[Bus, Bus]) -> None:
    sender, receiver = pair
    inbox, publisher = receiver.inbox(topics.MAP), sender.publisher(topics.MAP)
    other = m.Map(lanes=[samples.lane(7)])
    taken = []
    for n, world in enumerate([samples.world(), samples.world(), other, samples.world()], start=1):
        publisher.put(world, capture_ns=monotonic())
        received(inbox, n)
        stamped = inbox.take()
        assert stamped is not None and stamped.seq == n - 1 and equal(stamped.value, world)
        taken.append(stamped.value)
    assert taken[1] is taken[0] and taken[2] is not taken[0]


def raw_put(endpoint: str, topic: topics.Topic, payload: bytes, attachment: bytes | None) -> None:
    config = zenoh.Config.from_json5(
        json.dumps(
            {"mode": "client", "connect": {"endpoints": [endpoint]}, "scouting": {"multicast": {"enabled": False}}}
        )
    )
    with zenoh.open(config) as session:
        publisher = session.declare_publisher(topics.key("test", topic))
        until(lambda: publisher.matching_status.matching, what="a matching subscriber")
        publisher.put(payload, attachment=attachment)


def packed(**changes: Any) -> tuple[bytes, bytes]:
    now = monotonic()
    payload, _ = codec.encode_body(topics.EGO, samples.ego())
    fields = {"capture_ns": now, "sent_ns": now, "age_ns": 0, "cause": None, **changes}
    return payload, codec.encode_header(topics.EGO, header(topics.EGO, **fields))


@pytest.mark.parametrize(
    ("payload", "attachment", "reason"),
    [
        (b"\xc1\xc1", packed()[1], "malformed"),
        (bytes(5000), packed()[1], "too_large"),
        (packed()[0], None, "header_missing"),
        (packed()[0], b"junk", "header_malformed"),
        (packed()[0], bytes(9000), "header_too_large"),
        (packed()[0], packed(version=(2, 0))[1], "version"),
        (packed()[0], packed(schema="risk")[1], "schema"),
        (packed()[0], packed(age_ns=250 * MS)[1], "stale"),
        (codec.encode_body(topics.EGO, samples.ego())[0].replace(b"\xcb" + bytes(8), b"\xcb\x7f\xf8" + bytes(6), 1),
         packed()[1], "range"),
    ],
    ids=["malformed", "oversized", "no header", "junk header", "large header", "old version", "schema", "stale", "nan"],
)  # fmt: skip
def test_what_cannot_be_used_is_refused_under_its_name_and_harms_nothing(
    pair: tuple[Bus, Bus], endpoint: str, payload: bytes, attachment: bytes | None, reason: str
) -> None:
    sender, receiver = pair
    inbox = receiver.inbox(topics.EGO)
    raw_put(endpoint, topics.EGO, payload, attachment)
    received(inbox, 1)
    assert inbox.take() is None
    assert receiver.counters == {f"ego:{reason}": 1}
    publisher = sender.publisher(topics.EGO)
    matched(publisher)
    publisher.put(samples.ego(x=5.0), capture_ns=monotonic())
    received(inbox, 2)
    good = inbox.take()
    assert good is not None and good.value.x == 5.0


def test_a_latched_message_of_any_age_leaves_no_age_that_headers_cannot_tell(
    pair: tuple[Bus, Bus], endpoint: str
) -> None:
    _, receiver = pair
    inbox = receiver.inbox(topics.MAP)
    payload, _ = codec.encode_body(topics.MAP, samples.world())
    for n, sent_ns in enumerate([2**62, -(2**62)], start=1):  # the second seems to have travelled for centuries
        head = header(topics.MAP, seq=n, capture_ns=0, sent_ns=sent_ns, age_ns=2**62, cause=None)
        raw_put(endpoint, topics.MAP, payload, codec.encode_header(topics.MAP, head))
        received(inbox, n)
        map_ = inbox.take()
        assert map_ is not None
        now = monotonic()
        used = m.StepInputs(now, [m.Used("map", map_.boot, map_.seq, map_.capture_ns, True)])
        told = header(topics.PLAN, capture_ns=map_.capture_ns, age_ns=now - map_.capture_ns, step=used)
        assert codec.decode_header(topics.PLAN, codec.encode_header(topics.PLAN, told)).step == used


def test_a_repeated_message_is_used_once(pair: tuple[Bus, Bus], endpoint: str) -> None:
    _, receiver = pair
    inbox = receiver.inbox(topics.EGO)
    payload, attachment = packed()
    for n in (1, 2):
        raw_put(endpoint, topics.EGO, payload, attachment)
        received(inbox, n)
        assert (inbox.take() is not None) == (n == 1)
    assert receiver.counters == {"ego:duplicate": 1}


def test_a_restarted_sender_is_heard_and_its_former_life_is_not(pair: tuple[Bus, Bus], endpoint: str) -> None:
    _, receiver = pair
    inbox = receiver.inbox(topics.EGO)
    for n, boot in enumerate(["a" * 16, "b" * 16, "a" * 16], start=1):
        payload, attachment = packed(boot=boot, seq=n)
        raw_put(endpoint, topics.EGO, payload, attachment)
        received(inbox, n)
        assert (inbox.take() is not None) == (n < 3)
    assert receiver.counters == {"ego:old_boot": 1}


def test_vehicles_on_one_router_do_not_hear_each_other(endpoint: str) -> None:
    settings = BusSettings(connect=(endpoint,))
    with open_bus(settings, "one", "a") as one, open_bus(settings, "two", "b") as two:
        mine, other = one.inbox(topics.EGO), two.inbox(topics.EGO)
        publisher = one.publisher(topics.EGO)
        matched(publisher)
        publisher.put(samples.ego(), capture_ns=monotonic())
        received(mine, 1)
        assert mine.take() is not None
        assert other.take() is None and two.counters == {}


def test_nothing_that_breaks_its_contract_leaves_and_the_sequence_has_no_hole(pair: tuple[Bus, Bus]) -> None:
    sender, receiver = pair
    inbox, publisher = receiver.inbox(topics.OBJECTS), sender.publisher(topics.OBJECTS)
    matched(publisher)
    with pytest.raises(codec.RefusedError, match="non_finite"):
        publisher.put(samples.objects(x=np.array([0.0, np.nan, 1.0])), capture_ns=monotonic())
    publisher.put(samples.objects(), capture_ns=monotonic())
    received(inbox, 1)
    stamped = inbox.take()
    assert stamped is not None and stamped.seq == 0


def test_a_service_is_seen_alive_until_its_session_ends(endpoint: str) -> None:
    settings = BusSettings(connect=(endpoint,))
    with open_bus(settings, "life", "watcher") as watcher:
        with open_bus(settings, "life", "planner") as planner:
            planner.liveliness("planner")
            until(lambda: watcher.alive() == {"planner"}, what="the token")
        until(lambda: watcher.alive() == set(), what="the token's end")


def test_a_client_started_before_its_router_finds_it_and_survives_its_restart() -> None:
    port = free_port()
    settings = BusSettings(connect=(f"tcp/127.0.0.1:{port}",))
    got: list[float] = []
    ready, stop = threading.Event(), threading.Event()

    def receiver() -> None:
        with open_bus(settings, "early", "b") as b:
            inbox = b.inbox(topics.EGO)
            ready.set()
            while not stop.is_set():
                b.wait(0.05)
                if (stamped := inbox.take()) is not None:
                    got.append(stamped.value.x)

    thread = threading.Thread(target=receiver, daemon=True)
    thread.start()
    assert not ready.wait(0.8), "no router yet"
    with router(port), open_bus(settings, "early", "a") as a:
        publisher = a.publisher(topics.EGO)

        def heard(x: float) -> bool:
            publisher.put(samples.ego(x=x), capture_ns=monotonic())
            return x in got

        until(lambda: heard(1.0), within_s=20, every_s=0.05, what="the first life of the router")
    assert ready.is_set()
    with router(port), open_bus(settings, "early", "a") as a:
        publisher = a.publisher(topics.EGO)
        until(lambda: heard(2.0), within_s=20, every_s=0.05, what="the second life of the router")
    stop.set()
    thread.join(10)
    assert not thread.is_alive()


def test_waiting_for_a_router_can_be_given_up() -> None:
    settings = BusSettings(connect=(f"tcp/127.0.0.1:{free_port()}",))
    with pytest.raises(NoRouterError, match="is it running"), open_bus(settings, "early", "a", wait_s=0.1):
        pass


@pytest.mark.parametrize("name", ["", "a/b", "a*", "x" * 65, "ego$"])
def test_a_vehicle_name_that_would_break_the_keys_is_an_error(name: str) -> None:
    with pytest.raises(ValueError, match="vehicle name"):
        topics.key(name, topics.EGO)


def test_a_port_in_use_is_an_error_that_says_so(endpoint: str) -> None:
    with pytest.raises(ConfigError, match="another router"), router(listen=endpoint):
        pass
