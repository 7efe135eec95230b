"""The plan: candidates, the chosen path, its tail, and the cell that decided."""

from __future__ import annotations

import numpy as np
import rerun as rr

from common.geometry import rectangle_corners
from common.messages import U8, Candidates, Decision, Ego, Plan, Prediction, Risk, Trajectory
from viz.canvas import F32, Canvas, yaw
from viz.colours import CLASS_HEIGHTS, CLASS_NAMES, GREEN, PURPLE, VERMILION, WHITE, of_class, of_slice, of_speed
from viz.field import GROUND_OPACITY, GROUND_Z, heatmap
from viz.labels import apart, beside

PATH_Z, TAIL_Z, CANDIDATE_Z = 0.30, 0.25, 0.12
ACROSS_M = 1.7
"""Half a line across the path where a slice begins [m]."""
APART_M = 0.8
"""Such lines that lie closer than this are left out [m]."""
SIGN_EVERY = 0.13
"""How near to an even second a slice must begin to carry its time [2 s]."""
SIGN_M = 6.0
"""How far beside its cell a sign stands [m]."""


def log_candidates(canvas: Canvas, candidates: Candidates | None, points: int, top: float) -> None:
    """Log every candidate, coloured by its desired speed."""
    if candidates is None or candidates.x.shape[1] < 2:
        canvas.log("world/plan/candidates", rr.LineStrips3D([]))
        return
    k = np.unique(np.linspace(0, candidates.x.shape[1] - 1, points).round().astype(int))
    order = np.argsort(candidates.desired_speed, kind="stable")  # the fast ones are drawn over the slow ones
    canvas.log(
        "world/plan/candidates",
        rr.LineStrips3D(
            canvas.points(candidates.x[order][:, k], candidates.y[order][:, k], CANDIDATE_Z),
            colors=of_speed(candidates.desired_speed[order], top),
            radii=0.06,
        ),
    )


def log_path(canvas: Canvas, plan: Plan, lift: float, offset_s: float) -> None:
    """Log what is to be driven: the profile wide, the stopping tail beside it; on the ground and in the time stack.

    Args:
        canvas: where to draw.
        plan: the plan.
        lift: height of one second in the stack [m/s].
        offset_s: the plan's capture, counted from the time at which the stack's lowest layer lies [s].
    """
    for name, path, colour, z, radius in (
        ("profile", plan.profile, GREEN, PATH_Z, 0.38),
        ("tail", plan.tail, PURPLE, TAIL_Z, 0.20),
    ):
        if path is None or len(path.t) < 2:
            canvas.log(f"world/plan/{name}", rr.LineStrips3D([]))
            canvas.log(f"stack/plan/{name}", rr.LineStrips3D([]))
            continue
        z_stack = np.maximum(path.t + offset_s, 0.0) * lift + 0.2
        for place, height, r in (("world", z, radius), ("stack", z_stack, radius * 1.3)):
            strip = canvas.points(path.x, path.y, height)
            canvas.log(f"{place}/plan/{name}", rr.LineStrips3D([strip], colors=[colour], radii=[r]))


def log_slice_bounds(canvas: Canvas, plan: Plan) -> None:
    """Log where the path crosses from one slice into the next: short lines across it, whole even seconds with a sign.

    Their colours are those of the slices' curves: yellow now, blue last. Where the ego is to stand, those that would
    lie on one another are left out.
    """
    path, slices = plan.profile, plan.slice_risk
    strips: list[F32] = []
    colours: list[U8] = []
    signs: list[F32] = []
    texts: list[str] = []
    if path is not None and slices is not None and len(path.t) > 1:
        shades = of_slice(len(slices.t))
        heading = np.unwrap(path.heading)
        last = (np.inf, np.inf)
        for t, shade in zip(slices.t, shades, strict=True):
            if not path.t[0] < t <= path.t[-1]:
                continue
            x, y = float(np.interp(t, path.t, path.x)), float(np.interp(t, path.t, path.y))
            if np.hypot(x - last[0], y - last[1]) < APART_M:
                continue
            last = (x, y)
            ahead = float(np.interp(t, path.t, heading))
            ends = np.array([beside(x, y, ahead, side) for side in (-ACROSS_M, ACROSS_M)])
            strips.append(canvas.points(ends[:, 0], ends[:, 1], PATH_Z + 0.1))
            colours.append(shade)
            if abs(t / 2 - round(t / 2)) < SIGN_EVERY and round(t) > 0:
                signs.append(canvas.points(*beside(x, y, ahead, -2.2 * ACROSS_M), PATH_Z))
                texts.append(f"{t:.0f} s")
    canvas.log("world/plan/slices", rr.LineStrips3D(strips, colors=colours, radii=0.14))
    canvas.log("world/plan/slices/time", rr.Points3D(signs, radii=0.01, colors=[WHITE], labels=texts, show_labels=True))


