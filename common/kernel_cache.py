"""Where compiled kernels are kept: a folder for each kind of processor.

Kernels are compiled for the very processor they run on. A cache that travels (in a container image, on a shared home)
must not hand one machine the code of another, so the folder's name holds a digest of the processor's features.
"""

from __future__ import annotations

import hashlib
import os
import platform
from collections.abc import Mapping
from pathlib import Path

from common.config import ConfigError


def kernel_cache(environment: Mapping[str, str] | None = None) -> Path:
    """The folder for this processor, made if need be: in `WARP_CACHE_PATH`, otherwise in the user's cache.

    Raises:
        ConfigError: it cannot be written to.
    """
    env = os.environ if environment is None else environment
    root = Path(env["WARP_CACHE_PATH"]) if env.get("WARP_CACHE_PATH") else _user_cache(env) / "forefield" / "warp"
    folder = root / _processor()
    try:
        folder.mkdir(parents=True, exist_ok=True)
        probe = folder / f".writable-{os.getpid()}"
        probe.touch()
        probe.unlink()
    except OSError as e:
        raise ConfigError(f"compiled kernels cannot be kept in {folder} ({e.strerror}): set WARP_CACHE_PATH") from None
    return folder


def _user_cache(env: Mapping[str, str]) -> Path:
    return Path(env["XDG_CACHE_HOME"]) if env.get("XDG_CACHE_HOME") else Path.home() / ".cache"


def _processor() -> str:
    features = ""
    try:
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith(("flags", "Features")):
                features = line.partition(":")[2]
                break
    except OSError:
        features = platform.processor()
    return f"{platform.machine()}-{hashlib.sha256(features.encode()).hexdigest()[:12]}"
