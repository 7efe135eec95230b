"""Every piece is a whole recording, and a sink that takes nothing, or has no room, holds nobody up."""

from __future__ import annotations

import contextlib
import itertools
import os
import resource
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rerun")

import rerun as rr
import rerun_cli
from rerun.chunk import RrdReader

from tests.processes import group
from tests.viz import synthetic
from tests.viz.reading import rows
from tests.waiting import until
from viz import outlet
from viz.blueprint import blueprint
from viz.scene import Scene
from viz.settings import VizSettings
from viz.sinks import Recorder, recording

RERUN = Path(rerun_cli.__file__).with_name("rerun")  # the program itself: its launcher would leave it behind
SMALL = {"rows": 64, "columns": 32, "h": 1.25}
NOISE = np.random.default_rng(0).integers(0, 255, (200, 1000), dtype=np.uint8)


@pytest.fixture(autouse=True)
def quick(monkeypatch):
    """Look often: these tests wait for what happens then."""
    monkeypatch.setattr(outlet, "LOOK_S", 0.05)
    monkeypatch.setattr(outlet, "RETRY_S", 0.1)
    monkeypatch.setattr(outlet, "STUCK_S", 0.3)


def entities(path: Path) -> set[str]:
    return {str(chunk.entity_path) for chunk in RrdReader(path).stream()}


def verified(path: Path) -> bool:
    return subprocess.run([RERUN, "rrd", "verify", path], capture_output=True, timeout=60, check=False).returncode == 0


def noise(recorder: Recorder, n: int) -> None:
    recorder.set_time(n, 0.1 * n)
    recorder.log("noise", rr.Tensor(NOISE))
    recorder.tend()


def test_each_piece_is_whole_and_holds_what_stands(tmp_path):
    s = VizSettings(record=str(tmp_path) + "/", rotate_mib=0.5, flush_s=0.05)
    heard = list(synthetic.messages(synthetic.Drive(**SMALL), 30))

    def pieces() -> list[Path]:
        return sorted(tmp_path.iterdir())

    with recording(s, "synthetic", blueprint(), {"a": 1}) as recorder:
        scene, k = Scene(recorder, s), 0
        synthetic.give(scene, heard[:20])

        def another() -> bool:
            nonlocal k
            noise(recorder, k)
            k += 1
            return recorder.detail.get("pieces", "").startswith("4 begun")

        until(another, every_s=0.02, within_s=60, what="four pieces")
        synthetic.give(scene, heard[20:])
    first, *others = pieces()
    standing = {
        "/about", "/why", "/world", "/world/map/surface", "/world/map/barrier", "/world/route/goal", "/world/closed",
        "/world/ego/body", "/world/ego/legend/risk", "/plan", "/planner", "/plot/speed/ego", "/account/scale",
        "/account/ego/size", "/account", "/health",
    }  # fmt: skip
    ids = set()
    for path in (first, *others):
        assert verified(path), path
        reader = RrdReader(path)
        assert len(reader.blueprints()) == 1
        ids |= {store.recording_id for store in reader.recordings()}
        assert standing <= entities(path), (path, standing - entities(path))
    assert len(ids) == 1  # opened together they are one recording
    last = others[-1]
    assert rows(last, "/world/plan/profile"), "and what came later is drawn into the last"


def test_a_piece_that_was_only_just_begun_at_the_end_is_whole(tmp_path, monkeypatch):
    s = VizSettings(record=str(tmp_path) + "/", rotate_mib=0.5, flush_s=0.05)
    opens, ends = outlet.Files._stream, threading.Event()

    def slowly(self, sink):
        rec = opens(self, sink)
        if self.begun:
            ends.wait(0.5)  # a slow disk: the end comes first
        return rec

    monkeypatch.setattr(outlet.Files, "_stream", slowly)
    with recording(s, "synthetic", blueprint()) as recorder:
        k = itertools.count()
        until(lambda: noise(recorder, next(k)) or len(list(tmp_path.iterdir())) == 2, every_s=0.02, within_s=60)
    assert all(verified(path) for path in tmp_path.iterdir())