def log_decision(canvas: Canvas, plan: Plan, lift: float, offset_s: float, heading: float) -> None:
    """Mark the cell that decided, on the ground and at its height in the stack, with who it was and the risk there.

    The sign stands beside the cell, on a thin line, so that it hides neither the cell nor its source.

    Args:
        canvas: where to draw.
        plan: the plan.
        lift: height of one second in the stack [m/s].
        offset_s: the plan's capture, counted from the time at which the stack's lowest layer lies [s].
        heading: of the ego [rad]; what is left of it is up in the views.
    """
    decision = plan.decision
    if decision is None or decision.x is None or decision.y is None:
        for place in ("world/plan", "stack/plan", "slice"):
            canvas.log(f"{place}/decided", rr.Points3D([]))
            canvas.log(f"{place}/decided/line", rr.LineStrips3D([]))
            canvas.log(f"{place}/decided/sign", rr.Points3D([]))
        return
    height = max((decision.slice_s or 0.0) + offset_s, 0.0) * lift + 0.5
    aside = beside(decision.x, decision.y, heading, SIGN_M)
    for place, z, sign in (
        ("world/plan", 0.6, canvas.points(*aside, 0.6)),
        ("stack/plan", height, canvas.points(decision.x, decision.y, height + 2 * SIGN_M)),
        ("slice", 0.6, canvas.points(*aside, 0.6)),
    ):
        cell = canvas.points(decision.x, decision.y, z)
        canvas.log(f"{place}/decided", rr.Points3D([cell], radii=[0.7], colors=[VERMILION]))
        canvas.log(f"{place}/decided/line", rr.LineStrips3D([[cell, sign]], colors=[VERMILION], radii=[0.06]))
        canvas.log(
            f"{place}/decided/sign",
            rr.Points3D([sign], radii=[0.01], colors=[VERMILION], labels=[brief(decision)], show_labels=True),
        )


def brief(decision: Decision) -> str:
    """Who decided and how high the risk is: `pedestrian 1 · 0.58`."""
    name = source(decision) or decision.term or "decided"
    return name if decision.risk is None else f"{name} · {decision.risk:.2f}"


def source(decision: Decision) -> str:
    """Class and id of what decided; empty: nothing on the road did."""
    if decision.source_id is None:
        return ""
    kind = "source" if decision.source_cls is None else CLASS_NAMES.get(decision.source_cls, "line")
    return f"{kind} {decision.source_id}"


def log_decided_slice(
    canvas: Canvas, plan: Plan, plan_ns: int, risk: Risk, risk_ns: int, volume: U8, ego: Ego | None,
    prediction: Prediction | None, labelled: int,
) -> None:  # fmt: skip
    """Log the slice that decided: its field, everyone where predicted to be then, and the ego where it will be.

    Without a deciding slice it is the one with the highest risk on the chosen path, or the first.

    Args:
        canvas: where to draw.
        plan: the plan.
        plan_ns: its capture [ns].
        risk: the volume it rests on.
        risk_ns: that volume's capture [ns].
        volume: the volume as bytes.
        ego: our own size.
        prediction: the predictions behind the volume, if known.
        labelled: how many objects may carry a label.
    """
    j = deciding_slice(plan, len(risk.slice_times))
    t = risk.slice_times[j]
    grid = risk.grid
    corner = canvas.points(grid.x, grid.y, GROUND_Z)
    canvas.log("slice/risk", heatmap(volume[j], corner, grid.heading, grid.h, GROUND_OPACITY))
    if prediction is not None and len(prediction.id):
        x, y, heading = poses_at(prediction, t + risk.t_offset)
        height = np.array([CLASS_HEIGHTS[int(c)] for c in prediction.cls])
        canvas.log(
            "slice/objects",
            rr.Boxes3D(
                centers=canvas.points(x, y, height / 2),
                half_sizes=np.stack((prediction.length / 2, prediction.width / 2, height / 2), -1).astype(np.float32),
                quaternions=yaw(heading),
                colors=of_class(prediction.cls),
                radii=0.07,
            ),
        )
        decided = None if plan.decision is None else plan.decision.source_id
        others = np.flatnonzero(prediction.id != decided)  # what decided has its sign
        at = None if ego is None else (ego.x, ego.y, ego.heading)
        k = others[apart(x[others], y[others], at, labelled)]
        texts = [f"{CLASS_NAMES[int(prediction.cls[i])]} {prediction.id[i]}" for i in k]
        where, colours = canvas.points(x[k], y[k], height[k] + 0.3), of_class(prediction.cls[k])
        canvas.log("slice/label", rr.Points3D(where, radii=0.01, colors=colours, labels=texts, show_labels=True))
    else:
        canvas.log("slice/objects", rr.Boxes3D(half_sizes=[], centers=[]))
        canvas.log("slice/label", rr.Points3D([]))
    strips: list[F32] = []
    signs: list[F32] = []
    labels: list[str] = []
    if plan.profile is not None and len(plan.profile.t) and ego is not None:
        ahead = t + risk.t_offset + (risk_ns - plan_ns) * 1e-9
        box = footprint(canvas, plan.profile, max(ahead, 0.0), ego)
        strips, labels = [box], [f"ego in {max(ahead, 0.0):.1f} s"]
        x0, y0 = np.mean(box[:4, :2], axis=0) + (canvas.origin or (0.0, 0.0))
        signs = [canvas.points(*beside(float(x0), float(y0), ego.heading, -1.5 * SIGN_M), 0.6)]
    canvas.log("slice/ego", rr.LineStrips3D(strips, colors=[WHITE], radii=[0.14]))
    canvas.log("slice/ego/sign", rr.Points3D(signs, radii=0.01, colors=[WHITE], labels=labels, show_labels=True))


