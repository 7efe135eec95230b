"""How the others move: as recorded, or as recorded until the ego is in the way."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, Protocol

from common.messages import Closures, Ego, Objects
from rig.world import Scenario

Kind = Literal["replay", "reactive"]


class Traffic(Protocol):
    """The other road users of one drive."""

    def advance(self, t: float, ego: Ego) -> None:
        """The ego is there at `t` [s]; called in order of time, at every whole 0.1 s at least."""

    def objects_at(self, t: float) -> Objects:
        """Who is where at `t` [s], at most 0.1 s after the last `advance`."""
        ...

    def closures_at(self, t: float) -> Closures:
        """What is closed at `t` [s]."""
        ...


@dataclass(frozen=True)
class Replay:
    """Everybody moves as recorded, whatever the ego does."""

    scenario: Scenario

    def advance(self, t: float, ego: Ego) -> None:
        """Nobody cares."""

    def objects_at(self, t: float) -> Objects:
        """As recorded."""
        return self.scenario.objects_at(t)

    def closures_at(self, t: float) -> Closures:
        """As recorded."""
        return self.scenario.closures_at(t)
