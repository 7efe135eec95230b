"""The planner's hot loops on the CPU, compiled by Warp: paths, their risk, contact and law, motions rolled out.

The C++ of each is in `native`. The NumPy forms in `bezier.py`, `footprint.py`, `contact.py`, `beside.py`, `speed.py`,
`rollout.py` and `search.py` are the reference; tests hold that both give the same. Importing this module compiles
nothing; the first launch does (seconds when the cache is cold).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import warp as wp

from common.kernel_cache import kernel_cache
from services.planner.native import contact, paths
from services.planner.native import law as law_source
from services.planner.native import look_up as look_up_source
from services.planner.native import roll as roll_source
from services.planner.native.look_up import LANES, MOST_SAMPLES
from services.planner.native.parameters import Parameters
from services.planner.volume import Volume

__all__ = [
    "MOST_SAMPLES",
    "Outline",
    "RollField",
    "brake_before",
    "build",
    "crossings",
    "highest",
    "law",
    "look_up",
    "pack",
    "roll",
    "warm_up",
]

F32 = npt.NDArray[np.float32]
F64 = npt.NDArray[np.float64]
U8 = npt.NDArray[np.uint8]
I32 = npt.NDArray[np.int32]
Integers = npt.NDArray[np.integer[Any]]

_NEVER = 1e3  # E_max; where so much is taken off nothing is left

wp.config.log_level = wp.LOG_ERROR
wp.set_module_options({"enable_backward": False, "cpu_compiler_flags": "-march=native -w"})


@wp.func_native(look_up_source.SOURCE)
def look_up_stations(address: wp.uint64, task: int): ...


@wp.kernel
def look_up_kernel(address: wp.uint64):
    """The footprint's maximum along a part of one path, in every slice."""
    look_up_stations(address, wp.tid())


@wp.func_native(contact.SOURCE)
def crossings_of(address: wp.uint64, path: int): ...


@wp.kernel
def crossing_kernel(address: wp.uint64):
    """Where contact begins on one path."""
    crossings_of(address, wp.tid())


@wp.func_native(law_source.SOURCE)
def law_along(address: wp.uint64, path: int): ...


@wp.kernel
def law_kernel(address: wp.uint64):
    """What the risk beside one path allows."""
    law_along(address, wp.tid())


@wp.func_native(roll_source.ROLL)
def roll_one(address: wp.uint64, k: int): ...


@wp.kernel
def roll_kernel(address: wp.uint64):
    """One motion: the driven controller step by step, and its first failed check."""
    roll_one(address, wp.tid())


@wp.func_native(roll_source.SEARCH)
def search_one(address: wp.uint64, k: int): ...


@wp.kernel
def search_kernel(address: wp.uint64):
    """The highest target that passes on one path, going on and stopping."""
    search_one(address, wp.tid())


@wp.func_native(paths.BUILD)
def build_one(address: wp.uint64, path: int): ...


@wp.kernel
def build_kernel(address: wp.uint64):
    """One path, evenly spaced."""
    build_one(address, wp.tid())


@wp.func_native(paths.BRAKE)
def brake_one(address: wp.uint64, row: int): ...


@wp.kernel
def brake_kernel(address: wp.uint64):
    """The way to brake along one path."""
    brake_one(address, wp.tid())


_ready = False


def _initialise() -> None:
    global _ready
    if not _ready:
        wp.config.kernel_cache_dir = str(kernel_cache())
        wp.init()
        _ready = True


def warm_up() -> None:
    """Compile the kernels now (seconds when the cache is cold) and not in the first plan."""
    _initialise()
    wp.load_module(__name__, device="cpu")


def _launch(kernel: Any, tasks: int, parameters: Parameters) -> None:
    _initialise()
    wp.launch(kernel, dim=tasks, inputs=[parameters.address], device="cpu")


def build(line: Mapping[str, F64], start: tuple[float, ...], targets: F64, kind: Integers, lengths: F64, step: float,
          points: int, max_curvature: float) -> tuple[F64, F64]:  # fmt: skip
    """Paths [6, n, points]: x, y, heading, curvature, s, d; and the length of each that can be steered [n].

    Args:
        line: s, x, y, heading, curvature and curvature_rate of the reference line at its samples [m].
        start: (s, d, d', d'') of the rear axle.
        targets: offset, slope and bend of each [3, targets, m].
        kind: target of each path [n].
        lengths: of its lateral move [n] [m].
        step: between its points [m].
        points: how many of them.
        max_curvature: what is tighter ends the path [1/m].
    """
    n = len(kind)
    out, end = np.empty((6, n, points)), np.empty(n)
    _launch(
        build_kernel,
        n,
        paths.Build(
            samples=len(line["s"]), points=points, step=step, max_curvature=max_curvature, d=start[1], d1=start[2],
            d2=start[3], sin=np.sin(line["heading"]), cos=np.cos(line["heading"]), kind=kind, offset=targets[0],
            slope=targets[1], bend=targets[2], length=lengths, out=out, end=end, paths=n, **line,
        ),
    )  # fmt: skip
    return out, end


