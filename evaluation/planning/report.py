"""From drives to figures: the summary of each planner, tables for the terminal, one page of HTML."""

from __future__ import annotations

import html
from collections import Counter
from collections.abc import Mapping
from typing import Any

import numpy as np
from rich.table import Table

from evaluation.planning.measures import poisson_bound, pooled_efficiency

Entries = Mapping[str, dict[str, Any]]


def summary(entries: Entries) -> dict[str, Any]:
    """The figures of one planner over all its drives; what failed inside is counted under `errors`."""
    good = [e for e in entries.values() if "error" not in e]
    cycle = np.concatenate([e["cycle_ms"] for e in good]) if good else np.zeros(0)
    judged = [e for e in good if e["criterion"] is not None]
    on_map = [e for e in good if e["off_road"] is not None]
    length = sum(e["duration_s"] for e in good)
    km = sum(e["distance_m"] for e in good) / 1000.0
    return {
        "n": len(good),
        "errors": len(entries) - len(good),
        "collisions": sum(e["collision"] for e in good),
        "collisions_at_fault": sum(e["collision_at_fault"] for e in good),
        "collisions_unavoidable": sum(e.get("collision_unavoidable", False) for e in good),
        "goal_rate": _share(sum(e["goal"] for e in good), len(good)),
        "off_road": sum(bool(e["off_road"]) for e in on_map),
        "efficiency": pooled_efficiency(good),
        "efficiency_human": pooled_efficiency(good, "human"),
        "efficiency_comfortable_human": pooled_efficiency(good, "human", "comfortable_m"),
        "efficiency_sumo": pooled_efficiency(good, "sumo"),
        "efficiency_idm": pooled_efficiency(good, "idm"),
        "criteria_passed": sum(e["criterion"] == "" for e in judged),
        "criteria": len(judged),
        "max_accel_lon": max((e["max_accel_lon"] for e in good), default=0.0),
        "max_accel_lat": max((e["max_accel_lat"] for e in good), default=0.0),
        "max_accel_lon_with_emergencies": max((e["with_emergencies"]["max_accel_lon"] for e in good), default=0.0),
        "p95_jerk": round(float(np.average([e["p95_jerk"] for e in good], weights=_weights(good))), 3) if good else 0.0,
        "min_ttc_s": min((e["min_ttc_s"] for e in good if e["min_ttc_s"] is not None), default=None),
        "emergency_share": _share(
            sum(e["emergency_share"] * e["judged_s"] for e in good), sum(e["judged_s"] for e in good)
        ),
        "safe_stop_share": _share(sum(e["safe_stop_share"] * e["duration_s"] for e in good), length),
        "cycle_ms_p50": _percentile(cycle, 50),
        "cycle_ms_p99": _percentile(cycle, 99),
        "failed_cycles": dict(sum((Counter(e.get("failed_cycles", {})) for e in good), Counter()).most_common()),
        "driven_km": round(km, 3),
        "at_fault_per_1000_km_bound": round(poisson_bound(sum(e["collision_at_fault"] for e in good), km), 1)
        if km > 0
        else None,
    }


def _weights(entries: list[dict[str, Any]]) -> list[float]:
    return [max(e["duration_s"], 0.1) for e in entries]


def _share(part: float, whole: float) -> float:
    return round(part / whole, 4) if whole > 0 else 0.0


def _percentile(values: np.ndarray, q: float) -> float:
    return round(float(np.percentile(values, q)), 2) if len(values) else 0.0


def plain(entry: dict[str, Any]) -> dict[str, Any]:
    """An entry as it stands in the JSON: the cycle times as percentiles."""
    if "error" in entry:
        return entry
    cycle = np.array(entry["cycle_ms"])
    rest = {k: v for k, v in entry.items() if k != "cycle_ms"}
    return {**rest, "cycle_ms_p50": _percentile(cycle, 50), "cycle_ms_p99": _percentile(cycle, 99)}


