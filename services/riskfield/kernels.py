"""The risk field on the device: one Warp source for `cpu` and `cuda`, in two launches.

`prepare_kernel` computes what the slices share: the static layer, the segments of every path and which rows they cross,
and, where two levels are used, the smooth far field of every slice on nodes about a metre apart. `field_kernel` does
one run of columns of one row of blocks (4 grid rows) of a group of slices in each task. How long a run and how large a
group is are launch parameters: wide and many on the CPU, one block of one slice on CUDA. All coordinates are the grid's
own, so that float32 keeps its digits on any map.

What is left out of a loop is exactly zero there: the potential ends at the taper's radius, the kinetic term at its
horizon and beside its strip, a static line at its half-width. Equations: `common.risk`. The text stands in `native`.
"""

from __future__ import annotations

import re

import warp as wp

from common.risk import COUPLED
from services.riskfield.layout import FAR, LINE_FIELDS, MOST_VERTICES, OBJECT_FIELDS, SEGMENT_FIELDS, STRAIGHT
from services.riskfield.native import dominant, field, maths, paths, prepare, terms

wp.set_module_options(
    {
        "enable_backward": False,
        "fast_math": True,
        "cpu_compiler_flags": "-march=native -ffast-math -mprefer-vector-width=512 -w",
    }
)


@wp.struct
class Volume:
    """Everything the kernels read and write; flat arrays, C order."""

    slices: int
    rows: int
    columns: int
    h: float
    run: int  # columns of one task
    group: int  # slices of one task
    half: int  # 1: float16 into volume16, 0: float32 into volume32
    paper: int  # 1: the printed kinetic term
    two_level: int  # 1: far potential from the nodes, exact values near the bodies
    ratio: int  # fine cells from node to node
    far_rows: int
    far_pitch: int
    objects_most: int  # room in the arrays
    vertices_most: int
    segments_most: int
    k1: float
    e_max: float
    taper_radius: float
    taper_start: float
    t: float
    d0: float
    E_k: float
    counts: wp.array(dtype=int)  # objects, lines
    objects: wp.array(dtype=float)  # [slices, objects_most, len(OBJECT_FIELDS)]
    pose: wp.array(dtype=wp.float64)  # of the grid: x, y, cos, sin of its heading
    vertices: wp.array(dtype=wp.float64)  # [objects_most, vertices_most, 2], `map` frame
    arcs: wp.array(dtype=wp.float64)  # [objects_most, vertices_most]
    vertex_counts: wp.array(dtype=int)  # [objects_most]
    origins: wp.array(dtype=wp.float64)  # [objects_most]: arc length of the current state
    segments: wp.array(dtype=float)  # [objects_most, segments_most, len(SEGMENT_FIELDS)]
    lines: wp.array(dtype=float)  # [lines, len(LINE_FIELDS)]
    crossings: wp.array(dtype=int)  # [objects_most, rows / 4, 2]: first and last segment
    far: wp.array(dtype=float)  # [slices, far_rows, far_pitch]
    static_sum: wp.array(dtype=float)  # [rows, columns]
    static_best: wp.array(dtype=float)  # largest single share
    static_line: wp.array(dtype=int)  # its line, −1: none
    volume16: wp.array(dtype=wp.uint16)  # bits of float16
    volume32: wp.array(dtype=float)
    dominant: wp.array(dtype=int)  # [slices, rows / 4, columns / 4]: 2 o, 2 o + 1, 2 objects + line, −1


CONSTANTS = {
    "OBJECT_SIZE": len(OBJECT_FIELDS),
    "SEGMENT_SIZE": len(SEGMENT_FIELDS),
    "LINE_SIZE": len(LINE_FIELDS),
    "VERTICES": MOST_VERTICES,
    "FAR": FAR,
    "STRAIGHT": STRAIGHT,
    "COUPLED": COUPLED,
}


def _filled(*snippets: str) -> str:
    text = "".join(snippets)
    for name, value in CONSTANTS.items():
        text = re.sub(rf"\b{name}\b", str(value), text)
    return text


_SHARED = maths.SIZES + maths.WINDOW + maths.FUNCTIONS + terms.OBJECTS + terms.POTENTIAL + prepare.WEIGHTS
_PREPARE = _filled(
    _SHARED, prepare.TASKS, prepare.FAR, prepare.STATIC, paths.PATHS, prepare.PREPARE,
)  # fmt: skip
_FIELD = _filled(
    _SHARED, terms.KINETIC, prepare.TASKS, field.START, field.ADD_POTENTIAL, field.ADD_KINETIC, field.SUM, field.WRITE,
    dominant.NAME,
)  # fmt: skip


@wp.func_native(_PREPARE)
def prepare_task(p: Volume, task: int):
    """One task of `prepare_kernel`."""


@wp.func_native(_FIELD)
def field_task(p: Volume, task: int):
    """One task of `field_kernel`."""


@wp.kernel
def prepare_kernel(p: Volume, first: int, step: int):
    """Far rows of all slices, rows of the static layer, objects: task `first` and every `step`-th after it."""
    task = wp.tid()
    prepare_task(p, first + task * step)  # type: ignore[operator]


@wp.kernel
def field_kernel(p: Volume, first: int, step: int):
    """M and `dominant` of task `first` and every `step`-th after it; needs `prepare_kernel`."""
    task = wp.tid()
    field_task(p, first + task * step)  # type: ignore[operator]