def test_a_week_on_a_small_disk_stays_within_its_budget(tmp_path):
    s = VizSettings(record=str(tmp_path), rotate_mib=0.4, budget_mib=1.5, flush_s=0.02)
    begun: set[str] = set()
    with recording(s, "", blueprint()) as recorder:
        n = 0

        def enough() -> bool:
            nonlocal n
            noise(recorder, n)
            n += 1
            now = {path.name for path in tmp_path.iterdir()}
            begun.update(now)
            kept = sum(path.stat().st_size for path in tmp_path.iterdir())
            assert kept <= 1.5 * 2**20 + 4 * NOISE.size  # what arrives between two looks
            return len(begun) >= 12

        until(enough, every_s=0.03, within_s=90, what="twelve pieces")
    left = {path.name for path in tmp_path.iterdir()}
    assert left < begun and max(begun) in left and min(begun) not in left


def test_an_unwritable_place_degrades_and_recording_goes_on_when_it_can(tmp_path):
    place = tmp_path / "recordings"
    place.mkdir()
    s = VizSettings(record=str(place / "a.rrd"), flush_s=0.05)
    place.rmdir()  # gone between the look and the first piece: like a volume that is not mounted
    place.touch()
    with pytest.raises(ValueError, match="no such folder"), recording(s, "", blueprint()):
        pass
    place.unlink()
    place.mkdir()
    with recording(s, "", blueprint()) as recorder:
        noise(recorder, 0)
        assert not recorder.trouble
        (place / "a.rrd").unlink()
        place.rmdir()
        place.touch()
        until(lambda: noise(recorder, 1) or recorder.trouble, every_s=0.02, what="trouble")
        assert "not recording" in recorder.trouble and recorder.detail["recording"] == "none"
        before = recorder.dropped["recording"]
        noise(recorder, 2)
        assert recorder.dropped["recording"] == before + 1
        place.unlink()
        place.mkdir()
        until(lambda: noise(recorder, 3) or not recorder.trouble, every_s=0.02, what="recording again")
        noise(recorder, 4)
    (again,) = place.iterdir()
    assert verified(again) and "/about" in entities(again) and "/noise" in entities(again)


FULL = """
import os, resource, sys, time
import numpy as np, rerun as rr
from pathlib import Path
from viz import outlet
from viz.blueprint import blueprint
from viz.settings import VizSettings
from viz.sinks import recording
outlet.LOOK_S, outlet.RETRY_S, outlet.LEAVE_S = 0.05, 0.1, 2.0
noise = np.random.default_rng(0).integers(0, 255, (200, 1000), dtype=np.uint8)
unlimited = resource.RLIM_INFINITY
end = time.monotonic() + 60
with recording(VizSettings(record=sys.argv[1], flush_s=0.05), "", blueprint()) as recorder:
    resource.setrlimit(resource.RLIMIT_FSIZE, (1_000_000, unlimited))
    n = 0
    while time.monotonic() < end:
        recorder.set_time(n, n * 0.1)
        recorder.log("noise", rr.Tensor(noise))
        recorder.tend()
        n += 1
        time.sleep(0.02)
        if "not recording" in recorder.trouble:
            break
    print(recorder.trouble, flush=True)
    resource.setrlimit(resource.RLIMIT_FSIZE, (unlimited, unlimited))
    while time.monotonic() < end and (recorder.trouble or len(list(Path(sys.argv[1]).parent.iterdir())) < 2):
        recorder.tend()
        time.sleep(0.02)
    recorder.log("after", rr.Tensor(noise))
os._exit(0)  # as viz does at its deadline: what could not be written must not keep the process
"""


