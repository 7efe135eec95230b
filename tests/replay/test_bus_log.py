"""The bus recorded and replayed: every byte as it travelled, found by time, torn ends and other versions named."""

from __future__ import annotations

import json
import sys
import threading
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import msgpack
import pytest

pytest.importorskip("mcap")

from mcap.reader import SeekingReader
from mcap.writer import Writer
from typer.testing import CliRunner

from common import codec, topics
from common.bus import Bus, BusSettings, Raw, open_bus, router
from common.clock import monotonic
from common.messages import Cause, Closures, Map
from rig.application import app
from rig.bus_log import recorder as recorder_module
from rig.bus_log.check import _Memory, check
from rig.bus_log.envelope import MESSAGE_ENCODING, METADATA, Recorded, pack, schema_name, topics_named, unpack
from rig.bus_log.mend import mend
from rig.bus_log.player import Player, TakenError
from rig.bus_log.reader import BusLog, BusLogError
from rig.bus_log.recorder import Recorder
from tests import samples
from tests.contract.test_codec import equal, header
from tests.processes import group
from tests.waiting import until

MOVING = (topics.EGO, topics.OBJECTS)
STANDING = (topics.MAP, topics.ROUTE, topics.CLOSURES)
FRAMES = 30


@pytest.fixture(scope="module")
def endpoint() -> Iterator[str]:
    with router() as endpoint:
        yield endpoint


def bus_of(endpoint: str, source: str, vehicle: str = "ego"):
    return open_bus(BusSettings(connect=(endpoint,)), vehicle, source)


class Heard:
    """Everything of some topics, as it travels."""

    def __init__(self, bus: Bus, wanted) -> None:
        self.raw: list[Raw] = []
        for topic in wanted:
            bus.tap(topic, self.raw.append)

    def of(self, topic: topics.Topic) -> list[Raw]:
        return [r for r in self.raw if r.topic is topic]


@pytest.fixture(scope="module")
def recorded(endpoint: str, tmp_path_factory) -> tuple[Path, list[Raw]]:
    """A file, and what a second listener heard of the same."""
    path = tmp_path_factory.mktemp("bus") / "a.mcap"
    with bus_of(endpoint, "vehicle", "recorded") as bus, bus_of(endpoint, "recorder", "recorded") as ears:
        out = {t.suffix: bus.publisher(t) for t in (*MOVING, *STANDING)}
        out["map"].put(samples.world(), capture_ns=monotonic())  # before anyone listens: it is latched
        heard = Heard(ears, (*MOVING, *STANDING))
        with Recorder(ears, (*MOVING, *STANDING), path, {"vehicle": "recorded"}) as recorder:
            until(lambda: heard.of(topics.MAP) and recorder.written["map"], what="the latched map")
            out["route"].put(samples.route(), capture_ns=monotonic())
            for k in range(FRAMES):
                out["ego"].put(samples.ego(x=float(k), vx=8.0), capture_ns=monotonic())
                cause = out["objects"].put(samples.objects(k % 3), capture_ns=monotonic())
                out["closures"].put(Closures(ids=[k]), capture_ns=monotonic(), cause=cause)
                time.sleep(0.02)
            until(lambda: recorder.written.total() == len(heard.raw) == 2 + 3 * FRAMES, what="all of them")
    return path, heard.raw


def test_every_byte_is_kept_with_header_and_encoding(recorded):
    path, heard = recorded
    log = BusLog.open(path)
    found = list(log.messages())
    assert Counter((r.topic.suffix, r.attachment, r.payload, r.encoding) for r in heard) == Counter(
        (m.topic.suffix, m.attachment, m.payload, m.encoding) for m in found
    )
    assert not log.is_torn and not log.unknown and not log.refused and not log.dropped
    assert log.configuration == {"vehicle": "recorded"} and log.machine["numpy"]
    assert [m.header().seq for m in log.messages([topics.EGO])] == list(range(FRAMES))


