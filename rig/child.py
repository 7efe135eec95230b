"""Becomes a service that dies with its parent: `python -P -m rig.child PARENT_PID MODULE [ARGUMENTS ...]`.

The kernel is asked to kill this process when the launcher ends, however it ends (PR_SET_PDEATHSIG survives the exec):
even a launcher that was killed with SIGKILL leaves no process behind.
"""

from __future__ import annotations

import ctypes
import os
import signal
import sys

PR_SET_PDEATHSIG = 1


def main(arguments: list[str]) -> None:
    """Bind this process' life to its parent's, then become the module."""
    parent, command = int(arguments[0]), arguments[1:]
    if ctypes.CDLL(None, use_errno=True).prctl(PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0) != 0:
        raise OSError(ctypes.get_errno(), "prctl(PR_SET_PDEATHSIG)")
    if os.getppid() != parent:  # it ended before we asked
        raise SystemExit(1)
    os.execv(sys.executable, [sys.executable, "-P", "-m", *command])


if __name__ == "__main__":
    main(sys.argv[1:])
