"""The controller that is driven, rolled out for many paths and targets at once, and checked against the risk.

a_wanted = (v_wanted − v) / τ with v_wanted = min(target, cap a little ahead), limited by the tier's brake and jerk;
after the hold, a check rollout brakes to rest. What is published is the very rollout that was checked.

Checks, each with the name under which a failure is reported:
- `contact`: short of s_hit (by 0.8 m while moving), and once stopped the place stays free;
- `law`: up to the hold the target is within the speed law of the risk met; later v ≤ max(law, what braking leaves);
- `stop`: after 2 s the stop speed holds, unless the ego falls back from what is ahead; whoever does not close in may
  have less headway at first, for who falls back in haste because somebody has cut in is run into from behind;
- `stays`: the same against what may stay put;
- `tight`: the path is left before its curve is too tight to drive;
- `swerve`: lateral acceleration stays within what the tier allows, or what it is already.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from services.planner.backend import kernels
from services.planner.beside import beside_law
from services.planner.bezier import Start
from services.planner.contact import Contact
from services.planner.footprint import PathRisk
from services.planner.settings import PlannerSettings
from services.planner.speed import FAR, Cap, contact_distance
from services.planner.trajectory import Motion, brake_motion
from services.planner.volume import Volume

F64 = npt.NDArray[np.float64]
Ints = npt.NDArray[np.intp]
Bools = npt.NDArray[np.bool_]

DT = 0.1
"""Step of a rollout [s]."""
FAILURES = ("", "contact", "law", "stop", "stays", "tight", "swerve")
_CLEAR = 0.8  # m; short of a contact while moving
_SOFT_AFTER = 2.0  # s
_EASE, _EASE_S = 0.5, 4.0  # the share of the headway that must be there then, and how long until all of it is [s]
_CLOSING = 0.5  # m/s; who closes in so fast must have all of it then


@dataclass(frozen=True)
class Tier:
    """How hard may be braked."""

    index: int
    brake: float  # [m/s²]
    jerk: float  # [m/s³]
    soft: bool  # whether the soft checks count, and contact beside and behind
    gain: float  # of the speed controller, times tau
    most: float  # highest target speed: this times the speed now …
    lateral: float  # [m/s²]
    crawl: float = 0.0  # … or the speed now, up to this [m/s]
    swept: bool = False  # whether what comes over the ego even if it stands is let be
    clear: float = _CLEAR  # so far short of a contact it stays while it moves, less of what moves away [m]

    @staticmethod
    def all(settings: PlannerSettings) -> tuple[Tier, ...]:
        """Comfort, firm, squeezed, swept, hard, emergency; each given up for the next.

        Squeezed: as firm, but only what is ahead counts. Swept: and that only until something comes over the ego even
        if it stands, which no brake prevents. Braking tiers are there to brake: no faster than now, the harder the
        further below.
        """
        brake, jerk, lateral, crawl = settings.tier_brake, settings.tier_jerk, settings.tier_lateral, settings.crawl
        return (
            Tier(0, brake[0], jerk[0], True, 1.0, np.inf, lateral[0]),
            Tier(1, brake[1], jerk[1], True, 0.6, 1.0, lateral[1]),
            Tier(2, brake[1], jerk[1], False, 0.6, 0.9, lateral[1], crawl),
            Tier(3, 0.5 * (brake[0] + brake[1]), jerk[1], False, 0.6, 0.8, lateral[1], swept=True),
            Tier(4, brake[2], jerk[2], False, 0.4, 0.8, lateral[2]),
            Tier(5, brake[3], jerk[3], False, 0.3, 0.6, lateral[3]),
        )

    @staticmethod
    def between(a: Tier, b: Tier, share: float, clear: float) -> Tier:
        """As `b`, but only so much of the way from the limits of `a` [0, 1], and so far short of a contact [m]."""
        mixed = {k: (1.0 - share) * getattr(a, k) + share * getattr(b, k) for k in ("brake", "jerk", "gain", "lateral")}
        return replace(b, **mixed, clear=clear)


@dataclass(frozen=True)
class Field:
    """What a rollout looks up, at stations every `step` along n paths, flattened [n · S · p] or [n · p]."""

    step: float
    points: int
    slices: int
    starts: F64  # of the slices [S] [s]
    contact: Contact  # [n, S, p]
    stays: F64  # s_hit − gap of what may stay put [n · p] [m]
    law: F64  # speed law [n · S · p] [m/s]
    law_now: F64  # the same, at the very start of each slice
    cap_squared: F64  # [n · p]
    bend: F64  # size of the curvature [n · p] [1/m]
    end: F64  # length that can be steered; FAR if all of it [n] [m]
    s_max: F64  # highest wanted speed at the start of each path [n] [m/s]
    gap: float  # [m]
    gap_stays: float  # kept to what may stay put [m]
    swept: float = np.inf  # from when on contact is no brake's to prevent [s]
    of_ahead: Callable[[], Contact] | None = None  # finds contact with what is ahead; None: no difference

    @staticmethod
    def of(
        risk: PathRisk,
        volume: Volume,
        cap: Cap,
        end: F64,
        s_max: F64,
        step: float,
        settings: PlannerSettings,
        curvature: F64 | None = None,
        hardest: Motion | None = None,
        gap_stays: float | None = None,
    ) -> Field:
        """Put together what rollouts are checked against; `hardest` brakes as hard as can be, None: the ego stands.

        `gap_stays` is the gap kept to what may stay put, None: as to anybody [m].

        Contact moves within a slice if it is the same source's in the next; the speed law reads M_j and M_j+1.
        """
        gap_stays = settings.gap if gap_stays is None else gap_stays
        touch = risk.risk if risk.contact is None else risk.contact
        who = risk.who
        contact = Contact.of(touch, None if who is None else who[0], volume.starts, settings.r_hit, step)
        contact = contact.closing(settings.closing)
        ahead, whose = risk.ahead, None if who is None else who[1]
        of_ahead = None
        if ahead is not None:
            of_ahead = lambda: Contact.of(ahead, whose, volume.starts, settings.r_hit, step)  # noqa: E731
        sides = np.stack((risk.risk, risk.risk)) if risk.sides is None else risk.sides
        stays = contact_distance(risk.stays, settings.r_hit, step)
        law, law_now = beside_law(
            sides,
            None if who is None else who[2:],
            volume.starts,
            step,
            float(s_max.max(initial=0.0)),
            settings.r0,
            settings.r1,
            settings.along,
        )
        return Field(
            step,
            touch.shape[2],
            touch.shape[1],
            volume.starts,
            contact,
            np.where(stays < FAR, stays - gap_stays, FAR).ravel(),
            law.ravel(),
            law_now.ravel(),
            (cap.speed**2).ravel(),
            np.zeros(cap.speed.size) if curvature is None else np.abs(curvature).ravel(),
            np.where(end < step * (touch.shape[2] - 1), end, FAR),
            s_max,
            settings.gap,
            gap_stays,
            _swept(risk, volume.starts, settings.r_hit, step, hardest),
            of_ahead,
        )

    @cached_property
    def on_device(self) -> Any:
        """The same for the kernels."""
        return kernels.RollField(
            points=self.points,
            slices=self.slices,
            step=self.step,
            law=self.law,
            law_now=self.law_now,
            stays=self.stays,
            cap=np.sqrt(self.cap_squared),
            cap_squared=self.cap_squared,
            bend=self.bend,
            end=self.end,
        )

    @cached_property
    def ahead(self) -> Contact:
        """Contact of what is ahead alone [n, S, p]: only the harder tiers ask for it."""
        return self.contact if self.of_ahead is None else self.of_ahead()

    def clock(self, horizon: float) -> tuple[F64, Ints, F64]:
        """Times of the steps up to a horizon [s], the slice in force at each, and how far into it that is [s]."""
        if horizon not in self._clocks:
            times: F64 = np.asarray(DT * np.arange(round(horizon / DT) + 1), dtype=np.float64)
            slices = np.clip(np.searchsorted(self.starts, times + 1e-9, side="right") - 1, 0, self.slices - 1)
            self._clocks[horizon] = times, slices, np.clip(times - self.starts[slices], 0.0, None)
        return self._clocks[horizon]

    @cached_property
    def _clocks(self) -> dict[float, tuple[F64, Ints, F64]]:
        return {}


def _swept(risk: PathRisk, starts: F64, r_hit: float, step: float, hardest: Motion | None) -> float:
    """From when on contact ahead is no brake's to prevent [s]; inf: never.

    Something that is not there yet comes over the place where the ego is now, and over where the hardest brake would
    have brought it by then, whichever path it takes. Either alone is not enough: who passes over a place that a moving
    ego has left prevents nothing, and what the ego drives into was there before it.
    """
    hits = (risk.risk if risk.ahead is None else risk.ahead) >= r_hit  # [n, S, p]
    here = hits[0, :, 0].copy()
    if here[0] or not here.any():
        return np.inf
    if hardest is not None:
        ends = np.append(starts[1:], np.inf)
        cell = np.interp(np.stack((starts, ends)), hardest.t, hardest.distance) / step
        first, last = np.minimum(cell.astype(np.intp), hits.shape[2] - 1)
        for j in np.flatnonzero(here):
            here[j] = hits[:, j, first[j] : last[j] + 1].any(axis=1).all()
    return float(max(starts[max(int(np.argmax(here)) - 1, 0)], 0.0)) if here.any() else np.inf  # reads the next too


@dataclass(frozen=True)
class Rollouts:
    """K rollouts of T steps: distance, speed and acceleration at t = 0, DT, …; and the first failed check."""

    t: F64  # [T]
    distance: F64  # [K, T] [m]
    speed: F64  # [K, T] [m/s]
    acceleration: F64  # [K, T] [m/s²]
    failure: Ints  # [K] index into FAILURES; 0: passed
    failed_at: Ints  # [K] step of the first failure

    @property
    def passed(self) -> Bools:
        """Which of them break no check [K]."""
        return np.asarray(self.failure == 0)


def hardest_brake(start: Start, settings: PlannerSettings) -> Motion:
    """The motion of a vehicle that from now on brakes with the last tier."""
    return brake_motion(0.0, 0.0, start.speed, start.acceleration, settings.tier_brake[-1], settings.tier_jerk[-1])


def roll_out(
    field: Field,
    start: Start,
    path: Ints,
    target: F64,
    hold: F64,
    tier: Tier,
    settings: PlannerSettings,
    *,
    reference: bool = False,
) -> Rollouts:
    """Drive K paths at K target speeds, each braking to rest after its hold.

    Args:
        field: What the paths meet.
        start: State from which.
        path: Index of the path [K].
        target: Target speed [K] [m/s].
        hold: When the braking starts [K] [s]; beyond the horizon: never.
        tier: How hard may be braked.
        settings: The controller's.
        reference: Keep to NumPy.
    """
    times, slices, into = field.clock(settings.horizon_s)
    if kernels is None or reference:
        return _roll_out(field, start, path, target, hold, tier, settings, times, slices, into)
    found = kernels.roll(field.on_device, constants(field, start, tier, settings), path, target, hold)
    s, v, a, failure, failed_at = found
    return Rollouts(times, s, v, a, failure.astype(np.intp), failed_at.astype(np.intp))


def judge(
    field: Field, start: Start, path: Ints, target: F64, hold: F64, tier: Tier, settings: PlannerSettings
) -> tuple[Ints, Ints]:
    """What fails first of K motions (see `roll_out`) and in which step, both [K]; nothing else is kept of them."""
    if kernels is None:
        r = roll_out(field, start, path, target, hold, tier, settings)
        return r.failure, r.failed_at
    values = constants(field, start, tier, settings)
    *_, failure, failed_at = kernels.roll(field.on_device, values, path, target, hold, traced=False)
    return failure.astype(np.intp), failed_at.astype(np.intp)


def constants(field: Field, start: Start, tier: Tier, settings: PlannerSettings) -> dict[str, Any]:
    """What the kernels need to know besides the field's arrays, by their names."""
    times, slices, into = field.clock(settings.horizon_s)
    contact = field.contact if tier.soft else field.ahead
    return {
        "steps": len(times) - 1,
        "slice_of": slices,
        "into": into,
        "hit": contact.distance,
        "rate": contact.rate,
        "away": contact.away,
        "soft": int(tier.soft),
        "tier": tier.index,
        "dt": DT,
        "speed": start.speed,
        "acceleration": start.acceleration,
        "look": _look(settings),
        "gain": _gain(tier, settings),
        "down": -tier.jerk * DT,
        "up_brake": max(settings.release_jerk, tier.jerk) * DT,
        "up_gas": settings.jerk * DT,
        "up_comfort": max(settings.jerk, tier.jerk) * DT,
        "brake": tier.brake,
        "accel": settings.accel,
        "hard": -settings.release_from,
        "jerk": settings.jerk,
        "hold_s": settings.hold_s,
        "clear": tier.clear,
        "least_clear": _CLEAR,
        "soft_after": _SOFT_AFTER,
        "lateral": _lateral(start, tier),
        "until": field.swept if tier.swept else 1e9,
        "headway": settings.headway,
        "ease": _EASE,
        "ease_s": _EASE_S,
        "closing": _CLOSING,
        "gap": field.gap,
        "stop_brake": settings.stop_brake,
    }


