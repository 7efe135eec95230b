"""Processes that a test starts, and that never outlive it: not a failed test, nor one that was killed itself."""

from __future__ import annotations

import contextlib
import ctypes
import os
import signal
import subprocess
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import IO

_LIBC = ctypes.CDLL(None)
_PR_SET_PDEATHSIG = 1


@contextlib.contextmanager
def group(
    command: Sequence[str | Path], *, cwd: Path | None = None, stdout: int | IO[str] = subprocess.DEVNULL
) -> Iterator[subprocess.Popen[str]]:
    """Run a command in a process group of its own; on the way out all of the group is killed."""
    process = subprocess.Popen(
        command, cwd=cwd, text=True, stdout=stdout, stderr=subprocess.DEVNULL, start_new_session=True,
        preexec_fn=end_with_the_test,
    )  # fmt: skip
    try:
        yield process
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()
        if process.stdout is not None:
            process.stdout.close()


def remains(process: subprocess.Popen[str]) -> bool:
    """Whether anything of its group still runs."""
    try:
        os.killpg(process.pid, 0)
    except ProcessLookupError:
        return False
    return True


def end_with_the_test() -> None:
    """For `preexec_fn`: the kernel kills this process when the one that started it ends, however it ends."""
    _LIBC.prctl(_PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)  # stays through an exec
