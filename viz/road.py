"""Map, route and closures: what stands still."""

from __future__ import annotations

from collections import defaultdict

import numpy as np
import rerun as rr

from common.geometry import Polyline
from common.messages import F64, Closures, Map, Route
from viz.canvas import F32, Canvas
from viz.colours import GREEN, GREY, ROAD, VERMILION, WHITE, Colour

DASH_M, GAP_M = 3.0, 6.0

LINES: dict[str, tuple[str, Colour, float]] = {
    "unknown": ("lane_line", (125, 128, 138), 0.07),
    "dashed": ("lane_line_dashed", (190, 192, 200), 0.08),
    "solid": ("lane_line_solid", (190, 192, 200), 0.08),
    "virtual": ("virtual_line", (70, 73, 84), 0.03),
    "kerb": ("kerb", (235, 225, 205), 0.14),
    "barrier": ("barrier", (235, 225, 205), 0.22),
    "road_edge": ("road_edge", (235, 225, 205), 0.14),
}
"""Boundary type → entity, colour, radius [m]."""


def log_map(canvas: Canvas, road: Map) -> None:
    """Log a map: its surface, its lines by type, barriers, kerbs and stop lines."""
    strips: dict[str, list[F32]] = defaultdict(list)
    for lane in road.lanes:
        for line, kind in ((lane.left, lane.left_type), (lane.right, lane.right_type)):
            pieces = dashes(line) if kind == "dashed" else [line]
            strips[kind].extend(canvas.points(p[:, 0], p[:, 1], 0.01) for p in pieces)
    for line_kind, (name, line_colour, radius) in LINES.items():
        log_strips(canvas, f"world/map/{name}", strips[line_kind], line_colour, radius)
    for kind, colour in (("barrier", LINES["barrier"][1]), ("kerb", LINES["kerb"][1]), ("stop_line", GREY)):
        these = [o for o in road.obstacles if o.kind == kind]
        canvas.log(
            f"world/map/obstacle/{kind}",
            rr.LineStrips3D(
                [canvas.points(o.points[:, 0], o.points[:, 1], 0.02) for o in these],
                colors=[colour] * len(these),
                radii=[max(o.width / 2, 0.08) for o in these],
            ),
        )
    vertices, triangles = surface(canvas, road)
    if len(triangles):
        canvas.log(
            "world/map/surface",
            rr.Mesh3D(
                vertex_positions=vertices,
                triangle_indices=triangles,
                vertex_normals=np.tile(np.array((0, 0, 1), np.float32), (len(vertices), 1)),
                albedo_factor=(*ROAD, 255),
            ),
        )
    else:
        canvas.log("world/map/surface", rr.Clear(recursive=False))


def log_closures(canvas: Canvas, road: Map | None, closures: Closures | None) -> None:
    """Log what is closed now: stop lines across, closed lanes along their centre."""
    ids = set(closures.ids) if closures is not None else set()
    lines: list[F32] = []
    if road is not None:
        lines += [canvas.points(o.points[:, 0], o.points[:, 1], 0.05) for o in road.obstacles if o.id in ids]
        lines += [canvas.points(lane.centre[:, 0], lane.centre[:, 1], 0.05) for lane in road.lanes if lane.id in ids]
    log_strips(canvas, "world/closed", lines, VERMILION, 0.35)


def log_route(canvas: Canvas, route: Route) -> None:
    """Log the reference line and the goal: a ring of its radius, labelled."""
    reference = [canvas.points(p[:, 0], p[:, 1], 0.03) for p in dashes(route.reference, 1.0, 3.0)]
    log_strips(canvas, "world/route/reference", reference, GREEN, 0.06)
    goal = route.goal
    a = np.linspace(0.0, 2 * np.pi, 41)
    canvas.log(
        "world/route/goal",
        rr.LineStrips3D(
            [canvas.points(goal.x + goal.radius * np.cos(a), goal.y + goal.radius * np.sin(a), 0.05)],
            colors=[GREEN],
            radii=[0.15],
            labels=["goal (stop)" if goal.stop else "goal"],
            show_labels=True,
        ),
    )


def log_strips(canvas: Canvas, path: str, strips: list[F32], colour: Colour = WHITE, radius: float = 0.1) -> None:
    """Log lines of one colour; none clears what stood there."""
    canvas.log(path, rr.LineStrips3D(strips, colors=[colour], radii=[radius]))


def dashes(points: F64, on: float = DASH_M, off: float = GAP_M) -> list[F64]:
    """Cut a line [n, 2] into dashes of `on` with gaps of `off` [m]."""
    try:
        line = Polyline.of(points)
    except ValueError:
        return []
    starts = np.arange(0.0, line.length, on + off)
    ends = np.minimum(starts + on, line.length)
    return list(np.stack((line.at(starts), line.at((starts + ends) / 2), line.at(ends)), axis=1))


def surface(canvas: Canvas, road: Map) -> tuple[F32, np.ndarray]:
    """Triangles between the lanes' boundaries: vertices [v, 3], indices [t, 3]."""
    vertices, triangles, base = [], [], 0
    for lane in road.lanes:
        try:
            left, right = Polyline.of(lane.left), Polyline.of(lane.right)
        except ValueError:
            continue
        n = int(np.clip(np.ceil(max(left.length, right.length) / 4.0), 1, 400)) + 1
        share = np.linspace(0.0, 1.0, n)
        both = np.stack((left.at(share * left.length), right.at(share * right.length)), axis=1).reshape(-1, 2)
        vertices.append(canvas.points(both[:, 0], both[:, 1], -0.12))
        i = base + 2 * np.arange(n - 1)
        triangles.append(np.concatenate((np.stack((i, i + 1, i + 2), 1), np.stack((i + 1, i + 3, i + 2), 1))))
        base += 2 * n
    if not triangles:
        return np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint32)
    return np.concatenate(vertices), np.concatenate(triangles).astype(np.uint32)


class SpeedLimits:
    """The speed limit of the lane nearest to a point."""

    def __init__(self, road: Map | None = None, route: Route | None = None) -> None:
        lanes = [lane for lane in road.lanes if lane.speed_limit > 0] if road is not None else []
        self._points = np.concatenate([lane.centre for lane in lanes]) if lanes else np.zeros((0, 2))
        self._limits = (
            np.concatenate([np.full(len(lane.centre), lane.speed_limit) for lane in lanes]) if lanes else None
        )
        self._wanted = route.speed_limit if route is not None and route.speed_limit > 0 else None

    def at(self, x: float, y: float) -> float | None:
        """Limit [m/s] at a point of the `map` frame, the lower of the lane's and the route's; None: neither known."""
        if self._limits is None:
            return self._wanted
        lane = float(self._limits[np.argmin(np.hypot(*(self._points - (x, y)).T))])
        return lane if self._wanted is None else min(lane, self._wanted)
