"""Rows 5, 6, 7: what nobody should send. Fuzzed messages, numbers that are none, and bombs.

Each is tried on the codec alone, in a process of its own, and on the running services over a real bus.
"""

from __future__ import annotations

import time
from collections import Counter, defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import Any

import msgpack
import msgspec
import numpy as np

from common import codec, topics
from common.bus import Bus, BusSettings, Inbox, Raw, open_bus
from common.codec import RefusedError
from common.messages import Status
from common.topics import STATUS_OF, Topic
from evaluation.faults import specimens
from evaluation.faults.decoding import MIB, alone, outcome, resident
from evaluation.faults.fuzz import Attack, Fuzzer, bombs
from evaluation.faults.result import FaultError, Figure, Row, Say, Scale, Verdict
from evaluation.faults.specimens import FloatPlace
from evaluation.faults.stack import Stack, stack
from evaluation.faults.watch import until
from rig.launcher import SERVICES

INPUTS = (topics.EGO, topics.OBJECTS, topics.MAP, topics.ROUTE, topics.CLOSURES, topics.PREDICTION, topics.RISK)
"""What services read."""
HEARD = (topics.PLAN, STATUS_OF["planner"])
"""What vehicle and rig read: here an inbox of ours stands for them."""
ALL = (*INPUTS, *HEARD)
DECODE_MS = 5.0
GROWTH_MIB = 16.0
BOMB_MIB = 64.0
PAUSE_S = 0.006


# --- row 5 ---


def fuzzing(scale: Scale, seed: int, say: Say) -> Row:
    """Row 5: fuzzed messages on every topic."""
    n = scale.repetitions(10_000, 100_000, 300)
    results: dict[str, dict[str, Any]] = {}
    for topic in ALL:
        found = results[topic.suffix] = alone("fuzz", topic, n, seed)
        say(
            f"codec, {topic.suffix}: {n} messages, p99 {found['p99_cpu_ms']:.2f} ms, max {found['max_ms']:.0f} ms,"
            f" {found['grown_mib']:+.1f} MiB, {found['outcomes'].get('accepted', 0)} accepted"
        )
    m = scale.repetitions(10_000, 100_000, 300)
    with besieged(seed, say) as siege:
        siege.fuzz(m, seed)
        account = siege.account()
    say(f"lost on the way: { {k: v for k, v in account.lost.items() if v} }")
    slowest = max(results.values(), key=lambda r: float(r["p99_cpu_ms"]))
    grown = max(float(r["grown_mib"]) for r in results.values())
    escaped = {k: v for r in results.values() for k, v in r["outcomes"].items() if k.startswith("escaped")}
    attacks: Counter[str] = sum((Counter(r["kinds"]) for r in results.values()), Counter())
    verdict = Verdict()
    verdict.need(not escaped, f"escaped the codec: {escaped}")
    verdict.need(slowest["p99_cpu_ms"] <= DECODE_MS, f"p99 of decoding {slowest['p99_cpu_ms']:.1f} ms")
    verdict.need(grown <= GROWTH_MIB, f"the codec's process grew by {grown:.1f} MiB")
    _judge(verdict, account)
    figures: dict[str, Figure] = {
        "messages decoded": n * len(ALL),
        "of them accepted": sum(r["outcomes"].get("accepted", 0) for r in results.values()),
        "decoding p99, slowest topic, processor time [ms]": slowest["p99_cpu_ms"],
        "and by the clock [ms]": max(r["p99_ms"] for r in results.values()),
        "decoding max [ms]": max(r["max_ms"] for r in results.values()),
        "codec's process grown by [MiB]": grown,
        **account.figures(),
    }
    proof = f"{', '.join(f'{v} {k}' for k, v in attacks.items())} decoded, seed {seed}; {account.proof()}"
    fault = f"{n} fuzzed messages a topic through the codec, {m} a topic over the bus into running services"
    target = "0 exits; every message accounted for by exactly one counter; p99 of decoding one ≤ 5 ms; memory + ≤ 16 MB"
    return verdict.row(5, fault, target, figures, proof)


# --- row 6 ---

EDGES = (
    np.nan, np.inf, -np.inf, -0.0, 5e-324, 1e-310, 1e38, -1e38,
)  # fmt: skip


