"""Selection: which method predicts which object. A policy is a name; every policy is a pure function.

- `paper`: off the lanes and with 30 frames of history → learned; on a lane → map; otherwise kinematic.
- `learned-first`: with 30 frames of history → learned; otherwise on a lane → map; otherwise kinematic.
- `learned-on-lanes`: the same; who is on a lane moves along its path, as far as the network says (`blend`).
- `map-first`: on a lane → map; otherwise kinematic.
- `kinematic`: kinematic alone.

Kinematic is CTRA for vehicles and cycles that turn or change speed, constant velocity for all others and for
pedestrians. Without a map every object counts as off the lanes.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from common.messages import F64, HISTORY_FRAMES, U8, Ego, Method, ObjectClass, Objects, Stamped
from services.predictor.history import Bool, Frames
from services.predictor.kinematic import VEHICLES, Motion, State
from services.predictor.settings import Policy

DRIVES_ON_LANES: Bool = np.isin(np.arange(len(ObjectClass)), VEHICLES)
"""By class: who is predicted along lanes. Two-wheelers leave theirs too readily: kinematic measured better for them."""


class Learned(Protocol):
    """A learned predictor."""

    name: str
    classes: Bool
    """By class: whether it may be used."""
    spread: F64 | None
    """Radius within which positions lie, by frame [m], shape [60] (`weight_files`); None: not known."""

    def observe(self, objects: Objects, frames: Frames, ego: Stamped[Ego] | None, capture_ns: int) -> None:
        """See every message, also where nothing is to be predicted."""
        ...

    def predict(self, objects: Objects, frames: Frames, state: State, wanted: Bool) -> Motion:
        """Motion of the objects where `wanted` (each with 30 frames of history), one row for each of these."""
        ...


@dataclass(frozen=True)
class Known:
    """What a policy may look at, for n objects."""

    on_lane: Bool
    full: Bool
    """30 frames of history, and of a class that the learned predictor speaks for."""
    cls: U8
    kinematic: U8
    """CTRA or CONSTANT_VELOCITY."""


@dataclass(frozen=True)
class Choice:
    """The methods that are used, and where the learned one would have been."""

    method: U8
    missed: Bool
    """The policy wants the learned predictor and there is none."""


def choose(policy: Policy, known: Known, learned: bool) -> Choice:
    """Methods of all objects; without a learned predictor its objects fall back to map and kinematic."""
    fallback = map_first(known)
    method = POLICIES[policy](known)
    missed = (method == Method.LSTM) & (not learned)
    return Choice(np.where(missed, fallback, method).astype(np.uint8), missed)


def paper(known: Known) -> U8:
    """As the paper prints it."""
    return np.where(~known.on_lane & known.full, np.uint8(Method.LSTM), map_first(known))


def learned_first(known: Known) -> U8:
    """Learned wherever the history is long enough."""
    return np.where(known.full, np.uint8(Method.LSTM), map_first(known))


def map_first(known: Known) -> U8:
    """Map wherever there is a lane."""
    return np.where(known.on_lane, np.uint8(Method.MAP_BASED), known.kinematic)


def kinematic(known: Known) -> U8:
    """No map, nothing learned."""
    return known.kinematic


POLICIES: dict[Policy, Callable[[Known], U8]] = {
    "paper": paper,
    "learned-first": learned_first,
    "learned-on-lanes": learned_first,
    "map-first": map_first,
    "kinematic": kinematic,
}


LEARNED_POLICIES: tuple[Policy, ...] = ("paper", "learned-first", "learned-on-lanes")
"""Policies that ask for a network."""


def kinematic_method(state: State, cls: U8) -> U8:
    """CTRA for vehicles and cycles that turn or change speed, otherwise constant velocity."""
    wheeled = (cls != ObjectClass.PEDESTRIAN) & (cls != ObjectClass.UNKNOWN)
    steady = (state.turn_rate == 0.0) & (state.acceleration == 0.0)
    return np.where(wheeled & ~steady, np.uint8(Method.CTRA), np.uint8(Method.CONSTANT_VELOCITY))


def full_history(frames: Frames) -> Bool:
    """Whether all 30 frames are known."""
    return np.asarray(frames.steps >= HISTORY_FRAMES - 1)
