"""The whole comparison, as the JSON and the table that `forefield eval hazards` gives."""

from __future__ import annotations

import time
from collections.abc import Sequence
from functools import partial
from importlib import resources
from typing import Any

import msgspec
import numpy as np
from rich.table import Table

from evaluation.hazards import traffic
from evaluation.hazards.alarms import (
    METHODS,
    Alarm,
    Tuned,
    held,
    median_lead,
    score,
    strongest,
    tune,
    tune_at_recall,
)
from evaluation.hazards.fingerprint import fingerprint
from evaluation.hazards.named import ALARM_S, FORESEEABLE_S, Case, Drawn, named, variants
from evaluation.hazards.statistics import bootstrap_median, mcnemar, wilson
from evaluation.hazards.truth import PET_HARMLESS_S, PET_HAZARD_S
from evaluation.hazards.watch import Cores, Seen, watch
from evaluation.hazards.work import Work

TUNING_SEED = 1000
"""Seed of the variants on which thresholds are tuned; no test uses it."""
TUNING_COUNT = 240
FIELD = "field_predictive"

RECALLS = (0.3, 0.5, 0.8, 0.95)
"""Shares of the hazards at which false alarms are compared."""


class TunedAlarms(msgspec.Struct, frozen=True, kw_only=True):
    """The file `tuned.json`: what was tuned, and on what."""

    definitions: str
    seed: int
    count: int
    methods: dict[str, Tuned]
    at_recall: dict[str, dict[str, Tuned | None]] = {}
    """For each of `RECALLS` (as text) and method: fewest false alarms at that recall."""


def stored() -> TunedAlarms:
    """The thresholds that come with the package; `forefield eval hazards --tune` finds them again."""
    text = resources.files("evaluation.hazards").joinpath("tuned.json").read_bytes()
    return msgspec.json.decode(text, type=TunedAlarms)


def tuned_again(cores: Cores, work: Work) -> TunedAlarms:
    """Tune every method on the tuning variants."""
    watched = _watched(list(variants(TUNING_SEED, TUNING_COUNT)), "tuning", cores, work)
    pairs = [(case.truth, seen) for case, seen in watched]
    return TunedAlarms(
        definitions=fingerprint(named()),
        seed=TUNING_SEED,
        count=TUNING_COUNT,
        methods={m: tune(m, pairs) for m in METHODS},
        at_recall={f"{r:g}": {m: tune_at_recall(m, pairs, r) for m in METHODS} for r in RECALLS},
    )


def measure(
    *, seed: int, count: int, tuned: TunedAlarms, cores: Cores, with_traffic: bool, work: Work
) -> dict[str, Any]:
    """Judge every method on the 24 and on `count` random variants of `seed`, which must not be the tuning one."""
    if seed == tuned.seed:
        raise ValueError(f"seed {seed} is the one that thresholds were tuned on: choose another")
    begun = time.monotonic()
    alarms = [t.alarm for t in tuned.methods.values()]
    cases = named()
    drawn = Drawn()
    sets = {
        "named": _watched(cases, "named", cores, work),
        "random": _watched(list(variants(seed, count, drawn)), "random variants", cores, work),
    }
    result: dict[str, Any] = {
        "definitions": fingerprint(cases),
        "seed": seed,
        "count": count,
        "rules": {
            "alarm_s": ALARM_S,
            "pet_hazard_s": PET_HAZARD_S,
            "pet_harmless_s": PET_HARMLESS_S,
            "foreseeable_s": FORESEEABLE_S,
        },
        "cores": {"predictor": msgspec.to_builtins(cores.predictor), "risk": msgspec.to_builtins(cores.risk)},
        "drawn": {"used": drawn.used, "grey": drawn.grey, "unforeseeable": drawn.unforeseeable,
                  "too_early": drawn.too_early},
        "tuning": {"seed": tuned.seed, "count": tuned.count,
                   "methods": {m: msgspec.to_builtins(t) for m, t in tuned.methods.items()}},
    }  # fmt: skip
    right: dict[str, dict[str, list[bool]]] = {}
    for name, watched in sets.items():
        right[name] = {a.method: [correct(a, case, seen) for case, seen in watched] for a in alarms}
        result[name] = {a.method: figures(a, watched, right[name][a.method]) for a in alarms}
    result["mcnemar"] = {
        name: {m: dict(zip(("only_field", "only_other", "p"), mcnemar(per[FIELD], per[m]), strict=True))
               for m in per if m != FIELD}
        for name, per in right.items()
    }  # fmt: skip
    result["cases"] = [_verdicts(alarms, case, seen) for case, seen in sets["named"]]
    result["situations"] = _by_situation(sets["random"], right["random"])
    field = next(a for a in alarms if a.method == FIELD)
    result["missed"] = [
        {"set": name, **why(field, case, seen)}
        for name, watched in sets.items()
        for case, seen in watched
        if not correct(field, case, seen)
    ]
    result["frontier"] = {a.method: frontier(a, sets["random"]) for a in alarms}
    result["traffic"] = traffic.alarms_per_hour(alarms, at_recall(tuned), cores, work) if with_traffic else None
    result["took_s"] = time.monotonic() - begun
    return result


