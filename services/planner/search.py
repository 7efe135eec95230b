"""The default search: for every path the highest target speed whose rollout passes, in the gentlest tier with one.

Target speeds are tried on a grid from S_max down and then between the highest that passes and the next: the same
for any risk, so that a path's desired speed never rises when a cell's risk does.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from services.planner.backend import kernels
from services.planner.bezier import Paths, Start
from services.planner.lanes import Neighbour, RouteLanes
from services.planner.rollout import DT, Field, Rollouts, Tier, constants, roll_out
from services.planner.settings import PlannerSettings

F64 = npt.NDArray[np.float64]
Ints = npt.NDArray[np.intp]
Bools = npt.NDArray[np.bool_]

_OFF_CENTRE = 0.7  # m
_COARSE = 6
_NARROW = 30
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
    penalty: F64  # for coming to rest off a lane's centre [n] [m/s]


def search(
    field: Field,
    start: Start,
    settings: PlannerSettings,
    cost: F64,
    off_centre: Callable[[F64], F64],
    off_road: Bools | None = None,
    narrow: Bools | None = None,
    *,
    reference: bool = False,
) -> Verdict:
    """Evaluate every path of the field, going on and stopping apart.

    A path off the road passes only where no other does, however hard it brakes.

    Args:
        field: What the paths meet.
        start: State from which.
        settings: The controller's and the checks'.
        cost: What speaks against each path besides its speed [n] [m/s].
        off_centre: How far off a lane's centre each path is at distances [n] [m]: there nobody should stop.
        off_road: Which paths leave the road [n]; None: none.
        narrow: Which paths may be good for a narrow band of speeds only [n], for they lead into a gap; None: none.
        reference: Keep to NumPy.
    """
    if off_road is not None and off_road.any() and not off_road.all():
        verdict = _of_some(
            field, start, settings, cost, off_centre, narrow, np.flatnonzero(~off_road), reference=reference
        )
        if verdict.passed.any():
            return verdict
    everything = np.arange(len(field.s_max))
    return _of_some(field, start, settings, cost, off_centre, narrow, everything, reference=reference)


def _of_some(
    field: Field,
    start: Start,
    settings: PlannerSettings,
    cost: F64,
    off_centre: Callable[[F64], F64],
    narrow: Bools | None,
    some: Ints,
    *,
    reference: bool,
) -> Verdict:
    """The verdict on some of the paths; the others do not pass, in whatever tier."""
    n = len(field.s_max)
    comfort, firm, *harder = Tier.all(settings)

    def both(path: Ints, tier: Tier) -> Verdict:
        return _both(field, start, path, narrow, tier, settings, off_centre, reference=reference)

    verdict = _merged(_nothing(n, comfort, np.full(n, np.inf)), some, both(some, comfort))
    score = np.where(verdict.passed, verdict.desired - verdict.penalty - cost, -np.inf)
    # a firmer tier counts only where comfort fails, and only if it could be better
    could = np.minimum(field.s_max, max(start.speed, 1.0)) - cost - settings.tier_cost
    unsettled = some[(~verdict.passed & (could > score.max()))[some]]
    if len(unsettled):
        verdict = _merged(verdict, unsettled, both(unsettled, firm))
    for tier in harder:
        if not verdict.passed.any():
            verdict = _merged(verdict, some, both(some, tier))
    return verdict


def _nothing(n: int, tier: Tier, hold: F64) -> Verdict:
    """No path passes; nothing is known of why."""
    zero, none = np.zeros((4, n)), np.zeros((2, n), dtype=np.intp)
    return Verdict(
        np.zeros(n, dtype=bool), zero[0], np.full(n, tier.index), hold.copy(), zero[1], none[0], none[1], *zero[2:]
    )


def _both(
    field: Field,
    start: Start,
    path: Ints,
    narrow: Bools | None,
    tier: Tier,
    settings: PlannerSettings,
    off_centre: Callable[[F64], F64],
    *,
    reference: bool = False,
) -> Verdict:
    """The better of going on for good, and of braking to rest after the hold; more speeds are tried on narrow paths."""
    go, stop = highest(field, start, path, tier, settings, reference=reference)
    fine = np.zeros(len(path), dtype=bool) if narrow is None else narrow[path]
    if fine.any():
        finer = highest(field, start, path[fine], tier, settings, coarse=_NARROW, reference=reference)
        for all_of_it, found in zip((go, stop), finer, strict=True):
            for name, value in vars(found).items():
                getattr(all_of_it, name)[fine] = value
    rest = np.zeros(len(field.s_max))
    rest[path] = stop.rest
    stop.penalty[:] = settings.stop_off_centre_cost * (off_centre(rest)[path] > _OFF_CENTRE)
    better = np.where(go.passed, go.desired, -np.inf) >= np.where(stop.passed, stop.desired - stop.penalty, -np.inf)
    return Verdict(**{k: np.where(better, v, vars(stop)[k]) for k, v in vars(go).items()})


def gentlest(
    field: Field,
    start: Start,
    verdict: Verdict,
    chosen: int,
    settings: PlannerSettings,
    off_centre: Callable[[F64], F64],
    narrow: Bools | None = None,
) -> Tier:
    """The tier in which the chosen path is driven; where that is the firm one, it is no firmer than need be.

    Of `_FIRM_STEPS` from comfort to firm the first in which any target speed passes that keeps the gap all the time,
    and in that the highest such, which `verdict` is told: the harder a brake is counted on, the later it begins, and
    then it must be as hard as that. What is near leaves no time to brake harder later, should it do other than
    predicted: there the firm brake counts all the more.
    """
    comfort, firm, *_ = tiers = Tier.all(settings)
    if int(verdict.tier[chosen]) != firm.index:
        return tiers[int(verdict.tier[chosen])]
    path, best = np.array([chosen]), 1.0
    in_s = float(field.contact.distance[chosen, :, 0].min()) / max(start.speed, 1.0)
    near = float(np.clip((_FAR_S - in_s) / (_FAR_S - _NEAR_S), 0.0, 1.0))

    def found(share: float) -> Verdict:
        tier = Tier.between(comfort, firm, share, settings.gap)
        return _both(field, start, path, narrow, tier, settings, off_centre)

    low, high = 0, _FIRM_STEPS
    while high - low > 1:
        middle = (low + high) // 2
        if found(middle / _FIRM_STEPS).passed[0]:
            high, best = middle, middle / _FIRM_STEPS
        else:
            low = middle
    between = max(firm.brake - comfort.brake, 1e-9)
    now = (-start.acceleration - comfort.brake) / between  # what brakes so goes on so
    share = max(best + near * (1.0 - best), min(now, 1.0))
    if share < 1.0:
        told = found(share)
        if told.passed[0]:
            _merged(verdict, path, told)
            return Tier.between(comfort, firm, share, settings.gap)
    return firm


_NEAR_S, _FAR_S = 1.5, 3.0
"""Contact within the first needs the whole firm brake, beyond the second no more of it than suffices [s]."""
_FIRM_STEPS = 16
"""Brakes are told apart in so many steps from comfort to firm."""
_SWERVE_GAIN_S = 0.5
"""A slice: what is met sooner by less than this is not known to be met sooner [s]."""


def full_brake(field: Field, start: Start, settings: PlannerSettings, moved: F64) -> tuple[int, Rollouts]:
    """Nothing passes: brake with all there is, on the path that meets something last (see `last_to_meet`)."""
    n = len(field.s_max)
    emergency = Tier.all(settings)[-1]
    rollouts = roll_out(field, start, np.arange(n), np.zeros(n), np.zeros(n), emergency, settings)
    return last_to_meet(np.where(rollouts.passed, len(rollouts.t) + 1, rollouts.failed_at), moved), rollouts


def last_to_meet(steps: Ints, moved: F64) -> int:
    """The path that meets something last, in `steps` of DT [n].

    Of those that differ by no more than a slice it is the one that moves least to the side, `moved` [n] [m]: whoever
    brakes for somebody in vain has then not swerved into somebody else.
    """
    sooner = steps < steps.max() - round(_SWERVE_GAIN_S / DT)
    return int(np.lexsort((-steps, np.round(moved, 1), sooner))[0])


def highest(
    field: Field,
    start: Start,
    path: Ints,
    tier: Tier,
    settings: PlannerSettings,
    *,
    coarse: int = _COARSE,
    reference: bool = False,
) -> tuple[Verdict, Verdict]:
    """The highest target speed that passes on paths [n], going on for good and braking to rest after the hold.

    What stopping says counts only where it may be faster than going on; elsewhere it may be told to fail.
    """
    most = max(tier.most * start.speed, min(start.speed, tier.crawl)) if np.isfinite(tier.most) else np.inf
    s_max = np.minimum(field.s_max[path], most)
    holds = (np.inf, settings.hold_s)
    if kernels is None or reference:
        go, stop = (_highest(field, start, path, np.full(len(path), h), s_max, tier, settings, coarse) for h in holds)
        return go, stop
    values = constants(field, start, tier, settings)
    shares: F64 = np.linspace(0.0, 1.0, coarse + 1)
    found = kernels.highest(field.on_device, values, path, s_max, shares, _FINE)
    passed, desired, rest, failure, at, distance = found
    go, stop = (
        Verdict(
            passed[k],
            desired[k],
            np.full(len(path), tier.index),
            np.full(len(path), holds[k]),
            rest[k],
            failure[k].astype(np.intp),
            at[k].astype(np.intp),
            distance[k],
            np.zeros(len(path)),
        )
        for k in (0, 1)
    )
    return go, stop


def _highest(
    field: Field,
    start: Start,
    path: Ints,
    holds: F64,
    s_max: F64,
    tier: Tier,
    settings: PlannerSettings,
    coarse: int,
) -> Verdict:
    """The highest target speed up to `s_max` that passes on each path with its hold, all [n]; in NumPy."""
    n = len(path)
    low, high = np.full(n, -1.0), np.full(n, 1.0)  # shares of s_max: highest passed, next that fails
    out = _nothing(n, tier, holds)
    for m in (coarse + 1, _FINE, _FINE):
        if m > _FINE:
            rows = np.arange(n)
            shares = np.broadcast_to(np.linspace(0.0, 1.0, m), (n, m))
        else:
            rows = np.flatnonzero(out.passed & (low < 1.0))
            if not len(rows):
                break
            w = np.arange(1, m + 1) / (m + 1)
            shares = low[rows, None] + w * (high - low)[rows, None]
        targets = (shares * s_max[rows, None]).ravel()
        each = np.repeat(path[rows], m), targets, np.repeat(holds[rows], m)
        r = roll_out(field, start, *each, tier, settings, reference=True)
        good = r.passed.reshape(len(rows), m)
        best = np.where(good.any(axis=1), m - 1 - np.argmax(good[:, ::-1], axis=1), -1)
        local = np.arange(len(rows))
        hit = best >= 0
        k = local[hit], best[hit]
        up, flat = rows[hit], local[hit] * m + best[hit]
        low[up] = shares[k]
        out.passed[up] = True
        out.desired[up] = targets[flat]
        out.rest[up] = r.distance[flat, -1]
        fails = best + 1 < m
        k = local[fails], best[fails] + 1
        f, flat = rows[fails], local[fails] * m + best[fails] + 1
        high[f] = shares[k]
        out.failure[f] = r.failure[flat]
        out.failed_at[f] = r.failed_at[flat]
        out.failed_distance[f] = r.distance[flat, r.failed_at[flat]]
    return out


def _merged(a: Verdict, where: Ints, b: Verdict) -> Verdict:
    """`b` of the paths `where`, `a` of the others; what made the gentler tier fail is kept where `b` knows nothing."""
    told = b.failure > 0
    for name in ("failure", "failed_at", "failed_distance"):
        getattr(a, name)[where[told]] = getattr(b, name)[told]
    for name in ("passed", "desired", "tier", "hold", "rest", "penalty"):
        getattr(a, name)[where] = getattr(b, name)
    return a


def path_cost(
    paths: Paths, lanes: RouteLanes, half_width: float, previous: str, committed: Bools, settings: PlannerSettings
) -> F64:
    """What speaks against each path besides its speed [n], in m/s of desired speed.

    `previous` is the name of the target chosen last; `committed` [n] is the move under way, which costs no length.
    """
    n, p = paths.x.shape
    reach = np.minimum(np.searchsorted(paths.s[0] - paths.s[0, 0], paths.length), p - 1)
    at = lanes.index(paths.s[np.arange(n), reach])
    end = paths.d[:, -1] if n == 0 else paths.d[np.arange(n), reach]
    early = max(int(24.0 / paths.step), 2)  # what lies further ahead will be planned again
    off, end_off, along = np.abs(paths.d[:, :early]), np.abs(end), np.zeros(n, dtype=bool)
    name = np.array(paths.target)
    for k, track in enumerate(lanes.tracks):
        # whoever goes on in the lane in which he is drives on its centre, and waits for nobody to leave it
        mine = name == track_name(k)
        if mine.any() and abs(float(track.centre[lanes.index(paths.s[0, 0])] - paths.d[0, 0])) < _IN_LANE:
            along |= mine
            centre = track.centre[lanes.index(paths.s)]
            off[mine] = np.abs(paths.d - centre)[mine, :early]
            end_off[mine] = 0.0
    later = np.char.startswith(name, LATER)
    off[later], end_off[later] = 0.0, 0.0  # as long as it stays it is on a lane
    cost = settings.mean_offset_cost * off.mean(axis=1) + settings.end_offset_cost * end_off
    cost += settings.stay_cost * along
    for k in np.flatnonzero(later).tolist():  # while there is room a gap is looked for only where the lane ends
        ends = lanes.ends(lanes.tracks[later_from(paths.target[k])].leaves)
        cost[k] += settings.stay_cost * (_HURRY if ends else _PATIENT)
    cost += settings.length_cost * (1.0 - paths.length / paths.length.max()) * ~committed
    for sign, edge, side in ((1.0, lanes.own_left[at], lanes.left), (-1.0, -lanes.own_right[at], lanes.right)):
        over = sign * end + half_width - edge
        leaves = (over > settings.lane_margin) & (np.abs(end) > 0.05) & ~along & ~later
        cost += np.where(leaves, _side_cost(side, lanes, at, over, settings), 0.0)
    if previous:
        before = np.flatnonzero(np.array(paths.target) == previous)
        near = np.abs(end - end[before[0]]) / _OTHER if len(before) else np.ones(n)
        change = np.where(name == REFERENCE, 0.0, np.where(along, 0.5, 1.0))
        if previous.startswith(_LANE):  # who has found no gap so far does not try at every moment
            change = np.where((name == REFERENCE) | later, 0.5, change)
        # to make a little more room is not to change one's mind
        cost += np.where(name != previous, settings.change_cost * change * np.clip(near, 0.25, 1.0), 0.0)
    return np.asarray(cost)


_LANE = "lane "
LATER = "later "
"""What the names of targets begin with that leave the ego's lane further on."""
_HURRY, _PATIENT = (
    0.5,
    1.25,
)  # shares of the cost of staying, for who is about to leave a lane that ends, or that goes on
_IN_LANE = 1.0  # m
_OTHER = 1.6  # m; targets so far apart are quite different ones


def track_name(index: int) -> str:
    """Name of the target that is one of `RouteLanes.tracks`."""
    return f"{_LANE}{index}"


def later_from(name: str) -> int:
    """Index of the track that a target leaves whose name begins with LATER."""
    return int(name.rsplit(" ", 1)[1])


def track_index(name: str) -> int:
    """Index of the track of that name; −1: no track's."""
    return int(name.removeprefix(_LANE)) if name.startswith(_LANE) else -1


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
    for track in lanes.tracks:
        usable = (at >= track.first) & (at <= track.last)
        off = np.minimum(off, np.where(usable, np.abs(d - track.centre[at]), np.inf))
    return np.asarray(off)
