"""Curves, states and text: everything that is read along time."""

from __future__ import annotations

import re
from collections import deque
from dataclasses import dataclass, field

import rerun as rr

from common.messages import Plan, Status
from common.topics import RISK, STATUS_OF
from viz.canvas import Canvas
from viz.colours import GREEN, ORANGE, PURPLE, SKY, VERMILION, WHITE, YELLOW, Colour, of_slice
from viz.settings import VizSettings

SERIES: dict[str, tuple[str, Colour, float]] = {
    "plot/speed/ego": ("speed", WHITE, 2.0),
    "plot/speed/desired": ("desired speed", GREEN, 1.5),
    "plot/speed/limit": ("limit", VERMILION, 1.0),
    "plot/acceleration/ego": ("acceleration", WHITE, 1.5),
    "plot/acceleration/planned": ("planned acceleration", GREEN, 1.0),
    "plot/acceleration/most": ("comfort", VERMILION, 1.0),
    "plot/acceleration/least": ("comfort, braking", VERMILION, 1.0),
    "plot/jerk/ego": ("jerk", WHITE, 1.5),
    "plot/jerk/most": ("comfort", VERMILION, 1.0),
    "plot/jerk/least": ("comfort, downwards", VERMILION, 1.0),
    "plot/latency/predictor": ("predictor", SKY, 1.0),
    "plot/latency/riskfield": ("riskfield", ORANGE, 1.0),
    "plot/latency/planner": ("planner", GREEN, 1.0),
    "plot/latency/end_to_end": ("end to end", WHITE, 2.0),
    "plot/latency/deadline": ("deadline: older risk is a safe stop", VERMILION, 1.0),
}
"""Entity → name, colour, width of each curve."""

MODES: dict[str, Colour] = {"drive": GREEN, "waiting": YELLOW, "safe_stop": VERMILION}
STATES: dict[str, Colour] = {
    "ready": GREEN,
    "starting": SKY,
    "waiting": YELLOW,
    "degraded": ORANGE,
    "stopping": PURPLE,
    "silent": VERMILION,
}
OVER_S = 0.2
"""Span of the difference quotient of jerk [s]."""
SERVICES = tuple(name for name in STATUS_OF if name != "viz")
"""Who reports its health; each stands under its own name."""


def log_styles(canvas: Canvas) -> None:
    """Log names, colours and states, once."""
    for path, (name, colour, width) in SERIES.items():
        canvas.log(path, rr.SeriesLines(names=[name], colors=[colour], widths=[width]), static=True)
    _states(canvas, "plan", MODES)
    for service in SERVICES:
        _states(canvas, rr.escape_entity_path_part(service), STATES)


def _states(canvas: Canvas, path: str, states: dict[str, Colour]) -> None:
    style = rr.StateConfiguration(
        values=list(states), labels=[s.replace("_", " ") for s in states], colors=list(states.values())
    )
    canvas.log(path, style, static=True)


def log_value(canvas: Canvas, path: str, value: float | None) -> None:
    """Log one value of a curve; nothing where it is unknown."""
    if value is not None:
        canvas.log(path, rr.Scalars(value))


@dataclass
class Jerk:
    """Jerk as the acceleration's difference quotient over `OVER_S`, so that the integration step does not show."""

    _seen: deque[tuple[float, float]] = field(default_factory=deque)

    def of(self, t: float, acceleration: float) -> float | None:
        """Jerk [m/s³] at t [s]; None before enough was seen, or after a gap."""
        if self._seen and not 0 <= t - self._seen[-1][0] < 5 * OVER_S:
            self._seen.clear()
        self._seen.append((t, acceleration))
        while len(self._seen) > 1 and t - self._seen[1][0] >= OVER_S - 1e-6:
            self._seen.popleft()
        before, was = self._seen[0]
        return (acceleration - was) / (t - before) if t - before >= OVER_S - 1e-6 else None


def log_bounds(canvas: Canvas, settings: VizSettings) -> None:
    """Log what curves are held against: comfort's bounds, and the age at which a risk is no longer used."""
    log_value(canvas, "plot/acceleration/most", settings.comfort_accel)
    log_value(canvas, "plot/acceleration/least", -settings.comfort_brake)
    log_value(canvas, "plot/jerk/most", settings.comfort_jerk)
    log_value(canvas, "plot/jerk/least", -settings.comfort_jerk)
    log_value(canvas, "plot/latency/deadline", 1e3 * (RISK.max_age_s or 0.0))


