"""Work done a little at a time: a generator that says after each part how much that was, and returns its result.

A planner that must answer every 50 ms prepares a new road this way. The amount is counted, not timed, so that the same
inputs give the same plans on every machine.
"""

from __future__ import annotations

from collections.abc import Generator
from typing import TypeVar

T = TypeVar("T")
Work = Generator[int, None, T]
"""Yields how many lines, or what is worth so many, it has looked at since; about 0.1 ms each."""


def advance(work: Work[T], amount: float) -> T | None:
    """Go on until the result is there, or, with None, until `amount` has been done."""
    done = 0
    while done < amount:
        try:
            done += next(work)
        except StopIteration as e:
            result: T = e.value
            return result
    return None


def finished(work: Work[T]) -> T:
    """The result of all of it."""
    while True:
        try:
            next(work)
        except StopIteration as e:
            result: T = e.value
            return result
