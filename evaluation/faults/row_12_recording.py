"""Row 12: the disk is full, nearly full, read-only, or slow while the bus is recorded."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np

from common.config import as_toml
from evaluation.faults.result import FaultError, Figure, Row, Say, Scale, Verdict
from evaluation.faults.stack import Stack, stack
from evaluation.faults.watch import MISSED_MS, until
from rig.bus_log.reader import BusLog

NUMBER = 12
TARGET = "recording degrades and says so; plans unchanged; file readable to its last record"
MIB = 2**20
DISK_MIB = 64
ROOM_BYTES = 400_000
"""What is left on a disk that fills up: not even a second of risk volumes."""
SAYS = {"full": "No space left", "nearly full": "to stay so", "readonly": "Read-only file system", "slow": ""}


class Disk:
    """A small disk of its own (tmpfs), which may be filled up by somebody else."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def fill(self, but: int) -> None:
        """Leave so many bytes free."""
        with suppress(OSError), (self.folder / "filler").open("ab", buffering=0) as file:  # others write here too
            while (free := self.free() - but) > 0:
                file.write(bytes(min(free, MIB)))

    def relieve(self) -> None:
        """Take the filler away."""
        (self.folder / "filler").unlink(missing_ok=True)

    def free(self) -> int:
        """Bytes."""
        disk = os.statvfs(self.folder)
        return disk.f_bavail * disk.f_frsize


@contextmanager
def small_disk() -> Iterator[Disk]:
    """A file system of 64 MiB.

    Raises:
        FaultError: nothing may be mounted here.
    """
    folder = Path(tempfile.mkdtemp(prefix="faults-disk-"))
    mount = ["mount", "-t", "tmpfs", "-o", f"size={DISK_MIB}m", "faults", str(folder)]
    try:
        done = subprocess.run(mount, capture_output=True, text=True, check=False)
        if done.returncode:
            raise FaultError(f"a small disk cannot be mounted (root can): {done.stderr.strip()}")
        yield Disk(folder)
    finally:
        subprocess.run(["umount", "-l", str(folder)], capture_output=True, check=False)
        with suppress(OSError):
            folder.rmdir()


class Recording:
    """The recorder in a process of its own."""

    def __init__(self, s: Stack, path: Path, fault: str, reserve: int) -> None:
        self.path = path
        self._config = tempfile.NamedTemporaryFile(suffix=".toml")  # noqa: SIM115 - closed with it
        self._config.write(as_toml(s.tree).encode())
        self._config.flush()
        root = str(Path(__file__).parents[2])
        environment = {k: v for k, v in os.environ.items() if not k.startswith("FOREFIELD")}
        environment |= {"FOREFIELD_CONFIG": self._config.name}
        environment["PYTHONPATH"] = os.pathsep.join(filter(None, (root, environment.get("PYTHONPATH"))))
        self._process = subprocess.Popen(
            [sys.executable, "-P", "-m", "evaluation.faults.recording", str(path), fault, str(reserve)],
            env=environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
        )  # fmt: skip
        self.said: list[dict[str, Any]] = []
        self._thread = threading.Thread(target=self._listen, daemon=True)
        self._thread.start()

    @property
    def last(self) -> dict[str, Any]:
        """What it last said."""
        return self.said[-1] if self.said else {"written": {}, "dropped": {}, "trouble": "", "failing_writes": 0}

    def written(self) -> int:
        """Messages."""
        return sum(self.last["written"].values())

    def dropped(self) -> int:
        """Messages."""
        return sum(self.last["dropped"].values())

    def fail(self) -> None:
        """From now on its disk fails."""
        assert self._process.stdin is not None
        self._process.stdin.write("fault\n")
        self._process.stdin.flush()

    def close(self, within_s: float) -> int:
        """End it; its exit code.

        Raises:
            FaultError: it does not end.
        """
        assert self._process.stdin is not None
        with suppress(OSError):
            self._process.stdin.close()
        try:
            code = self._process.wait(within_s)
        except subprocess.TimeoutExpired:
            self._process.kill()
            raise FaultError("the recorder did not end") from None
        self._thread.join(5.0)
        self._config.close()
        return code

    def kill(self) -> None:
        """Whatever it does."""
        self._process.kill()
        self._process.wait()

    def _listen(self) -> None:
        assert self._process.stdout is not None
        for line in self._process.stdout:
            self.said.append(json.loads(line))


