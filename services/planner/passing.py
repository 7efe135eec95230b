"""What stands alone in the lane: whoever cannot go round it yet waits where there is room to steer out.

A car that is parked in the second row is driven round, the end of a queue is not. The volume tells them apart: behind
the one the lane goes on free, and one of the paths beside it meets nothing that stays. As long as that path is not
free (somebody comes towards the ego on it), the ego keeps a wider gap; and since waiting longer gains nothing, leaving
the lane costs the less the longer it has been slow. Nobody overtakes a queue or goes round a closed line.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from msgspec.structs import replace

from services.planner.bezier import Paths
from services.planner.footprint import Footprint, PathRisk
from services.planner.lanes import Neighbour, RouteLanes
from services.planner.settings import PlannerSettings
from services.planner.speed import FAR, speed_law
from services.planner.volume import NOBODY, Volume

Bools = npt.NDArray[np.bool_]
F64 = npt.NDArray[np.float64]

_LONG = 18.0  # m; what blocks the path for longer (the ego's own length counted in) is no single vehicle
_FREE = 10.0  # m; so much of the lane must be free behind it
LEAST = 0.2
"""Share of its cost that leaving the lane keeps for who has waited."""
_BESIDE = 12.0
"""What stands nearer than this may be what the ego is going round [m]."""
OUT = 0.05
"""The share for who has pulled out: to make more room beside what stands is then hardly dearer than to make less."""


@dataclass(frozen=True)
class Blocked:
    """What stands in the lane."""

    distance: float  # [m]
    alone: bool  # the lane goes on free behind it, and a path leads round it


def blocked_by(
    paths: Paths,
    lanes: RouteLanes,
    risk: PathRisk,
    volume: Volume,
    footprint: Footprint,
    settings: PlannerSettings,
) -> Blocked | None:
    """What stands in the lane, None: nothing."""
    hit = risk.stays >= settings.r_hit  # [n, p]
    own = int(np.argmin(np.abs(paths.d).mean(axis=1)))
    blocked = np.flatnonzero(hit[own])
    if not len(blocked):
        return None
    first = int(blocked[0])
    alone = first > 0 and _alone(paths, lanes, risk, volume, footprint, hit, own, first, settings)
    return Blocked(paths.step * first, alone)


def _alone(
    paths: Paths,
    lanes: RouteLanes,
    risk: PathRisk,
    volume: Volume,
    footprint: Footprint,
    hit: Bools,
    own: int,
    first: int,
    settings: PlannerSettings,
) -> bool:
    last = first + int(np.argmin(np.append(hit[own, first:], False))) - 1
    beyond = last + 1 + int(np.ceil(_FREE / paths.step))
    known = paths.step * beyond <= min(float(risk.known[own]), float(paths.end[own]))
    if not known or paths.step * (last - first) > _LONG or hit[own, last + 1 : beyond + 1].any():
        return False
    if risk.who is None or np.isin(risk.who[0, own, 0, first : last + 1], lines(volume)).any():
        return False
    round_it = ~hit[:, : beyond + 1].any(axis=1) & (paths.end >= paths.step * last)
    round_it &= on_road(paths, lanes, footprint.half_width, last, settings)
    return bool(round_it.any())


def lines(volume: Volume) -> npt.NDArray[np.uint8]:
    """Numbers of the sources that are no bodies: closed lines, barriers, kerbs; and of what is not known."""
    of = [volume.who[i] for i, slot in enumerate(volume.risk.slots[: len(volume.who)]) if slot.cls < 0]
    return np.array([*of, NOBODY], dtype=np.uint8)


def on_road(paths: Paths, lanes: RouteLanes, half_width: float, station: int, settings: PlannerSettings) -> Bools:
    """Whether there is a lane, of whichever direction, under the outline of each path at a station [n]."""
    at, d = lanes.index(paths.s[:, station]), paths.d[:, station]

    margin = settings.lane_margin

    def covered(over: npt.NDArray[np.float64], side: Neighbour) -> Bools:
        return np.asarray((over <= margin) | side.exists[at] | ~lanes.mapped[at])

    return covered(d + half_width - lanes.own_left[at], lanes.left) & covered(
        lanes.own_right[at] - d + half_width, lanes.right
    )


def waiting_gap(stands: Blocked | None, speed: float, settings: PlannerSettings) -> float:
    """The gap to keep to it: `gap_round`, less where the ego is too near to keep it without braking firmly [m]."""
    if stands is None or not stands.alone:
        return settings.gap
    way = speed * settings.headway + 0.5 * speed**2 / settings.curve_brake
    return float(np.clip(stands.distance - way, settings.gap, settings.gap_round))


def priced(settings: PlannerSettings, stands: Blocked | None, share: float) -> PlannerSettings:
    """Settings with what leaving the lane costs now: less for who has waited long enough, more beside a queue."""
    if stands is None:
        return settings
    if share >= 1.0:
        if stands.alone:
            return settings
        return replace(settings, oncoming_cost=settings.oncoming_cost + settings.queue_cost)
    return replace(
        settings,
        oncoming_cost=share * settings.oncoming_cost,
        neighbour_cost=share * settings.neighbour_cost,
        mean_offset_cost=share * settings.mean_offset_cost,
        end_offset_cost=share * settings.end_offset_cost,
        change_cost=share * settings.change_cost,
    )


def patience(stands: Blocked | None, before: float, speed: float, dt: float, settings: PlannerSettings) -> float:
    """What leaving the lane still costs, as a share: all of it until the ego is slow, then less with the time it waits.

    It does not rise again before the lane is free, or what is next in it is no longer what was waited for: who has
    begun to go round goes on, but not past a queue further ahead.

    Args:
        stands: What stands in the lane.
        before: The share `dt` [s] ago.
        speed: Of the ego [m/s].
        dt: Time since then [s].
        settings: How slow is slow, and how long it waits.
    """
    if stands is None:
        return 1.0
    if not stands.alone:
        return before if stands.distance < _BESIDE else 1.0
    return min(before, max(before - dt / settings.patience * (speed < settings.patience_speed), LEAST))


def in_view(stands: Blocked | None, risk: PathRisk, put: F64, s_max: F64, settings: PlannerSettings) -> F64:
    """Speed that each path is good for in view of what stands in the lane [n], inf if nothing does [m/s].

    Where it must stop for it: as would bring the ego there within the horizon. Where it leads round: what the speed law
    says at the nearest place.

    Args:
        stands: What stands in the lane.
        risk: Of the paths.
        put: Where each must stop, far if nowhere [n] [m].
        s_max: Highest wanted speed [n] [m/s].
        settings: The speed law's, and the horizon.
    """
    if stands is None:
        return np.full(len(put), np.inf)
    nearest = risk.stays.max(axis=1) + settings.flank_margin
    law = speed_law(nearest, s_max, settings.r0, settings.r1)
    return np.where(put < 0.5 * FAR, np.maximum(put, 0.0) / settings.horizon_s, law)
