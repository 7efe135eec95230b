"""The default search: for every path the highest target speed whose rollout passes, in the gentlest tier with one.

Target speeds are tried on a grid from S_max down and then between the highest that passes and the next: the same
for any risk, so that a path's desired speed never rises when a cell's risk does.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from services.planner.bezier import Paths, Start
from services.planner.lanes import Neighbour, RouteLanes
from services.planner.rollout import Field, Rollouts, Tier, roll_out
from services.planner.settings import PlannerSettings

F64 = npt.NDArray[np.float64]
Ints = npt.NDArray[np.intp]
Bools = npt.NDArray[np.bool_]

_COARSE = 6
_FINE = 3


@dataclass(frozen=True)
class Verdict:
    """What the search found about each of n paths."""

    passed: Bools  # some target speed passes [n]
    desired: F64  # S_p, 0 where nothing passes [n] [m/s]
    tier: Ints  # in which tier [n]
    hold: F64  # hold of the rollout that passed [n] [s]
    rest: F64  # where that rollout ends [n] [m]
    failure: Ints  # what fails just above S_p, index into FAILURES; 0: nothing [n]
    failed_at: Ints  # in which step [n]
    failed_distance: F64  # and where on the path [n] [m]


def search(field: Field, start: Start, settings: PlannerSettings, preferred: F64) -> Verdict:
    """Evaluate every path of the field; `preferred` [n] is what all but speed adds to each path's score."""
    n = len(field.s_max)
    everything = np.arange(n)
    comfort, firm, emergency = Tier.all(settings)
    verdict = _highest(field, start, everything, comfort, settings)
    score = np.where(verdict.passed, verdict.desired + preferred, -np.inf)
    # a firmer tier counts only where comfort fails, and only if it could be better
    could = np.minimum(field.s_max, max(start.speed, 1.0)) + preferred - settings.tier_cost
    todo = everything[~verdict.passed & (could > score.max())]
    if len(todo):
        verdict = _merged(verdict, todo, _highest(field, start, todo, firm, settings))
    if not verdict.passed.any():
        verdict = _merged(verdict, everything, _highest(field, start, everything, emergency, settings))
    return verdict


def full_brake(field: Field, start: Start, settings: PlannerSettings) -> tuple[int, Rollouts]:
    """Nothing passes: brake with all there is, on the path that meets something last."""
    n = len(field.s_max)
    emergency = Tier.all(settings)[2]
    rollouts = roll_out(field, start, np.arange(n), np.zeros(n), np.zeros(n), emergency, settings)
    time_to_hit = np.where(rollouts.passed, len(rollouts.t) + 1, rollouts.failed_at)
    return int(np.argmax(time_to_hit)), rollouts


def _highest(field: Field, start: Start, path: Ints, tier: Tier, settings: PlannerSettings) -> Verdict:
    n = len(path)
    # braking tiers are there to brake: no faster than now, in an emergency well below
    s_max = np.minimum(field.s_max[path], (np.inf, start.speed, 0.6 * start.speed)[tier.index])
    low, high = np.full(n, -1.0), np.full(n, 1.0)  # shares of s_max: highest passed, next that fails
    out = Verdict(
        np.zeros(n, dtype=bool),
        np.zeros(n),
        np.full(n, tier.index),
        np.zeros(n),
        np.zeros(n),
        np.zeros(n, dtype=np.intp),
        np.zeros(n, dtype=np.intp),
        np.zeros(n),
    )
    for round_ in range(3):
        if round_ == 0:
            shares = np.broadcast_to(np.linspace(0.0, 1.0, _COARSE + 1), (n, _COARSE + 1))
            rows = np.arange(n)
        else:
            rows = np.flatnonzero(out.passed & (low < 1.0))
            if not len(rows):
                break
            w = np.arange(1, _FINE + 1) / (_FINE + 1)
            shares = low[rows, None] + w * (high - low)[rows, None]
        m = shares.shape[1]
        # for each target both holds: brake after the hold, never brake
        k_path = np.repeat(path[rows], 2 * m)
        k_target = np.repeat((shares * s_max[rows, None]).ravel(), 2)
        k_hold = np.tile([settings.hold_s, np.inf], len(rows) * m)
        r = roll_out(field, start, k_path, k_target, k_hold, tier, settings)
        ok = r.passed.reshape(len(rows), m, 2)
        which = np.where(ok[..., 1], 1, 0)  # going on is preferred to stopping
        good: Bools = np.asarray(ok[..., 0] | ok[..., 1])
        best = np.where(np.any(good, axis=1), m - 1 - np.argmax(good[:, ::-1], axis=1), -1)
        hit = best >= 0
        pick = np.maximum(best, 0)
        local = np.arange(len(rows))
        flat = (local * m + pick) * 2 + which[local, pick]
        up = rows[hit]
        low[up] = shares[local, pick][hit]
        out.passed[up] = True
        out.desired[up] = (shares[local, pick] * s_max[rows])[hit]
        out.hold[up] = k_hold[flat][hit]
        out.rest[up] = r.distance[flat, -1][hit]
        above = np.minimum(best + 1, m - 1)
        fails = best + 1 < m
        at = (local * m + above) * 2  # the rollout that brakes after the hold
        at = np.where(r.failure[at] > 0, at, at + 1)
        f = rows[fails]
        high[f] = shares[local, above][fails]
        out.failure[f] = r.failure[at][fails]
        out.failed_at[f] = r.failed_at[at][fails]
        out.failed_distance[f] = r.distance[at, r.failed_at[at]][fails]
    return out