def test_any_tool_can_read_it(recorded):
    path, _ = recorded
    with path.open("rb") as file:
        for schema, channel, message in SeekingReader(file).iter_messages(["objects"]):
            assert schema is not None and schema.name == "forefield.objects.v1" and b"perceives" in schema.data
            assert channel.message_encoding == "msgpack"
            assert channel.metadata == {"encoding": topics.OBJECTS.encoding, "key": "forefield/recorded/objects"}
            body = msgpack.unpackb(msgpack.unpackb(message.data)["payload"])
            assert body["x"]["dtype"] == "<f8"


def test_a_stretch_is_found_by_its_time(recorded):
    path, _ = recorded
    log = BusLog.open(path)
    every = [m.time_ns for m in log.messages(MOVING)]
    assert every == sorted(every) and log.span_ns()[1] == max(m.time_ns for m in log.messages())
    start, end = every[20], every[40]
    assert [m.time_ns for m in log.messages(MOVING, start, end)] == [t for t in every if start <= t <= end]
    latched = {m.topic.suffix: m for m in log.latched_before(start)}
    assert set(latched) == {"map", "route", "closures"}
    assert latched["closures"].time_ns < start
    assert latched["closures"].header().seq == max(
        m.header().seq for m in log.messages([topics.CLOSURES]) if m.time_ns < start
    )


@pytest.mark.parametrize("share", [0.3, 0.7, 0.97])
def test_a_torn_file_is_read_to_its_tear_and_mended(recorded, tmp_path, share):
    whole, _ = recorded
    torn, out = tmp_path / "torn.mcap", tmp_path / "out.mcap"
    content = whole.read_bytes()
    torn.write_bytes(content[: int(len(content) * share)])
    log = BusLog.open(torn)
    found, expected = list(log.messages()), list(BusLog.open(whole).messages())
    assert log.is_torn
    kept = {(m.topic.suffix, m.header().seq) for m in found}
    assert kept <= {(m.topic.suffix, m.header().seq) for m in expected}
    if not found:
        return  # torn within the first chunk
    assert mend(torn, out) == len(found)
    assert not BusLog.open(out).is_torn
    assert [(m.topic, m.time_ns, m.attachment, m.payload) for m in BusLog.open(out).messages()] == sorted(
        ((m.topic, m.time_ns, m.attachment, m.payload) for m in found), key=lambda m: m[1]
    )
    assert mend(out, out) is None


@pytest.mark.parametrize("content", [b"", b"no such thing", b"\x89MCAP0\r\n"])
def test_what_is_no_recorded_bus_is_named(tmp_path, content):
    path = tmp_path / "a.mcap"
    path.write_bytes(content)
    with pytest.raises(BusLogError, match=r"a\.mcap"):
        BusLog.open(path)
    with pytest.raises(BusLogError, match="No such file"):
        BusLog.open(tmp_path / "nowhere.mcap")


def write(path: Path, rows: list[tuple[str, str, bytes]], form: str = "1") -> Path:
    """A file of (channel, schema, data), as another version might have written it."""
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start(profile="", library="other")
        writer.add_metadata(METADATA, {"format": form, "vehicle": "ego", "configuration": "{}", "machine": "{}"})
        for k, (name, schema, data) in enumerate(rows):
            identity = writer.register_schema(schema, "text", b"")
            channel = writer.register_channel(name, MESSAGE_ENCODING, identity)
            writer.add_message(channel, 1000 + k, data, 1000 + k)
        writer.finish()
    return path


def test_other_versions_are_named_and_the_rest_is_read(recorded, tmp_path):
    ego = next(BusLog.open(recorded[0]).messages([topics.EGO]))
    good = pack(ego.attachment, ego.payload)
    path = write(
        tmp_path / "a.mcap",
        [
            ("ego", schema_name(topics.EGO), good),
            ("risk", "forefield.risk.v2", b"?"),
            ("weather", "forefield.weather.v1", b"?"),
            ("objects", schema_name(topics.OBJECTS), b"\x93not an envelope"),
        ],
    )
    log = BusLog.open(path)
    assert [m.topic.suffix for m in log.messages()] == ["ego"]
    assert "forefield.risk.v2" in log.unknown["risk"] and "v1" in log.unknown["risk"]
    assert "no topic" in log.unknown["weather"]
    assert log.refused == {"objects:envelope": 1}
    with pytest.raises(BusLogError, match="format '9'"):
        BusLog.open(write(tmp_path / "b.mcap", [], form="9"))


