"""The ego and everyone else: boxes, labels, driven trails, predicted tracks."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field

import numpy as np
import rerun as rr

from common.messages import Ego, Method, Objects, Prediction
from viz.canvas import Canvas, turned, yaw
from viz.colours import CLASS_HEIGHTS, CLASS_NAMES, GREY, WHITE, faded, of_class
from viz.labels import apart

METHOD_NAMES = {
    Method.CONSTANT_VELOCITY: "straight",
    Method.CTRA: "turn",
    Method.MAP_BASED: "lane",
    Method.LSTM: "network",
}
"""What made a prediction, in a word that fits into a label."""
FRAMES_PER_SEGMENT = 10
FRAMES_PER_POINT = 5
EGO_HEIGHT = 1.5


@dataclass
class Trails:
    """Where objects (and the ego, under None) have been, for the last `seconds`."""

    seconds: float
    _seen: dict[int | None, deque[tuple[float, float, float]]] = field(default_factory=dict)

    def add(self, key: int | None, t: float, x: float, y: float) -> np.ndarray:
        """Note a position at time t [s]; returns the trail [n, 2], oldest first. A jump begins a new one."""
        trail = self._seen.setdefault(key, deque())
        if trail and (t < trail[-1][0] or np.hypot(x - trail[-1][1], y - trail[-1][2]) > 15.0):
            trail.clear()
        trail.append((t, x, y))
        while trail[0][0] < t - self.seconds:
            trail.popleft()
        return np.array(trail)[:, 1:]

    def forget(self, keep: set[int]) -> None:
        """Drop the trails of objects that are gone."""
        for key in [k for k in self._seen if k is not None and k not in keep]:
            del self._seen[key]


def log_ego(canvas: Canvas, ego: Ego, trail: np.ndarray) -> None:
    """Log the ego's pose (the frame in which the views are drawn), its box and its trail."""
    canvas.log(
        "world/ego",
        rr.Transform3D(translation=canvas.points(ego.x, ego.y), quaternion=turned(ego.heading)),
    )
    if len(trail) > 1:
        canvas.log(
            "world/ego_trail",
            rr.LineStrips3D([canvas.points(trail[:, 0], trail[:, 1], 0.06)], colors=[WHITE], radii=[0.12]),
        )


def log_ego_body(canvas: Canvas, length: float, width: float) -> None:
    """Log the ego's box and its nose, in its own frame."""
    canvas.log(
        "world/ego/body",
        rr.Boxes3D(
            half_sizes=[(length / 2, width / 2, EGO_HEIGHT / 2)],
            centers=[(0, 0, EGO_HEIGHT / 2)],
            colors=[WHITE],
            radii=[0.09],
            fill_mode="TransparentFillMajorWireframe",
        ),
    )
    behind = [(-length / 2 - 5.0, 0.0, 0.1)]
    canvas.log("world/ego/name", rr.Points3D(behind, radii=0.01, colors=[WHITE], labels=["ego"], show_labels=True))
    nose = [(length / 2 - 1.2, width / 2, 1.55), (length / 2, 0, 1.55), (length / 2 - 1.2, -width / 2, 1.55)]
    canvas.log("world/ego/nose", rr.LineStrips3D([nose], colors=[WHITE], radii=[0.09]))


