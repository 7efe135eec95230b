"""Wait for a condition with a deadline: never sleep for luck."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import TypeVar

T = TypeVar("T")


def until(condition: Callable[[], T], *, within_s: float = 10.0, every_s: float = 0.01, what: str = "condition") -> T:
    """Return the first truthy value of `condition`; fail after `within_s`."""
    end = time.monotonic() + within_s
    while True:
        value = condition()
        if value:
            return value
        if time.monotonic() > end:
            raise AssertionError(f"{what} did not come within {within_s} s")
        time.sleep(every_s)