def numbers(scale: Scale, seed: int, say: Say) -> Row:
    """Row 6: numbers that are none, or nearly none, in each float field of each message."""
    rng = np.random.default_rng(seed)
    verdict, counts = Verdict(), Counter[str]()
    sent: list[tuple[Topic, Attack]] = []
    for topic in topics.TOPICS.values():
        message = specimens.of(topic, rng)
        for place in specimens.float_places(topic.message, message):
            for value in EDGES:
                attack = edged(topic, message, place, value)
                counts[_judged(topic, place, value, attack, verdict)] += 1
                if topic in INPUTS:
                    sent.append((topic, attack))
    say(f"codec: {counts.total()} messages: {dict(counts)}")
    rounds = scale.repetitions(3, 20, 1)
    with besieged(seed, say, heard=()) as siege:
        for i in range(rounds):
            siege.send_all(sent, pause_s=0.012)
            say(f"services: round {i + 1} of {rounds}")
        account = siege.account()
        non_finite, checked = siege.non_finite()
    _judge(verdict, account)
    verdict.need(not non_finite, f"non-finite outputs: {non_finite}")
    verdict.need(checked > 0, "no outputs were seen")
    places = sum(
        1 for t in topics.TOPICS.values()
        for _ in specimens.float_places(t.message, specimens.specimen(t.message, rng))
    )  # fmt: skip
    figures: dict[str, Figure] = {
        "float fields": places, "messages": counts.total(), "refused": counts["refused"],
        "refusals that do not name the field": counts["unnamed"], "allowed edge values": counts["allowed"],
        "outputs checked": checked, "non-finite outputs": len(non_finite), **account.figures(),
    }  # fmt: skip
    fault = f"NaN, ±Inf, −0, subnormal, ±1e38 in each of {places} float fields of {len(topics.TOPICS)} topics"
    proof = f"{counts['refused']} refused by the codec; {account.proof()}"
    return verdict.row(6, fault, "0 non-finite outputs; the refusal names the field", figures, proof)


def edged(topic: Topic, message: Any, place: FloatPlace, value: float) -> Attack:
    """A message with one number at an edge, encoded without any check."""
    fields, raw = specimens.plain(message)
    at: Any = fields
    if raw is not None and place.path == ("volume",):
        cells = np.frombuffer(raw, place.dtype, count=message.volume.size).copy()
        with np.errstate(over="ignore"):
            cells[0] = value
        raw = cells.tobytes() + raw[cells.nbytes :]
    else:
        for step in place.path[:-1]:
            at = at[step]
        last = place.path[-1]
        if place.dtype:
            values = np.frombuffer(at[last]["data"], place.dtype).copy()
            with np.errstate(over="ignore"):
                values[0] = value
            at[last] = {**at[last], "data": values.tobytes()}
        else:
            at[last] = value
    head = specimens.header(topic, fields if raw is not None else None, boot="e" * 16, seq=1, now_ns=0)
    return Attack("edge", msgpack.packb(msgspec.to_builtins(head)), msgpack.packb(fields) if raw is None else raw)


def _judged(topic: Topic, place: FloatPlace, value: float, attack: Attack, verdict: Verdict) -> str:
    """What the codec makes of it: what is not finite must be refused, and a refusal must name the field."""
    where = f"{topic.suffix} {'.'.join(map(str, place.path))} = {value}"
    try:
        codec.decode_body(topic, codec.decode_header(topic, attack.attachment), attack.payload)
    except RefusedError as e:
        # of a map with free keys msgspec names the map; of `problem()` the words name what is wrong
        named = place.name in e.detail or any(str(p) in e.detail for p in place.path if isinstance(p, str))
        if named or e.reason == "content":
            return "refused"
        verdict.need(False, f"{where}: the refusal does not name the field: {e}")
        return "unnamed"
    if not np.isfinite(np.asarray(value, dtype=place.dtype or "f8")):
        verdict.need(False, f"{where} was accepted")
        return "accepted though not finite"
    return "allowed"


# --- row 7 ---


