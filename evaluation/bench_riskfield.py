"""Speed of the risk field: `forefield bench riskfield`.

Every variant computes the same frame and is first held against the float64 reference: at randomly drawn cells of all
slices directly, and at every cell against our exact variant, which is itself held against the reference. Then all take
turns in one process. Ours is what the service does between sources and message (packing, both launches, float16, the
dominant source of every block), on every core; the rivals start from rows that are already packed, write float32, and
name no source. `step_ms` is the whole step, from the prediction's message to the risk's, without encoding.
"""

from __future__ import annotations

import importlib.util
import os
import platform
import resource
import time
import tracemalloc
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import numpy as np
from msgspec.structs import replace
from rich.progress import Progress
from rich.table import Table

from common.config import ConfigError
from common.messages import Stamped
from common.risk import RiskParameters
from evaluation import bench_riskfield_frames as frames
from evaluation.bench_riskfield_frames import FRAMES, Frame
from evaluation.bench_riskfield_naive import NaiveWarp
from evaluation.bench_riskfield_rivals import Library, Rows, array_volume
from services.riskfield.core import RiskField
from services.riskfield.device import FieldDevice, resolve
from services.riskfield.packing import pack_objects
from services.riskfield.settings import RiskfieldSettings
from services.riskfield.static_layer import pack_lines

ERROR = 2e-3
"""What every variant may differ from the reference [E_max], float16's rounding apart."""
QUICK = 4
"""Timed runs of a fast variant for each run of a slow one; each right after an untimed one, so that a variant finds its
own data in the caches and not its rivals'."""
OBJECT_STEPS = (16, 32, 64, 128, 256, 512)
AREA_STEPS = ((100, 40), (200, 40), (200, 80), (400, 80), (400, 160), (800, 160), (800, 320))
"""Length and width [m] at 0.25 m: 64 000 to 4 096 000 cells a slice."""
RIVALS = {
    "numpy_f32_ms": "NumPy float32",
    "naive_warp_ms": "naive Warp kernel",
    "numba_ms": "numba",
    "torch_ms": "torch",
    "cupy_ms": "CuPy",
    "memset_ms": "memset",
}


def installed(library: str) -> bool:
    """Whether a rival's library is there."""
    return importlib.util.find_spec(library) is not None


class Ours:
    """Our field from sources to volume, with everything kept that the service keeps."""

    def __init__(self, frame: Frame, p: RiskParameters, device: str, **settings: Any) -> None:
        self.settings: RiskfieldSettings = replace(frame.settings, **settings)
        self._p, self._grid = p, frame.grid
        self.sources, self.counts, self.lines = frame.sources(p)
        self.device = FieldDevice(self.settings, p, device)

    def __call__(self) -> Any:
        """One frame; the caller holds the volume as a message would."""
        packed = pack_objects(self.sources, self.counts, self._grid, self._p, self.settings.accuracy == "fast")
        return self.device.compute(self._grid, packed, pack_lines(self.lines, self._grid))[0]

    def rows(self) -> Rows:
        """What the kernels read."""
        packed = pack_objects(self.sources, self.counts, self._grid, self._p, self.settings.accuracy == "fast")
        lines = pack_lines(self.lines, self._grid)
        self.device.compute(self._grid, packed, lines)
        return Rows(self._grid, *self.device.rows(packed), lines, self._p)


def measure(
    names: list[str], *, rounds: int, device: str, scaling: bool, points: int = 120, progress: Progress | None = None
) -> dict[str, Any]:
    """Frames by name and, with `scaling`, how time grows.

    Args:
        names: of `FRAMES`.
        rounds: runs of the slow variants; the fast ones run four times as often.
        device: `cpu`, `cuda` or `auto`.
        scaling: measure the rows of objects and area too.
        points: cells a slice at which the reference is evaluated.
        progress: told how far it is.

    Raises:
        ConfigError: an unknown frame, or no such device here.
    """
    unknown = [n for n in names if n not in FRAMES]
    if unknown or not names:
        raise ConfigError(f"--frames: no frame {', '.join(unknown) or 'given'}; there are {', '.join(FRAMES)}")
    try:
        where = resolve(device)
    except RuntimeError:
        raise ConfigError(f"--device {device}: there is no CUDA device here; use --device cpu") from None
    threads = len(os.sched_getaffinity(0)) if where == "cpu" else 1
    p = RiskParameters()
    result: dict[str, Any] = {"schema": "forefield.bench_riskfield.v1", "frames": {}}
    for name in names:
        result["frames"][name] = _frame(FRAMES[name](), p, where, threads, rounds, points, progress)
    if scaling:
        result["scaling"] = _scaling(p, where, threads, rounds, progress)
    result["allocation"] = _allocation(FRAMES[names[0]](), p, where, threads)
    result["machine"] = {
        "cpu": platform.processor() or platform.machine(), "threads": threads, "device": where, "rounds": rounds,
    }  # fmt: skip
    return result