def brake_before(cap: F64, step: float, brake: float) -> F64:
    """A cap [n, p] lowered so that every lower speed ahead can be reached with `brake` [m/s²]."""
    lowered = np.empty_like(cap)
    drop = 2.0 * brake * step
    _launch(brake_kernel, len(cap), paths.Brake(points=cap.shape[1], drop=drop, cap=cap, lowered=lowered))
    return lowered


@dataclass(frozen=True)
class Outline:
    """Samples of a footprint as the kernel wants them: group by group of which the same is taken off."""

    x: F64  # [samples] [m]
    y: F64
    known: U8  # whether it must be known [samples]
    begin: I32  # of each group's samples, the end included [groups + 1]
    taken: F32  # [2, groups, 5] [E_max]
    counts: U8  # whether anything of the group can count [2, groups]


def pack(x: F64, y: F64, taken: F32, outlined: int) -> Outline:
    """Bring samples together of which the same is taken off.

    Args:
        x: frame of the rear axle, at most MOST_SAMPLES [m].
        y: the same.
        taken: off each sample for each of the four and `risk`, on paths that stay and leave [2, 5, samples] [E_max].
        outlined: so many of the samples must be known.
    """
    columns = taken.reshape(10, -1)
    order = np.lexsort(columns)
    ranked = columns[:, order]
    new = np.flatnonzero((ranked[:, 1:] != ranked[:, :-1]).any(axis=0)) + 1
    begin = np.concatenate(([0], new, [len(order)])).astype(np.int32)
    off = np.ascontiguousarray(taken[..., order[begin[:-1]]].transpose(0, 2, 1))
    counts: U8 = np.asarray(np.any(off < _NEVER, axis=-1), dtype=np.uint8)
    return Outline(x[order], y[order], (order < outlined).astype(np.uint8), begin, off, counts)


