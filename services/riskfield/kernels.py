"""The risk field on the device: one Warp source for `cpu` and `cuda`, in two launches.

`prepare_kernel` computes what the slices share: the static layer, which segments of a path cross which rows, and, where
two levels are used, the smooth far field of every slice on nodes about a metre apart. `field_kernel` does one run of
columns of one row of blocks (4 grid rows) of one slice a task. The length of a run is a launch parameter: wide on the
CPU, one block on CUDA. All coordinates are the grid's own, so that float32 keeps its digits on any map.

What is left out of a loop is exactly zero there: the potential ends at the taper's radius, the kinetic term at its
horizon and beside its strip, a static line at its half-width. Equations: `common.risk`. The text stands in `native`.
"""

from __future__ import annotations

import warp as wp

from services.riskfield.layout import LINE_FIELDS, MOST_SEGMENTS, OBJECT_FIELDS, SEGMENT_FIELDS
from services.riskfield.native import dominant, field, maths, prepare, terms

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
    widths: wp.array(dtype=float)  # [objects_most]
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


def _sized(*snippets: str) -> str:
    text = "".join(snippets)
    for name, fields in (("OBJECT", OBJECT_FIELDS), ("SEGMENT", SEGMENT_FIELDS), ("LINE", LINE_FIELDS)):
        text = text.replace(f"{name}_SIZE", str(len(fields)))
    return text.replace("[SEGMENTS]", f"[{MOST_SEGMENTS}]").replace("< SEGMENTS", f"< {MOST_SEGMENTS}")


_SHARED = maths.SIZES + maths.WINDOW + maths.FUNCTIONS + terms.OBJECTS + terms.POTENTIAL + prepare.WEIGHTS
_PREPARE = _sized(
    _SHARED, prepare.TASKS, prepare.FAR, prepare.STATIC, prepare.CROSSINGS, prepare.PREPARE,
)  # fmt: skip
_FIELD = _sized(
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