def summary_table(result: dict[str, Any]) -> Table:
    """One row a planner."""
    out = Table(title="Closed loop in simulated time", title_justify="left")
    for name in (
        "planner", "drives", "criteria", "coll.", "at fault", "goal", "off road", "vs human", "vs IDM", "a_lon",
        "a_lat", "jerk p95", "emerg.", "safe stop", "cycle p50/p99 ms",
    ):  # fmt: skip
        out.add_column(name, justify="left" if name == "planner" else "right")
    for planner, s in result["summary"].items():
        errors = f" +{s['errors']} failed" if s["errors"] else ""
        criteria = f"{s['criteria_passed']}/{s['criteria']}" if s["criteria"] else "–"
        out.add_row(
            planner, f"{s['n']}{errors}", criteria, str(s["collisions"]), str(s["collisions_at_fault"]),
            f"{s['goal_rate']:.0%}", str(s["off_road"]), _percent(s["efficiency_human"]), _percent(s["efficiency_idm"]),
            f"{s['max_accel_lon']:.2f}", f"{s['max_accel_lat']:.2f}", f"{s['p95_jerk']:.2f}",
            f"{s['emergency_share']:.1%}", f"{s['safe_stop_share']:.1%}",
            f"{s['cycle_ms_p50']:.1f}/{s['cycle_ms_p99']:.1f}",
        )  # fmt: skip
    if any(_enough(s) for s in result["summary"].values()):
        out.caption = "\n".join(f"{planner}: {rate(s)}" for planner, s in result["summary"].items())
        out.caption_justify = "left"
    return out


def rate(s: dict[str, Any]) -> str:
    """Collisions at fault over the kilometres driven, with the upper bound of their rate."""
    bound = s["at_fault_per_1000_km_bound"]
    found = f"{s['collisions_at_fault']} collisions at fault in {s['driven_km']:.1f} km"
    return found if bound is None else f"{found}: at most {bound:.1f} per 1000 km (95 %)"


def _enough(s: dict[str, Any]) -> bool:
    return bool(s["driven_km"] >= ENOUGH_KM or s["efficiency_sumo"])


def _percent(value: float | None) -> str:
    return "–" if value is None else f"{value:.0%}"


def _number(value: float | None, digits: int = 2) -> str:
    return "–" if value is None else f"{value:.{digits}f}"


COLUMNS = (
    "scenario", "collision", "clear m", "TTC s", "goal s", "v m/s", "effic.", "a_lon", "a_lat", "jerk", "emerg.",
    "stop", "criterion",
)  # fmt: skip


def cells(name: str, e: dict[str, Any]) -> list[str]:
    """One drive as a row of `COLUMNS`."""
    if "error" in e:
        return [name, "failed", *[""] * (len(COLUMNS) - 3), e["error"]]
    collision = "at fault" if e["collision_at_fault"] else "not at fault" if e["collision"] else "none"
    goal = _number(e["goal_t"], 1) if e["goal"] else "no"
    return [
        name, collision, _number(e["min_clearance_m"]), _number(e["min_ttc_s"], 1), goal,
        _number(e["mean_speed_mps"], 1),
        _percent(e["efficiency"]), _number(e["max_accel_lon"]), _number(e["max_accel_lat"]), _number(e["p95_jerk"]),
        f"{e['emergency_share']:.0%}", f"{e['safe_stop_share']:.0%}", wrong(e) or "ok",
    ]  # fmt: skip


def drives_table(planner: str, entries: Entries, *, only_failures: bool = False) -> Table | None:
    """One row a drive; None: nothing to show."""
    out = Table(title=f"{planner}: {'what went wrong' if only_failures else 'each drive'}", title_justify="left")
    for column in COLUMNS:
        out.add_column(
            column, justify="left" if column in ("scenario", "criterion") else "right", no_wrap=column != "criterion"
        )
    rows = [cells(n, e) for n, e in entries.items() if wrong(e) or not only_failures]
    for row in rows:
        out.add_row(*row)
    return out if rows else None


def wrong(e: dict[str, Any]) -> str:
    """What is wrong with a drive, in a few words; empty: nothing."""
    if "error" in e:
        return str(e["error"])
    if e["criterion"]:
        return str(e["criterion"])
    if e["collision_at_fault"]:
        lost = ", lost from its first state on" if e.get("collision_unavoidable") else ""
        return next(f"collision at fault: {c['why']}{lost}" for c in e["collisions"] if c["at_fault"])
    return f"{e['off_road_m']} m off the road" if e["off_road"] else ""


HEAD = {
    "n": "drives",
    "criteria_passed": "criteria met",
    "collisions": "collisions",
    "collisions_at_fault": "at fault",
    "collisions_unavoidable": "lost from the start",
    "goal_rate": "goal",
    "off_road": "off road",
    "efficiency_human": "of the human's way",
    "efficiency_comfortable_human": "of the human's, in comfort",
    "efficiency_idm": "of the IDM's way",
    "efficiency_sumo": "of SUMO's way",
    "max_accel_lon": "peak a_lon",
    "max_accel_lat": "peak a_lat",
    "p95_jerk": "jerk p95",
    "emergency_share": "emergency",
    "cycle_ms_p50": "cycle p50 ms",
    "cycle_ms_p99": "p99 ms",
    "driven_km": "km",
    "at_fault_per_1000_km_bound": "at fault per 1000 km, at most (95 %)",
}
SHARES = (
    "goal_rate",
    "efficiency_human",
    "efficiency_comfortable_human",
    "efficiency_idm",
    "efficiency_sumo",
    "emergency_share",
)


