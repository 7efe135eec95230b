"""The 24 named situations, and random variants of them by seed. Fixed before any alarm's threshold was tuned.

Each is a function of its parameters; the named one takes the nominal values, a variant draws them from their ranges.
What a variant is, hazardous or harmless, is told by `truth_of` alone, whatever its name.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from evaluation.hazards import across, along
from evaluation.hazards.episode import Episode
from evaluation.hazards.script import Draw
from evaluation.hazards.truth import Truth, truth_of

HAZARDOUS: tuple[Callable[[Draw], Episode], ...] = (
    along.cut_in_short,
    along.cut_out_reveals_standing_car,
    along.braking_lead,
    along.queue_end,
    along.merge_side_swipe,
    along.truck_drifts,
    along.door_zone_cyclist,
    across.crossing_pedestrian,
    across.perpendicular_conflict,
    across.oncoming_left_turn,
    across.u_turning_car,
    across.roundabout_entry,
)
HARMLESS: tuple[Callable[[Draw], Episode], ...] = (
    along.cut_in_wide,
    along.lead_leaves_by_exit,
    along.lead_slows_and_goes_on,
    along.stopped_car_on_shoulder,
    along.overtaken_in_next_lane,
    along.pedestrian_alongside,
    along.cyclist_straight,
    across.perpendicular_clear,
    across.side_street_car_stops,
    across.oncoming_left_turn_clears,
    across.oncoming_on_bend,
    across.roundabout_exit,
)

ALARM_S = 1.5
"""An alarm counts when it comes at least so long before the event [s]."""
FORESEEABLE_S = 2.5
"""A manoeuvre that makes a danger must begin at least so long before the event [s]: one second of it can be seen before
the last moment at which an alarm counts. Variants that nobody could foresee are drawn again, and counted."""


@dataclass(frozen=True)
class Case:
    """An episode and what happens in it."""

    episode: Episode
    truth: Truth
    seed: int | None = None


def named() -> list[Case]:
    """The 24."""
    return [_case(make(Draw())) for make in (*HAZARDOUS, *HARMLESS)]


@dataclass
class Drawn:
    """How many variants were drawn, and why some were drawn again."""

    used: int = 0
    grey: int = 0
    unforeseeable: int = 0
    too_early: int = 0


def variants(seed: int, count: int, drawn: Drawn | None = None) -> Iterator[Case]:
    """`count` random variants, situations in turn, parameters by `seed`; what is neither is drawn again."""
    random = np.random.default_rng(seed)
    drawn = Drawn() if drawn is None else drawn
    makers = (*HAZARDOUS, *HARMLESS)
    order = np.concatenate([random.permutation(len(makers)) for _ in range(-(-count // len(makers)))])[:count]
    for k in order:
        while True:
            case = _case(makers[k](Draw(random)), seed)
            why = unfit(case)
            if why is None:
                break
            setattr(drawn, why, getattr(drawn, why) + 1)
        drawn.used += 1
        yield case


def unfit(case: Case) -> str | None:
    """Why a variant is drawn again: `grey`, `unforeseeable`, `too_early` (no time for any alarm); None: it is used."""
    truth, episode = case.truth, case.episode
    if truth.label == "grey":
        return "grey"
    if truth.event_s is None:
        return None
    if truth.event_s < ALARM_S + 1.0:
        return "too_early"
    if episode.onset_s is not None and truth.event_s - episode.onset_s < FORESEEABLE_S:
        return "unforeseeable"
    return None


def _case(episode: Episode, seed: int | None = None) -> Case:
    return Case(episode, truth_of(episode), seed)
