"""What a run comes to: the JSON of the command contract, and the table a person reads."""

from __future__ import annotations

import os
import platform
from pathlib import Path
from typing import Any

import numpy as np
from rich.markup import escape
from rich.table import Table

from common.config import Tree
from common.topics import TOPICS
from rig.live import LiveRun
from rig.statuses import by_topic
from rig.tally import quantiles


def report(live: LiveRun, tree: Tree, failures: list[str]) -> dict[str, Any]:
    """The report of one drive; `failures` are added to those that the drive itself shows."""
    result, tally = live.result, live.tally
    driven = live.measure.summary()
    at_fault = [c for c in live.measure.collisions if c.at_fault]
    failures = [*failures, *(f"collision at fault with object {c.id} at {c.t:.2f} s: {c.why}" for c in at_fault)]
    refused, skipped = by_topic(result.counters.values(), TOPICS)
    total = sum(result.modes_after_first_drive.values())
    return {
        "scenario": live.scenario.name,
        "title": live.scenario.title,
        "duration_s": round(result.duration_s, 3),
        "outcome": "failed" if failures else "completed" if result.completed else "interrupted",
        "failures": failures,
        "frames": {topic: tally.frames.get(topic, 0) for topic in ("objects", "prediction", "risk", "plan")},
        "latency_ms": tally.latency_ms(),
        "period_ms": tally.period_ms(),
        "modes": {mode: round(seconds, 3) for mode, seconds in result.modes.items()},
        "first_drive_s": result.first_drive_s,
        "share_after_first_drive": {
            mode: round(seconds / total, 4) if total > 0 else 0.0
            for mode, seconds in result.modes_after_first_drive.items()
        },
        "reasons": dict(result.reasons.most_common(20)),
        "refused": refused,
        "skipped": skipped,
        "counters": {name: dict(sorted((+counts).items())) for name, counts in result.counters.items()},
        "interventions": driven["interventions"],
        "ego": driven["ego"],
        "schedule_late_ms": quantiles(result.late_ms),
        "warnings": list(live.scenario.warnings),
        "machine": {"cpu": _cpu(), "cores": len(os.sched_getaffinity(0)), "python": platform.python_version()},
        "configuration": tree,
        "recording": tree["viz"]["record"] or None,
    }


def _cpu() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.machine()
    return next((x.partition(":")[2].strip() for x in lines if x.startswith("model name")), platform.machine())


def table(r: dict[str, Any]) -> Table:
    """The summary."""
    ego, latency, modes = r["ego"], r["latency_ms"], r["modes"]
    out = Table(title=escape(f"{r['scenario']}: {r['title']}"), title_justify="left", show_header=False, min_width=60)
    out.add_column(style="bold", no_wrap=True)
    out.add_column()
    colour = {"completed": "green", "interrupted": "yellow"}.get(r["outcome"], "red")
    out.add_row("outcome", f"[{colour}]{r['outcome']}[/] after {r['duration_s']:.1f} s")
    collisions = ego.get("collisions", [])
    said = ", ".join(f"object {c['id']} at {c['t']:.1f} s{' (at fault)' if c['at_fault'] else ''}" for c in collisions)
    clearance = ego["min_clearance_m"]
    near = "no other road user came near" if clearance is None else f"closest {clearance:.2f} m"
    out.add_row("collision", f"[red]{said}[/]" if collisions else f"none, {near}")
    goal = f"reached after {ego['goal_t']:.1f} s" if ego["reached_goal"] else "not reached"
    out.add_row("drive", f"{ego['distance_m']:.0f} m at {ego['mean_speed_mps']:.1f} m/s on average, goal {goal}")
    out.add_row(
        "comfort",
        f"at most {ego['max_abs_accel_lon']:.1f} m/s² along, {ego['max_abs_accel_lat']:.1f} m/s² across, "
        f"jerk {ego['max_abs_jerk']:.1f} m/s³",
    )
    out.add_row("modes", ", ".join(f"{m.replace('_', ' ')} {s:.1f} s" for m, s in modes.items()))
    for why, ticks in list(r["reasons"].items())[:3]:
        out.add_row("", f"[dim]{ticks} × {escape(why)}[/]")
    for i in r["interventions"][:6]:
        cause = i.get("sentence") or i.get("term") or "no reason given"
        change = f"{i['speed_from']:.1f} → {i['speed_to']:.1f} m/s"
        out.add_row(
            "" if i is not r["interventions"][0] else "slowed", f"{i['t']:.1f} s: {i['kind']} {change}: {escape(cause)}"
        )
    frames = r["frames"]
    out.add_row("frames", ", ".join(f"{n} {topic}" for topic, n in frames.items()))
    for stage in ("predictor", "riskfield", "planner", "end_to_end"):
        q = latency[stage]
        heard = q["p50"] is not None
        words = (
            f"{q['p50']:.1f} ms, 99 % within {q['p99']:.1f} ms, at most {q['max']:.1f} ms" if heard else "nothing came"
        )
        out.add_row(stage.replace("_", " "), words)
    for name in ("refused", "skipped"):
        words = ", ".join(f"{t} {reason} {n}" for t, reasons in r[name].items() for reason, n in reasons.items())
        out.add_row(name, words or "none")
    return out


def finite(value: Any) -> Any:
    """The same with NumPy numbers as plain ones and without NaN, as JSON wants it."""
    if isinstance(value, dict):
        return {str(k): finite(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [finite(v) for v in value]
    if isinstance(value, np.generic):
        value = value.item()
    return None if isinstance(value, float) and not np.isfinite(value) else value