def _frame(
    frame: Frame, p: RiskParameters, where: str, threads: int, rounds: int, points: int, progress: Progress | None
) -> dict[str, Any]:
    task = None if progress is None else progress.add_task(f"{frame.name}: reference", total=rounds)
    at, expected = frames.reference(frame, p, points)
    on_cpu = where == "cpu"
    rows = Ours(frame, p, "cpu", dtype="float32", accuracy="exact").rows()
    ours = {
        "ours_ms": Ours(frame, p, where, threads=threads),
        "ours_exact_ms": Ours(frame, p, where, threads=threads, accuracy="exact"),
    }
    if threads > 1:
        ours["ours_one_thread_ms"] = Ours(frame, p, where, threads=1)
    slow, fast = _rivals(rows, where)
    exact = Ours(frame, p, "cpu", dtype="float32", accuracy="exact")()
    errors = {"exact": float(np.abs(exact[at] - expected).max(initial=0.0))}
    checked: dict[str, Callable[[], Any]] = {
        "ours_ms": Ours(frame, p, where, dtype="float32", threads=threads), **slow, **fast,
    }  # fmt: skip
    for name, job in checked.items():
        volume = _host(job())
        direct = np.abs(volume[at] - expected).max(initial=0.0)
        errors[name] = float(max(direct, np.abs(volume - exact).max() + errors["exact"]))
        if not errors[name] <= ERROR * p.e_max:
            raise ConfigError(
                f"{frame.name}: {name} differs by {errors[name]:.1e} from the reference: not the same field"
            )
    step = RiskField(replace(frame.settings, threads=threads), p, where)
    message = Stamped(frame.prediction, 0, 0), Stamped(frame.ego, 0, 0), frame.map, None
    floor = np.empty(rows.shape, dtype=np.uint16)
    quick: dict[str, Callable[[], Any]] = {
        "step_ms": lambda: step.step(*message), **ours, "memset_ms": lambda: floor.fill(0), **fast,
    }  # fmt: skip
    if progress is not None and task is not None:
        progress.update(task, description=frame.name)
    times: dict[str, list[float]] = {name: [] for name in (*quick, *slow)}
    for job in quick.values():
        for _ in range(3):
            job()
    for _ in range(rounds):
        for _ in range(QUICK):
            _each(quick, times, warm=True)
        _each(slow, times)
        if progress is not None and task is not None:
            progress.advance(task)
    ms = {name: round(float(np.median(t)) * 1e3, 4) for name, t in times.items()}
    out: dict[str, Any] = {k: ms.get(k) for k in ("ours_ms", *RIVALS) if on_cpu or k in ms}
    if on_cpu:
        out.pop("torch_ms"), out.pop("cupy_ms")
    for rival in ("numpy", "naive", "numba", "torch", "cupy"):
        key = next(k for k in RIVALS if k.startswith(rival))
        if key in out:
            out[f"ratio_vs_{rival}"] = None if ms.get(key) is None else round(ms[key] / ms["ours_ms"], 2)
    out["max_error"] = errors["ours_ms"]
    out["errors"] = errors
    out |= {k: v for k, v in ms.items() if k not in out}
    return out | {"shape": list(rows.shape), "objects": len(frame.prediction.id)}


def _each(jobs: Mapping[str, Callable[[], Any]], times: dict[str, list[float]], warm: bool = False) -> None:
    for name, job in jobs.items():
        if warm:
            job()
        begin = time.perf_counter()
        held = job()  # given back only after the clock was read
        times[name].append(time.perf_counter() - begin)
        del held


def _rivals(rows: Rows, where: str) -> tuple[dict[str, Callable[[], Any]], dict[str, Callable[[], Any]]]:
    """Slow ones and fast ones; one whose library is absent is left out."""
    if where != "cpu":
        found: dict[str, Callable[[], Any]] = {"naive_warp_ms": NaiveWarp(rows, where)}
        for name in ("torch", "cupy"):
            if installed(name):
                lib = Library(importlib.import_module(name), where)
                found[f"{name}_ms"] = _on_card(rows, lib)
        return found, {}
    slow: dict[str, Callable[[], Any]] = {
        "numpy_f32_ms": lambda: array_volume(rows),
        "naive_warp_ms": NaiveWarp(rows),
    }
    if not installed("numba"):
        return slow, {}
    from evaluation.bench_riskfield_numba import NumbaField

    return slow, {"numba_ms": NumbaField(rows)}


def _on_card(rows: Rows, lib: Library) -> Callable[[], Any]:
    return lambda: _host(array_volume(rows, lib))


