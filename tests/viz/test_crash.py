"""viz killed in mid-write: at most the last second is lost, and what is left can be mended."""

from __future__ import annotations

import signal
import time
from pathlib import Path

import pytest

pytest.importorskip("rerun")

from common import topics
from common.bus import BusSettings, open_bus, router
from tests.viz import synthetic
from tests.viz.reading import record, rows
from tests.viz.test_viz_process import Vehicle, start
from tests.waiting import until
from viz.repair import Mended, RepairError, is_whole, repair

SMALL = {"rows": 64, "columns": 32, "h": 1.25}


def killed(endpoint: str, path: Path) -> float:
    """Kill viz while it records; how much of what it had heard is not in the file [s]."""
    with open_bus(BusSettings(connect=(endpoint,)), "ego", "vehicle") as bus:
        vehicle = Vehicle(bus)
        viz = start(endpoint, "--record", str(path))
        try:
            until(lambda: (s := vehicle.status()) and s.state == "ready", within_s=30, what="viz")
            said: list[float] = []

            def told() -> bool:
                vehicle.say(len(said))
                said.append(time.monotonic())
                return vehicle.drawn("risk") >= 30

            until(told, within_s=60, every_s=0.1, what="three seconds of risk")
            viz.send_signal(signal.SIGKILL)
            end = time.monotonic()
        finally:
            viz.kill()
            viz.communicate()
    first = said[0]
    mended = path.with_suffix(".mended.rrd")
    done = repair(path, mended)
    assert not done.was_whole and done.rows > 100 and is_whole(mended)
    values = [found["translation"].as_py()[0][0] for _, found in rows(mended, "/world/ego")]
    reached = max(values) / (synthetic.Drive().speed * 0.1)  # the ego's place tells which message it was
    return end - said[min(round(reached), len(said) - 1)] if values else end - first


def test_a_kill_in_mid_write_loses_at_most_the_last_second(tmp_path):
    with router() as endpoint:
        lost = [killed(endpoint, tmp_path / "a.rrd")]
        if lost[0] > 1.0:  # the machine was busy elsewhere at that moment: once more
            lost.append(killed(endpoint, tmp_path / "b.rrd"))
    assert min(lost) <= 1.0, lost


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> Path:
    return record(tmp_path_factory.mktemp("repair") / "a.rrd", synthetic.Drive(**SMALL), 10)


@pytest.mark.parametrize("share", [0.4, 0.999])
def test_wherever_it_is_torn_the_rest_is_mended_layout_and_all(whole, tmp_path, share):
    torn, out = tmp_path / "torn.rrd", tmp_path / "out.rrd"
    content = whole.read_bytes()
    torn.write_bytes(content[: int(len(content) * share)])
    assert not is_whole(torn)
    done = repair(torn, out)
    assert done.rows > 0 and is_whole(out)
    from rerun.chunk import RrdReader

    assert len(RrdReader(out).blueprints()) == 1
    kept, all_of_it = rows(out, "/world/ego"), rows(whole, "/world/ego")
    assert [f for f, _ in kept] == [f for f, _ in all_of_it][: len(kept)]
    assert torn.stat().st_size == int(len(content) * share)  # the original is untouched


def test_it_may_replace_the_file_itself_and_leaves_nothing_beside_it(whole, tmp_path):
    torn = tmp_path / "torn.rrd"
    torn.write_bytes(whole.read_bytes()[:-100])
    repair(torn, torn)
    assert is_whole(torn) and list(tmp_path.iterdir()) == [torn]


def test_what_is_whole_stays_as_it_is(whole, tmp_path):
    before = whole.read_bytes()
    assert repair(whole, whole) == Mended(True)
    assert repair(whole, tmp_path / "b.rrd").was_whole and (tmp_path / "b.rrd").read_bytes() == before


@pytest.mark.parametrize("content", [b"", b"RRF2", b"PK\x03\x04 something else entirely", b"RRF2" + bytes(100)])
def test_what_holds_no_recording_is_refused_by_name(tmp_path, content):
    path = tmp_path / "a.rrd"
    path.write_bytes(content)
    with pytest.raises(RepairError, match=r"a\.rrd"):
        repair(path, tmp_path / "out.rrd")
    assert not (tmp_path / "out.rrd").exists()


def test_viz_has_longer_to_end_than_the_others_and_compose_gives_it_longer_still():
    import yaml

    from common.process import EXIT_DEADLINE_S
    from rig.launcher import STOP_VIZ_S
    from viz.__main__ import END_S
    from viz.outlet import CLOSE_S

    compose = yaml.safe_load((Path(__file__).parents[2] / "compose.yaml").read_text())
    grace = float(compose["services"]["viz"]["stop_grace_period"].removesuffix("s"))
    assert EXIT_DEADLINE_S < CLOSE_S < END_S < grace and END_S < STOP_VIZ_S


def test_a_frozen_viz_slows_nobody_and_draws_on_when_it_thaws(tmp_path):
    with (
        router() as endpoint,
        open_bus(BusSettings(connect=(endpoint,)), "ego", "vehicle") as bus,
        open_bus(BusSettings(connect=(endpoint,)), "ego", "ears") as ears,
    ):
        vehicle = Vehicle(bus)
        heard: list[int] = []
        ears.watch(topics.RISK, lambda header, _: heard.append(header.seq))
        viz = start(endpoint, "--record", str(tmp_path / "a.rrd"))
        try:
            until(lambda: (s := vehicle.status()) and s.state == "ready", within_s=30, what="viz")
            until(lambda: vehicle.say(0) or vehicle.drawn("risk") >= 1, within_s=30, every_s=0.1, what="a drawing")
            viz.send_signal(signal.SIGSTOP)
            before, worst = len(heard), 0.0
            for k in range(1, 61):
                began = time.monotonic()
                vehicle.say(k)
                worst = max(worst, time.monotonic() - began)
                time.sleep(0.02)
            until(lambda: len(heard) >= before + 60, what="everyone else")
            assert worst < 2.0  # a put that waited for viz would wait until its link's lease is over, or longer
            drawn = vehicle.drawn("risk")
            viz.send_signal(signal.SIGCONT)
            until(lambda: vehicle.say(61) or vehicle.drawn("risk") > drawn, within_s=30, every_s=0.1, what="more")
        finally:
            viz.kill()
            viz.communicate()
