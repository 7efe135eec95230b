"""From what a method sees to its alarms: one number a frame, a threshold, and how many frames must agree."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt

from common.messages import F64, FRAME_S
from evaluation.hazards.named import ALARM_S
from evaluation.hazards.truth import Truth
from evaluation.hazards.watch import SLACK, SLICE_S, Seen

Bool = npt.NDArray[np.bool_]

METHODS = ("field_predictive", "field_current", "ttc_lane", "ttc_2d", "wttc")

CHOICES: dict[str, dict[str, tuple[float, ...]]] = {
    # who shall be warned early has to look far ahead: a shorter fade gains one of 240 tuning variants and costs 0.4 s
    # of lead. Slices are half a second apart, a slack below a quarter would leave gaps.
    "field_predictive": {"full_s": (2.0,), "fade_s": (4.0,), "slack_s": (0.3, 0.4, 0.5)},
    "field_current": {"full_s": (0.5, 1.0, 1.5, 2.0), "fade_s": (2.5, 3.0, 4.0)},
    "ttc_lane": {},
    "ttc_2d": {},
    "wttc": {},
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
    """A number for each frame, the higher the more dangerous, [F].

    Of the field: max over τ of w(τ) M(τ), τ the time until the ego is there; for the predictive field M is that of the
    slices within `slack_s` of τ. w is 1 up to `full_s` and falls linearly to 0 at `fade_s`: what lies farther ahead is
    less certain, and there is time to look again.
    """
    if method == "field_predictive":
        slack = round(options["slack_s"] / FRAME_S)
        slices = seen.field.shape[1]
        ahead = SLICE_S * np.arange(slices)[:, None] + FRAME_S * np.arange(-slack, slack + 1)
        met = seen.field[:, :, SLACK - slack : SLACK + slack + 1]
        return np.asarray((met * faded(ahead, options)).max((1, 2)))
    if method == "field_current":
        return np.asarray((seen.current * faded(SLICE_S * np.arange(seen.current.shape[1]), options)).max(1))
    times: dict[str, F64] = {"ttc_lane": seen.ttc_lane, "ttc_2d": seen.ttc_2d, "wttc": seen.wttc}
    return -times[method]


def faded(ahead: npt.ArrayLike, options: dict[str, float]) -> F64:
    """w: how much counts what is met so far ahead [s]."""
    full, fade = options["full_s"], options["fade_s"]
    return np.asarray(np.clip((fade - np.asarray(ahead)) / (fade - full), 0.0, 1.0), dtype=np.float64)


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
    best = _best(method, watched, best_threshold, lambda t: (t.accuracy, -t.false_alarm_rate, t.median_lead_s))
    assert best is not None
    return best


def tune_at_recall(method: str, watched: Sequence[tuple[Truth, Seen]], recall: float) -> Tuned | None:
    """Fewest false alarms among the alarms that catch at least this share of the hazards; then the longest median lead.

    None: nothing that can be chosen catches so many.
    """

    def threshold(top: F64, hazard: Bool) -> tuple[float, float, float] | None:
        needed = int(np.ceil(recall * hazard.sum() - 1e-9))
        at = float(np.sort(top[hazard])[::-1][needed - 1])
        if not np.isfinite(at):
            return None
        alarmed = top >= at
        return at, float(np.mean(alarmed == hazard)), float(alarmed[~hazard].mean())

    return _best(method, watched, threshold, lambda t: (-t.false_alarm_rate, t.median_lead_s))


def _best(
    method: str,
    watched: Sequence[tuple[Truth, Seen]],
    threshold_of: Callable[[F64, Bool], tuple[float, float, float] | None],
    rank: Callable[[Tuned], tuple[float, ...]],
) -> Tuned | None:
    """The best by rank, whose last part is the median lead, over all options and persistences."""
    hazard = np.array([truth.label == "hazard" for truth, _ in watched])
    best: Tuned | None = None
    for options in _options(method):
        scores = [score(method, seen, options) for _, seen in watched]
        for frames in PERSISTENCE:
            values = [held(s, frames) for s in scores]
            top = np.array([strongest(v, seen, truth) for v, (truth, seen) in zip(values, watched, strict=True)])
            known = threshold_of(top, hazard)
            if known is None:
                continue
            threshold, accuracy, false = known
            found = Tuned(Alarm(method, threshold, frames, options), accuracy, false, 0.0)
            if best is not None and rank(found)[:-1] < rank(best)[:-1]:
                continue
            found = replace(found, median_lead_s=median_lead(threshold, values, watched))
            if best is None or rank(found) > rank(best):
                best = found
    return best


def best_threshold(top: F64, hazard: Bool) -> tuple[float, float, float]:
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


def median_lead(threshold: float, values: Sequence[F64], watched: Sequence[tuple[Truth, Seen]]) -> float:
    """Median lead over the hazards of which a method warns at all [s]; 0: of none. `values` are held scores."""
    leads = []
    for v, (truth, seen) in zip(values, watched, strict=True):
        if truth.event_s is not None and len(above := np.flatnonzero(v >= threshold)):
            leads.append(truth.event_s - float(seen.t[above[0]]))
    return float(np.median(leads)) if leads else 0.0


def _options(method: str) -> Iterator[dict[str, float]]:
    names = list(CHOICES[method])
    for values in itertools.product(*CHOICES[method].values()):
        yield dict(zip(names, values, strict=True))