def log_objects(
    canvas: Canvas, objects: Objects, trails: list[np.ndarray], near: tuple[float, float, float] | None, labelled: int,
    left_out: dict[int, str], methods: dict[int, int] | None = None,
) -> None:  # fmt: skip
    """Log boxes by class, headings, labels (id, class, speed) of those nearest to `near`, and driven trails.

    Args:
        canvas: where to draw.
        objects: the objects.
        trails: driven path of each object, [points, 2], in the order of the ids.
        near: position [m] and heading [rad] of the ego, if known.
        labelled: how many objects may carry a label.
        left_out: objects that do not count in the risk, and why.
        methods: what made the last prediction of each (`Method`), as far as it is known.
    """
    colours = of_class(objects.cls)
    height = np.array([CLASS_HEIGHTS[int(c)] for c in objects.cls]).reshape(-1)
    colours = np.where(np.isin(objects.id, list(left_out))[:, None], np.array(GREY, np.uint8), colours)
    canvas.log(
        "world/objects/box",
        rr.Boxes3D(
            centers=canvas.points(objects.x, objects.y, height / 2),
            half_sizes=np.stack((objects.length / 2, objects.width / 2, height / 2), axis=-1).astype(np.float32),
            quaternions=yaw(objects.heading),
            colors=colours,
            radii=0.07,
            fill_mode="TransparentFillMajorWireframe",
            show_labels=False,
        ),
    )
    tip = objects.length / 2 + 0.6
    c, s = np.cos(objects.heading), np.sin(objects.heading)
    noses = np.stack(
        (canvas.points(objects.x, objects.y, height), canvas.points(objects.x + c * tip, objects.y + s * tip, height)),
        axis=1,
    )
    canvas.log("world/objects/heading", rr.LineStrips3D(noses, colors=colours, radii=0.07))
    long = [i for i, trail in enumerate(trails) if len(trail) > 1]
    canvas.log(
        "world/objects/trail",
        rr.LineStrips3D(
            [canvas.points(trails[i][:, 0], trails[i][:, 1], 0.05) for i in long],
            colors=faded(colours[long], 0.75),
            radii=0.09,
        ),
    )
    order = apart(objects.x, objects.y, near, labelled)
    speed = np.hypot(objects.vx, objects.vy)
    canvas.log(
        "world/objects/label",
        rr.Points3D(
            canvas.points(objects.x, objects.y, height + 0.3)[order],
            radii=0.02,
            colors=colours[order],
            labels=[_label(objects, int(i), float(speed[i]), left_out, methods or {}) for i in order],
            show_labels=True,
        ),
    )


def _label(objects: Objects, i: int, speed: float, left_out: dict[int, str], methods: dict[int, int]) -> str:
    identity = int(objects.id[i])
    text = f"{CLASS_NAMES[int(objects.cls[i])]} {identity} · {speed:.0f} m/s"
    if identity in methods:
        text += f" · {METHOD_NAMES[Method(methods[identity])]}"
    return f"{text} · left out: {left_out[identity]}" if identity in left_out else text


def log_prediction(canvas: Canvas, prediction: Prediction, lift: float) -> None:
    """Log predicted tracks that fade with time, on the ground and climbing through the time stack.

    Args:
        canvas: where to draw.
        prediction: the predictions.
        lift: height of one second in the stack [m/s].
    """
    n = len(prediction.id)
    frames = prediction.x.shape[1]
    x = np.concatenate((prediction.x0[:, None], prediction.x), axis=1)
    y = np.concatenate((prediction.y0[:, None], prediction.y), axis=1)
    t = np.arange(frames + 1) * 0.1
    segments = [
        np.arange(a, min(a + FRAMES_PER_SEGMENT, frames) + 1, FRAMES_PER_POINT)
        for a in range(0, frames, FRAMES_PER_SEGMENT)
    ]
    share = np.linspace(1.0, 0.3, len(segments))
    flat = [canvas.points(x[i, k], y[i, k], 0.04) for i in range(n) for k in segments]
    colours = faded(np.repeat(of_class(prediction.cls), len(segments), axis=0), np.tile(share, n))
    canvas.log("world/prediction", rr.LineStrips3D(flat, colors=colours, radii=np.tile(0.05 + 0.12 * share, n)))
    whole = np.arange(0, frames + 1, FRAMES_PER_POINT)
    canvas.log(
        "stack/prediction",
        rr.LineStrips3D(
            [canvas.points(x[i, whole], y[i, whole], t[whole] * lift) for i in range(n)],
            colors=of_class(prediction.cls),
            radii=0.15,
        ),
    )
