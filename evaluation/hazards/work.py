"""One function on many things, in several processes, with progress; the results in the order of the things."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing import get_context
from typing import TypeVar

from rich.progress import Progress

T = TypeVar("T")
R = TypeVar("R")

JOBS_MOST = 4
"""So many processes at most unless told otherwise: each holds some 400 MB."""


def usable_cores() -> int:
    """How many processes make sense here."""
    with suppress(AttributeError):  # not on every system
        return max(1, min(JOBS_MOST, len(os.sched_getaffinity(0))))
    return max(1, min(JOBS_MOST, os.cpu_count() or 1))


@dataclass(frozen=True)
class Work:
    """How work is done: in how many processes, and where its progress is shown."""

    jobs: int = 1
    progress: Progress | None = None

    def map(self, function: Callable[[T], R], things: Sequence[T], what: str) -> list[R]:
        """`function`, which must be importable, of each thing; the same whatever the number of processes."""
        task = None if self.progress is None else self.progress.add_task(what, total=len(things))

        def one_more() -> None:
            if self.progress is not None and task is not None:
                self.progress.advance(task)

        if self.jobs <= 1 or len(things) < 2:
            results = []
            for thing in things:
                results.append(function(thing))
                one_more()
            return results
        pool = ProcessPoolExecutor(min(self.jobs, len(things)), get_context("spawn"), initializer=_deaf)
        try:
            futures: list[Future[R]] = [pool.submit(function, thing) for thing in things]
            for _ in as_completed(futures):
                one_more()
            return [f.result() for f in futures]
        finally:
            pool.shutdown(cancel_futures=True)


def _deaf() -> None:
    """In a process of the pool: who interrupts the command is answered by the command."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
