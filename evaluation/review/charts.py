"""The curves of a review: what happened along time, latencies, prediction error, and the drive as a map."""

from __future__ import annotations

import itertools
import math
from typing import Any

import numpy as np
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure

from common.messages import F64
from evaluation.figures.style import ACCENT, EGO, INK, risk_colours
from evaluation.review.bounds import Bounds
from evaluation.review.drive import Drive
from evaluation.review.hindsight import Errors, Group
from evaluation.review.recording import STAGES, Recording
from rig.interventions import Intervention
from viz.account import HORIZONS_S

MODES = {"drive": "#009e73", "waiting": "#f0e442", "safe_stop": "#d55e00"}
STATES = {
    "ready": "#009e73",
    "starting": "#56b4e9",
    "waiting": "#f0e442",
    "degraded": "#e69f00",
    "stopping": "#cc79a7",
    "silent": "#d55e00",
}
METHODS = {"constant_velocity": "#7f7f7f", "ctra": "#cc79a7", "map_based": "#009e73", "lstm": "#d55e00"}
STAGE_COLOURS = dict(zip(STAGES, ("#56b4e9", "#e69f00", "#009e73", INK), strict=True))
EPISODE = "#d1006c"
MOST_POINTS = 2500
"""Points of one curve; more are told by the lowest and highest of each stretch."""
SILENT_S = 2.0