@pytest.mark.parametrize("rate", [1.0, 3.0])
def test_a_replay_is_accepted_by_receivers_as_a_drive_of_now(recorded, endpoint, rate):
    path, _ = recorded
    log = BusLog.open(path)
    first = log.span_ns()[0]
    last = max(m.time_ns for m in log.messages(MOVING))
    vehicle = f"replay{rate:.0f}"
    with bus_of(endpoint, "ears", vehicle) as ears, bus_of(endpoint, "replay", vehicle) as bus:
        heard = Heard(ears, (*MOVING, *STANDING))
        inboxes = {t.suffix: ears.inbox(t) for t in (*MOVING, *STANDING)}
        begun = time.monotonic()
        for _ in range(2):  # a second replay is another drive, not a repetition of the first
            player = Player(log, bus, (topics.MAP, *MOVING))
            player.play(first, last, rate)
            for name in ("map", "ego", "objects"):
                until(inboxes[name].take, what=f"{name} that is used")
        took = time.monotonic() - begun
        until(lambda: len(heard.raw) == 2 * (1 + 2 * FRAMES), what="both replays")
        assert took >= 2 * (last - first) * 1e-9 / rate
        refused = {k: n for k, n in ears.counters.items() if "overwritten" not in k}
        assert not refused
        sent = {(m.topic.suffix, m.payload) for m in log.messages((topics.MAP, *MOVING))}
        assert {(r.topic.suffix, r.payload) for r in heard.raw} == sent
        causes = {codec.decode_header(topics.EGO, r.attachment).boot for r in heard.of(topics.EGO)}
        assert len(causes) == 2


def test_a_stretch_begins_with_what_stood_before_it(recorded, endpoint):
    log = BusLog.open(recorded[0])
    first, last = log.span_ns()
    middle = (first + last) // 2
    with bus_of(endpoint, "ears", "stretch") as ears, bus_of(endpoint, "replay", "stretch") as bus:
        heard = Heard(ears, (*MOVING, *STANDING))
        player = Player(log, bus, (*MOVING, *STANDING))
        player.play(middle, last, 10.0)
        until(lambda: len(heard.raw) == player.sent.total(), what="the replay")
        assert {r.topic.suffix for r in heard.raw[:3]} == {"map", "route", "closures"}
        assert 0 < player.sent["ego"] < FRAMES


@pytest.fixture(scope="module")
def driven(tmp_path_factory) -> Path:
    """A recorded drive with what the vehicle sent and what the planner answered."""
    path = tmp_path_factory.mktemp("driven") / "a.mcap"
    log = BusLog.open(Path(__file__).with_name("reference_drive.mcap"))
    found = [m for t in (topics.EGO, topics.PLAN) for m in list(log.messages([t]))[:3]]
    return write(path, [(m.topic.suffix, schema_name(m.topic), pack(m.attachment, m.payload)) for m in found])


def replayed(file: Path, endpoint: str, vehicle: str, *more: str):
    arguments = ["replay", str(file), "--connect", endpoint, "--set", f"vehicle={vehicle}", *more]
    return CliRunner().invoke(app, arguments, env={"COLUMNS": "400", "TERM": "dumb"})


