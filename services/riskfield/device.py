"""Launching the kernels: buffers that stay, on `cpu` or `cuda`; one float volume out."""

from __future__ import annotations

import math
from collections import OrderedDict
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import numpy.typing as npt
import warp as wp

from common.kernel_cache import kernel_cache
from common.messages import BLOCK, F32, Grid
from common.risk import RiskParameters
from services.riskfield import kernels
from services.riskfield.buffers import DeviceArray, HostRing
from services.riskfield.layout import CPU_GROUP, CPU_RUN, MOST_VERTICES, OBJECT_FIELDS, SEGMENT_FIELDS
from services.riskfield.packing import PackedObjects, nodes_every
from services.riskfield.settings import RiskfieldSettings

wp.config.log_level = wp.LOG_ERROR

UPLOADED = ("counts", "pose", "objects", "vertices", "arcs", "vertex_counts", "origins", "lines")
MOST_GRAPHS = 4
SCRATCH = ("segments", "crossings", "far", "static_sum", "static_best", "static_line", "unused16", "unused32")


def resolve(device: str) -> str:
    """`auto` becomes `cuda:0` where there is one, otherwise `cpu`.

    Raises:
        RuntimeError: CUDA is asked for and there is none.
        ConfigError: there is no place to keep compiled kernels.
    """
    wp.config.kernel_cache_dir = str(kernel_cache())
    wp.init()  # type: ignore[no-untyped-call]
    if device == "auto":
        return "cuda:0" if wp.is_cuda_available() else "cpu"
    if device.startswith("cuda"):
        if not wp.is_cuda_available():
            raise RuntimeError("device = cuda, but there is no CUDA device here: use riskfield.device=auto or cpu")
        return "cuda:0" if device == "cuda" else device
    return "cpu"


