"""From what a method sees to its alarms: one number a frame, a threshold, and how many frames must agree."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np

from common.messages import F64, FRAME_S
from evaluation.hazards.named import ALARM_S
from evaluation.hazards.truth import Truth
from evaluation.hazards.watch import SLACK, SLICE_S, Seen

METHODS = ("field_predictive", "field_current", "ttc_lane", "ttc_2d", "crime_wttc")
"""Every method; the last only where commonroad-crime is installed."""

CHOICES: dict[str, dict[str, tuple[float, ...]]] = {
    "field_predictive": {
        "horizon_s": (1.5, 2.0, 2.5, 3.0, 3.5, 4.0, 4.5, 5.0),
        "slack_s": (0.0, 0.1, 0.2, 0.3, 0.4, 0.5),
    },
    "field_current": {"horizon_s": (0.0, 1.0, 1.5, 2.0, 2.5, 3.0, 3.5, 4.0, 4.5, 5.0)},
    "ttc_lane": {},
    "ttc_2d": {},
    "crime_wttc": {},
}
"""What is chosen for each method beside its threshold and persistence, on the tuning set alone."""
PERSISTENCE = (1, 2, 3, 4, 5)
"""So many frames in a row must lie above the threshold; chosen for every method."""


@dataclass(frozen=True)
class Alarm:
    """One method with everything about it chosen. It warns when `persistence` scores in a row are ≥ `threshold`.

    A score is the risk met [E_max], or a time to collision [s] with its sign turned.
    """

    method: str
    threshold: float
    persistence: int
    options: dict[str, float] = field(default_factory=dict)

    def first(self, seen: Seen) -> float | None:
        """When it first warns [s]; None: never."""
        above = np.flatnonzero(held(score(self.method, seen, self.options), self.persistence) >= self.threshold)
        return float(seen.t[above[0]]) if len(above) else None


def score(method: str, seen: Seen, options: dict[str, float]) -> F64:
    """A number for each frame, the higher the more dangerous, [F]."""
    if method == "field_predictive":
        slices = round(options["horizon_s"] / SLICE_S) + 1
        slack = round(options["slack_s"] / FRAME_S)
        return np.asarray(seen.field[:, :slices, SLACK - slack : SLACK + slack + 1].max((1, 2)))
    if method == "field_current":
        return np.asarray(seen.current[:, : round(options["horizon_s"] / SLICE_S) + 1].max(1))
    times: dict[str, F64] = {"ttc_lane": seen.ttc_lane, "ttc_2d": seen.ttc_2d, "crime_wttc": seen.crime_wttc}
    return -times[method]


def held(values: F64, frames: int) -> F64:
    """Least of the last `frames` values; −∞ before there are so many."""
    out = np.full(len(values), -np.inf)
    if len(values) >= frames:
        out[frames - 1 :] = np.lib.stride_tricks.sliding_window_view(values, frames).min(1)
    return out


def strongest(values: F64, seen: Seen, truth: Truth) -> float:
    """The highest threshold at which the episode raises an alarm that counts: all of it, or up to ALARM_S before."""
    if truth.event_s is not None:
        values = values[seen.t <= truth.event_s - ALARM_S + 1e-9]
    return float(values.max(initial=-np.inf))


@dataclass(frozen=True)
class Tuned:
    """An alarm and how it did on the tuning set."""

    alarm: Alarm
    accuracy: float
    false_alarm_rate: float
    median_lead_s: float


def tune(method: str, watched: Sequence[tuple[Truth, Seen]]) -> Tuned:
    """Highest accuracy on the tuning set; among equals fewest false alarms, then the longest median lead.

    Every method is tuned by this rule, over its threshold, its persistence and its choices. The threshold lies in the
    middle between the two episodes that it separates.
    """
    hazard = np.array([truth.label == "hazard" for truth, _ in watched])
    best: Tuned | None = None
    for options in _options(method):
        scores = [score(method, seen, options) for _, seen in watched]
        for frames in PERSISTENCE:
            values = [held(s, frames) for s in scores]
            top = np.array([strongest(v, seen, truth) for v, (truth, seen) in zip(values, watched, strict=True)])
            threshold, accuracy, false = best_threshold(top, hazard)
            if best is not None and (accuracy, -false) < (best.accuracy, -best.false_alarm_rate):
                continue
            alarm = Alarm(method, threshold, frames, options)
            lead = median_lead(alarm, watched)
            found = Tuned(alarm, accuracy, false, lead)
            if best is None or _rank(found) > _rank(best):
                best = found
    assert best is not None
    return best


def _rank(t: Tuned) -> tuple[float, float, float]:
    return (t.accuracy, -t.false_alarm_rate, t.median_lead_s)


def best_threshold(top: F64, hazard: np.ndarray) -> tuple[float, float, float]:
    """Threshold, accuracy and false alarm rate: highest accuracy, then fewest false alarms."""
    finite = np.unique(top[np.isfinite(top)])
    if not len(finite):
        return 0.0, float(np.mean(~hazard)), 0.0
    between = (finite[1:] + finite[:-1]) / 2
    candidates = np.concatenate(([finite[0] - 1e-3], between, [finite[-1] + 1e-3]))
    alarmed = top[None] >= candidates[:, None]
    accuracy = (alarmed == hazard).mean(1)
    false = alarmed[:, ~hazard].mean(1) if (~hazard).any() else np.zeros(len(candidates))
    k = int(np.lexsort((false, -accuracy))[0])
    return float(candidates[k]), float(accuracy[k]), float(false[k])


def leads(alarm: Alarm, watched: Sequence[tuple[Truth, Seen]]) -> list[float | None]:
    """For each hazard, how long before the event the method first warns [s]; None: never."""
    found: list[float | None] = []
    for truth, seen in watched:
        if truth.event_s is not None:
            first = alarm.first(seen)
            found.append(None if first is None else truth.event_s - first)
    return found


def median_lead(alarm: Alarm, watched: Sequence[tuple[Truth, Seen]]) -> float:
    """Median lead over the hazards of which the method warns at all [s]; 0: of none."""
    known = [v for v in leads(alarm, watched) if v is not None]
    return float(np.median(known)) if known else 0.0


def _options(method: str) -> Iterator[dict[str, float]]:
    names = list(CHOICES[method])
    for values in itertools.product(*CHOICES[method].values()):
        yield dict(zip(names, values, strict=True))