def look_up(
    volume: Volume,
    outline: Outline,
    named: tuple[float, float],
    leaves: U8,
    x: F64,
    y: F64,
    heading: F64,
    later: int,
    slice_of: Integers | None = None,
) -> tuple[F32, F32, npt.NDArray[np.bool_], F32, U8]:
    """Risk [n, S, p], stays [n, p], whether the outline is known [n, p]; the four of `PathRisk` and of whom they are.

    Args:
        volume: the volume on the plan's clock.
        outline: the samples of the footprint, from `pack`.
        named: from which risk on the source is told: of a contact, of what is beside [E_max].
        leaves: whether each path leaves where the ego drives [n].
        x: rear axle along n paths of p points, `map` frame [n, p] [m].
        y: the same.
        heading: of the body there [rad].
        later: the last slice in which something must be there to count for `stays`.
        slice_of: the one slice in which each point is looked up [p], then S is 1; None: all.
    """
    n, points = x.shape
    slices = volume.slices if slice_of is None else 1
    risk, four = np.empty((n, slices, points), np.float32), np.empty((4, n, slices, points), np.float32)
    stays, whole = np.empty((n, points), np.float32), np.empty((n, points), np.uint8)
    who = np.empty(four.shape, np.uint8)
    q, kept = _prepared(volume, outline)
    q.fill(
        slices=slices, later=later, timed=int(slice_of is not None), paths=n, points=points, r_hit=named[0],
        r0=named[1], x=x, y=y, heading=heading, leaves=leaves, risk=risk, stays=stays, whole=whole, four=four, who=who,
    )  # fmt: skip
    if slice_of is not None:
        q.fill(slice_of=slice_of)
    _launch(look_up_kernel, n * -(-points // LANES), q)
    del q.kept[kept:]
    return risk, stays, whole.view(np.bool_), four, who


def _prepared(volume: Volume, outline: Outline) -> tuple[Parameters, int]:
    """What every look-up of an outline in a volume needs, and how many arrays that keeps."""
    known = volume.prepared.get(id(outline))
    if known is None:
        g, m, dominant = volume.risk.grid, volume.risk.volume, volume.risk.dominant
        q = look_up_source.LookUp(
            first=volume.first, rows=g.rows, columns=g.columns, block_columns=dominant.shape[2],
            block_plane=dominant.shape[1] * dominant.shape[2], half=int(m.dtype == np.float16), volume=m,
            dominant=dominant, who_of=volume.who, grid_x=g.x, grid_y=g.y, grid_cos=math.cos(g.heading),
            grid_sin=math.sin(g.heading), grid_heading=g.heading, h=g.h, samples=len(outline.x),
            groups=len(outline.begin) - 1, outline_x=outline.x, outline_y=outline.y, begin=outline.begin,
            outline=outline.known, taken=outline.taken, counts=outline.counts,
        )  # fmt: skip
        known = volume.prepared[id(outline)] = outline, q, len(q.kept)
    return known[1], known[2]


def law(
    sides: F32,
    who: U8,
    starts: F64,
    step: float,
    s_max: float,
    r0: float,
    r1: float,
    along: float,
    going: float,
) -> tuple[F64, F64]:
    """Speed that the risk on either side [2, n, S, p] of the sources `who` allows [n, S, p]; see `beside_law`."""
    out: F64 = np.empty((2, *sides.shape[1:]))
    n, slices, points = sides.shape[1:]
    q = law_source.Law(
        slices=slices, points=points, s_max=s_max, r0=r0, r1=r1, along=along, step=step, going=going, starts=starts,
        left=sides[0], right=sides[1], who_left=who[0], who_right=who[1], law=out[0], law_now=out[1],
        allowed=np.empty((n, points)),
    )  # fmt: skip
    _launch(law_kernel, n, q)
    return out[0], out[1]


def crossings(
    risk: F32, who: U8, starts: F64, r_hit: float, step: float, far: float, over: int
) -> tuple[F64, F64, F64]:
    """Where contact begins at or beyond each station, how fast that moves, and how fast it moves away [n, S, p]."""
    out: F64 = np.empty((3, *risk.shape))
    n, slices, points = risk.shape
    q = contact.Crossing(
        slices=slices, points=points, over=over, r_hit=r_hit, far=far, step=step, starts=starts, risk=risk, who=who,
        hit=out[0], rate=out[1], away=out[2],
    )  # fmt: skip
    _launch(crossing_kernel, n, q)
    return out[0], out[1], out[2]


class RollField:
    """What every motion of a cycle looks up, handed over once: arrays and numbers of `Roll` and `Search`, by name."""

    def __init__(self, **values: Any) -> None:
        self.one = roll_source.Roll(**values)
        self.many = roll_source.Search(**values)


def roll(
    field: RollField,
    constants: Mapping[str, Any],
    path: Integers,
    target: F64,
    hold: F64,
    *,
    traced: bool = True,
) -> tuple[F64, F64, F64, I32, I32]:
    """Roll K motions out; returns distance, speed, acceleration [K, steps + 1], failure and its step [K].

    Args:
        field: what they look up.
        constants: the numbers of `Roll`, by name.
        path: path of each motion [K].
        target: target speed [K] [m/s].
        hold: when the braking starts [K] [s].
        traced: else they are only judged, and the first three are empty [0, steps + 1].
    """
    q, k, n = field.one, len(path), constants["steps"] + 1
    out: F64 = np.empty((3, k if traced else 0, n))
    failure, failed_at = np.empty(k, np.int32), np.empty(k, np.int32)
    kept = len(q.kept)
    q.fill(
        path=path, target=target, hold=hold, traced=int(traced), s=out[0], v=out[1], a=out[2], failure=failure,
        failed_at=failed_at, **constants,
    )  # fmt: skip
    _launch(roll_kernel, k, q)
    del q.kept[kept:]
    return out[0], out[1], out[2], failure, failed_at


def highest(
    field: RollField, constants: Mapping[str, Any], path: Integers, s_max: F64, shares: F64, fine: int
) -> tuple[npt.NDArray[np.bool_], F64, F64, I32, I32, F64]:
    """The highest target that passes on K paths, [2, K]: going on, and stopping where that could be better.

    Args:
        field: what they look up.
        constants: the numbers of `Search`, by name.
        path: the paths [K].
        s_max: the highest target on each [K] [m/s].
        shares: of it that are tried at first, increasing.
        fine: so many targets are tried between the highest that passes and the next, twice.

    Returns:
        Whether any passes, the target, where its motion ends; what fails just above, in which step and where.
    """
    q, k = field.many, len(path)
    whole, real = np.zeros((3, 2, k), np.int32), np.zeros((3, 2, k))
    kept = len(q.kept)
    q.fill(
        coarse=len(shares), fine=fine, paths=k, path=path, s_max=s_max, shares=shares, passed=whole[0],
        desired=real[0], rest=real[1], failure=whole[1], failed_at=whole[2], failed_distance=real[2], **constants,
    )  # fmt: skip
    _launch(search_kernel, k, q)
    del q.kept[kept:]
    return whole[0] > 0, real[0], real[1], whole[1], whole[2], real[2]