def test_who_runs_on_the_bus_is_not_shut_out_by_a_replay_unless_that_is_forced(driven, endpoint):
    with bus_of(endpoint, "planner", "living") as planner, bus_of(endpoint, "ears", "living") as ears:
        heard = Heard(ears, (topics.EGO, topics.PLAN))
        planner.liveliness("planner")
        until(lambda: "planner" in ears.alive(), what="the planner's token")
        refused = replayed(driven, endpoint, "living")
        assert refused.exit_code == 2
        (line,) = refused.stderr.splitlines()
        assert all(words in line for words in ("plan: ", "(planner)", "--only ego)", "--force"))
        assert replayed(driven, endpoint, "living", "--only", "plan").exit_code == 2
        allowed = replayed(driven, endpoint, "living", "--only", "ego")
        assert allowed.exit_code == 0, allowed.stderr
        until(lambda: len(heard.of(topics.EGO)) == 3, what="the ego")
        assert not heard.of(topics.PLAN)
        forced = replayed(driven, endpoint, "living", "--force")
        assert forced.exit_code == 0, forced.stderr
        until(lambda: len(heard.of(topics.PLAN)) == 3, what="the plans")


@pytest.mark.parametrize("topic", [topics.EGO, topics.MAP], ids=["moves", "stands"])
def test_a_writer_without_a_token_is_heard_and_left_alone(endpoint, tmp_path, topic):
    message = samples.ego() if topic is topics.EGO else samples.world()
    vehicle = f"untold-{topic.suffix}"
    with bus_of(endpoint, "my_car", vehicle) as car, bus_of(endpoint, "other", "elsewhere") as other:
        taken_down: list[Raw] = []
        other.tap(topic, taken_down.append)
        other.publisher(topic).put(message, capture_ns=monotonic())
        until(lambda: taken_down, what="what is to be replayed")
        raw = taken_down[0]
        rows = [(topic.suffix, schema_name(topic), pack(raw.attachment, raw.payload))]
        path = write(tmp_path / "a.mcap", rows * 2)
        publisher, stop = car.publisher(topic), threading.Event()
        publisher.put(message, capture_ns=monotonic())

        def drive() -> None:
            while topic is topics.EGO and not stop.wait(0.05):
                publisher.put(message, capture_ns=monotonic())

        thread = threading.Thread(target=drive)
        thread.start()
        try:
            refused = replayed(path, endpoint, vehicle)
        finally:
            stop.set()
            thread.join()
    assert refused.exit_code == 2 and f"{topic.suffix}: written by" in refused.stderr and "my_car" in refused.stderr


def test_a_replay_stops_when_somebody_begins_to_write_what_it_replays(endpoint, tmp_path):
    rows = []
    log = BusLog.open(Path(__file__).with_name("reference_drive.mcap"))
    for m in list(log.messages([topics.EGO]))[:50]:
        rows.append((m.topic.suffix, schema_name(m.topic), pack(m.attachment, m.payload)))
    path = write(tmp_path / "a.mcap", rows)
    with bus_of(endpoint, "my_car", "later") as car, bus_of(endpoint, "replay", "later") as bus:
        heard = Heard(car, (topics.EGO,))
        publisher = car.publisher(topics.EGO)
        player = Player(BusLog.open(path), bus, (topics.EGO,), yields=True)
        first, last = BusLog.open(path).span_ns()

        def show(_: float) -> None:
            if player.sent["ego"] == 10:
                publisher.put(samples.ego(), capture_ns=monotonic())
                until(lambda: player.others, what="the newcomer")

        with pytest.raises(TakenError, match=r"ego \(my_car\)"):
            player.play(first, last, 1.0, show)
        until(lambda: len(heard.raw) == 11, what="what was sent until then")


def test_a_vehicle_that_the_rig_drives_is_left_alone_too(driven, endpoint):
    run = [sys.executable, "-m", "rig.command", "run", "--scenario", "straight", "--attach"]
    settings = ["--set", f'bus.connect=["{endpoint}"]', "--set", "vehicle=rigged", "--set", "rig.ready_timeout_s=120"]
    with group([*run, *settings]), bus_of(endpoint, "ears", "rigged") as ears:
        until(lambda: "vehicle" in ears.alive(), within_s=60, what="the vehicle's token")
        refused = replayed(driven, endpoint, "rigged", "--only", "ego,plan")
    assert refused.exit_code == 2 and "--only plan)" in refused.stderr


