"""The scene: takes each message as it comes, places it in time and draws it.

It holds only what one message needs of another: the ego's size, the last volume and prediction, driven trails,
what was last said. Nothing here waits, subscribes or looks at a clock.
"""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
import rerun as rr

from common.messages import U8, Closures, Ego, Map, Objects, Plan, Prediction, Risk, Route, SliceRisk, Stamped, Status
from viz import account, decision, field, plots, road, traffic
from viz.canvas import Canvas, Rows
from viz.colours import of_speed
from viz.run_time import RunTime
from viz.settings import VizSettings

V = TypeVar("V")

SILENT_NS = 2_000_000_000
KEPT_VOLUMES = 4
EARLY = 0.2
"""A message may come this share of the period too early and is still drawn."""


@dataclass(frozen=True)
class Volume:
    """A volume that a plan may rest on."""

    risk: Stamped[Risk]
    levels: U8
    full_scale: float
    prediction: Prediction | None

    @property
    def base_ns(self) -> int:
        """When slice 0 begins [ns]."""
        return self.risk.capture_ns + round(self.risk.value.t_offset * 1e9)


class Scene:
    """Draws messages into a recording."""

    def __init__(self, rec: Rows, settings: VizSettings) -> None:
        self._settings = settings
        self._canvas = Canvas(rec)
        self._time = RunTime()
        self._changes = plots.Changes.none()
        self._trails = traffic.Trails(settings.trail_s)
        self._ego: Stamped[Ego] | None = None
        self._map: Map | None = None
        self._route: Route | None = None
        self._closures: Closures | None = None
        self._limits = road.SpeedLimits()
        self._limit: float | None = None
        self._left_out: dict[int, str] = {}
        self._predictions: OrderedDict[tuple[str, int], Prediction] = OrderedDict()
        self._volumes: OrderedDict[tuple[str, int], Volume] = OrderedDict()
        self._statuses: dict[str, Stamped[Status]] = {}
        self._next: dict[str, int] = {}
        self._top_speed = 0.0
        self._full_scale = (0.0, 0.0)
        self._scale: tuple[float, float, tuple[float, ...]] | None = None
        self._story = ""
        self._jerk = plots.Jerk()
        self._methods: dict[int, int] = {}
        self._slices = self._styled = 0
        self._last_cause: tuple[str, int] | None = None
        plots.log_styles(self._canvas)
        account.log_version(self._canvas)
        self._legend(settings.full_scale, 1.0, 10.0)

    # --- what stands still ---

    def map(self, stamped: Stamped[Map]) -> None:
        """Draw a map."""
        self._map = stamped.value
        if self._map.lanes:
            self._canvas.place(*(float(v) for v in self._map.lanes[0].centre[0]))
        self._limits = road.SpeedLimits(self._map, self._route)
        self._canvas.set_time(self._time.at(stamped.received_ns))
        road.log_map(self._canvas, self._map)
        road.log_closures(self._canvas, self._map, self._closures)

    def route(self, stamped: Stamped[Route]) -> None:
        """Draw a route."""
        self._route = stamped.value
        self._canvas.place(*(float(v) for v in self._route.reference[0]))
        self._limits = road.SpeedLimits(self._map, self._route)
        self._canvas.set_time(self._time.at(stamped.received_ns))
        road.log_route(self._canvas, self._route)

    def closures(self, stamped: Stamped[Closures]) -> None:
        """Draw what is closed."""
        self._closures = stamped.value
        self._canvas.set_time(self._time.at(stamped.received_ns))
        road.log_closures(self._canvas, self._map, self._closures)

    # --- what moves ---

    def ego(self, stamped: Stamped[Ego]) -> None:
        """Draw the ego."""
        ego, before = stamped.value, self._ego
        self._time.start(stamped.capture_ns)
        self._canvas.place(ego.x, ego.y)
        when = self._time.at(stamped.capture_ns)
        self._canvas.set_time(when)
        account.log_ego(self._canvas, ego)
        if not self._due("ego", stamped.capture_ns, self._settings.ego_hz):
            return
        self._ego = stamped
        traffic.log_ego(self._canvas, ego, self._trails.add(None, when.t, ego.x, ego.y))
        if before is None or (before.value.length, before.value.width) != (ego.length, ego.width):
            traffic.log_ego_body(self._canvas, ego.length, ego.width)
            account.log_ego_size(self._canvas, ego)
        self._limit = self._limits.at(ego.x, ego.y)
        plots.log_value(self._canvas, "plot/speed/ego", ego.speed)
        plots.log_value(self._canvas, "plot/speed/limit", self._limit)
        plots.log_value(self._canvas, "plot/acceleration/ego", ego.acceleration)
        plots.log_value(self._canvas, "plot/jerk/ego", self._jerk.of(when.t, ego.acceleration))
        if self._due("bounds", stamped.capture_ns, 1.0):
            plots.log_bounds(self._canvas, self._settings)

    def objects(self, stamped: Stamped[Objects]) -> None:
        """Draw the objects."""
        when = self._time.begin(stamped)
        objects = stamped.value
        if len(objects.id):
            self._canvas.place(float(objects.x[0]), float(objects.y[0]))
        self._canvas.set_time(when)
        account.log_objects(self._canvas, objects)
        if not self._due("objects", stamped.capture_ns, self._settings.heavy_hz):
            return
        ids = [int(i) for i in objects.id]
        self._trails.forget(set(ids))
        trails = [
            self._trails.add(i, when.t, float(x), float(y)) for i, x, y in zip(ids, objects.x, objects.y, strict=True)
        ]
        ego = None if self._ego is None else self._ego.value
        near = None if ego is None else (ego.x, ego.y, ego.heading)
        traffic.log_objects(self._canvas, objects, trails, near, self._settings.labelled, self._left_out, self._methods)

    def prediction(self, stamped: Stamped[Prediction]) -> None:
        """Draw predicted tracks."""
        prediction = stamped.value
        if stamped.cause is not None:
            _keep(self._predictions, (stamped.cause.boot, stamped.cause.seq), prediction)
        self._canvas.set_time(self._time.of(stamped))
        plots.log_value(self._canvas, "plot/latency/predictor", stamped.work_ns * 1e-6)
        account.log_prediction(self._canvas, prediction)
        self._methods = dict(zip(prediction.id.tolist(), prediction.method.tolist(), strict=True))
        if self._due("prediction", stamped.capture_ns, self._settings.heavy_hz):
            if len(prediction.id):
                self._canvas.place(float(prediction.x0[0]), float(prediction.y0[0]))
            traffic.log_prediction(self._canvas, prediction, self._settings.lift)

    def risk(self, stamped: Stamped[Risk]) -> None:
        """Draw the volume."""
        risk, s = stamped.value, self._settings
        self._canvas.place(risk.grid.x, risk.grid.y)
        self._canvas.set_time(self._time.of(stamped))
        plots.log_value(self._canvas, "plot/latency/riskfield", stamped.work_ns * 1e-6)
        self._left_out = {source.id: source.reason for source in risk.left_out}
        if not self._due("risk", stamped.received_ns, s.heavy_hz):
            return
        self._slices = max(self._slices, len(risk.slice_times))
        full_scale = s.full_scale * risk.e_max
        self._legend(full_scale, risk.e_max, self._top_speed)
        if self._scale != (scale := (full_scale, risk.e_max, tuple(risk.slice_times))):
            self._scale = scale
            account.log_scale(self._canvas, risk, full_scale)
        levels = field.log_risk(self._canvas, risk, full_scale, s.lift if s.stack else None, s.stack_step)
        cause = ("", 0) if stamped.cause is None else (stamped.cause.boot, stamped.cause.seq)
        _keep(self._volumes, cause, Volume(stamped, levels, full_scale, self._predictions.get(cause)))
        if s.exact_hz > 0 and self._due("exact", stamped.received_ns, s.exact_hz):
            field.log_exact(self._canvas, risk, full_scale)

    # --- what was decided ---

    def plan(self, stamped: Stamped[Plan]) -> None:
        """Draw the plan: curves and text always, lines no faster than the limit."""
        plan, s = stamped.value, self._settings
        when = self._time.at(stamped.capture_ns)
        self._canvas.set_time(when)
        plots.log_value(self._canvas, "plot/speed/desired", plan.desired_speed if plan.mode == "drive" else 0.0)
        if plan.profile is not None and len(plan.profile.acceleration):
            plots.log_value(self._canvas, "plot/acceleration/planned", float(plan.profile.acceleration[0]))
        cause = None if stamped.cause is None else (stamped.cause.boot, stamped.cause.seq)
        if cause is not None and cause != self._last_cause:
            self._last_cause = cause
            plots.log_value(self._canvas, "plot/latency/planner", stamped.work_ns * 1e-6)
            end_to_end = self._time.since_objects_ms(stamped.cause, stamped.received_ns)
            plots.log_value(self._canvas, "plot/latency/end_to_end", end_to_end)
        plots.log_mode(self._canvas, plan, self._changes)
        account.log_plan(self._canvas, stamped, when.t + (stamped.received_ns - stamped.capture_ns) * 1e-9)
        if self._due("plan", stamped.received_ns, s.heavy_hz):
            self._draw(stamped)

    def _draw(self, stamped: Stamped[Plan]) -> None:
        plan, s, canvas = stamped.value, self._settings, self._canvas
        ego = None if self._ego is None else self._ego.value
        cause = None if stamped.cause is None else (stamped.cause.boot, stamped.cause.seq)
        volume = self._volumes.get(cause) if cause is not None else None
        offset = 0.0 if volume is None else float(np.clip((stamped.capture_ns - volume.base_ns) * 1e-9, -1.0, 1.0))
        if plan.candidates is not None and len(plan.candidates.desired_speed):
            self._raise_top(float(plan.candidates.desired_speed.max()))
        decision.log_candidates(canvas, plan.candidates, s.candidate_points, self._top_speed)
        decision.log_path(canvas, plan, s.lift, offset)
        decision.log_slice_bounds(canvas, plan)
        heading = 0.0 if ego is None else ego.heading
        decision.log_decision(canvas, plan, s.lift, offset, heading)
        if volume is not None:
            risk = volume.risk
            decision.log_decided_slice(
                canvas, plan, stamped.capture_ns, risk.value, risk.capture_ns, volume.levels, ego, volume.prediction,
                s.labelled,
            )  # fmt: skip
        if plan.slice_risk is not None and len(plan.slice_risk.risk):
            self._slice_risk(plan.slice_risk)
        text = decision.story(plan, ego, self._limit)
        if text != self._story:
            self._story = text
            canvas.log("why", rr.TextDocument(text, media_type=rr.MediaType.MARKDOWN))

    def _slice_risk(self, found: SliceRisk) -> None:
        # a plan that has left the first slice behind tells one less: the number of curves stays
        if len(found.risk) > self._styled:
            self._slices = self._styled = max(self._slices, len(found.risk))
            step = float(found.t[1] - found.t[0]) if len(found.t) > 1 else 0.0
            plots.log_slice_risk_style(self._canvas, [step * j for j in range(self._slices)])
        padded = np.full(self._slices, np.nan)
        padded[: len(found.risk)] = found.risk
        self._canvas.log("plot/max_risk/slices", rr.Scalars(padded))

    # --- health ---

    def status(self, stamped: Stamped[Status]) -> None:
        """Draw what a service says about itself."""
        self._statuses[stamped.value.service] = stamped
        self._canvas.set_time(self._time.at(stamped.received_ns))
        plots.log_status(self._canvas, stamped.value, self._changes)
        account.log_status(self._canvas, stamped.value)
        if self._due("health", stamped.received_ns, 1.0):
            plots.log_health(self._canvas, {k: v.value for k, v in self._statuses.items()})

    def silence(self, now_ns: int) -> None:
        """Note which services have not spoken for two seconds."""
        for service, last in self._statuses.items():
            if now_ns - last.received_ns > SILENT_NS and last.value.state != "stopping":
                self._canvas.set_time(self._time.at(now_ns))
                plots.log_state(self._canvas, service, "silent", "no status for two seconds", self._changes)

    # --- helpers ---

    def _due(self, what: str, ns: int, hz: float) -> bool:
        period = round(1e9 / hz)
        due = self._next.get(what, ns)
        if due - 2 * period < ns < due - EARLY * period:
            return False
        # counted from when it was due, so that what comes early now and then does not raise the rate
        self._next[what] = (due if due - period < ns < due + period else ns) + period
        return True

    def _raise_top(self, speed: float) -> None:
        wanted = max(speed, self._limit or 0.0)
        if wanted > self._top_speed:
            self._legend(*self._full_scale, float(np.ceil(wanted / 5.0) * 5.0))

    def _legend(self, full_scale: float, e_max: float, top: float) -> None:
        top = max(top, self._top_speed)
        if (full_scale, e_max, top) == (*self._full_scale, self._top_speed):
            return
        self._full_scale, self._top_speed = (full_scale, e_max), top
        speeds = np.linspace(0.0, top, 16, dtype=np.float32)
        field.log_legend(self._canvas, full_scale, e_max, speeds, of_speed(speeds, top), top)


def _keep(store: OrderedDict[tuple[str, int], V], key: tuple[str, int], value: V) -> None:
    store[key] = value
    while len(store) > KEPT_VOLUMES:
        store.popitem(last=False)