def run(scale: Scale, seed: int, say: Say) -> Row:
    """Each fault once, or some times."""
    n, seconds = scale.repetitions(1, 10), scale.seconds(5.0, 30.0, 2.5)
    verdict, gaps = Verdict(), []
    figures: dict[str, Figure] = {}
    stops, proofs = 0, []
    users = 8 if scale.smoke else 32
    with stack(seed=seed, road_users=users, drive=False) as s, small_disk() as disk:
        for service in ("predictor", "riskfield", "planner"):
            s.wait_up(service)
        s.wait_drive()
        since = time.monotonic_ns()
        time.sleep(seconds)
        before = s.watch.gaps_ms(since)
        stops_before = sum(p.mode != "drive" for p in s.watch.heard("plan", since)) / max(len(before), 1)
        for _ in range(n):
            for fault in SAYS:
                found, proof, since, end = _recorded(s, disk, fault, seconds, verdict)
                figures |= found
                proofs.append(f"{fault}: {proof}")
                gaps.append(s.watch.gaps_ms(since, end))
                stops += sum(p.mode != "drive" for p in s.watch.heard("plan", since, end))
                s.check()
                say(f"{fault}: {proof}; {found}")
        refused = _refused_from_the_start(s, disk)
    all_gaps = np.concatenate(gaps)
    missed, missed_before = int((all_gaps > MISSED_MS).sum()), int((before > MISSED_MS).sum())
    share = stops / max(len(all_gaps), 1)
    verdict.need(missed == 0, f"{missed} plans missed ({missed_before} before any fault)")
    verdict.need(
        share <= stops_before + 0.01,
        f"{100 * share:.1f} % of the plans do not drive, {100 * stops_before:.1f} % before any fault",
    )
    verdict.need(bool(refused), "a read-only folder is not refused before the recording begins")
    figures |= {
        "missed plans": missed, "plan gap p99, before and during [ms]":
        f"{np.percentile(before, 99):.0f}, {np.percentile(all_gaps, 99):.0f}",
        "plans that do not drive [%]": 100 * share, "a read-only folder, said at once": refused,
    }  # fmt: skip
    fault = f"disk full (ENOSPC), nearly full, read-only (EROFS), slow (300 kB/s), {seconds:g} s each"
    return verdict.row(NUMBER, fault, TARGET, figures, "; ".join(proofs[: len(SAYS)]))


def _recorded(
    s: Stack, disk: Disk, fault: str, seconds: float, verdict: Verdict
) -> tuple[dict[str, Figure], str, int, int]:  # fmt: skip
    """Record, let the disk fail, and read what is there; and from when to when it failed [ns].

    That a recorder is started, and that what it wrote is read here, costs time that no failing disk takes.
    """
    path = disk.folder / "bus.mcap"
    path.unlink(missing_ok=True)
    disk.relieve()
    recording = Recording(s, path, fault, 8 * MIB if fault == "nearly full" else 0)
    try:
        until(lambda: recording.written() > 50, 60.0, "a recording that runs")
        since = time.monotonic_ns()
        if fault in ("full", "nearly full"):
            disk.fill(ROOM_BYTES if fault == "full" else 4 * MIB)
        else:
            recording.fail()
        if fault == "slow":
            until(lambda: recording.last["failing_writes"] > 0, 20.0, "a slow write")
            time.sleep(seconds)
        else:
            until(lambda: SAYS[fault] in recording.last["trouble"], 30.0, f"the recorder's word about {fault}")
            time.sleep(seconds)
        troubled = dict(recording.last)
        proof = f"{troubled['trouble'][-60:] or 'slow'}, {sum(troubled['dropped'].values())} dropped and counted"
        if fault == "nearly full":
            disk.relieve()
            at = recording.written()
            until(lambda: not recording.last["trouble"] and recording.written() > at, 20.0, "recording again")
        if fault == "full":
            verdict.need(disk.free() < 100_000 + ROOM_BYTES, f"the disk was not full: {disk.free()} bytes free")
        end = time.monotonic_ns()
        code = recording.close(90.0)
    except BaseException:
        recording.kill()
        raise
    verdict.need(code == 0, f"{fault}: the recorder ended with code {code}")
    verdict.need(recording.dropped() > 0, f"{fault}: nothing was counted as dropped")
    verdict.need(bool(recording.last["trouble"]) or fault == "nearly full", f"{fault}: nothing was said")
    log = BusLog.open(path)
    found = sum(1 for _ in log.messages())
    verdict.need(found == recording.written() > 0, f"{fault}: {found} read, {recording.written()} written")
    verdict.need(not log.refused, f"{fault}: {log.refused} refused")
    return {f"{fault}: written, read back": f"{recording.written()}, {found}"}, proof, since, end


def _refused_from_the_start(s: Stack, disk: Disk) -> str:
    """`forefield record` into a file system that is mounted read-only; what it says."""
    if subprocess.run(["mount", "-o", "remount,ro", str(disk.folder)], capture_output=True, check=False).returncode:
        return ""
    command = [shutil.which("forefield") or str(Path(sys.executable).with_name("forefield"))]
    done = subprocess.run(
        [*command, "record", str(disk.folder / "x.mcap"), "--connect", s.endpoint, "--duration", "1"],
        capture_output=True, text=True, check=False, timeout=60,
    )  # fmt: skip
    return f"code {done.returncode}" if done.returncode == 2 and "not writable" in done.stderr else ""