def _look(settings: PlannerSettings) -> float:
    """How far ahead the cap is read [s]."""
    return settings.tau + 0.5 * settings.curve_brake / settings.jerk


def _lateral(start: Start, tier: Tier) -> float:
    """Largest lateral acceleration: the tier's, or what it is already, for nothing lowers that at once [m/s²]."""
    return max(tier.lateral, 1.02 * abs(start.curvature) * start.speed**2)


def _gain(tier: Tier, settings: PlannerSettings) -> float:
    """Of the speed controller [1/s]."""
    return 1.0 / (settings.tau * tier.gain)


def _roll_out(
    field: Field,
    start: Start,
    path: Ints,
    target: F64,
    hold: F64,
    tier: Tier,
    settings: PlannerSettings,
    times: F64,
    slices: Ints,
    into: F64,
) -> Rollouts:
    n = len(times) - 1
    k = len(path)
    s, v, a = np.zeros(k), np.full(k, start.speed), np.full(k, start.acceleration)
    out_s, out_v, out_a = np.empty((n + 1, k)), np.empty((n + 1, k)), np.empty((n + 1, k))
    out_s[0], out_v[0], out_a[0] = s, v, a
    base = path * field.points
    inverse, last = 1.0 / field.step, field.points - 1.001
    look, gain = _look(settings), _gain(tier, settings)
    down, up_brake, up_gas = -tier.jerk * DT, max(settings.release_jerk, tier.jerk) * DT, settings.jerk * DT
    up_comfort = max(settings.jerk, tier.jerk) * DT
    cap = np.sqrt(field.cap_squared)
    target = target.copy()
    for i in range(n):
        ahead = np.minimum((s + v * look) * inverse, last)
        c = ahead.astype(np.intp)
        w = ahead - c
        c += base
        squared = field.cap_squared.take(c)
        squared += w * (field.cap_squared.take(c + 1) - squared)
        here = base + np.minimum(s * inverse, last).astype(np.intp)
        stopping = hold <= DT * i + 1e-9
        wanted = np.minimum(np.minimum(target, np.sqrt(squared)), cap.take(here))
        wanted[stopping] = 0.0
        a_wanted = (wanted - v) * gain
        a_wanted[stopping] = -tier.brake
        rest = wanted <= 0.0
        # let the brake go in time to stand softly, but do come to rest
        if tier.index == 0:
            a_wanted = np.maximum(a_wanted, -0.15 - np.sqrt(2.0 * settings.jerk * v))
        a_wanted = np.where(rest & (v > 0.0), np.minimum(a_wanted, -0.15), a_wanted)
        a_wanted = np.minimum(np.maximum(a_wanted, -tier.brake), settings.accel)
        up = np.where(a < -settings.release_from, up_brake, np.where(a < 0.0, up_comfort, up_gas))
        a_new = a + np.minimum(np.maximum(a_wanted - a, down), up)
        mean = 0.5 * (a + a_new)
        v_new = v + mean * DT
        moved = 0.5 * DT * (v + v_new)
        stops = v_new <= 1e-3
        if stops.any():
            way = np.where(v > 0.0, v * v / np.maximum(-2.0 * mean, 1e-6), 0.0)  # of a stop within this step
            moved = np.where(stops, np.minimum(way, v * DT), moved)
            v_new = np.where(stops, 0.0, v_new)
            a_new = np.where(stops, np.where(rest, 0.0, np.maximum(a_new, 0.0)), a_new)
        s = s + moved
        v, a = v_new, a_new
        out_s[i + 1], out_v[i + 1], out_a[i + 1] = s, v, a
    failure, failed_at = _check(
        field, times, slices, into, out_s, out_v, path, target, hold, tier, settings, _lateral(start, tier)
    )
    return Rollouts(times, out_s.T, out_v.T, out_a.T, failure, failed_at)