def at_recall(tuned: TunedAlarms) -> dict[str, list[Alarm]]:
    """By recall, the alarms of the methods that reach it."""
    return {r: [t.alarm for t in per.values() if t is not None] for r, per in tuned.at_recall.items()}


def _watched(cases: list[Case], what: str, cores: Cores, work: Work) -> list[tuple[Case, Seen]]:
    return list(zip(cases, work.map(partial(watch, cores=cores), cases, what), strict=True))


def correct(alarm: Alarm, case: Case, seen: Seen) -> bool:
    """A hazard: it warns in time. Harmless: it never warns."""
    values = held(score(alarm.method, seen, alarm.options), alarm.persistence)
    warned = strongest(values, seen, case.truth) >= alarm.threshold
    return warned == (case.truth.label == "hazard")


def figures(alarm: Alarm, watched: Sequence[tuple[Case, Seen]], right: Sequence[bool]) -> dict[str, Any]:
    """Accuracy, recall, false alarm rate and lead of one method on one set, with 95 % intervals.

    `median_lead_s` is over the hazards of which the method warns at all before the event, in time or not;
    `median_lead_all_s` counts those without any warning as 0.
    """
    hazard = np.array([case.truth.label == "hazard" for case, _ in watched])
    hits = np.asarray(right)
    n, n_hazard, n_harmless = len(hits), int(hazard.sum()), int((~hazard).sum())
    caught, false = int(hits[hazard].sum()), int((~hits[~hazard]).sum())
    firsts = [(case.truth.event_s, alarm.first(seen)) for case, seen in watched if case.truth.event_s is not None]
    leads = [event - first for event, first in firsts if first is not None]
    with_none = [0.0 if first is None else event - first for event, first in firsts]
    return {
        "accuracy": float(hits.mean()),
        "recall": caught / max(n_hazard, 1),
        "false_alarm_rate": false / max(n_harmless, 1),
        "median_lead_s": float(np.median(leads)) if leads else 0.0,
        "median_lead_all_s": float(np.median(with_none)) if with_none else 0.0,
        "ci": {
            "accuracy": wilson(int(hits.sum()), n),
            "recall": wilson(caught, n_hazard),
            "false_alarm_rate": wilson(false, n_harmless),
            "median_lead_s": bootstrap_median(leads),
            "median_lead_all_s": bootstrap_median(with_none),
        },
        "n": n,
        "n_hazard": n_hazard,
        "n_harmless": n_harmless,
    }


def frontier(alarm: Alarm, watched: Sequence[tuple[Case, Seen]], most: int = 60) -> list[dict[str, float]]:
    """What another threshold would give: accuracy, false alarms, recall and median lead, at up to `most` thresholds."""
    pairs = [(case.truth, seen) for case, seen in watched]
    values = [held(score(alarm.method, seen, alarm.options), alarm.persistence) for _, seen in watched]
    hazard = np.array([truth.label == "hazard" for truth, _ in pairs])
    top = np.array([strongest(v, seen, truth) for v, (truth, seen) in zip(values, pairs, strict=True)])
    finite = np.unique(top[np.isfinite(top)])
    if not len(finite):
        return []
    points = []
    for threshold in np.unique(np.quantile(finite, np.linspace(0.0, 1.0, most), method="nearest")):
        alarmed = top >= threshold
        points.append(
            {
                "threshold": float(threshold),
                "accuracy": float(np.mean(alarmed == hazard)),
                "recall": float(alarmed[hazard].mean()) if hazard.any() else 0.0,
                "false_alarm_rate": float(alarmed[~hazard].mean()) if (~hazard).any() else 0.0,
                "median_lead_s": median_lead(float(threshold), values, pairs),
            }
        )
    return points