def test_a_drive_without_what_the_living_write_and_a_bus_without_them_are_replayed_as_they_are(
    driven, endpoint, tmp_path
):
    ego = list(BusLog.open(driven).messages([topics.EGO]))
    inputs = write(tmp_path / "a.mcap", [("ego", schema_name(m.topic), pack(m.attachment, m.payload)) for m in ego])
    with bus_of(endpoint, "planner", "inputs") as planner:
        planner.liveliness("planner")
        until(lambda: "planner" in planner.alive(), what="the planner's token")
        assert replayed(inputs, endpoint, "inputs").exit_code == 0
    assert replayed(driven, endpoint, "alone").exit_code == 0


def test_what_a_recording_holds_is_known_torn_or_whole(recorded, tmp_path):
    whole, _ = recorded
    torn = tmp_path / "torn.mcap"
    torn.write_bytes(whole.read_bytes()[:-20])
    assert BusLog.open(torn).is_torn
    assert BusLog.open(whole).holds() == BusLog.open(torn).holds() == {t.suffix for t in (*MOVING, *STANDING)}


def test_causes_follow_the_new_boots_and_unknown_fields_travel_on(endpoint, tmp_path):
    with bus_of(endpoint, "a", "causes") as bus:
        sent: list[Raw] = []
        bus.tap(topics.CLOSURES, sent.append)
        bus.publisher(topics.CLOSURES).put(Closures(ids=[1]), capture_ns=monotonic(), cause=Cause("boot-of-objects", 7))
        until(lambda: sent, what="the message")
        header = msgpack.unpackb(sent[0].attachment)
        header["of_tomorrow"] = 5
        path = write(tmp_path / "a.mcap", [("closures", schema_name(topics.CLOSURES),
                                            pack(msgpack.packb(header), sent[0].payload))])  # fmt: skip
        player = Player(BusLog.open(path), bus, (topics.CLOSURES,))
        player.play(0, 10_000, 1.0)
        until(lambda: len(sent) == 2, what="the replay")
        again = msgpack.unpackb(sent[1].attachment)
        assert again["of_tomorrow"] == 5 and again["cause"][1] == 7
        assert again["cause"][0] not in ("boot-of-objects", again["boot"]) and again["boot"] != header["boot"]


def test_what_does_not_fit_into_the_queue_is_dropped_and_counted(endpoint, tmp_path, monkeypatch):
    monkeypatch.setattr(recorder_module, "QUEUE_BYTES", 1000)
    with bus_of(endpoint, "a", "queue") as bus:
        recorder = Recorder(bus, (topics.EGO,), tmp_path / "a.mcap", {})
        large = Raw(topics.EGO, b"", bytes(1001), "", monotonic())
        recorder.hear(large)
        recorder.hear(Raw(topics.EGO, b"", bytes(10), "", monotonic()))
        recorder.close()
    assert recorder.dropped == {"ego": 1} and recorder.written == {"ego": 1}
    assert BusLog.open(tmp_path / "a.mcap").dropped == {"ego": 1}


def test_what_waits_is_bounded_headers_and_all(endpoint, tmp_path, monkeypatch):
    monkeypatch.setattr(recorder_module, "QUEUE_BYTES", 1000)
    with bus_of(endpoint, "a", "headers") as bus, Recorder(bus, (topics.EGO,), tmp_path / "a.mcap", {}) as recorder:
        recorder.hear(Raw(topics.EGO, bytes(1001), b"", "", monotonic()))
        assert recorder.dropped == {"ego": 1}
        for k in range(1, 4):  # and what was written makes room again
            recorder.hear(Raw(topics.EGO, bytes(600), bytes(300), "", monotonic()))
            until(lambda k=k: recorder.written["ego"] == k, what="a message")
    assert recorder.dropped == {"ego": 1}


class SlowCounter(Counter[str]):
    """Where two threads count without a lock, both read before either writes."""

    def __getitem__(self, name: str) -> int:
        n = super().__getitem__(name)
        time.sleep(0.0005)
        return n