def exploding(scale: Scale, seed: int, say: Say) -> Row:
    """Row 7: bombs."""
    verdict = Verdict()
    peak, worst, refused, total = 0.0, "", 0, 0
    for topic in ALL:
        found = alone("bombs", topic, 1, seed)
        outcomes = Counter(found["outcomes"])
        total += outcomes.total()
        refused += outcomes.total() - outcomes["accepted"]
        say(f"codec, {topic.suffix}: {outcomes.total()} bombs, peak {found['peak_mib']:+.1f} MiB ({found['worst']})")
        if found["peak_mib"] > peak:
            peak, worst = found["peak_mib"], f"{found['worst']} on {topic.suffix}"
        verdict.need(not found["accepted"], f"accepted on {topic.suffix}: {found['accepted']}")
        escaped = [k for k in outcomes if k.startswith("escaped")]
        verdict.need(not escaped, f"escaped on {topic.suffix}: {escaped}")
    verdict.need(peak <= BOMB_MIB, f"{worst} took {peak:.0f} MiB beyond its own bytes")
    rounds = scale.repetitions(2, 20, 1)
    with besieged(seed, say, heard=()) as siege:
        for _ in range(rounds):
            # a message of 64 MB and the copy of it that is read are the transport's; what they claim is not
            small = [
                (t, b) for t in INPUTS for b in bombs(t, siege.boot, time.monotonic_ns()) if len(b.payload) < 4 * MIB
            ]
            siege.send_all(small, pause_s=0.02)
        account = siege.account()
    _judge(verdict, account, BOMB_MIB)
    figures: dict[str, Figure] = {
        "bombs decoded": total, "refused": refused, "peak memory of one beyond its own bytes [MiB]": peak,
        "which": worst, **account.figures(),
    }  # fmt: skip
    fault = (
        "4 G length headers, depth 100 000 and 1 010, nested claims, empty maps and small values to the topic's limit,"
        " shape × itemsize ≠ bytes, dtypes that are none"
    )
    proof = f"{total} bombs decoded, each in a process whose peak was read; {account.proof()}"
    return verdict.row(7, fault, "refused; + ≤ 64 MB; no recursion error escapes", figures, proof)


# --- the services ---


@dataclass
class Account:
    """What became of what was sent: for each reader and topic (received, used, counted by name)."""

    sent: Counter[str]
    reads: dict[tuple[str, str], tuple[int, int, dict[str, int]]]
    unaccounted: dict[str, int]
    lost: dict[str, int]
    grown_mib: dict[str, float]
    """After the first quarter of a fuzz, or from the beginning."""
    in_all_mib: dict[str, float]
    peak_mib: dict[str, float]
    exits: list[str]
    step_errors: dict[str, int] = field(default_factory=dict)

    def figures(self) -> dict[str, Figure]:
        """For the table."""
        received = sum(r for r, _, _ in self.reads.values())
        return {
            "sent over the bus": self.sent.total(),
            "received by services": received,
            "used": sum(u for _, u, _ in self.reads.values()),
            "overwritten": sum(n for *_, c in self.reads.values() for k, n in c.items() if k.endswith(":overwritten")),
            "not accounted for": sum(abs(n) for n in self.unaccounted.values()),
            "lost on the way": sum(self.lost.values()),
            "exits": len(self.exits),
            "exceptions of steps (survived)": sum(self.step_errors.values()),
            "services grown by after the first quarter, most [MiB]": max(self.grown_mib.values(), default=0.0),
            "and from the beginning on [MiB]": max(self.in_all_mib.values(), default=0.0),
            "services' peak, most [MiB]": max(self.peak_mib.values(), default=0.0),
        }

    def proof(self) -> str:
        """How it is known that they arrived."""
        refused = sum(n for *_, c in self.reads.values() for n in c.values())
        return f"services received {sum(r for r, _, _ in self.reads.values())} and counted {refused} as not used"


def _judge(verdict: Verdict, account: Account, grown: float = GROWTH_MIB) -> None:
    verdict.need(not account.exits, f"exits: {account.exits}")
    verdict.need(not any(account.unaccounted.values()), f"not accounted for: {account.unaccounted}")
    worst = max(account.grown_mib, key=lambda k: account.grown_mib[k], default="")
    if worst:
        more = account.grown_mib[worst]
        verdict.need(more <= grown, f"{worst} grew by {more:.0f} MiB")


