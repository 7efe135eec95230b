"""Quick forms of the rows about what nobody should send."""

from __future__ import annotations

from collections import Counter
from contextlib import ExitStack
from typing import Annotated

import msgspec
import numpy as np
import pytest
from msgspec import Meta

from common import codec, topics
from common import messages as m
from common.bus import BusSettings, open_bus, router
from common.clock import monotonic
from evaluation.faults import specimens
from evaluation.faults.decoding import outcome
from evaluation.faults.fuzz import Fuzzer, bombs
from evaluation.faults.result import Verdict
from evaluation.faults.row_05_to_07_what_arrives import EDGES, _judged, edged
from tests.waiting import until

KINDS = {t.name: t for t in topics.TOPICS.values()}.values()


@pytest.mark.parametrize("topic", KINDS, ids=lambda t: t.name)
def test_a_message_made_from_its_type_alone_is_valid_and_whole(topic: topics.Topic) -> None:
    message = specimens.specimen(topic.message, np.random.default_rng(3))
    codec.check(message)
    optional = [f for f in message.__struct_fields__ if getattr(message, f) is None]
    assert not optional


def test_a_field_that_is_added_to_a_message_is_attacked_by_itself() -> None:
    more = msgspec.defstruct(
        "Ego", [("pitch", Annotated[float, Meta(ge=-3.0, le=3.0)], 0.0)], bases=(m.Ego,), frozen=True, kw_only=True
    )
    message = specimens.specimen(more, np.random.default_rng(0))
    assert "pitch" in [p.name for p in specimens.float_places(more, message)]


@pytest.mark.parametrize("topic", KINDS, ids=lambda t: t.name)
def test_fuzzed_messages_are_read_or_refused_and_a_seed_repeats_them(topic: topics.Topic) -> None:
    fuzzer, again = Fuzzer(topic, 5), Fuzzer(topic, 5)
    kinds, outcomes = Counter[str](), Counter[str]()
    for i in range(250):
        attack = fuzzer.next(i)
        assert attack == again.next(i)
        kinds[attack.kind] += 1
        outcomes[outcome(topic, attack)] += 1
    assert not [o for o in outcomes if o.startswith("escaped")]
    assert set(kinds) == {"valid", "random", "mutated", "edge"} and outcomes["accepted"] >= kinds["valid"]
    assert len(outcomes) >= 4


def test_every_fuzzed_message_that_arrives_raises_exactly_one_counter_or_is_used() -> None:
    with ExitStack() as stack:
        connect = BusSettings(connect=(stack.enter_context(router()),))
        a, b = (stack.enter_context(open_bus(connect, "fuzz", name)) for name in "ab")
        readers = [(t, b.inbox(t), a.publisher(t), Fuzzer(t, 9)) for t in (topics.OBJECTS, topics.MAP)]
        for topic, inbox, out, _ in readers:
            until(lambda out=out: out._raw.matching_status.matching, what="a reader") if topic.rate_hz else None
            assert inbox.take() is None
        sent = 150
        for i in range(sent):
            for topic, inbox, out, fuzzer in readers:
                attack = fuzzer.next(monotonic())
                out.put_raw(attack.attachment, attack.payload, topic.encoding)
                if i % 3:  # every third is overwritten, if it comes in time
                    until(lambda inbox=inbox: inbox.waiting, within_s=1.0, what="it") if i % 20 == 1 else None
                    inbox.take()
        for topic, inbox, _, _ in readers:
            until(lambda inbox=inbox: inbox._monitor.view(monotonic()).received >= sent, what="all of them")
            while inbox.waiting:
                inbox.take()
            seen = inbox._monitor.view(monotonic())
            counted = sum(n for name, n in b.counters.items() if name.startswith(f"{topic.suffix}:"))
            assert seen.received == seen.used + counted and seen.used > 0 and counted > 0


@pytest.mark.parametrize("topic", topics.TOPICS.values(), ids=lambda t: t.suffix)
def test_numbers_that_are_none_are_refused_by_the_name_of_their_field(topic: topics.Topic) -> None:
    verdict, counts = Verdict(), Counter[str]()
    message = specimens.of(topic, np.random.default_rng(1))
    for place in specimens.float_places(topic.message, message):
        for value in EDGES:
            counts[_judged(topic, place, value, edged(topic, message, place, value), verdict)] += 1
    assert not verdict.missed
    assert counts["refused"] > 0 or topic is topics.CLOSURES


@pytest.mark.parametrize("topic", [topics.EGO, topics.MAP, topics.RISK, topics.PLAN], ids=lambda t: t.suffix)
def test_bombs_are_refused(topic: topics.Topic) -> None:
    small = [b for b in bombs(topic) if len(b.payload) < 2_000_000]
    assert len(small) > 20
    for bomb in small:
        found = outcome(topic, bomb)
        assert found.isidentifier() and found != "accepted", (bomb.kind, found)
