"""The risk volume as heatmaps: one byte a cell, coloured by the viewer on one fixed scale."""

from __future__ import annotations

import itertools
from functools import lru_cache
from typing import Any

import numpy as np
import numpy.typing as npt
import rerun as rr

from common.messages import BLOCK, U8, Grid, Risk
from viz.canvas import F32, Canvas, turned
from viz.colours import EDGE, WHITE, see_through

COLOURMAP = rr.components.Colormap.Inferno
"""Perceptually even and safe for colour-blind eyes; 0 is black."""
GROUND_Z = -0.05
GROUND_OPACITY = 0.8
LEVELS = 255
SHADES = 64
"""Levels that are used, evenly over the 256: as good to the eye, half the file."""
STACK_LEVELS = 20
"""Colours of the time stack; fewer levels make a smaller file."""
STACK_FAINTEST = 0.08
"""Risk below this share of the scale is clear in the time stack."""


def levels(field: npt.NDArray[np.floating], full_scale: float) -> U8:
    """Risk as bytes: 255 stands for `full_scale` and more, 0 for none, in SHADES steps."""
    if field.dtype == np.float16:
        return np.asarray(_half_levels(full_scale)[np.ascontiguousarray(field).view(np.uint16)])
    return _rounded(field, full_scale)


def _rounded(field: npt.NDArray[np.floating], full_scale: float) -> U8:
    finite = np.nan_to_num(field.astype(np.float32), nan=full_scale, posinf=full_scale, neginf=0.0)
    steps = np.rint(np.clip(finite, 0.0, full_scale) * ((SHADES - 1) / full_scale))
    return np.asarray(np.rint(steps * (LEVELS / (SHADES - 1))), dtype=np.uint8)


@lru_cache(maxsize=4)
def _half_levels(full_scale: float) -> U8:
    # there are only 65536 halves: looking them up is much faster than converting a million of them
    return _rounded(np.arange(65536, dtype=np.uint16).view(np.float16), full_scale)


def static_cells(risk: Risk) -> npt.NDArray[np.bool_]:
    """Which cells lie in a block whose `dominant` names a static source; shape of the volume."""
    is_static = np.zeros(256, dtype=np.uint32)
    is_static[: len(risk.slots)] = [slot.term == "static" for slot in risk.slots]
    slices, rows, columns = risk.volume.shape
    # a block's byte four times over is a row of its cells
    wide = (is_static[risk.dominant] * np.uint32(0x01010101)).view(np.bool_)
    return np.asarray(np.repeat(wide, BLOCK, axis=1)[:slices, :rows, :columns])


def without_plateau(volume: U8, static: npt.NDArray[np.bool_]) -> U8:
    """Levels with 0 where what stands still reaches the full scale: the field stays at its peak off the road.

    A block names one source for all its cells, so a cell counts only if it is at full scale in every slice: nothing
    that moves is, and a car beside the kerb is not drawn dark.
    """
    return np.asarray(volume * ~(static & (volume.min(axis=0) == LEVELS)))


def coarser(field: U8, step: int) -> U8:
    """Maximum of blocks of step × step cells in the last two axes; the last blocks may be smaller."""
    if step == 1:
        return field
    i, j = (-n % step for n in field.shape[-2:])
    if i or j:
        field = np.pad(field, [(0, 0)] * (field.ndim - 2) + [(0, i), (0, j)])
    # rows first: they are contiguous
    rows = np.maximum.reduce([field[..., k::step, :] for k in range(step)])
    return np.asarray(np.maximum.reduce([rows[..., k::step] for k in range(step)]))


