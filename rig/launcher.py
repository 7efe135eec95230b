"""The launcher: each service as its own process, watched, and gone afterwards whatever happens.

Nothing lies about on the disk: the configuration and the logs are files without a name (O_TMPFILE), handed to the
children as descriptors, so that even a launcher killed with SIGKILL leaves neither file nor process (`child.py`).
"""

from __future__ import annotations

import os
import site
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import IO

import common
from common.config import ENVIRONMENT_PREFIX, ConfigError, Tree, as_toml
from rig.statuses import Statuses

SERVICES = ("predictor", "riskfield", "planner")
MODULES = {**{name: f"services.{name}" for name in SERVICES}, "viz": "viz"}
STOP_S = 4.0
"""From SIGTERM to SIGKILL for a service [s]; it is due to end within 3 s."""
STOP_VIZ_S = 15.0
"""The same for viz, which has a recording to finish [s]."""
KEEP_MEMORY = {
    "MALLOC_MMAP_THRESHOLD_": str(64 * 2**20),
    "MALLOC_TRIM_THRESHOLD_": str(256 * 2**20),
    "MALLOC_TOP_PAD_": str(16 * 2**20),
}
"""glibc keeps the memory of one risk volume for the next instead of mapping and clearing 3 MB for each again."""
ONE_THREAD = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMEXPR_NUM_THREADS")
BAD_CONFIGURATION = 2
"""Exit code of a service that cannot use its configuration."""
UP = ("waiting", "ready", "degraded")


class LaunchError(RuntimeError):
    """Services that could not be brought up, or did not stay up; the text shows the end of their logs."""


@dataclass(frozen=True)
class Child:
    """One service's process and its log."""

    name: str
    process: subprocess.Popen[bytes]
    log: IO[bytes]

    def tail(self, lines: int = 15) -> str:
        """The last lines of its log."""
        size = os.fstat(self.log.fileno()).st_size
        start = max(size - 16384, 0)
        text = os.pread(self.log.fileno(), size - start, start).decode(errors="replace")
        return "\n".join(text.splitlines()[-lines:])


class Crew:
    """The services that were started. Made by `launch`."""

    def __init__(self, children: Sequence[Child]) -> None:
        self.children = tuple(children)

    def check(self) -> None:
        """Raise LaunchError if a service has ended, ConfigError if it did so because of its configuration."""
        for child in self.children:
            code = child.process.poll()
            if code == BAD_CONFIGURATION:
                raise ConfigError(child.tail(1))
            if code is not None:
                how = f"was killed by signal {-code}" if code < 0 else f"ended with code {code}"
                tail = child.tail() or "(its log is empty)"
                raise LaunchError(f"service {child.name} {how}; the end of its log:\n{tail}")

    def wait_ready(self, statuses: Statuses, timeout_s: float) -> None:
        """Wait until every service has said that it is up.

        Raises:
            LaunchError: a service ended, or was not up in time; says which and what it said last.
        """
        deadline = time.monotonic() + timeout_s
        while True:
            statuses.update()
            self.check()
            late = [c for c in self.children if statuses.state(c.name) not in UP]
            if not late:
                return
            if time.monotonic() > deadline:
                words = "; ".join(f"{c.name}: {statuses.words(c.name)}" for c in late)
                tails = "".join(f"\n--- log of {c.name}\n{c.tail()}" for c in late)
                raise LaunchError(
                    f"not ready after {timeout_s:g} s ({words}); --set rig.ready_timeout_s=… waits longer{tails}"
                )
            statuses.bus.wait(0.05)

    def stop(self) -> None:
        """End every process: SIGTERM, then SIGKILL at the deadline; viz last, it writes down the end of the others."""
        try:
            for wave in (SERVICES, ("viz",)):
                wanted = [c for c in self.children if c.name in wave]
                for child in wanted:
                    child.process.terminate()
                deadline = time.monotonic() + (STOP_VIZ_S if "viz" in wave else STOP_S)
                for child in wanted:
                    with suppress(subprocess.TimeoutExpired):
                        child.process.wait(max(deadline - time.monotonic(), 0.01))
        finally:
            for child in self.children:
                child.process.kill()
                child.process.wait()


@contextmanager
def launch(tree: Tree, names: Sequence[str], *, logs: Path | None = None) -> Iterator[Crew]:
    """Start services; when the `with` ends, none of them is left.

    To be called from the main thread: the children live as long as the thread that made them.

    Args:
        tree: the configuration that each of them gets, and nothing else (`FOREFIELD__…` variables are not passed on).
        names: which of `MODULES`.
        logs: folder that receives `NAME.log`; None: logs are kept only for as long as the run.

    Raises:
        ConfigError: `logs` cannot be written to.
        LaunchError: a process cannot be started.
    """
    with ExitStack() as stack:
        config = stack.enter_context(tempfile.TemporaryFile())
        config.write(as_toml(tree).encode())
        config.flush()
        children: list[Child] = []
        crew: Crew | None = None
        try:
            for name in names:
                log = stack.enter_context(_log(logs, name))
                children.append(start(name, (MODULES[name],), config, log))
            crew = Crew(children)
            yield crew
        finally:
            (crew or Crew(children)).stop()


def _log(folder: Path | None, name: str) -> IO[bytes]:
    if folder is None:
        return tempfile.TemporaryFile()
    try:
        folder.mkdir(parents=True, exist_ok=True)
        return (folder / f"{name}.log").open("w+b")
    except OSError as e:
        raise ConfigError(f"--logs {folder}: {e.strerror}") from None


def start(name: str, module: Sequence[str], config: IO[bytes], log: IO[bytes], *, within: Sequence[str] = ()) -> Child:
    """Start one process that ends with the thread that started it.

    Args:
        name: what it is called.
        module: its module and that one's arguments.
        config: file with its configuration.
        log: file that receives its output.
        within: a command before it, such as `ip netns exec NAME`.

    Raises:
        LaunchError: it cannot be started.
    """
    environment = _environment() | {"FOREFIELD_CONFIG": f"/proc/self/fd/{config.fileno()}"}
    command = [*within, sys.executable, "-P", "-m", "rig.child", str(os.getpid()), *module]
    try:
        process = subprocess.Popen(
            command,
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=log,
            env=environment,
            pass_fds=(config.fileno(),),
            start_new_session=True,  # Ctrl-C reaches the launcher alone, which then stops its children in order
        )
    except OSError as e:
        raise LaunchError(f"cannot start {name}: {e}") from e
    return Child(name, process, log)


def _environment() -> dict[str, str]:
    """Ours, with one thread for each service and our packages importable from any working directory."""
    environment = {k: v for k, v in os.environ.items() if not k.startswith(ENVIRONMENT_PREFIX)}
    environment |= {**dict.fromkeys(ONE_THREAD, "1"), **KEEP_MEMORY}
    environment |= {"PYTHONSAFEPATH": "1", "PYTHONUNBUFFERED": "1"}
    root = str(Path(common.__file__).resolve().parent.parent)
    if root not in [*site.getsitepackages(), site.getusersitepackages()]:  # a checkout, installed or not
        environment["PYTHONPATH"] = os.pathsep.join(filter(None, (root, environment.get("PYTHONPATH"))))
    return environment
