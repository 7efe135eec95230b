"""Launching the kernels: buffers on `cpu` or `cuda`, one float volume out."""

from __future__ import annotations

import itertools
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import numpy.typing as npt
import warp as wp

from common.kernel_cache import kernel_cache
from common.messages import BLOCK, F32, Grid
from common.risk import RiskParameters
from services.riskfield import kernels
from services.riskfield.packing import PackedObjects
from services.riskfield.settings import RiskfieldSettings

wp.config.log_level = wp.LOG_ERROR

TYPES: dict[type, Any] = {np.float32: wp.float32, np.int32: wp.int32, np.uint16: wp.uint16}


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
    """The device's side of the field: uploads packed sources, launches, brings the volume back."""

    def __init__(self, settings: RiskfieldSettings, risk: RiskParameters, device: str) -> None:
        self._half = settings.dtype == "float16"
        self._risk = risk
        self._device = device
        self._on_cpu = device == "cpu"
        self._threads = settings.threads if self._on_cpu else 1
        self._pool = ThreadPoolExecutor(self._threads) if self._threads > 1 else None
        self._kept: dict[str, Any] = {}

    def compute(
        self, grid: Grid, packed: PackedObjects, lines: F32
    ) -> tuple[npt.NDArray[np.floating[Any]], npt.NDArray[np.int32]]:
        """M [slices, rows, columns] and the code of the dominant source [slices, rows / 4, columns / 4].

        Code 2 o is the potential of the packed object o, 2 o + 1 its kinetic term, 2 n + m line m, −1 nothing.
        """
        slices, count = packed.objects.shape[:2]
        cells = grid.rows * grid.columns
        blocks = (slices, grid.rows // BLOCK, grid.columns // BLOCK)
        p = self._risk
        v = kernels.Volume()
        v.slices, v.rows, v.columns, v.h = slices, grid.rows, grid.columns, grid.h
        v.objects_count, v.segments_stride, v.lines_count = count, packed.segments.shape[1], len(lines)
        v.run = min(kernels.CPU_RUN, grid.columns) if self._on_cpu else BLOCK
        v.half, v.paper = int(self._half), int(p.kinetic == "paper")
        v.k1, v.e_max, v.taper_radius, v.taper_start = p.k1, p.e_max, p.taper_radius, p.taper_start
        v.t, v.d0, v.E_k = p.t, p.d0, p.E_k
        v.objects, v.segments, v.lines = self._put(packed.objects), self._put(packed.segments), self._put(lines)
        v.static_sum = self._keep("static_sum", cells, wp.float32)
        v.static_best = self._keep("static_best", cells, wp.float32)
        v.static_line = self._keep("static_line", cells, wp.int32)
        volume = self._fresh("volume", (slices, grid.rows, grid.columns), np.uint16 if self._half else np.float32)
        dominant = self._fresh("dominant", blocks, np.int32)
        v.volume16 = volume[1] if self._half else self._keep("none16", 1, wp.uint16)
        v.volume32 = self._keep("none32", 1, wp.float32) if self._half else volume[1]
        v.dominant = dominant[1]

        runs = -(-grid.columns // v.run)
        wp.launch(kernels.static_kernel, dim=grid.rows * runs, inputs=[v], device=self._device)
        tasks = slices * (grid.rows // BLOCK) * runs
        if self._pool is None:
            wp.launch(kernels.field_kernel, dim=tasks, inputs=[v, 0], device=self._device)
        else:
            cuts = np.linspace(0, tasks, self._threads + 1).astype(int)
            for done in [
                self._pool.submit(wp.launch, kernels.field_kernel, dim=int(b - a), inputs=[v, int(a)], device="cpu")
                for a, b in itertools.pairwise(cuts)
            ]:
                done.result()
        m = self._back(*volume)
        return m.view(np.float16) if self._half else m, self._back(*dominant)

    def _put(self, a: F32) -> Any:
        if a.size == 0:
            return self._keep("nothing", 1, wp.float32)
        return wp.array(a.ravel(), dtype=wp.float32, device=self._device, copy=not self._on_cpu)

    def _keep(self, name: str, size: int, dtype: Any) -> Any:
        """A buffer that lives on and grows when it must."""
        if name not in self._kept or self._kept[name].size < size:
            self._kept[name] = wp.empty(size, dtype=dtype, device=self._device)
        return self._kept[name]

    def _fresh(self, name: str, shape: tuple[int, ...], dtype: type) -> tuple[npt.NDArray[Any], Any]:
        """Host memory of its own for every frame (the message keeps it), and where the device writes."""
        host: npt.NDArray[Any] = np.empty(shape, dtype=dtype)
        if self._on_cpu:
            return host, wp.array(host.reshape(-1), dtype=TYPES[dtype], device="cpu", copy=False)
        return host, self._keep(name, host.size, TYPES[dtype])

    def _back(self, host: npt.NDArray[Any], on_device: Any) -> npt.NDArray[Any]:
        if not self._on_cpu:
            flat: Any = wp.array(host.reshape(-1), dtype=on_device.dtype, device="cpu", copy=False)
            wp.copy(flat, on_device, count=host.size)
            wp.synchronize_device(self._device)
        return host
