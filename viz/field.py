"""The risk volume as heatmaps: one byte a cell, coloured by the viewer on one fixed scale."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import numpy.typing as npt
import rerun as rr

from common.messages import U8, Grid, Risk
from viz.canvas import F32, Canvas, yaw
from viz.colours import WHITE

COLOURMAP = rr.components.Colormap.Inferno
"""Perceptually even and safe for colour-blind eyes; 0 is black."""
GROUND_Z = -0.05
GROUND_OPACITY = 0.8
STACK_OPACITY = 0.45
LEVELS = 255


def levels(field: npt.NDArray[np.floating], full_scale: float) -> U8:
    """Risk as bytes: 255 stands for `full_scale` and more, in steps of full_scale / 255."""
    if field.dtype == np.float16:
        return np.asarray(_half_levels(full_scale)[np.ascontiguousarray(field).view(np.uint16)])
    return np.asarray(_rounded(field, full_scale))


def _rounded(field: npt.NDArray[np.floating], full_scale: float) -> U8:
    scaled = np.nan_to_num(field.astype(np.float32) * (LEVELS / full_scale), nan=LEVELS, posinf=LEVELS)
    return np.clip(np.rint(scaled), 0, LEVELS).astype(np.uint8)


@lru_cache(maxsize=4)
def _half_levels(full_scale: float) -> U8:
    # there are only 65536 halves: looking them up is much faster than converting a million of them
    return _rounded(np.arange(65536, dtype=np.uint16).view(np.float16), full_scale)


def coarser(field: U8, step: int) -> U8:
    """Maximum of blocks of step × step cells; the last blocks may be smaller."""
    if step == 1:
        return field
    i, j = (-n % step for n in field.shape)
    padded = np.pad(field, ((0, i), (0, j)))
    return np.asarray(padded.reshape(padded.shape[0] // step, step, padded.shape[1] // step, step).max(axis=(1, 3)))


def raster(field: U8) -> U8:
    """Image of a slice [i, j]: its columns grow with i (forward), its row 0 lies at the largest j (left)."""
    return np.ascontiguousarray(field.T[::-1])


def heatmap(field: U8, corner: F32, heading: float, cell: float, opacity: float, order: float = 0.0) -> rr.GridMap:
    """A slice [i, j] as a map whose lower left corner, cell (0, 0)'s outer one, lies at `corner`."""
    image = raster(field)
    return rr.GridMap(
        data=image.tobytes(),
        format=rr.components.ImageFormat(
            width=image.shape[1], height=image.shape[0], color_model="L", channel_datatype="U8"
        ),
        cell_size=cell,
        translation=corner,
        quaternion=yaw(heading),
        colormap=COLOURMAP,
        opacity=opacity,
        draw_order=order,
    )


def log_slice(canvas: Canvas, path: str, grid: Grid, field: U8, z: float, opacity: float, step: int = 1) -> None:
    """Log one slice as a heatmap at height z [m]."""
    corner = canvas.points(grid.x, grid.y, z)
    canvas.log(path, heatmap(coarser(field, step), corner, grid.heading, grid.h * step, opacity))


def log_risk(canvas: Canvas, risk: Risk, full_scale: float, lift: float | None, step: int) -> U8:
    """Log the first slice on the ground and, if `lift` is given, every slice of the time stack; returns the levels.

    Args:
        canvas: where to draw.
        risk: the volume.
        full_scale: brightest risk, in the volume's own units.
        lift: height of one second [m/s]; None: no stack.
        step: cells of the volume on a side of one cell of the stack.
    """
    volume = levels(risk.volume, full_scale)
    log_slice(canvas, "world/risk/now", risk.grid, volume[0], GROUND_Z, GROUND_OPACITY)
    outline = corners(canvas, risk.grid, 0.0)
    canvas.log("world/risk/edge", rr.LineStrips3D([outline], colors=[(110, 110, 125)], radii=[0.05]))
    if lift is not None:
        for j, t in enumerate(risk.slice_times):
            log_slice(canvas, f"stack/risk/slice_{j:02d}", risk.grid, volume[j], t * lift, STACK_OPACITY, step)
    return volume


def log_exact(canvas: Canvas, risk: Risk, full_scale: float) -> None:
    """Log the volume with its own numbers and what is needed to read it: grid, times, slots, sources left out."""
    grid = risk.grid
    canvas.log(
        "risk/exact",
        rr.Tensor(
            risk.volume.astype(np.float16, copy=False),
            dim_names=("slice", "i_forward", "j_left"),
            value_range=(0.0, full_scale),
        ),
        rr.AnyValues(
            grid=np.array((grid.x, grid.y, grid.heading, grid.h)),
            slice_times_s=np.asarray(risk.slice_times),
            t_offset_s=risk.t_offset,
            e_max=risk.e_max,
            slots=[f"{s.id} {s.term} {s.label or s.cls}" for s in risk.slots],
            left_out=[f"{s.id} {s.reason}" for s in risk.left_out],
        ),
    )


def corners(canvas: Canvas, grid: Grid, z: float) -> F32:
    """Outline of a grid, closed, shape [5, 3]."""
    i = np.array((0, grid.rows, grid.rows, 0, 0)) * grid.h
    j = np.array((0, 0, grid.columns, grid.columns, 0)) * grid.h
    c, s = np.cos(grid.heading), np.sin(grid.heading)
    return canvas.points(grid.x + c * i - s * j, grid.y + s * i + c * j, z)


def log_legend(canvas: Canvas, full_scale: float, e_max: float, speeds: F32, colours: U8, top: float) -> None:
    """Log the scales, in the ego's frame, where the bird's-eye view shows them: risk, desired speed, 20 metres."""
    y = -27.0
    ramp = np.repeat(np.arange(0, 256, dtype=np.uint8)[:, None], 8, axis=1)
    length = 30.0
    canvas.log("world/ego/legend/risk", heatmap(ramp, np.float32((-28, y, 0)), 0.0, length / 256, 1.0))
    marks = [0.0, full_scale / 3, 2 * full_scale / 3, full_scale]
    texts = [f"{m / e_max:.2g}" for m in marks]
    texts[0], texts[-1] = "risk 0", f"≥ {texts[-1]} E_max"
    _texts(canvas, "world/ego/legend/risk_scale", [(-28 + length * m / full_scale, y - 1.6, 0) for m in marks], texts)
    x = np.linspace(12.0, 42.0, len(speeds) + 1)
    canvas.log(
        "world/ego/legend/speed",
        rr.LineStrips3D([[(a, y + 0.5, 0), (b, y + 0.5, 0)] for a, b in zip(x[:-1], x[1:], strict=True)],
                        colors=colours, radii=0.45),
    )  # fmt: skip
    _texts(
        canvas,
        "world/ego/legend/speed_scale",
        [(12, y - 1.6, 0), (42, y - 1.6, 0)],
        ["candidate 0 m/s", f"{top:.0f} m/s"],
    )
    canvas.log(
        "world/ego/legend/length",
        rr.LineStrips3D([[(56, y + 1, 0), (56, y, 0), (76, y, 0), (76, y + 1, 0)]], colors=[WHITE], radii=[0.12]),
    )
    _texts(canvas, "world/ego/legend/length_scale", [(66, y - 1.6, 0)], ["20 m"])


def _texts(canvas: Canvas, path: str, where: list[tuple[float, float, float]], texts: list[str]) -> None:
    canvas.log(path, rr.Points3D(where, radii=0.01, colors=[WHITE], labels=texts, show_labels=True))
