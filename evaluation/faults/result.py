"""What a row of the fault table is: the fault, the proof that it happened, the figures, reached or not."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

Figure = float | int | str
Say = Callable[[str], None]
"""Told in a few words what a row is doing."""


class FaultError(Exception):
    """A row that proves nothing: its fault did not happen, or what it needs did not come; the text says which."""


@dataclass(frozen=True)
class Scale:
    """How often a fault is repeated."""

    full: bool = False
    """`make faults-full`: the counts of the issue, hours."""
    smoke: bool = False
    """The quick forms in the tests: does the fault happen, and are the promises kept that speed does not touch?"""

    def repetitions(self, quick: int, full: int, smoke: int = 1) -> int:
        """So many repetitions in `make faults`, in `make faults-full`, in a test."""
        return full if self.full else smoke if self.smoke else quick

    def seconds(self, quick: float, full: float, smoke: float) -> float:
        """The same for a length of time [s]."""
        return full if self.full else smoke if self.smoke else quick

    @property
    def mode(self) -> str:
        """The make target that runs at this scale."""
        return "faults-full" if self.full else "smoke" if self.smoke else "faults"


@dataclass(frozen=True)
class Row:
    """One row of the table."""

    number: int
    fault: str
    """What was done to the system, with how often."""
    target: str
    """What was to be reached."""
    figures: dict[str, Figure]
    """What was measured; a name ends with its unit, such as `plan gap p99.9 [ms]`."""
    proof: str
    """How the run showed that its fault really happened, such as "5 of 5 processes gone, 5 new boots"."""
    reached: bool
    why: str = ""
    """If not reached: which part of the target was missed, and its cause as far as it is known."""


@dataclass
class Verdict:
    """Collects what of a target was missed."""

    missed: list[str] = field(default_factory=list)

    def need(self, holds: bool, otherwise: str) -> None:
        """Note `otherwise` unless it holds; write conditions so that NaN fails: `value <= limit`."""
        if not holds:
            self.missed.append(otherwise)

    def row(self, number: int, fault: str, target: str, figures: dict[str, Figure], proof: str) -> Row:
        """The row with this verdict.

        Raises:
            FaultError: there is no proof.
        """
        if not proof:
            raise FaultError("nothing shows that the fault happened")
        return Row(number, fault, target, figures, proof, not self.missed, "; ".join(self.missed))