def markdown(result: dict[str, Any]) -> str:
    """The summary as a table for a document, and every drive that went wrong, with why."""
    found = result["summary"].values()
    shown = [k for k in HEAD if any(s.get(k) not in (None, 0) for s in found) or k in PROMISED]
    if not any(_enough(s) for s in found):
        shown = [k for k in shown if k != "at_fault_per_1000_km_bound"]
    lines = [f"`{result['command']}`", "", f"| planner | {' | '.join(HEAD[k] for k in shown)} |"]
    lines.append(f"|---{'|---:' * len(shown)}|")
    for planner, s in result["summary"].items():
        row = [_percent(s[k]) if k in SHARES else _shown(s[k]) for k in shown]
        if "criteria_passed" in shown:
            row[shown.index("criteria_passed")] = f"{s['criteria_passed']}/{s['criteria']}"
        lines.append(f"| {planner} | {' | '.join(row)} |")
    for planner, entries in result["scenarios"].items():
        bad = [f"{n}: {wrong(e)}" for n, e in entries.items() if wrong(e)]
        if bad:
            lines += ["", f"{planner} ({len(bad)}): {'; '.join(bad)}."]
    for planner, s in result["summary"].items():
        if s.get("failed_cycles"):
            told = "; ".join(f"{n} × {why}" for why, n in s["failed_cycles"].items())
            lines += ["", f"{planner}, cycles without a trajectory: {told}."]
    for name, why in result["not_loaded"].items():
        lines += ["", f"Not loaded: {name}: {why}"]
    return "\n".join(lines) + "\n"


ENOUGH_KM = 20.0
"""Over fewer kilometres a rate per 1000 says nothing."""
PROMISED = ("n", "collisions", "collisions_at_fault", "goal_rate", "off_road")

STYLE = (
    "body{font:14px/1.4 system-ui,sans-serif;margin:2rem;color:#222}table{border-collapse:collapse;margin:1rem 0 2rem}"
    "th,td{padding:.25rem .6rem;border-bottom:1px solid #ddd;text-align:right;white-space:nowrap}"
    "th:first-child,td:first-child,th:last-child,td:last-child{text-align:left}td:last-child{white-space:normal}"
    "th{background:#f4f4f4}tr.bad td{background:#fdecea}code{background:#f4f4f4;padding:.1rem .3rem}"
)


def page(result: dict[str, Any]) -> str:
    """Everything on one page that needs nothing else."""
    keys = [k for s in result["summary"].values() for k in s]
    keys = list(dict.fromkeys(keys))
    names = list(result["summary"])
    rows = [[k, *(_shown(result["summary"][n].get(k)) for n in names)] for k in keys]
    parts = [
        "<!doctype html><html lang='en'><head><meta charset='utf-8'><title>Forefield: planning in closed loop</title>",
        f"<style>{STYLE}</style></head><body><h1>Planning in closed loop</h1>",
        f"<p><code>{html.escape(result['command'])}</code></p>",
        _table(["figure", *names], rows, set()),
    ]
    if result["not_loaded"]:
        parts.append("<h2>Not loaded</h2>")
        parts.append(_table(["scenario", "why"], [[k, v] for k, v in result["not_loaded"].items()], set()))
    for planner, entries in result["scenarios"].items():
        table = [cells(n, e) for n, e in entries.items()]
        bad = {i for i, e in enumerate(entries.values()) if wrong(e)}
        parts += [f"<h2>{html.escape(planner)}</h2>", _table(list(COLUMNS), table, bad)]
    return "".join([*parts, "</body></html>\n"])


def _shown(value: Any) -> str:
    return "–" if value is None else f"{value:g}" if isinstance(value, float) else str(value)


def _table(head: list[str], rows: list[list[str]], bad: set[int]) -> str:
    top = "".join(f"<th>{html.escape(h)}</th>" for h in head)
    body = "".join(
        f"<tr{' class=bad' if i in bad else ''}>{''.join(f'<td>{html.escape(c)}</td>' for c in row)}</tr>"
        for i, row in enumerate(rows)
    )
    return f"<table><thead><tr>{top}</tr></thead><tbody>{body}</tbody></table>"