def why(alarm: Alarm, case: Case, seen: Seen) -> dict[str, Any]:
    """What went wrong in one case, in numbers and in a sentence."""
    truth, first = case.truth, alarm.first(seen)
    values = held(score(alarm.method, seen, alarm.options), alarm.persistence)
    top = strongest(values, seen, truth)
    entry: dict[str, Any] = {
        "name": case.episode.name,
        "label": truth.label,
        "event_s": truth.event_s,
        "contact": truth.contact,
        "onset_s": case.episode.onset_s,
        "alarm_s": first,
        "highest": top if np.isfinite(top) else None,
        "threshold": alarm.threshold,
        "parameters": {k: round(v, 3) for k, v in case.episode.parameters.items()},
    }
    if truth.event_s is None:
        entry["why"] = f"false alarm at {first:.1f} s: risk {top:.2f} where {alarm.threshold:.2f} warns; " \
                       f"least clearance {truth.clearance_m:.2f} m"  # fmt: skip
        return entry
    onset = case.episode.onset_s
    seen_for = "" if onset is None else f"; the manoeuvre began {truth.event_s - onset:.1f} s before the event"
    come = "no warning" if first is None else f"warned {truth.event_s - first:.1f} s before the event"
    entry["why"] = f"{come}; risk {top:.2f} in time where {alarm.threshold:.2f} warns{seen_for}"
    return entry


def _verdicts(alarms: Sequence[Alarm], case: Case, seen: Seen) -> dict[str, Any]:
    truth = case.truth
    return {
        "name": case.episode.name,
        "label": truth.label,
        "event_s": truth.event_s,
        "methods": {a.method: {"alarm_s": a.first(seen), "correct": correct(a, case, seen)} for a in alarms},
    }


def _by_situation(watched: Sequence[tuple[Case, Seen]], right: dict[str, list[bool]]) -> dict[str, dict[str, float]]:
    names = np.array([case.episode.name for case, _ in watched])
    return {
        name: {m: float(np.mean(np.asarray(hits)[names == name])) for m, hits in right.items()}
        for name in dict.fromkeys(names.tolist())
    }


def table(result: dict[str, Any]) -> Table:
    """Both sets, one row a method."""
    out = Table(title=f"Does it see danger? An alarm counts {result['rules']['alarm_s']} s before the event")
    for name in ("set", "method", "accuracy", "recall", "false alarms", "median lead", "McNemar p", "alarms / h"):
        out.add_column(name, justify="left" if name in ("set", "method") else "right")
    per_hour = (result["traffic"] or {}).get("alarms_per_hour", {})
    for name in ("named", "random"):
        for m, f in result[name].items():
            low, high = f["ci"]["accuracy"]
            p = result["mcnemar"][name].get(m, {}).get("p")
            rate = per_hour.get(m) if name == "random" else None
            out.add_row(
                f"{name} ({f['n']})",
                m,
                f"{100 * f['accuracy']:.1f} % [{100 * low:.1f}, {100 * high:.1f}]",
                f"{100 * f['recall']:.1f} %",
                f"{100 * f['false_alarm_rate']:.1f} %",
                f"{f['median_lead_s']:.1f} s",
                "" if p is None else f"{p:.2g}",
                "" if rate is None else f"{rate:.1f}",
            )
        out.add_section()
    return out


def traffic_table(found: dict[str, Any]) -> Table:
    """Alarms for an hour of recorded driving, at equal recall on the tuning set and as tuned."""
    out = Table(title=f"Alarms per hour in recorded traffic ({found['drives']} drives, {found['hours']:.2f} h)")
    methods = list(found["alarms_per_hour"])
    out.add_column("thresholds")
    for m in methods:
        out.add_column(m, justify="right")
    rows = [(f"recall {100 * float(r):.0f} %", rates) for r, rates in found["at_recall"].items()]
    for name, rates in [*rows, ("highest accuracy", found["alarms_per_hour"])]:
        cells = [rates.get(m) for m in methods]
        out.add_row(name, *("not reached" if v is None else f"{v:.0f}" for v in cells))
    return out


def misses(result: dict[str, Any]) -> Table:
    """Where the predictive field was wrong: every one of the 24, and how often among the random variants."""
    out = Table(title="Where the predictive field is wrong")
    for name in ("set", "situation", "why"):
        out.add_column(name)
    random: dict[str, list[dict[str, Any]]] = {}
    for miss in result["missed"]:
        if miss["set"] == "named":
            out.add_row("named", miss["name"], miss["why"])
        else:
            random.setdefault(miss["name"], []).append(miss)
    for name, found in sorted(random.items(), key=lambda item: -len(item[1])):
        out.add_row(f"random: {len(found)}", name, f"for example: {found[0]['why']}")
    return out
