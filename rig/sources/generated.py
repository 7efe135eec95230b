"""Built-in scenarios: small worlds by name, for a first look without any data and for tests with a known answer.

Seed 0 is the nominal case; any other seed draws speeds, gaps and moments around it and turns the whole world to
another heading, so that nothing rests on a lucky number or on a road that runs along x.
"""

from __future__ import annotations

from collections.abc import Callable

from common.messages import ObjectClass
from rig.sources.at_junctions import left_turn, red_light, right_turn, roundabout, u_turn, unprotected_left
from rig.sources.building import Draw
from rig.sources.merging import lane_ends, ramp_merge
from rig.sources.on_road import (
    blocked_road,
    car_adjacent,
    crossing_cyclist,
    crossing_pedestrian,
    cut_in,
    dead_end,
    demo,
    double_parked,
    following,
    hard_braking_lead,
    narrow_street,
    queue,
    slow_pedestrian,
    stop_and_go,
    stop_line_closed,
    straight,
    truck_adjacent,
)
from rig.world import Scenario

__all__ = ["REPLAYED", "SCENARIOS", "Draw", "ObjectClass", "generate", "truck_adjacent"]

SCENARIOS: dict[str, Callable[[Draw], Scenario]] = {
    "demo": demo,
    "straight": straight,
    "following": following,
    "stop_and_go": stop_and_go,
    "hard_braking_lead": hard_braking_lead,
    "cut_in": cut_in,
    "slow_pedestrian": slow_pedestrian,
    "truck_adjacent": truck_adjacent,
    "car_adjacent": car_adjacent,
    "crossing_pedestrian": crossing_pedestrian,
    "crossing_cyclist": crossing_cyclist,
    "left_turn": left_turn,
    "right_turn": right_turn,
    "u_turn": u_turn,
    "unprotected_left": unprotected_left,
    "ramp_merge": ramp_merge,
    "lane_ends": lane_ends,
    "roundabout": roundabout,
    "red_light": red_light,
    "stop_line": stop_line_closed,
    "double_parked": double_parked,
    "blocked_road": blocked_road,
    "queue": queue,
    "narrow_street": narrow_street,
    "dead_end": dead_end,
}
"""Every built-in scenario by name."""

REPLAYED: tuple[str, ...] = ("crossing_pedestrian", "crossing_cyclist")
"""Those whose others do not react: whether the ego sees them in time is the question."""


def generate(name: str, seed: int = 0) -> Scenario:
    """Build a built-in scenario; KeyError for an unknown name."""
    return SCENARIOS[name](Draw(seed))