def test_drops_are_counted_exactly_whichever_thread_drops(endpoint, tmp_path, monkeypatch):
    monkeypatch.setattr(recorder_module, "QUEUE_BYTES", 1000)
    monkeypatch.setattr(recorder_module, "Counter", SlowCounter)
    large, small = (Raw(topics.EGO, b"", bytes(n), "", monotonic()) for n in (1001, 1))
    with bus_of(endpoint, "a", "drops") as bus:
        with Recorder(bus, (topics.EGO,), tmp_path / "a.mcap", {}, reserve_bytes=2**62) as recorder:
            for _ in range(100):
                recorder.hear(small)  # dropped by the writing thread: there is no room
                recorder.hear(large)  # dropped here
        assert recorder.dropped == {"ego": 200}


def test_without_room_the_recording_pauses_and_says_so(endpoint, tmp_path):
    with bus_of(endpoint, "a", "room") as bus:
        recorder = Recorder(bus, (topics.EGO,), tmp_path / "a.mcap", {}, reserve_bytes=2**62)
        recorder.hear(Raw(topics.EGO, b"", b"x", "", monotonic()))
        until(lambda: recorder.dropped["ego"], what="a drop")
        assert "to stay so" in recorder.trouble
        recorder._reserve = 0
        recorder.hear(Raw(topics.EGO, b"", b"x", "", monotonic()))
        until(lambda: recorder.written["ego"], what="a message")
        assert not recorder.trouble
        recorder.close()


def test_topics_are_chosen_by_name():
    assert topics_named("ego, objects") == MOVING
    assert len(topics_named("status")) == len(topics.STATUS_OF)
    with pytest.raises(ValueError, match="weather"):
        topics_named("ego,weather")


def test_an_envelope_holds_what_was_put_in_and_nothing_else():
    assert unpack(pack(None, b"")) == (None, b"")
    assert unpack(pack(b"h", b"p")) == (b"h", b"p")
    for bad in (b"", b"\xc0", msgpack.packb({"payload": b"p"}), msgpack.packb({"attachment": 1, "payload": b""})):
        with pytest.raises(codec.RefusedError, match="envelope"):
            unpack(bad)


def test_outputs_that_do_not_name_their_inputs_are_not_compared_and_the_reason_is_told(tmp_path):
    pytest.importorskip("torch")
    from rig import configuration

    source = Path(__file__).with_name("reference_drive.mcap")
    log = BusLog.open(source)
    rows = []
    for m in log.messages([topics.OBJECTS, topics.PREDICTION]):
        header = msgpack.unpackb(m.attachment)
        header["step"] = None
        rows.append((m.topic.suffix, schema_name(m.topic), pack(msgpack.packb(header), m.payload)))
    bare = BusLog.open(write(tmp_path / "a.mcap", rows))
    (result,) = check(bare, configuration.resolve({}), same_machine=True, services=("predictor",))
    assert not result.is_good and result.compared == 0 and "no `step`" in result.why_skipped


def test_a_recording_that_begins_late_is_compared_from_where_it_can_be(tmp_path):
    pytest.importorskip("torch")
    from rig import configuration

    log = BusLog.open(Path(__file__).with_name("reference_drive.mcap"))
    messages: list[Recorded] = list(log.messages())
    late = [m for m in messages if m.topic.suffix != "prediction" or m.header().seq != 3]
    rows = [(m.topic.suffix, schema_name(m.topic), pack(m.attachment, m.payload)) for m in late]
    gap = BusLog.open(write(tmp_path / "a.mcap", rows))
    tree = configuration.resolve(log.configuration)
    (whole,) = check(log, tree, same_machine=True, services=("predictor",))
    (result,) = check(gap, tree, same_machine=True, services=("predictor",))
    assert result.skipped > 0 and "state is unknown" in result.why_skipped
    assert result.compared + result.skipped == whole.compared - 1
    assert json.dumps(log.machine)