def _check(
    field: Field,
    times: F64,
    slices: Ints,
    into: F64,
    s: F64,
    v: F64,
    path: Ints,
    target: F64,
    hold: F64,
    tier: Tier,
    settings: PlannerSettings,
    lateral: float,
) -> tuple[Ints, Ints]:
    """First failed check of motions s, v [T, K] and its step, each [K]."""
    n, k = s.shape
    cell = np.minimum((s * (1.0 / field.step)).astype(np.intp), field.points - 1)
    here = (path * (field.slices * field.points))[None] + (slices * field.points)[:, None] + cell
    moving = v > 0.05
    contact = field.contact if tier.soft else field.ahead
    hit = contact.distance.ravel().take(here) + contact.rate.ravel().take(here) * into[:, None]
    away = contact.away.ravel().take(here)
    clear = np.maximum(tier.clear - away * away * (0.5 / settings.stop_brake), _CLEAR)
    bad = np.where(s + clear * moving < hit, 0, 1)
    if tier.soft:
        law = field.law.take(here)
        starts = into < DT - 1e-9
        law[starts] = np.minimum(law[starts], field.law_now.take(here[starts]))
        t = times[:, None]
        left = np.maximum(target - tier.brake * np.maximum(t - settings.hold_s, 0.0), 0.0)
        above = np.where(t <= np.minimum(hold, settings.hold_s), target > law + 1e-9, v > np.maximum(law, left) + 0.05)
        bad = np.where((bad == 0) & above, 2, bad)
        late = slice(int(np.searchsorted(times, _SOFT_AFTER - 1e-9)), None)
        vl, sl = v[late], s[late]
        way = vl * vl * (0.5 / settings.stop_brake) + sl
        ease = np.minimum(_EASE + (1.0 - _EASE) * (times[late, None] - _SOFT_AFTER) / _EASE_S, 1.0)
        away = away[late]
        share = ease + (1.0 - ease) * np.clip((vl - away) / _CLOSING, 0.0, 1.0)
        need = vl * settings.headway * share + way
        room = hit[late] - field.gap + away * away * (0.5 / settings.stop_brake)
        fast = (need > room) & (vl > 0.85 * away + 0.05)
        put = vl * settings.headway + way > field.stays.take((path * field.points)[None] + cell[late])
        soft = np.where(fast, 3, np.where(put, 4, 0)) * moving[late]
        bad[late] = np.where(bad[late] == 0, soft, bad[late])
    bad = np.where((bad == 0) & (s > field.end[path]) & moving, 5, bad)
    bend = field.bend.take((path * field.points)[None] + cell)
    bad = np.where((bad == 0) & (bend * v * v > lateral), 6, bad)
    if tier.swept:
        bad[times >= field.swept - 1e-9] = 0
    any_bad = bad > 0
    failed = any_bad.any(axis=0)
    first = np.where(failed, any_bad.argmax(axis=0), n - 1)
    return np.where(failed, bad[first, np.arange(k)], 0), first