def thin(t: F64, v: F64, most: int = MOST_POINTS) -> tuple[F64, F64]:
    """A curve of at most so many points that keeps every peak."""
    if len(t) <= most:
        return t, v
    edges = np.linspace(0, len(t), most // 2 + 1).astype(int)
    keep = set()
    for a, b in itertools.pairwise(edges):
        part = np.nan_to_num(v[a:b], nan=0.0)
        keep |= {a + int(np.argmin(part)), a + int(np.argmax(part))}
    k = np.array(sorted(keep))
    return t[k], v[k]


def timeline(recording: Recording, drive: Drive, bounds: Bounds) -> Figure:
    """Modes and states, speed, accelerations, jerk, risk on the path and clearance, one under the other."""
    services = [name for name in ("predictor", "riskfield", "planner") if recording.statuses.get(name)]
    heights = [0.32 + 0.2 * len(services), 1.5, 1.25, 1.0, 1.0, 1.0]
    fig = Figure(figsize=(7.4, 1.5 * sum(heights) * 0.78), layout="constrained")
    axes = fig.subplots(len(heights), 1, sharex=True, gridspec_kw={"height_ratios": heights})
    _states(axes[0], recording, drive, services)
    _speed(axes[1], recording, drive)
    _comfort(axes[2], axes[3], drive, bounds)
    _risk(axes[4], drive, bounds)
    _clearance(axes[5], drive, bounds)
    for ax in axes[1:]:
        ax.grid(axis="y", alpha=0.25, lw=0.5)
        ax.margins(x=0.005)
        for found in drive.interventions:
            ax.axvspan(found.t, found.until, color=EPISODE, alpha=0.07, lw=0)
    axes[-1].set_xlabel("time of the run [s]")
    fig.align_ylabels(axes)
    return fig


def _spans(ax: Any, row: float, t: F64, values: list[str], end: float, colours: dict[str, str]) -> None:
    """A bar that changes its colour where a value changes."""
    k = 0
    while k < len(values):
        j = k
        while j + 1 < len(values) and values[j + 1] == values[k]:
            j += 1
        until = float(t[j + 1]) if j + 1 < len(t) else end
        ax.barh(row, until - float(t[k]), left=float(t[k]), height=0.72, color=colours.get(values[k], "#999999"), lw=0)
        k = j + 1


def _states(ax: Any, recording: Recording, drive: Drive, services: list[str]) -> None:
    t = drive.states.t
    end = float(t[-1]) if len(t) else 0.0
    _spans(ax, 0, t, drive.modes, end, MODES)
    used = {mode: MODES[mode] for mode in drive.modes if mode in MODES}
    for row, name in enumerate(services, start=1):
        times: list[float] = []
        values: list[str] = []
        for at, status in recording.statuses[name]:
            at -= drive.began
            if times and at - times[-1] > SILENT_S:
                times.append(times[-1] + SILENT_S)
                values.append("silent")
            times.append(at)
            values.append(status.state)
        _spans(ax, row, np.array(times), values, end, STATES)
        inside = [v for k, v in enumerate(values) if times[k] <= end and (k + 1 == len(times) or times[k + 1] > t[0])]
        used |= {v: STATES[v] for v in inside if v in STATES}
    ax.set_yticks(range(len(services) + 1), ["plan", *services])
    ax.tick_params(axis="y", length=0)
    ax.invert_yaxis()
    ax.set_xlim(float(t[0]) if len(t) else 0.0, max(end, 1e-3))
    by_colour: dict[str, str] = {}
    for name, colour in used.items():
        said = name.replace("_", " ")
        by_colour[colour] = f"{by_colour[colour]} / {said}" if colour in by_colour else said
    handles = [ax.barh(0, 0, color=colour, label=name) for colour, name in by_colour.items()]
    ax.legend(handles=handles, loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=6, frameon=False, borderpad=0.0)
    for side in ("top", "right", "left"):
        ax.spines[side].set_visible(False)


def _speed(ax: Any, recording: Recording, drive: Drive) -> None:
    states = drive.states
    t, v = recording.limit
    if len(t):
        ax.step(t - drive.began, v, where="post", color="#d55e00", lw=0.9, label="limit")
    plans = [p for p in recording.plans if p.t >= drive.began]
    desired = np.array([p.said.desired_speed if p.said.mode == "drive" else 0.0 for p in plans])
    if len(plans):
        at = np.array([p.received for p in plans]) - drive.began
        ax.step(*thin(at, desired), where="post", color=ACCENT, lw=0.9, label="desired")
    ax.plot(*thin(states.t, states.speed), color=EGO, lw=1.6, label="driven")
    ax.set_ylim(bottom=min(0.0, float(np.min(states.speed, initial=0.0))))
    top = ax.get_ylim()[1]
    ax.set_ylim(top=top * 1.12)
    for n, found in enumerate(drive.interventions, start=1):
        ax.annotate(
            str(n), ((found.t + found.until) / 2, top * 1.03), ha="center", va="center", fontsize=8.5, color="white",
            fontweight="bold", bbox={"boxstyle": "circle,pad=0.22", "fc": EPISODE, "ec": "none"},
        )  # fmt: skip
    ax.set_ylabel("speed\n[m/s]")
    ax.legend(loc="lower right", ncols=3, frameon=False)


def _comfort(ax: Any, below: Any, drive: Drive, bounds: Bounds) -> None:
    for leg in drive.legs:
        m = leg.motion
        first = leg is drive.legs[0]
        ax.plot(*thin(m.t_acceleration, m.acceleration), color=EGO, lw=1.1, label="along" if first else None)
        ax.plot(*thin(m.t_acceleration, m.lateral), color="#e69f00", lw=1.0, label="across" if first else None)
        below.plot(*thin(m.t_jerk, m.jerk), color=EGO, lw=0.9)
    for value, colour in ((bounds.accel, EGO), (-bounds.brake, EGO), (bounds.lateral, "#e69f00")):
        for sign in (1, -1) if value == bounds.lateral else (1,):
            ax.axhline(sign * value, color=colour, lw=0.7, ls="--", alpha=0.8)
    for sign in (1, -1):
        below.axhline(sign * bounds.jerk, color=EGO, lw=0.7, ls="--", alpha=0.8)
    ax.set_ylabel("acceleration\n[m/s²]")
    below.set_ylabel("jerk\n[m/s³]")
    ax.plot([], [], color=EGO, lw=0.7, ls="--", label="comfort bounds")
    ax.set_ylim(bottom=ax.get_ylim()[0] - 0.35 * float(np.ptp(ax.get_ylim())))
    ax.legend(loc="lower right", ncols=3, frameon=False)


def _sign(ax: Any, y: float, text: str) -> None:
    """The name of a bound, at the right end of its line."""
    ax.text(
        0.995, y, text, transform=ax.get_yaxis_transform(), fontsize=7.5, ha="right", va="bottom",
        bbox={"boxstyle": "round,pad=0.1", "fc": "white", "ec": "none", "alpha": 0.7},
    )  # fmt: skip


def _risk(ax: Any, drive: Drive, bounds: Bounds) -> None:
    t, v = risk_along(drive)
    ax.plot(*thin(t, v), color="#8c2981", lw=1.1)
    ax.set_ylabel("highest risk\nahead [$E_\\mathrm{max}$]")
    ax.axhline(bounds.contact, color=INK, lw=0.7, ls="--", alpha=0.7)
    ax.set_ylim(0.0, max(1.15, 1.15 * float(np.nanmax(v)) if np.any(np.isfinite(v)) else 1.0))
    _sign(ax, bounds.contact, f"contact {bounds.contact:.1f}")


def risk_along(drive: Drive) -> tuple[F64, F64]:
    """Highest risk on the path in force, over all its slices, at each state; NaN without a path."""
    values = [math.nan if p is None else p.highest_risk for p in drive.in_force]
    return drive.states.t, np.array(values, dtype=np.float64)


def _clearance(ax: Any, drive: Drive, bounds: Bounds) -> None:
    c = drive.clearance
    if len(c.t):
        ax.plot(*thin(c.t, c.distance), color=INK, lw=1.1)
    ax.set_ylim(0.0, max(5.0, min(20.0, float(np.nanmax(c.distance)) if np.any(np.isfinite(c.distance)) else 5.0)))
    ax.axhline(bounds.clearance, color="#d55e00", lw=0.8, ls="--")
    ax.set_ylabel("nearest\n[m]")
    _sign(ax, bounds.clearance, f"contact threshold {bounds.clearance:.2f} m")


def latencies(recording: Recording, drive: Drive, period_ms: float) -> Figure:
    """A histogram for each stage and for the whole way, with median, 99 % and the period."""
    fig = Figure(figsize=(7.4, 2.1), layout="constrained")
    axes = fig.subplots(1, len(STAGES))
    for ax, stage in zip(axes, STAGES, strict=True):
        t, ms = recording.latency_ms[stage]
        ms = ms[t >= drive.began]
        ax.set_title(stage.replace("_", " "), loc="left")
        ax.set_xlabel("[ms]")
        ax.tick_params(axis="y", labelleft=False, length=0)
        if not len(ms):
            ax.text(0.5, 0.5, "nothing came", transform=ax.transAxes, ha="center", va="center", alpha=0.6)
            ax.set_xticks([])
            continue
        top = max(float(np.percentile(ms, 99.5)) * 1.15, 1.0)
        if float(np.ptp(ms)) < 1e-6:
            top = 2.0 * max(float(ms[0]), 0.5)
        ax.hist(np.clip(ms, 0.0, top), bins=np.linspace(0.0, top, 33).tolist(), color=STAGE_COLOURS[stage], alpha=0.75)
        for q, style in ((50, "-"), (99, "--")):
            at = float(np.percentile(ms, q))
            ax.axvline(at, color=INK, lw=0.9, ls=style)
        if period_ms < top:
            ax.axvline(period_ms, color="#d55e00", lw=0.9, ls=":")
        p50, p99 = (float(np.percentile(ms, q)) for q in (50, 99))
        ax.text(
            0.97, 0.95, f"50 % {p50:.0f}\n99 % {p99:.0f}", transform=ax.transAxes, ha="right", va="top", fontsize=7.5,
            bbox={"boxstyle": "round,pad=0.2", "fc": "white", "ec": "none", "alpha": 0.8},
        )  # fmt: skip
        ax.set_xlim(0.0, top)
    return fig


def hindsight(found: dict[Group, list[Errors]]) -> Figure | None:
    """Mean error by horizon of each method, beside constant velocity at the same moments; those who moved."""
    groups = {m: e for (m, moving), e in found.items() if moving and any(len(x.method) for x in e)}
    if not groups:
        return None
    fig = Figure(figsize=(7.4, 2.6), layout="constrained")
    ax, share = fig.subplots(1, 2)
    for method, by_horizon in groups.items():
        has = [k for k, e in enumerate(by_horizon) if len(e.method)]
        h = [HORIZONS_S[k] for k in has]
        own = np.array([by_horizon[k].method.mean() for k in has])
        plain = np.array([by_horizon[k].constant_velocity.mean() for k in has])
        colour, n = METHODS.get(method, INK), sum(len(by_horizon[k].method) for k in has)
        name = method.replace("_", " ")
        ax.plot(h, own, color=colour, marker="o", ms=3.5, lw=1.3, label=f"{name} (n = {n})")
        ax.plot(h, plain, color=colour, lw=0.9, ls=":")
        p95 = [np.percentile(by_horizon[k].method, 95) for k in has]
        share.plot(h, p95, color=colour, marker="o", ms=3.5, lw=1.3)
    ax.set_title("mean; dotted: constant velocity, same moments", loc="left")
    share.set_title("95 % are below", loc="left")
    for a in (ax, share):
        a.set_xlabel("horizon [s]")
        a.set_ylim(bottom=0.0)
        a.grid(alpha=0.25, lw=0.5)
    ax.set_ylabel("error [m]")
    ax.legend(loc="upper left", frameon=False)
    return fig


def drive_map(recording: Recording, drive: Drive) -> Figure:
    """The drive from above, north up, coloured by the highest risk ahead, with every slow-down by its number."""
    s = drive.states
    x0, y0 = float(np.min(s.x)), float(np.min(s.y))
    x, y = s.x - x0, s.y - y0
    wide, tall = float(np.ptp(x)), float(np.ptp(y))
    margin = max(12.0, 0.06 * max(wide, tall))
    upright = tall > wide  # a drive to the north is shown lying, so that the page stays short
    width, height = (tall, wide) if upright else (wide, tall)
    ratio = (height + 2 * margin) / (width + 2 * margin)
    fig = Figure(figsize=(7.4, float(np.clip(5.7 * ratio + 0.75, 1.9, 4.3))), layout="constrained")
    ax = fig.subplots()

    def here(px: Any, py: Any) -> tuple[Any, Any]:
        return (py, -np.asarray(px)) if upright else (px, py)

    for line in recording.road:
        if line.kind in ("virtual_line", "goal"):
            continue
        edge = line.kind in ("kerb", "barrier", "road_edge")
        lx, ly = here(line.points[:, 0] - x0, line.points[:, 1] - y0)
        ax.plot(lx, ly, color="#9aa0a9" if edge else "#c9cdd4", lw=0.9 if edge else 0.5, zorder=1)
    k = np.unique(np.linspace(0, len(x) - 1, min(len(x), 4000)).astype(int))
    hx, hy = here(x[k], y[k])
    points = np.stack((hx, hy), axis=-1)
    _, risk = risk_along(drive)
    same = np.hypot(*np.diff(points, axis=0).T) < 10.0
    segments = np.stack((points[:-1], points[1:]), axis=1)[same]
    lines = LineCollection(list(segments), cmap=_map_colours(), linewidths=4.0, capstyle="round", zorder=3)
    lines.set_array(np.nan_to_num(risk[k][:-1][same], nan=0.0))
    lines.set_clim(0.0, 1.0)
    ax.add_collection(lines)
    for n, found in enumerate(drive.interventions, start=1):
        mx, my = here(*place_of(drive, found, x0, y0))
        ax.annotate(
            str(n), (float(mx), float(my)), xytext=(0, 15), textcoords="offset points", ha="center", va="center",
            fontsize=8.5, color="white", fontweight="bold", zorder=6,
            bbox={"boxstyle": "circle,pad=0.22", "fc": EPISODE, "ec": "none"},
            arrowprops={"arrowstyle": "-", "color": EPISODE, "lw": 1.0},
        )  # fmt: skip
    for k_end, text in ((0, "start"), (len(x) - 1, "end")):
        ex, ey = here(x[k_end], y[k_end])
        ax.annotate(
            text, (float(ex), float(ey)), xytext=(0, -13), textcoords="offset points", ha="center", va="center",
            fontsize=8, zorder=6,
        )  # fmt: skip
    hx, hy = here(x, y)
    ax.set_xlim(float(np.min(hx)) - margin, float(np.max(hx)) + margin)
    ax.set_ylim(float(np.min(hy)) - margin, float(np.max(hy)) + margin)
    ax.set_aspect("equal")
    ax.set_xlabel("north [m]" if upright else "east [m]")
    ax.set_ylabel("west [m]" if upright else "north [m]")
    bar = fig.colorbar(lines, ax=ax, extend="max", pad=0.015, fraction=0.03, aspect=14)
    bar.set_label("highest risk ahead [$E_\\mathrm{max}$]")
    bar.outline.set_linewidth(0.6)
    return fig


def place_of(drive: Drive, found: Intervention, x0: float = 0.0, y0: float = 0.0) -> tuple[float, float]:
    """Where the ego was when its reason took hold [m]."""
    s = drive.states
    return float(np.interp(found.since, s.t, s.x)) - x0, float(np.interp(found.since, s.t, s.y)) - y0


def _map_colours() -> Any:
    from matplotlib.colors import ListedColormap

    return ListedColormap(risk_colours()(np.linspace(0.12, 0.85, 256)), name="drive")
