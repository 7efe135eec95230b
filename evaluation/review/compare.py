"""Two drives side by side: what changed in figures, slow-downs, settings. Times count from the begin of each run."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from rich.markup import escape
from rich.table import Table

from evaluation.review.command import Review
from rig.interventions import Intervention

MATCH_S = 4.0
"""Slow-downs that begin further apart are not the same [s]."""
SAME_SOURCE_S = 2.0
"""A common source is worth as much as beginning this much nearer to each other [s]."""
GRID_S = 0.1

FIGURES = (
    ("duration_s", "s"),
    ("distance_m", "m"),
    ("mean_speed_mps", "m/s"),
    ("slow_downs", ""),
    ("stops", ""),
    ("min_clearance_m", "m"),
    ("highest_risk", "E_max"),
    ("max_abs_accel_lon", "m/s²"),
    ("max_abs_accel_lat", "m/s²"),
    ("max_abs_jerk", "m/s³"),
    ("p95_abs_jerk", "m/s³"),
)


def compare(a: Review, b: Review) -> dict[str, Any]:
    """Everything that changed from A to B, as plain values."""
    return {
        "a": a.recording.path.name,
        "b": b.recording.path.name,
        "same_scenario": a.recording.name == b.recording.name,
        "scenario": {"a": a.recording.name, "b": b.recording.name},
        "settings": settings(a.recording.configuration, b.recording.configuration),
        "summary": list(_figures(a.result, b.result)),
        "apart": apart(a, b),
        "interventions": [
            {"a": None if i is None else i.as_dict(), "b": None if j is None else j.as_dict()}
            for i, j in matched(a.drive.interventions, b.drive.interventions)
        ],
    }


def _figures(a: dict[str, Any], b: dict[str, Any]) -> Iterator[dict[str, Any]]:
    for name, unit in FIGURES:
        yield _row(name, unit, a["summary"][name], b["summary"][name])
    for mode in sorted(a["summary"]["modes_s"].keys() | b["summary"]["modes_s"].keys()):
        x, y = (r["summary"]["modes_s"].get(mode, 0.0) for r in (a, b))
        yield _row(f"{mode}_s", "s", x, y)
    for stage in a["latency_ms"]:
        yield _row(f"{stage}_p50_ms", "ms", a["latency_ms"][stage]["p50"], b["latency_ms"][stage]["p50"])
        yield _row(f"{stage}_p99_ms", "ms", a["latency_ms"][stage]["p99"], b["latency_ms"][stage]["p99"])


def _row(name: str, unit: str, a: float | None, b: float | None) -> dict[str, Any]:
    change = None if a is None or b is None else round(b - a, 3)
    return {"name": name, "unit": unit, "a": a, "b": b, "change": change}


def settings(a: dict[str, Any], b: dict[str, Any]) -> dict[str, dict[str, Any]]:
    """Settings that differ, by `section.key`; a section that one of them does not tell says nothing.

    Where the runs were recorded to, and over which bus, is no setting of the drive.
    """
    flat_a, flat_b = dict(_flat(a)), dict(_flat(b))
    names = sorted(flat_a.keys() | flat_b.keys())
    return {
        name: {"a": flat_a.get(name), "b": flat_b.get(name)}
        for name in names
        if flat_a.get(name) != flat_b.get(name)
        and (section := name.partition(".")[0]) not in ("bus", "viz", "service")
        and section in a
        and section in b
    }


def _flat(tree: dict[str, Any], above: str = "") -> Iterator[tuple[str, Any]]:
    for key, value in tree.items():
        if isinstance(value, dict):
            yield from _flat(value, f"{above}{key}.")
        else:
            yield f"{above}{key}", value


def apart(a: Review, b: Review) -> dict[str, float | None]:
    """How far the two egos are from each other at the same time of their runs: at most, and from when on [m], [s]."""
    x, y = a.drive.states, b.drive.states
    none: dict[str, float | None] = {
        "most_m": None,
        "at_s": None,
        "speed_mps": None,
        "speed_at_s": None,
        "from_s": None,
    }
    if len(x.t) < 2 or len(y.t) < 2:
        return none
    t = np.arange(max(x.t[0], y.t[0]), min(x.t[-1], y.t[-1]) + 1e-9, GRID_S)
    if not len(t):
        return none

    def at(values: str) -> tuple[Any, Any]:
        return np.interp(t, x.t, getattr(x, values)), np.interp(t, y.t, getattr(y, values))

    (ax, bx), (ay, by), (av, bv) = at("x"), at("y"), at("speed")
    distance, speed = np.hypot(ax - bx, ay - by), np.abs(av - bv)
    far = np.flatnonzero(distance > 0.5)
    return {
        "most_m": round(float(np.max(distance)), 2),
        "at_s": round(float(t[np.argmax(distance)]), 2),
        "speed_mps": round(float(np.max(speed)), 2),
        "speed_at_s": round(float(t[np.argmax(speed)]), 2),
        "from_s": round(float(t[far[0]]), 2) if len(far) else None,
    }


def matched(
    a: list[Intervention], b: list[Intervention]
) -> list[tuple[Intervention | None, Intervention | None]]:  # fmt: skip
    """Slow-downs of both, those that begin nearest to each other side by side, in the order of time.

    A pair with the same source goes before one that begins up to SAME_SOURCE_S nearer to each other.
    """

    def cost(i: Intervention, j: Intervention) -> float:
        same = i.reason.source_id is not None and i.reason.source_id == j.reason.source_id
        return abs(i.t - j.t) - (SAME_SOURCE_S if same else 0.0)

    near = sorted(
        (cost(i, j), k, n) for k, i in enumerate(a) for n, j in enumerate(b) if abs(i.t - j.t) <= MATCH_S
    )  # fmt: skip
    of_a: dict[int, int] = {}
    of_b: dict[int, int] = {}
    for _, k, n in near:
        if k not in of_a and n not in of_b:
            of_a[k], of_b[n] = n, k
    pairs: list[tuple[Intervention | None, Intervention | None]] = [
        (i, b[of_a[k]] if k in of_a else None) for k, i in enumerate(a)
    ]
    pairs += [(None, j) for n, j in enumerate(b) if n not in of_b]
    return sorted(pairs, key=lambda pair: min(i.t for i in pair if i is not None))


def tables(found: dict[str, Any]) -> list[Table]:
    """The same for a terminal."""
    return [t for t in (_settings_table(found), _summary_table(found), _interventions_table(found)) if t is not None]


def _settings_table(found: dict[str, Any]) -> Table | None:
    if not found["settings"]:
        return None
    out = Table(title="Settings that differ", title_justify="left")
    out.add_column("setting")
    out.add_column("A")
    out.add_column("B")
    for name, value in found["settings"].items():
        out.add_row(name, *(escape(_said(value[k])) for k in "ab"))
    return out


def _summary_table(found: dict[str, Any]) -> Table:
    title = f"A: {found['a']}   B: {found['b']}"
    far = found["apart"]
    caption = ""
    if far["most_m"] is not None:
        since = "never more than 0.5 m" if far["from_s"] is None else f"more than 0.5 m from {far['from_s']:.1f} s on"
        caption = (
            f"apart {since}, at most {far['most_m']:.1f} m at {far['at_s']:.1f} s; "
            f"speeds at most {far['speed_mps']:.1f} m/s at {far['speed_at_s']:.1f} s"
        )
    out = Table(title=escape(title), title_justify="left", caption=caption, caption_justify="left")
    out.add_column("")
    for name in ("A", "B", "change"):
        out.add_column(name, justify="right")
    for row in found["summary"]:
        change = "" if not row["change"] else f"{row['change']:+g}"
        out.add_row(escape(_label(row)), _said(row["a"]), _said(row["b"]), change)
    return out


def _interventions_table(found: dict[str, Any]) -> Table:
    out = Table(title="Slow-downs and stops, matched in time", title_justify="left")
    for name in ("A", "B"):
        out.add_column(name, ratio=1)
    for pair in found["interventions"]:
        out.add_row(*(escape(_sentence(pair[k])) for k in "ab"))
    if not found["interventions"]:
        out.add_row("none", "none")
    return out


def _label(row: dict[str, Any]) -> str:
    """What a row is about, with its unit."""
    label = row["name"]
    for suffix in ("_mps", "_ms", "_s", "_m"):
        label = label.removesuffix(suffix)
    return f"{label.replace('_', ' ')} [{row['unit']}]" if row["unit"] else label.replace("_", " ")


def _sentence(i: dict[str, Any] | None) -> str:
    if i is None:
        return "–"
    return f"{i['t']:.1f} s: {i['speed_from']:.1f} → {i['speed_to']:.1f} m/s: {i['sentence']}"


def _said(value: Any) -> str:
    if value is None:
        return "–"
    return f"{value:g}" if isinstance(value, float) else str(value)


def markdown(found: dict[str, Any]) -> str:
    """The same for a viewer."""
    lines = [f"# A: {found['scenario']['a']}", f"# B: {found['scenario']['b']}", ""]
    if found["settings"]:
        lines += ["| setting | A | B |", "|:--|:--|:--|"]
        lines += [f"| {n} | {_said(v['a'])} | {_said(v['b'])} |" for n, v in found["settings"].items()] + [""]
    lines += ["| | A | B | change |", "|:--|--:|--:|--:|"]
    for row in found["summary"]:
        change = "" if not row["change"] else f"{row['change']:+g}"
        lines.append(f"| {_label(row)} | {_said(row['a'])} | {_said(row['b'])} | {change} |")
    lines += ["", "## Slow-downs and stops", "", "| A | B |", "|:--|:--|"]
    lines += [f"| {_sentence(p['a'])} | {_sentence(p['b'])} |" for p in found["interventions"]]
    return "\n".join(lines)
