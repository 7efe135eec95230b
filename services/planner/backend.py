"""The kernels if warp is installed; without it NumPy does the same, slower."""

from __future__ import annotations

import importlib.util
from typing import Any

kernels: Any = None

if importlib.util.find_spec("warp") is not None:
    from services.planner import kernels as _kernels

    kernels = _kernels