def deciding_slice(plan: Plan, n: int) -> int:
    """Index of the slice that decided, or that with the highest risk on the path, or 0; always below n."""
    if plan.decision is not None and plan.decision.slice is not None:
        return int(np.clip(plan.decision.slice, 0, n - 1))
    if plan.slice_risk is not None and len(plan.slice_risk.risk):
        return min(int(np.argmax(plan.slice_risk.risk)), n - 1)
    return 0


def poses_at(prediction: Prediction, t: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Predicted centres [m] and headings [rad] t seconds after the prediction's capture, by the nearest frame."""
    i = round(t / 0.1) - 1
    if i < 0:
        return prediction.x0, prediction.y0, prediction.heading0
    i = min(i, prediction.x.shape[1] - 1)
    return prediction.x[:, i], prediction.y[:, i], prediction.heading[:, i]


def footprint(canvas: Canvas, path: Trajectory, t: float, ego: Ego) -> F32:
    """Outline of the ego t seconds along a path, closed, shape [5, 3]."""
    x, y = np.interp(t, path.t, path.x), np.interp(t, path.t, path.y)
    heading = np.interp(t, path.t, np.unwrap(path.heading))
    corners = rectangle_corners(x, y, heading, ego.length, ego.width)[[0, 1, 2, 3, 0]]
    return canvas.points(corners[:, 0], corners[:, 1], 0.4)


def story(plan: Plan, ego: Ego | None, limit: float | None) -> str:
    """What the vehicle does now and why, as Markdown."""
    mode = {"drive": "Driving", "waiting": "Waiting", "safe_stop": "**Safe stop**"}[plan.mode]
    lines = [f"### {mode}", plan.reason, ""]
    decision = plan.decision
    if decision is not None and decision.sentence and decision.sentence not in plan.reason:
        lines += [f"**What decided:** {decision.sentence}", ""]
    lines += ["| | |", "|:--|:--|"]
    if ego is not None:
        lines.append(f"| speed | {ego.speed:.1f} m/s |")
    lines.append(f"| desired speed | {plan.desired_speed:.1f} m/s |")
    if limit is not None:
        lines.append(f"| limit | {limit:.1f} m/s |")
    if decision is not None:
        if decision.risk is not None:
            lines.append(f"| risk that decided | {decision.risk:.2f} |")
        if decision.slice is not None:
            ahead = decision.slice_s
            when = "" if ahead is None else ", now" if ahead <= 0 else f", from {ahead:.1f} s ahead"
            lines.append(f"| slice | {decision.slice}{when} |")
        if decision.cell is not None:
            lines.append(f"| cell (i, j) | {decision.cell[0]}, {decision.cell[1]} |")
        if source(decision):
            lines.append(f"| source | {source(decision)} |")
        if decision.term is not None:
            lines.append(f"| term | {decision.term} |")
    if plan.candidates is not None:
        lines.append(f"| path | {plan.chosen} of {len(plan.candidates.desired_speed)} |")
    if plan.planner:
        lines.append(f"| planner | {plan.planner} |")
    return "\n".join(lines)