def test_a_write_that_fails_is_noticed_and_the_next_piece_is_whole(tmp_path):
    done = subprocess.run(
        [sys.executable, "-c", FULL, str(tmp_path / "a.rrd")], capture_output=True, text=True, timeout=120,
        cwd=Path(__file__).parents[2], check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert "not recording" in done.stdout, (done.stdout, done.stderr)
    later = sorted(path for path in tmp_path.iterdir() if path.name != "a.rrd")
    assert later and verified(later[-1]) and "/after" in entities(later[-1]), done.stderr


class Disk:
    """A pipe in place of a file: what is written waits until it is read, and it is read only while the disk works."""

    def __init__(self, path: Path) -> None:
        os.mkfifo(path)
        self.works = threading.Event()
        self.works.set()
        self._fd = os.open(path, os.O_RDWR | os.O_NONBLOCK)
        self._gone = threading.Event()
        self._thread = threading.Thread(target=self._read, daemon=True)
        self._thread.start()

    def _read(self) -> None:
        while not self._gone.wait(0.001):
            if self.works.wait(0.1):
                with contextlib.suppress(BlockingIOError):
                    while os.read(self._fd, 1 << 20):
                        pass

    def close(self) -> None:
        self._gone.set()
        self._thread.join(5)
        os.close(self._fd)


def test_a_file_that_takes_nothing_holds_up_nobody_and_costs_no_memory(tmp_path):
    disk = Disk(tmp_path / "a.rrd")
    try:
        with recording(VizSettings(record=str(tmp_path / "a.rrd"), flush_s=0.05), "", blueprint()) as recorder:
            n = 0

            def given(done) -> bool:
                nonlocal n
                noise(recorder, n)
                n += 1
                return done()

            until(lambda: given(lambda: n > 20), every_s=0.01, what="the first rows")
            assert not recorder.trouble
            disk.works.clear()
            until(lambda: given(lambda: recorder.dropped["recording"] > 50), every_s=0.01, within_s=60, what="drops")
            assert "does not take" in recorder.trouble
            memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
            began = time.monotonic()
            for _ in range(1500):  # 300 MB
                given(bool)
            assert time.monotonic() - began < 30
            assert (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - memory) / 1024 < 100
            disk.works.set()
            until(lambda: given(lambda: not recorder.trouble), every_s=0.02, within_s=30, what="taken again")
            before = recorder.dropped["recording"]
            given(bool)
            assert recorder.dropped["recording"] == before
    finally:
        disk.works.set()
        disk.close()


def test_a_viewer_that_is_frozen_slows_nothing(tmp_path):
    """A client that connected and reads no more: the server's queue fills, rows are dropped, the file goes on."""
    from common.bus import free_port

    port, path = free_port(), tmp_path / "a.rrd"
    s = VizSettings(record=str(path), serve=port, server_memory="8MiB", flush_s=0.05, live_flush_s=0.05)
    with recording(s, "", blueprint()) as recorder:
        copying = [RERUN, f"rerun+http://127.0.0.1:{port}/proxy", "--save", tmp_path / "viewer.rrd"]
        with group(copying) as saver:
            n = 0

            def seen() -> bool:
                nonlocal n
                noise(recorder, n)
                n += 1
                copy = tmp_path / "viewer.rrd"
                return copy.exists() and copy.stat().st_size > 2**20

            until(seen, every_s=0.05, within_s=60, what="the viewer's copy")
            os.killpg(saver.pid, signal.SIGSTOP)
            worst, bytes_before = 0.0, path.stat().st_size
            for _ in range(800):  # 160 MB
                began = time.monotonic()
                noise(recorder, n)
                n += 1
                worst = max(worst, time.monotonic() - began)
                time.sleep(0.002)
            assert worst < 5.0
            until(lambda: path.stat().st_size - bytes_before > 120 * 2**20, within_s=60, what="the file")
            assert recorder.dropped["recording"] == 0
