"""Records the whole bus beside a drive, from before its first message to after its last."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from common.config import Tree, as_toml
from rig import session
from rig.launcher import LaunchError

READY = "recording"
"""First word of what `forefield record` says when it hears the bus."""
STOP_S = 60.0


@contextmanager
def recorder(tree: Tree, path: Path, only: str = "") -> Iterator[None]:
    """`forefield record` as a process of its own: packing volumes would disturb the rig's ticks.

    Args:
        tree: the configuration with which the bus is reached; the recording keeps it.
        path: the MCAP file.
        only: topics to record; empty: all.

    Raises:
        LaunchError: it does not come up.
    """
    with tempfile.TemporaryFile() as config:
        config.write(as_toml(tree).encode())
        config.flush()
        command = [
            sys.executable,
            "-P",
            "-m",
            "rig.child",
            str(os.getpid()),
            "rig.command",
            "record",
            str(path.absolute()),
        ]
        command += ["--config", f"/proc/self/fd/{config.fileno()}", *(["--only", only] if only else [])]
        environment = {k: v for k, v in os.environ.items() if not k.startswith("FOREFIELD__")}
        root = str(Path(session.__file__).resolve().parent.parent)
        environment["PYTHONPATH"] = os.pathsep.join(filter(None, (root, environment.get("PYTHONPATH"))))
        process = subprocess.Popen(
            command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
            env=environment, pass_fds=(config.fileno(),), start_new_session=True,
        )  # fmt: skip
        try:
            assert process.stdout is not None
            assert process.stderr is not None
            if not process.stdout.readline().startswith(READY):
                process.kill()
                raise LaunchError(f"the bus is not recorded: {process.stderr.read().strip()[-500:]}")
            yield
        finally:
            process.send_signal(signal.SIGTERM)
            with suppress(subprocess.TimeoutExpired):
                process.communicate(timeout=STOP_S)
            process.kill()
            process.wait()
