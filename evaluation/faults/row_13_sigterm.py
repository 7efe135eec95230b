"""Row 13: SIGTERM under load: every process ends in time, with code 0, and leaves nothing in /dev/shm."""

from __future__ import annotations

from pathlib import Path

from evaluation.faults.result import FaultError, Figure, Row, Say, Scale, Verdict
from evaluation.faults.stack import Stack, stack
from rig.launcher import SERVICES

NUMBER = 13
TARGET = "exit ≤ 3 s, code 0, nothing left in /dev/shm"
EXIT_S = 3.0
SHM = "/dev/shm/"


def run(scale: Scale, seed: int, say: Say) -> Row:
    """End each service in turn while the others send it messages; then the router, with everything running."""
    n = scale.repetitions(5, 100)
    took: dict[str, list[float]] = {name: [] for name in (*SERVICES, "router")}
    codes: list[int] = []
    used: set[Path] = set()
    with stack(seed=seed) as s:
        for i in range(n):
            for service in SERVICES:
                s.settle(0.3)
                used |= mapped(s)
                end(s, service, took, codes)
                s.start(service)
                s.wait_up(service)
            say(f"{i + 1} of {n}: {', '.join(f'{k} {v[-1]:.2f} s' for k, v in took.items() if v)}")
        routers = scale.repetitions(3, 100)
        for _ in range(routers):
            s.settle(0.3)
            end(s, "router", took, codes)
            s.start("router")
            s.wait_drive()
        say(f"router {routers}×: worst {max(took['router']):.2f} s")
    left = sum(path.exists() for path in used)
    shared = shared_memory(seed, codes, took)
    say(f"with shared memory: {len(shared)} files, {sum(path.exists() for path in shared)} left")
    worst = {name: max(seconds) for name, seconds in took.items()}
    bad = [c for c in codes if c != 0]
    figures: dict[str, Figure] = {
        **{f"{name} ends, worst [s]": seconds for name, seconds in worst.items()},
        "exit codes other than 0": len(bad),
        "left in /dev/shm": f"{left} of {len(used)}",
        "with shared memory on (not the default)": f"{sum(path.exists() for path in shared)} of {len(shared)} left",
    }
    verdict = Verdict()
    for name, seconds in worst.items():
        verdict.need(seconds <= EXIT_S, f"{name} took {seconds:.1f} s")
    verdict.need(not bad, f"exit codes {sorted(set(bad))}")
    verdict.need(left == 0, f"{left} files left in /dev/shm")
    if not shared:
        raise FaultError("shared memory was on and no file of it was seen: nothing is known of what is left")
    proof = f"{len(codes)} processes were sent SIGTERM while the vehicle drove, and each ended before it was killed"
    return verdict.row(NUMBER, f"SIGTERM under load {n}× each service, {routers}× the router", TARGET, figures, proof)


def shared_memory(seed: int, codes: list[int], took: dict[str, list[float]]) -> set[Path]:
    """The same once with Zenoh's shared memory on; returns the files that its processes had in /dev/shm."""
    with stack(seed=seed, settings={"bus.shared_memory": True}) as s:
        used = mapped(s)
        for name in (*SERVICES, "router"):
            end(s, name, took, codes)
    return used


def end(s: Stack, name: str, took: dict[str, list[float]], codes: list[int]) -> None:
    """SIGTERM; notes how long it took and with which code it ended."""
    seconds, code = s.terminate(name, 10.0)
    took[name].append(seconds)
    codes.append(code)


def mapped(s: Stack) -> set[Path]:
    """Files in /dev/shm that our processes use."""
    found = set()
    for life in s.lives.values():
        maps = Path(f"/proc/{life.pid}/maps").read_text().splitlines()
        found |= {Path(words[5]) for line in maps if len(words := line.split(maxsplit=5)) == 6 and SHM in words[5]}
    return found