class Siege:
    """Running services, and somebody on their bus who sends them what nobody should."""

    def __init__(self, s: Stack, bus: Bus, samples: dict[str, list[tuple[bytes, bytes]]], say: Say) -> None:
        self.stack, self.boot, self._say = s, bus.boot, say
        self._samples = samples
        # what waits for room instead of being dropped arrives, and can be accounted for
        self._out = {t.suffix: bus.publisher(replace(t, wait=True)) for t in INPUTS}
        self._sent: Counter[str] = Counter()
        self._heard: dict[str, Inbox] = {}
        self._own: dict[str, Bus] = {}
        self._outputs: list[Raw] = []
        for t in (topics.PREDICTION, topics.RISK, topics.PLAN, *(STATUS_OF[n] for n in SERVICES)):
            s.bus.tap(t, self._output)
        self._begin = {name: self._status(name) for name in SERVICES}
        self._reads = {name: [topics.TOPICS[t] for t in said.inputs] for name, said in self._begin.items()}
        self._rss = {name: resident(pid=s.lives[name].pid) for name in SERVICES}
        self._pids = {name: s.lives[name].pid for name in SERVICES}
        self._warm = dict(self._rss)

    def listen(self, sender: Bus, receiver: Bus, heard: tuple[Topic, ...]) -> None:
        """Inboxes of our own, for what the services do not read."""
        for topic in heard:
            self._heard[topic.suffix] = receiver.inbox(topic)
            self._out[topic.suffix] = sender.publisher(replace(topic, wait=True))
            self._own[topic.suffix] = receiver

    def fuzz(self, count: int, seed: int) -> None:
        """So many fuzzed messages on each topic, in turn."""
        chosen = [t for t in ALL if t.suffix in self._out]
        fuzzers = [Fuzzer(t, seed + 1, self._samples.get(t.suffix, ())) for t in chosen]
        told = time.monotonic()
        for i in range(count):
            for fuzzer in fuzzers:
                self._put(fuzzer.topic, fuzzer.next(time.monotonic_ns()))
            if i == count // 4:  # by now they have seen grids, roads and crowds of every size that comes
                self._warm = {n: resident(pid=pid) for n, pid in self._pids.items()}
            if i % 4 == 0:
                time.sleep(PAUSE_S)
                self._take()
            if time.monotonic() - told > 10.0:
                told = time.monotonic()
                self._say(f"services: {i + 1} of {count} a topic")
                self.stack.check()

    def send_all(self, attacks: list[tuple[Topic, Attack]], pause_s: float) -> None:
        """Each as a newer message of a fresh sender, slowly enough to be looked at."""
        boots = defaultdict[str, str](lambda: np.random.default_rng().bytes(8).hex())
        for i, (topic, attack) in enumerate(attacks):
            self._put(topic, _renumbered(attack, boots[topic.suffix], i))
            time.sleep(pause_s)
            if i % 100 == 0:
                self.stack.check()

    def account(self) -> Account:
        """Wait until everything was counted, and add it up."""
        self._settle()
        exits = [n for n in SERVICES if self.stack.lives[n].child.process.poll() is not None]
        exits += [n for n, pid in self._pids.items() if self.stack.lives[n].pid != pid]
        reads: dict[tuple[str, str], tuple[int, int, dict[str, int]]] = {}
        unaccounted: dict[str, int] = {}
        lost: dict[str, int] = {}
        errors: dict[str, int] = {}
        for name in SERVICES:
            before, now = self._begin[name], self._status(name)
            errors |= {f"{name} {k}": v for k, v in now.counters.items() if k.startswith("step:")}
            for topic in self._reads[name]:
                a, b = before.inputs[topic.suffix], now.inputs[topic.suffix]
                counted = {
                    k: v - before.counters.get(k, 0) for k, v in now.counters.items()
                    if k.startswith(f"{topic.suffix}:") and not k.partition(":")[2].startswith(("sent", "not_sent"))
                }  # fmt: skip
                received, used = b.received - a.received, b.used - a.used
                reads[name, topic.suffix] = received, used, counted
                unaccounted[f"{name} {topic.suffix}"] = received - used - sum(counted.values())
                others = self._others(topic)
                lost[f"{name} {topic.suffix}"] = max(self._sent[topic.suffix] + others - received, 0)
        for suffix, inbox in self._heard.items():
            view = inbox._monitor.view(time.monotonic_ns())
            counted = {k: v for k, v in self._own[suffix].counters.items() if k.startswith(f"{suffix}:")}
            reads["here", suffix] = view.received, view.used, counted
            unaccounted[suffix] = view.received - view.used - sum(counted.values())
            lost[suffix] = max(self._sent[suffix] - view.received, 0)
        alive = [n for n in SERVICES if n not in exits]
        grown = {n: (resident(pid=self._pids[n]) - self._warm[n]) / MIB for n in alive}
        in_all = {n: (resident(pid=self._pids[n]) - self._rss[n]) / MIB for n in alive}
        peak = {n: resident("VmHWM", self._pids[n]) / MIB for n in alive}
        return Account(self._sent, reads, unaccounted, lost, grown, in_all, peak, exits, errors)

    def non_finite(self) -> tuple[list[str], int]:
        """Outputs of the services that do not pass the codec, and how many there were."""
        bad = []
        for raw in self._outputs:
            attack = Attack("", raw.attachment, raw.payload)
            if (found := outcome(raw.topic, attack)) != "accepted":
                bad.append(f"{raw.topic.suffix}: {found}")
        return bad, len(self._outputs)

    def _output(self, raw: Raw) -> None:
        # ours carry our own source; of the services' own risk volumes a few hundred are enough
        if raw.attachment is not None and b"\xa6source\xa4fuzz" not in raw.attachment and len(self._outputs) < 3000:
            big = raw.topic is topics.RISK and sum(r.topic is topics.RISK for r in self._outputs) >= 100
            if not big and _of_a_service(raw):
                self._outputs.append(raw)

    def _put(self, topic: Topic, attack: Attack) -> None:
        self._out[topic.suffix].put_raw(attack.attachment, attack.payload, topic.encoding)
        self._sent[topic.suffix] += 1

    def _take(self) -> None:
        for inbox in self._heard.values():
            inbox.take()

    def _status(self, name: str) -> Status:
        heard = self.stack.watch.status(name)
        if heard is None or heard.status is None:
            raise FaultError(f"{name} says nothing")
        return heard.status

    def _others(self, topic: Topic) -> int:
        """How many messages of a topic a service of the stack itself sent meanwhile."""
        if topic.writer not in SERVICES:
            return 0
        key = f"{topic.suffix}:sent"
        return self._status(topic.writer).counters.get(key, 0) - self._begin[topic.writer].counters.get(key, 0)

    def _settle(self, quiet_s: float = 1.0) -> None:
        """Until no reader has received anything for a while and nothing waits to be read."""
        last: tuple[Any, float] = (None, time.monotonic())

        def quiet() -> bool:
            nonlocal last
            self._take()
            now = [
                (n, t.suffix, (h := self._status(n).inputs[t.suffix]).received, h.used)
                for n in SERVICES for t in self._reads[n]
            ]  # fmt: skip
            if now != last[0]:
                last = now, time.monotonic()
            return time.monotonic() - last[1] > quiet_s

        until(quiet, 60.0, "the end of what was sent", every_s=0.02)


