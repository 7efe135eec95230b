"""Where the drives are computed: here, in processes of this machine, or on a Dask cluster; the figures are the same."""

from __future__ import annotations

import importlib
import itertools
import multiprocessing
import os
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from typing import Any, TypeVar

from common.config import ConfigError
from evaluation.planning.tasks import Task, run

Outcome = tuple[int, dict[str, dict[str, Any]]]


def outcomes(tasks: Sequence[Task], *, jobs: int = 1, cluster: str = "") -> Iterator[Outcome]:
    """Index of each task and what came of it, as they are done.

    Raises:
        ConfigError: the cluster cannot be used.
    """
    if cluster:
        yield from _on_cluster(tasks, cluster)
    elif jobs > 1 and len(tasks) > 1:
        yield from _in_processes(tasks, jobs)
    else:
        for i, task in enumerate(tasks):
            yield i, run(task)


def _few_threads() -> None:
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(name, "1")  # before a child imports NumPy


def _in_processes(tasks: Sequence[Task], jobs: int) -> Iterator[Outcome]:
    _few_threads()
    with ProcessPoolExecutor(jobs, mp_context=multiprocessing.get_context("spawn")) as pool:
        waiting = {pool.submit(run, task): i for i, task in enumerate(tasks)}
        try:
            for done in as_completed(waiting):
                yield waiting[done], done.result()
        finally:
            pool.shutdown(wait=False, cancel_futures=True)


W = TypeVar("W")
R = TypeVar("R")


def in_order(piece: Callable[[int], tuple[W, R]], call: Callable[[W], R], jobs: int) -> Iterator[tuple[W, R, bool]]:
    """Pieces of work 0, 1, 2 … without end, each with its result, in this order whatever `jobs` is.

    `piece` gives the work of a number and its result where it is known already (empty: it is not); the last item says
    whether it was computed now.
    """
    if jobs <= 1:
        for k in itertools.count():
            work, known = piece(k)
            yield work, known or call(work), not known
    _few_threads()
    pool = ProcessPoolExecutor(jobs, mp_context=multiprocessing.get_context("spawn"))
    waiting: deque[tuple[W, R, Future[R] | None]] = deque()
    try:
        for k in itertools.count():
            work, known = piece(k)
            waiting.append((work, known, None if known else pool.submit(call, work)))
            while waiting and (len(waiting) >= 2 * jobs or waiting[0][2] is None):
                work, known, future = waiting.popleft()
                yield work, known if future is None else future.result(), future is not None
    finally:
        pool.shutdown(wait=False, cancel_futures=True)


def _on_cluster(tasks: Sequence[Task], address: str) -> Iterator[Outcome]:
    try:
        dask: Any = importlib.import_module("distributed")
    except ImportError:
        raise ConfigError("--cluster needs Dask: pip install 'forefield[cluster]'") from None
    try:
        client = dask.Client(address, timeout="10s")
    except (OSError, TimeoutError, ValueError) as e:
        raise ConfigError(f"--cluster {address}: no Dask scheduler answers there ({e or type(e).__name__})") from None
    with client:
        # a drive is not pure: its wall times differ, and it must not be answered from another run's results
        futures = [client.submit(run, task, pure=False) for task in tasks]
        index = {future.key: i for i, future in enumerate(futures)}
        for done in dask.as_completed(futures):
            yield index[done.key], done.result()