def test_a_step_that_raises_is_a_difference_told_by_name(monkeypatch):
    pytest.importorskip("torch")
    from rig import configuration
    from services.predictor import __main__ as predictor

    def build(*_):
        def step(_):
            raise ZeroDivisionError("no road\nat all")

        return step

    monkeypatch.setattr(predictor, "SERVICE", replace(predictor.SERVICE, build=build))
    log = BusLog.open(Path(__file__).with_name("reference_drive.mcap"))
    (result,) = check(log, configuration.resolve(log.configuration), same_machine=True, services=("predictor",))
    assert result.first is not None and not result.is_good
    seq, found = result.first
    assert (seq, found.field, found.recorded) == (0, "prediction", "a message")
    assert found.repeated == "ZeroDivisionError: no road\nat all"
    assert result.different == result.compared > 1


def test_a_map_that_was_sent_again_and_again_is_kept_once():
    """As its receiver had it: the same object until another one comes."""
    memory, first = _Memory(), samples.world()
    body, _ = codec.encode_body(topics.MAP, first)
    other, _ = codec.encode_body(topics.MAP, replace_lanes(first))
    for seq, payload in enumerate([body, bytes(bytearray(body)), other]):
        head = header(topics.MAP, seq=seq)
        message = Recorded(topics.MAP, seq, codec.encode_header(topics.MAP, head), payload, topics.MAP.encoding)
        memory.add(message, head)
    boot = head.boot
    same, again, new = (memory.value(("map", boot, seq)) for seq in range(3))
    assert again is same and new is not same and equal(same, first)
    assert memory.recorded[("map", boot, 1)].payload is memory.recorded[("map", boot, 0)].payload


def replace_lanes(world: Map) -> Map:
    return Map(lanes=world.lanes[:1], obstacles=world.obstacles)


class FailingDisk:
    """A file on a disk that is full from some moment on, or takes long for every write."""

    def __init__(self, file) -> None:
        self._file, self.full, self.slow_s = file, False, 0.0

    def write(self, data: bytes) -> int:
        time.sleep(self.slow_s)
        if self.full:
            raise OSError(28, "No space left on device")
        return self._file.write(data)

    def __getattr__(self, name: str):
        return getattr(self._file, name)


def on_failing_disk(recorder: Recorder) -> FailingDisk:
    disk = FailingDisk(recorder._file)
    recorder._file = recorder._writer._Writer__stream = disk
    return disk


def test_what_a_full_disk_did_not_take_counts_as_dropped_and_the_rest_is_read_back(endpoint, tmp_path):
    with bus_of(endpoint, "a", "full") as bus:
        path = tmp_path / "a.mcap"
        with Recorder(bus, (topics.EGO,), path, {}, reserve_bytes=0) as recorder:
            disk = on_failing_disk(recorder)
            good = Raw(topics.EGO, b"h", b"p", "", monotonic())
            for _ in range(3):
                recorder.hear(good)
            until(lambda: recorder.written["ego"] == 3 and not recorder._chunk, what="a chunk on the disk")
            disk.full = True
            for _ in range(4):
                recorder.hear(good)
            until(lambda: recorder.dropped["ego"] == 4, what="the count of what was lost")
            assert "No space left" in recorder.trouble
        assert recorder.written["ego"] == 3
    found = BusLog.open(path)
    assert sum(1 for _ in found.messages()) + sum(found.refused.values()) == 3


def test_a_disk_that_is_too_slow_does_not_keep_the_recording_from_ending(endpoint, tmp_path, monkeypatch):
    monkeypatch.setattr(recorder_module, "CLOSE_S", 0.3)
    monkeypatch.setattr(recorder_module, "CHUNK_BYTES", 1)  # each message by itself
    with bus_of(endpoint, "a", "slow") as bus:
        path = tmp_path / "a.mcap"
        recorder = Recorder(bus, (topics.EGO,), path, {}, reserve_bytes=0)
        on_failing_disk(recorder).slow_s = 0.02
        for _ in range(500):
            recorder.hear(Raw(topics.EGO, b"h", b"p", "", monotonic()))
        recorder.close()  # all of it would take ten seconds
    assert recorder.dropped["ego"] > 0 and recorder.written["ego"] + recorder.dropped["ego"] == 500
    assert "too slow" in recorder.trouble
    assert BusLog.open(path).dropped == {"ego": recorder.dropped["ego"]}
