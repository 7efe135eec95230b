"""The drive in a recording: from where the run began, what was in force when, slow-downs, modes, clearance.

Times count from the begin of the run, as in the run's own JSON; `began` is where that lies in the recording.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from common.geometry import distance_between_rectangles, rectangle_corners
from common.messages import F64
from common.topics import PLAN
from evaluation.review.recording import Recording, Seen, Spoken, States
from rig.comfort import GRID_S, Motion, motion
from rig.interventions import Intervention, Reason, interventions

SNAP_S = 0.0225
"""The rig tells the begin of its run to about one tick [s]."""
PAUSE_S = 1.0
"""A longer silence of the ego ends a leg of the drive [s]."""
JUMP_M = 3.0
"""So does a step further than its speed explains [m]: another run was recorded into the same file."""
NEAR_M = 40.0
"""Road users further away have no clearance worth measuring [m]."""


@dataclass(frozen=True)
class Leg:
    """One uninterrupted part of the drive."""

    states: States
    motion: Motion
    interventions: list[Intervention]


@dataclass(frozen=True)
class Clearance:
    """Distance to the nearest road user along time [s], [m], and who it was."""

    t: F64
    distance: F64
    id: F64


@dataclass(frozen=True)
class Drive:
    """A drive, ready to be told."""

    began: float
    """Time of the recording at which the run began [s]."""
    states: States
    in_force: list[Spoken | None]
    """The plan in force at each state."""
    legs: list[Leg]
    clearance: Clearance

    @property
    def duration_s(self) -> float:
        """From the first state to the last [s]."""
        return float(self.states.t[-1] - self.states.t[0]) if len(self.states.t) else 0.0

    @property
    def distance_m(self) -> float:
        """Driven [m]."""
        return float(sum(np.hypot(np.diff(leg.states.x), np.diff(leg.states.y)).sum() for leg in self.legs))

    @property
    def interventions(self) -> list[Intervention]:
        """Of all legs, in the order of time."""
        return [i for leg in self.legs for i in leg.interventions]

    @property
    def modes(self) -> list[str]:
        """Mode in force at each state; without a plan `waiting`."""
        return ["waiting" if plan is None else plan.said.mode for plan in self.in_force]

    def mode_seconds(self) -> dict[str, float]:
        """How long each mode was in force [s]; each state stands for the time since the one before."""
        seconds = {"drive": 0.0, "waiting": 0.0, "safe_stop": 0.0}
        steps = np.minimum(np.diff(self.states.t), PAUSE_S)
        for mode, step in zip(self.modes[1:], steps, strict=True):
            seconds[mode] = seconds.get(mode, 0.0) + float(step)
        return seconds


def drive_of(recording: Recording) -> Drive:
    """Find the drive in a recording."""
    began = _begin(recording)
    chosen = recording.ego.t >= began - 1e-6
    part = recording.ego.part(chosen)
    states = States(part.t - began, *list(vars(part).values())[1:])
    in_force = _in_force(states.t, recording.plans, began)
    reasons = [None if p is None else Reason.of(p.said.mode, p.said.reason, p.said.decision) for p in in_force]
    legs = [_leg(states.part(slice(a, b)), reasons[a:b]) for a, b in _cuts(states)]
    return Drive(began, states, in_force, legs, _clearance(states, recording, began))


def _begin(recording: Recording) -> float:
    told = recording.run_began
    before = recording.ego.t[(recording.ego.t <= told + 1e-6) & (recording.ego.t >= told - SNAP_S)]
    return float(before[-1]) if len(before) else told


def _in_force(t: F64, plans: Sequence[Spoken], began: float) -> list[Spoken | None]:
    """The newest plan that had arrived, unless it is older than the topic allows."""
    received = np.array([p.received for p in plans]) - began
    oldest = PLAN.max_age_s or math.inf
    found: list[Spoken | None] = []
    for at, k in zip(t, np.searchsorted(received, t - 1e-6, side="left") - 1, strict=True):
        plan = plans[k] if k >= 0 else None
        found.append(plan if plan is not None and at + began - plan.t <= oldest + 1e-6 else None)
    return found


def _cuts(states: States) -> list[tuple[int, int]]:
    """First and behind the last state of each leg."""
    step = np.diff(states.t)
    far = np.hypot(np.diff(states.x), np.diff(states.y)) > np.abs(states.speed[:-1]) * step * 2.0 + JUMP_M
    ends = np.flatnonzero((step > PAUSE_S) | far) + 1
    bounds = [0, *(int(e) for e in ends), len(states.t)]
    return [(a, b) for a, b in itertools.pairwise(bounds) if b > a]


def _leg(states: States, reasons: list[Reason | None]) -> Leg:
    moved = motion(states.t, states.speed, states.yaw_rate)
    return Leg(states, moved, interventions(moved.t, moved.speed, states.t, reasons))


def pose_at(states: States, t: float) -> tuple[float, float, float]:
    """Centre [m] and heading [rad] of the ego at a time between two states."""
    k = int(np.clip(np.searchsorted(states.t, t), 1, max(len(states.t) - 1, 1)))
    k = min(k, len(states.t) - 1)
    near = slice(max(k - 1, 0), k + 1)
    heading = np.interp(t, states.t[near], np.unwrap(states.heading[near]))
    x, y = (float(np.interp(t, states.t[near], values[near])) for values in (states.x, states.y))
    return x, y, float(heading)


def _clearance(states: States, recording: Recording, began: float) -> Clearance:
    t, distance, who = [], [], []
    for seen in recording.seen:
        at = seen.t - began
        if not len(states.t) or not states.t[0] - GRID_S <= at <= states.t[-1] + GRID_S:
            continue
        found = _nearest(seen, pose_at(states, at), recording.size)
        t.append(at)
        distance.append(math.nan if found is None else found[0])
        who.append(math.nan if found is None else float(found[1]))
    return Clearance(np.array(t), np.array(distance), np.array(who))


def _nearest(seen: Seen, pose: tuple[float, float, float], size: tuple[float, float]) -> tuple[float, int] | None:
    near = np.flatnonzero(np.hypot(seen.x - pose[0], seen.y - pose[1]) < NEAR_M)
    if not len(near):
        return None
    body = rectangle_corners(*pose, *size)
    others = rectangle_corners(seen.x[near], seen.y[near], seen.heading[near], seen.length[near], seen.width[near])
    distance = distance_between_rectangles(body, others)
    best = int(np.argmin(distance))
    return float(distance[best]), int(seen.id[near[best]])
