"""Which machine and software made a recording: figures are equal to the last digits only on the same ones."""

from __future__ import annotations

import hashlib
import platform
from importlib import metadata
from pathlib import Path

PACKAGES = ("numpy", "torch", "warp-lang", "msgspec", "mcap")


def machine() -> dict[str, str]:
    """Processor, system and the packages that compute."""
    return {"processor": _processor(), "system": f"{platform.system()} {platform.machine()}",
            "python": platform.python_version(), **{name: _version(name) for name in PACKAGES}}  # fmt: skip


def _processor() -> str:
    """Model and a digest of what it can do: both decide which kernels a library chooses."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor() or "unknown"
    facts: dict[str, str] = {}
    for line in lines:
        name, _, value = line.partition(":")
        facts.setdefault(name.strip(), value.strip())
    abilities = facts.get("flags") or facts.get("Features") or ""
    digest = hashlib.sha256(" ".join(sorted(abilities.split())).encode()).hexdigest()[:12]
    return f"{facts.get('model name', 'unknown')} {digest}"


def _version(package: str) -> str:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return "none"