class FieldDevice:
    """The device's side of the field: uploads packed sources, launches, brings the volume back.

    Every buffer is kept from frame to frame and grows when it must. On CUDA the uploads and both kernels are one
    captured graph for each shape of the grid and each capacity.
    """

    def __init__(self, settings: RiskfieldSettings, risk: RiskParameters, device: str) -> None:
        self._half = settings.dtype == "float16"
        self._risk = risk
        self._device = device
        self._on_cpu = device == "cpu"
        self._threads = settings.threads if self._on_cpu else 1
        self._others = ThreadPoolExecutor(self._threads - 1) if self._threads > 1 else None
        self._in = {name: DeviceArray(device) for name in UPLOADED}
        self._work = {name: DeviceArray(device, staged=False) for name in SCRATCH}
        self._volumes, self._dominants = HostRing(device), HostRing(device)
        self._graphs: OrderedDict[tuple[Any, ...], Any] = OrderedDict()

    @property
    def fresh_volumes(self) -> int:
        """How many volumes were allocated so far; the others were given back by their messages."""
        return self._volumes.made

    def compute(
        self, grid: Grid, packed: PackedObjects, lines: F32
    ) -> tuple[npt.NDArray[np.floating[Any]], npt.NDArray[np.int32]]:
        """M [slices, rows, columns] and the code of the dominant source [slices, rows / 4, columns / 4].

        Code 2 o is the potential of the packed object o, 2 o + 1 its kinetic term, 2 n + m line m, −1 nothing. Both
        belong to the caller: their memory is used again once nobody holds them.
        """
        slices, count = packed.objects.shape[:2]
        blocks = (slices, grid.rows // BLOCK, grid.columns // BLOCK)
        v = self._volume(grid, packed, lines)
        shape = (slices, grid.rows, grid.columns)
        volume, pinned, on_device = self._volumes.take(shape, np.uint16 if self._half else np.float32)
        dominant, pinned_names, named = self._dominants.take(blocks, np.int32)
        v.volume16 = on_device if self._half else self._work["unused16"].room(1, np.uint16)
        v.volume32 = self._work["unused32"].room(1, np.float32) if self._half else on_device
        v.dominant = named

        runs = -(-grid.columns // v.run)
        prepare = (slices * v.far_rows if v.two_level else 0) * runs + grid.rows * runs + self._room(count)
        tasks = -(-slices // v.group) * (grid.rows // BLOCK) * runs
        if self._on_cpu:
            self._spread(kernels.prepare_kernel, prepare, v)
            self._spread(kernels.field_kernel, tasks, v)
        else:
            self._replay(v, prepare, tasks)
            wp.copy(pinned, on_device)
            wp.copy(pinned_names, named)
            wp.synchronize_device(self._device)
        return volume.view(np.float16) if self._half else volume, dominant

    def rows(self, packed: PackedObjects) -> tuple[F32, F32]:
        """What the kernels read for the frame computed last: objects and segments, copied; for measurements."""
        slices, count = packed.objects.shape[:2]
        room = self._room(count)
        objects = self._in["objects"].read((slices, room, len(OBJECT_FIELDS)))
        segments = self._work["segments"].read((room, MOST_VERTICES - 1, len(SEGMENT_FIELDS)))
        return objects[:, :count], segments[:count]

    @staticmethod
    def _room(count: int) -> int:
        """Objects for which there is room: grows in steps, so that a graph holds for many frames."""
        return max(16, -(-count // 16) * 16)

    def _volume(self, grid: Grid, packed: PackedObjects, lines: F32) -> Any:
        slices, count = packed.objects.shape[:2]
        room = self._room(count)
        cells = grid.rows * grid.columns
        p = self._risk
        v = kernels.Volume()
        v.slices, v.rows, v.columns, v.h = slices, grid.rows, grid.columns, grid.h
        runs = -(-grid.columns // CPU_RUN)
        v.run = -(-grid.columns // (16 * runs)) * 16 if self._on_cpu else BLOCK
        v.group = min(slices, CPU_GROUP) if self._on_cpu else 1
        v.half, v.paper, v.two_level = int(self._half), int(p.kinetic == "paper"), int(packed.two_level)
        v.ratio = nodes_every(grid.h)
        v.far_rows = (grid.rows - 1) // v.ratio + 5
        v.far_pitch = grid.columns + v.ratio + 4
        v.objects_most, v.vertices_most, v.segments_most = room, MOST_VERTICES, MOST_VERTICES - 1
        v.k1, v.e_max, v.taper_radius, v.taper_start = p.k1, p.e_max, p.taper_radius, p.taper_start
        v.t, v.d0, v.E_k = p.t, p.d0, p.E_k

        host = {name: kept.host for name, kept in self._in.items()}
        counts, v.counts = self._in["counts"].host((2,), np.int32)
        counts[:] = count, len(lines)
        objects, v.objects = host["objects"]((slices, room, len(OBJECT_FIELDS)), np.float32)
        objects[:, :count] = packed.objects
        pose, v.pose = host["pose"]((4,), np.float64)
        pose[:] = grid.x, grid.y, math.cos(grid.heading), math.sin(grid.heading)
        used = packed.vertices.shape[1]
        vertices, v.vertices = host["vertices"]((room, MOST_VERTICES, 2), np.float64)
        vertices[:count, :used] = packed.vertices
        arcs, v.arcs = host["arcs"]((room, MOST_VERTICES), np.float64)
        arcs[:count, :used] = packed.arcs
        vertex_counts, v.vertex_counts = host["vertex_counts"]((room,), np.int32)
        vertex_counts[:count] = packed.vertex_counts
        origins, v.origins = host["origins"]((room,), np.float64)
        origins[:count] = packed.origins
        rows, v.lines = host["lines"]((max(-(-len(lines) // 256) * 256, 256), max(lines.shape[1], 1)), np.float32)
        rows[: len(lines)] = lines

        work = self._work
        v.segments = work["segments"].room(room * v.segments_most * len(SEGMENT_FIELDS), np.float32)
        v.crossings = work["crossings"].room(room * (grid.rows // BLOCK) * 2, np.int32)
        v.far = work["far"].room(slices * v.far_rows * v.far_pitch + 64 if v.two_level else 1, np.float32)
        v.static_sum = work["static_sum"].room(cells, np.float32)
        v.static_best = work["static_best"].room(cells, np.float32)
        v.static_line = work["static_line"].room(cells, np.int32)
        return v

    def _spread(self, kernel: Any, tasks: int, v: Any) -> None:
        """Every thread takes every n-th task: neighbours cost alike, so the threads end together."""
        n = self._threads
        rest = []
        for k in range(1, n):
            assert self._others is not None
            rest.append(
                self._others.submit(wp.launch, kernel, dim=len(range(k, tasks, n)), inputs=[v, k, n], device="cpu")
            )
        wp.launch(kernel, dim=len(range(0, tasks, n)), inputs=[v, 0, n], device="cpu")
        for done in rest:
            done.result()

    def _replay(self, v: Any, prepare: int, tasks: int) -> None:
        """Upload and launch as one captured graph; captured anew where a buffer moved or the grid changed.

        The last few are kept: grid and room for objects go back and forth between two sizes.
        """
        given = tuple(self._in.values())
        memory: tuple[Any, ...] = (*given, *self._work.values(), self._volumes, self._dominants)
        shape = (v.slices, v.rows, v.columns, v.h, v.two_level, v.objects_most, v.segments_most)
        key = (prepare, tasks, *shape, *(a.where for a in memory))
        graph = self._graphs.pop(key, None)
        if graph is None:
            while len(self._graphs) >= MOST_GRAPHS:
                self._graphs.popitem(last=False)
            wp.load_module(kernels, device=self._device)
            with wp.ScopedCapture(device=self._device) as captured:
                for a in given:
                    a.upload()
                wp.launch(kernels.prepare_kernel, dim=prepare, inputs=[v, 0, 1], device=self._device)
                wp.launch(kernels.field_kernel, dim=tasks, inputs=[v, 0, 1], device=self._device)
            graph = captured.graph
        self._graphs[key] = graph
        wp.capture_launch(graph)