def log_slice_risk_style(canvas: Canvas, times: list[float]) -> None:
    """Name the curves of the slices by the time at which they begin."""
    names = [f"{t:.1f} s" for t in times]
    style = rr.SeriesLines(names=names, colors=of_slice(len(times)), widths=[1.0] * len(times))
    canvas.log("plot/max_risk/slices", style, static=True)


@dataclass
class Changes:
    """What was last said about each thing, so that only news is logged."""

    said: dict[str, str]

    @staticmethod
    def none() -> Changes:
        """Nothing was said yet."""
        return Changes({})

    def news(self, about: str, what: str) -> bool:
        """Whether `what` differs from what was last said, numbers aside."""
        core = re.sub(r"[-+]?\d+(?:\.\d+)?", "#", what)
        if self.said.get(about) == core:
            return False
        self.said[about] = core
        return True


def log_mode(canvas: Canvas, plan: Plan, changes: Changes) -> None:
    """Log the plan's mode where it changes, and its reason and decision as text where they do."""
    if changes.news("mode", plan.mode):
        canvas.log("plan", rr.StateChange(state=plan.mode))
    sentence = plan.decision.sentence if plan.decision is not None else ""
    source = "" if plan.decision is None else f"{plan.decision.term} of {_spelt(plan.decision.source_id)}"
    if changes.news("plan", f"{plan.mode} {plan.reason} {source}"):
        level = {"drive": "INFO", "waiting": "WARN", "safe_stop": "ERROR"}[plan.mode]
        text = f"{plan.mode}: {plan.reason}" + (f" · {sentence}" if sentence and sentence != plan.reason else "")
        canvas.log("plan", rr.TextLog(text, level=level))


def _spelt(identity: int | None) -> str:
    # letters, because `news` disregards digits and another source is news
    return "" if identity is None else "".join(chr(ord("a") + int(d)) for d in str(abs(identity)))


def log_state(canvas: Canvas, service: str, state: str, reason: str, changes: Changes) -> None:
    """Log a service's state where it changes, with its reason."""
    path = rr.escape_entity_path_part(service)
    if changes.news(f"state {service}", state):
        canvas.log(path, rr.StateChange(state=state))
    if changes.news(f"reason {service}", f"{state} {reason}"):
        level = "INFO" if state in ("ready", "starting", "stopping") else "WARN"
        canvas.log(path, rr.TextLog(f"{state}: {reason}", level=level))


def log_status(canvas: Canvas, status: Status, changes: Changes) -> None:
    """Log what a service says about itself: state, reason, inputs, what it refused."""
    log_state(canvas, status.service, status.state, status.reason, changes)
    for counter, n in status.counters.items():
        if not counter.endswith(":sent") and not counter.startswith("mode:") and changes.news(
            f"{status.service} {counter}", "counted"
        ):  # fmt: skip
            canvas.log(rr.escape_entity_path_part(status.service), rr.TextLog(f"first {counter} ({n})", level="DEBUG"))


def log_health(canvas: Canvas, statuses: dict[str, Status]) -> None:
    """Log a table of every service: state, rates, work, what was not used."""
    lines = ["| service | state | inputs [Hz] | work p50 / p99 [ms] | not used |", "|:--|:--|:--|--:|:--|"]
    for name, s in sorted(statuses.items()):
        inputs = ", ".join(f"{k} {v.rate_hz:.0f}{'' if v.alive else ' ✗'}" for k, v in s.inputs.items() if v.rate_hz)
        unused = ", ".join(f"{k} {v}" for k, v in s.counters.items() if not k.endswith(":sent") and "mode:" not in k)
        work = f"{s.work_ms.get('p50', 0):.1f} / {s.work_ms.get('p99', 0):.1f}" if s.work_ms else ""
        lines.append(f"| {name} | {s.state}: {s.reason} | {inputs} | {work} | {unused or 'nothing'} |")
    canvas.log("health", rr.TextDocument("\n".join(lines), media_type=rr.MediaType.MARKDOWN))