def _host(volume: Any) -> Any:
    if hasattr(volume, "cpu"):
        return volume.cpu().numpy()
    return volume.get() if hasattr(volume, "get") else volume


def _scaling(
    p: RiskParameters, where: str, threads: int, rounds: int, progress: Progress | None
) -> dict[str, list[dict[str, Any]]]:
    """Time against road users (on the standard grid) and against area (32 road users spread over it)."""
    sweeps: dict[str, list[Frame]] = {
        "objects": [frames.make("objects", objects=n) for n in OBJECT_STEPS],
        "cells": [frames.make("cells", length=float(a), width=float(b)) for a, b in AREA_STEPS],
    }
    out: dict[str, list[dict[str, Any]]] = {}
    for name, sweep in sweeps.items():
        task = None if progress is None else progress.add_task(f"time against {name}", total=rounds)
        jobs = {str(k): Ours(frame, p, where, threads=threads) for k, frame in enumerate(sweep)}
        times: dict[str, list[float]] = {k: [] for k in jobs}
        for job in jobs.values():
            job()
        for _ in range(rounds):
            _each(jobs, times, warm=True)
            if progress is not None and task is not None:
                progress.advance(task)
        ms = [float(np.median(times[k])) * 1e3 for k in jobs]
        out[name] = [
            {
                "objects": len(frame.prediction.id), "cells": frame.grid.rows * frame.grid.columns,
                "ms": round(t, 3), "times_the_last": None if before is None else round(t / before, 2),
            }
            for frame, t, before in zip(sweep, ms, [None, *ms[:-1]], strict=True)
        ]  # fmt: skip
    return out


def _allocation(frame: Frame, p: RiskParameters, where: str, threads: int, count: int = 20) -> dict[str, float]:
    """What a frame allocates once the buffers exist: new volumes, Python's own peak, pages the kernel had to give."""
    ours = Ours(frame, p, where, threads=threads)
    held = [ours() for _ in range(2)]  # as a service: one message is under way while the next is computed

    def run() -> Iterator[None]:
        for k in range(count):
            held[k % 2] = None
            held[k % 2] = ours()
            yield

    for _ in run():
        pass
    made, faults = ours.device.fresh_volumes, resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    for _ in run():
        pass
    faults = resource.getrusage(resource.RUSAGE_SELF).ru_minflt - faults
    tracemalloc.start()
    peak = 0
    for _ in run():
        peak = max(peak, tracemalloc.get_traced_memory()[1])
        tracemalloc.reset_peak()
    tracemalloc.stop()
    return {
        "fresh_volumes_per_frame": (ours.device.fresh_volumes - made) / (2 * count),
        "page_faults_per_frame": round(faults / count, 2),
        "python_peak_kb": round(peak / 1e3, 1),
        "volume_kb": round(held[0].nbytes / 1e3, 1) if held[0] is not None else 0.0,
    }


def table(result: dict[str, Any]) -> list[Table]:
    """Frames, growth and allocation."""
    machine = result["machine"]
    out = Table(title=f"Risk field on {machine['device']}, {machine['threads']} threads; ms (× slower than ours)")
    out.add_column("")
    for name, f in result["frames"].items():
        out.add_column(f"{name}\n{f['objects']} road users\n{' × '.join(map(str, f['shape']))}", justify="right")
    columns = list(result["frames"].values())
    out.add_row("[bold]ours[/]", *(f"[bold]{f['ours_ms']:.2f}[/]" for f in columns))
    names = {
        "ours_one_thread_ms": "ours, one thread",
        "ours_exact_ms": "ours, every cell exact",
        "step_ms": "ours, whole step",
        **RIVALS,
    }
    for key, name in names.items():
        if any(key in f for f in columns):
            cells = [
                "not installed" if f.get(key) is None else f"{f[key]:.2f} ({f[key] / f['ours_ms']:.2g} ×)"
                for f in columns
            ]
            out.add_row(name, *cells)
    out.add_row("largest error [E_max]", *(f"{f['max_error']:.1e}" for f in columns))
    tables = [out]
    for name, rows in result.get("scaling", {}).items():
        growth = Table(title=f"Time against {name}")
        for column in ("road users", "cells a slice", "ms", "× the last"):
            growth.add_column(column, justify="right")
        for r in rows:
            last = "" if r["times_the_last"] is None else f"{r['times_the_last']:.2f}"
            growth.add_row(f"{r['objects']}", f"{r['cells']:,}", f"{r['ms']:.2f}", last)
        tables.append(growth)
    a = result["allocation"]
    tables[-1].caption = (
        f"a frame in steady state: {a['fresh_volumes_per_frame']:g} new volumes (of {a['volume_kb']:.0f} kB), "
        f"{a['page_faults_per_frame']:g} page faults, {a['python_peak_kb']:.0f} kB of Python's own for a moment"
    )
    return tables