def raster(field: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Image of a slice [i, j]: its columns grow with i (forward), its row 0 lies at the largest j (left)."""
    return np.ascontiguousarray(field.T[::-1])


def heatmap(field: U8, corner: npt.ArrayLike, heading: float, cell: float, opacity: float) -> rr.GridMap:
    """Levels [i, j] as a map whose lower left corner, cell (0, 0)'s outer one, lies at `corner`."""
    image = raster(field)
    return rr.GridMap(
        data=image.tobytes(),
        format=rr.components.ImageFormat(
            width=image.shape[1], height=image.shape[0], color_model="L", channel_datatype="U8"
        ),
        cell_size=cell,
        translation=np.asarray(corner, dtype=np.float32),
        quaternion=turned(heading),
        colormap=COLOURMAP,
        opacity=opacity,
    )


def layer(field: U8, corner: npt.ArrayLike, heading: float, cell: float) -> rr.GridMap:
    """Levels [i, j] as a map through which one sees wherever there is little risk; placed like `heatmap`."""
    image = raster(_layer_colours()[field])
    return rr.GridMap(
        data=image.tobytes(),
        format=rr.components.ImageFormat(
            width=image.shape[1], height=image.shape[0], color_model="RGBA", channel_datatype="U8"
        ),
        cell_size=cell,
        translation=np.asarray(corner, dtype=np.float32),
        quaternion=turned(heading),
        opacity=0.98,  # the viewer heeds the image's own transparency only below 1
    )


@lru_cache(maxsize=1)
def _layer_colours() -> npt.NDArray[np.uint32]:
    steps = see_through(STACK_LEVELS, STACK_FAINTEST)
    return steps[np.arange(LEVELS + 1) * STACK_LEVELS // (LEVELS + 1)]


def log_risk(canvas: Canvas, risk: Risk, full_scale: float, lift: float | None, step: int) -> U8:
    """Log the first slice on the ground and, if `lift` is given, every slice of the time stack; returns the levels.

    The plateau off the road is dark on the ground; the stack shows only what moves.

    Args:
        canvas: where to draw.
        risk: the volume.
        full_scale: brightest risk, in the volume's own units.
        lift: height of one second [m/s]; None: no stack.
        step: cells of the volume on a side of one cell of the stack.
    """
    grid = risk.grid
    static = static_cells(risk)
    volume = without_plateau(levels(risk.volume, full_scale), static)
    corner = canvas.points(grid.x, grid.y, GROUND_Z)
    canvas.log("world/risk/now", heatmap(volume[0], corner, grid.heading, grid.h, GROUND_OPACITY))
    outline = corners(canvas, grid, 0.0)
    canvas.log("world/risk/edge", rr.LineStrips3D([outline], colors=[EDGE], radii=[0.05]))
    if lift is not None:
        moving = coarser(volume * ~static, step)
        for j, t in enumerate(risk.slice_times):
            at = canvas.points(grid.x, grid.y, t * lift)
            canvas.log(f"stack/risk/slice_{j:02d}", layer(moving[j], at, grid.heading, grid.h * step))
        _log_storeys(canvas, risk, lift)
    return volume


def _log_storeys(canvas: Canvas, risk: Risk, lift: float) -> None:
    # the outline of every second slice of a whole second, with its time, so that height reads as time
    times = [t for t in risk.slice_times if abs(t / 2 - round(t / 2)) < 1e-6] or risk.slice_times[:1]
    outlines = [corners(canvas, risk.grid, t * lift) for t in times]
    canvas.log("stack/storey", rr.LineStrips3D(outlines, colors=[EDGE], radii=[0.06]))
    signs = np.stack([outline[2] for outline in outlines])
    texts = [f"in {t:g} s" if t else "now" for t in times]
    canvas.log("stack/storey/time", rr.Points3D(signs, radii=0.01, colors=[WHITE], labels=texts, show_labels=True))


def log_exact(canvas: Canvas, risk: Risk, full_scale: float) -> None:
    """Log the volume with its own numbers and what is needed to read it: grid, times, slots, sources left out."""
    grid = risk.grid
    canvas.log(
        "risk/exact",
        rr.Tensor(
            # the slices of one row side by side: what stands still repeats within the compressor's sight
            np.ascontiguousarray(risk.volume.astype(np.float16, copy=False).transpose(1, 0, 2)),
            dim_names=("i_forward", "slice", "j_left"),
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
    y = -24.0
    low, high = -26.0, 4.0
    ramp = np.repeat(np.arange(0, 256, dtype=np.uint8)[:, None], 8, axis=1)
    canvas.log("world/ego/legend/risk", heatmap(ramp, (low, y, 0), 0.0, (high - low) / 256, 1.0))
    shares = (0.0, 1 / 3, 2 / 3, 1.0)
    texts = [f"{share * full_scale / e_max:.2g}" for share in shares]
    texts[0], texts[-1] = "risk 0", f"≥ {texts[-1]} E_max"
    _texts(canvas, "world/ego/legend/risk_scale", [(low + (high - low) * s, y - 1.4, 0) for s in shares], texts)
    x = np.linspace(26.0, 54.0, len(speeds) + 1)
    bars = [[(a, y + 0.5, 0), (b, y + 0.5, 0)] for a, b in itertools.pairwise(x)]
    canvas.log("world/ego/legend/speed", rr.LineStrips3D(bars, colors=colours, radii=0.45))
    _texts(
        canvas,
        "world/ego/legend/speed_scale",
        [(26, y - 1.4, 0), (54, y - 1.4, 0)],
        ["candidates: 0", f"{top:.0f} m/s"],
    )
    canvas.log(
        "world/ego/legend/length",
        rr.LineStrips3D([[(72, y + 1, 0), (72, y, 0), (92, y, 0), (92, y + 1, 0)]], colors=[WHITE], radii=[0.12]),
    )
    _texts(canvas, "world/ego/legend/length_scale", [(82, y - 1.4, 0)], ["20 m"])


def _texts(canvas: Canvas, path: str, where: list[tuple[float, float, float]], texts: list[str]) -> None:
    canvas.log(path, rr.Points3D(where, radii=0.01, colors=[WHITE], labels=texts, show_labels=True))