def _merged(a: Verdict, where: Ints, b: Verdict) -> Verdict:
    """`b` of the paths `where`, `a` of the others; where neither passes, the harder tier's failure is kept."""
    for name in Verdict.__dataclass_fields__:
        getattr(a, name)[where] = getattr(b, name)
    return a


def path_cost(paths: Paths, lanes: RouteLanes, half_width: float, previous: str, settings: PlannerSettings) -> F64:
    """What speaks against each path besides its speed [n], in m/s of desired speed."""
    n, p = paths.x.shape
    reach = np.minimum(np.searchsorted(paths.s[0] - paths.s[0, 0], paths.length), p - 1)
    at = lanes.index(paths.s[np.arange(n), reach])
    end = paths.d[:, -1] if n == 0 else paths.d[np.arange(n), reach]
    cost = settings.mean_offset_cost * np.abs(paths.d).mean(axis=1) + settings.end_offset_cost * np.abs(end)
    longest = paths.length.max()
    cost += settings.length_cost * (1.0 - paths.length / longest)
    for sign, edge, side in ((1.0, lanes.own_left[at], lanes.left), (-1.0, -lanes.own_right[at], lanes.right)):
        over = sign * end + half_width - edge
        leaves = (over > settings.lane_margin) & (np.abs(end) > 0.05)
        cost += np.where(leaves, _side_cost(side, lanes, at, over, settings), 0.0)
    if previous:
        name = np.array(paths.target)
        cost += np.where((name != previous) & (name != REFERENCE), settings.change_cost, 0.0)
    return np.asarray(cost)


REFERENCE = "reference"
"""Name of the target that is the reference line itself."""


def _side_cost(side: Neighbour, lanes: RouteLanes, at: Ints, over: F64, settings: PlannerSettings) -> F64:
    there = side.exists[at]
    share = np.clip(over / 1.0, 0.0, 1.0)  # a little over the line is a little dear
    oncoming = settings.oncoming_cost * (0.25 + 0.75 * share)
    lane = np.where(side.same_direction[at], settings.neighbour_cost, oncoming)
    none = np.where(lanes.mapped[at], settings.off_road_cost * (0.25 + 0.75 * share), settings.unknown_side_cost)
    return np.where(there, lane, none)


def lane_centre_distance(paths: Paths, lanes: RouteLanes, distance: F64) -> F64:
    """How far off the nearest lane centre (own or of the same direction) each path is at a distance [n] [m]."""
    n, p = paths.x.shape
    i = np.clip(np.rint(distance / paths.step).astype(np.intp), 0, p - 1)
    d = paths.d[np.arange(n), i]
    at = lanes.index(paths.s[np.arange(n), i])
    off = np.abs(d)
    for side in (lanes.left, lanes.right):
        usable = side.exists[at] & side.same_direction[at]
        off = np.minimum(off, np.where(usable, np.abs(d - side.centre[at]), np.inf))
    return np.asarray(off)
