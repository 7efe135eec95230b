"""What the kernel tells of a process: its memory, descriptors, threads; and how busy the machine is."""

from __future__ import annotations

import os
import resource
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

MIB = 2**20


@dataclass(frozen=True)
class Sample:
    """One process at one moment."""

    t_s: float
    rss_mib: float
    fds: int
    threads: int


def sample(pid: int) -> Sample:
    """Look at a process now.

    Raises:
        OSError: it is gone.
    """
    fields = dict(line.split(":", 1) for line in Path(f"/proc/{pid}/status").read_text().splitlines() if ":" in line)
    rss, threads = int(fields["VmRSS"].split()[0]) / 1024, int(fields["Threads"])
    return Sample(time.monotonic(), rss, len(os.listdir(f"/proc/{pid}/fd")), threads)  # noqa: PTH208 - names suffice


def growth_mib(samples: Sequence[Sample]) -> float:
    """How much a process grew from first to last sample [MiB], by the Theil-Sen line: no single jump moves it."""
    kept = samples[:: max(1, len(samples) // 300)]
    t, rss = np.array([s.t_s for s in kept]), np.array([s.rss_mib for s in kept])
    i, j = np.triu_indices(len(kept), 1)
    return float(np.median((rss[j] - rss[i]) / (t[j] - t[i])) * (t[-1] - t[0])) if len(i) else 0.0


def drift(values: Sequence[int]) -> int:
    """By how much a count changed for good: the median of its last fifth less that of its first."""
    fifth = max(1, len(values) // 5)
    return round(float(np.median(values[-fifth:]) - np.median(values[:fifth])))


def cpu_times() -> tuple[float, float]:
    """Time in which all cores together worked, and in which they did not, since the start of the machine [s]."""
    fields = [int(x) for x in Path("/proc/stat").read_text().split("\n", 1)[0].split()[1:9]]
    tick = os.sysconf("SC_CLK_TCK")
    idle = fields[3] + fields[4]
    return (sum(fields) - idle) / tick, idle / tick


class Others:
    """How much of the cores processes that are not ours use, from its making on; ours are counted once they ended."""

    def __init__(self) -> None:
        self._begin = (*cpu_times(), _ours_s())

    def share(self) -> float:
        """Of all cores, 0 to 1."""
        (worked, idle), ours = cpu_times(), _ours_s()
        worked_0, idle_0, ours_0 = self._begin
        return max(worked - worked_0 - (ours - ours_0), 0.0) / max(worked - worked_0 + idle - idle_0, 1e-9)


def _ours_s() -> float:
    return sum(
        u.ru_utime + u.ru_stime for u in map(resource.getrusage, (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    )


def cpu_s(pid: int) -> float:
    """CPU time that a process has used [s]."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