def _of_a_service(raw: Raw) -> bool:
    """Whether a header says that a service of ours sent it."""
    try:
        return codec.decode_header(raw.topic, raw.attachment).source in SERVICES
    except RefusedError:
        return False


def _renumbered(attack: Attack, boot: str, seq: int) -> Attack:
    """The same message sent now, if its header can be read at all."""
    try:
        fields = msgpack.unpackb(attack.attachment)
        now = time.monotonic_ns()
        fields |= {"boot": boot, "seq": seq, "capture_ns": now, "sent_ns": now, "age_ns": 0, "source": "fuzz"}
    except Exception:  # a bomb in the header
        return attack
    return Attack(attack.kind, msgpack.packb(fields), attack.payload)


@contextmanager
def besieged(seed: int, say: Say, heard: tuple[Topic, ...] = HEARD) -> Iterator[Siege]:
    """Services that have just driven, whose vehicle has fallen silent, and a sender on their bus."""
    samples: dict[str, list[tuple[bytes, bytes]]] = defaultdict(list)

    def keep(raw: Raw) -> None:
        if raw.attachment is not None and len(samples[raw.topic.suffix]) < 6:
            samples[raw.topic.suffix].append((raw.attachment, raw.payload))

    with stack(seed=seed, road_users=8, drive=False) as s:
        for topic in ALL:
            s.bus.tap(topic, keep)
        for service in SERVICES:
            s.wait_up(service)
        s.wait_drive()
        until(lambda: all(len(samples[t.suffix]) >= 2 for t in ALL if t.rate_hz is not None), 60.0, "samples to damage")
        s.vehicle.ego_too = s.vehicle.objects_too = False
        s.watch.mode("safe_stop", time.monotonic_ns(), 10.0)  # the silence was heard
        time.sleep(1.0)
        settings = BusSettings(connect=(s.endpoint,))
        with (
            open_bus(settings, "faults", "fuzz") as bus,
            open_bus(settings, "elsewhere", "fuzz") as sender,
            open_bus(settings, "elsewhere", "reader") as receiver,
        ):
            siege = Siege(s, bus, {name: list(good) for name, good in samples.items()}, say)
            siege.listen(sender, receiver, heard)
            time.sleep(0.5)
            yield siege


ROWS = {5: fuzzing, 6: numbers, 7: exploding}
