"""Memory that is used again from frame to frame: inputs of the kernels, their scratch, what leaves in messages."""

from __future__ import annotations

import math
import sys
from collections import OrderedDict
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import warp as wp

TYPES: dict[Any, Any] = {np.float32: wp.float32, np.int32: wp.int32, np.uint16: wp.uint16, np.float64: wp.float64}


class DeviceArray:
    """A flat array on the device that grows when it must; `staged`: with the host's side of it, pinned for CUDA."""

    def __init__(self, device: str, staged: bool = True) -> None:
        self._device, self._staged = device, staged
        self._array: Any = None
        self._pinned: Any = None
        self._flat: npt.NDArray[Any] = np.zeros(0)

    @property
    def where(self) -> int:
        """Changes when the memory moved."""
        return 0 if self._array is None else int(self._array.ptr or 0)

    def room(self, size: int, dtype: type) -> Any:
        """The device's array with room for at least so many."""
        if self._array is None or self._array.size < size:
            self._array = wp.zeros(max(size, 1), dtype=TYPES[dtype], device=self._device)
            if self._staged:
                on_cpu = self._device == "cpu"
                self._pinned = (
                    self._array if on_cpu else wp.zeros(max(size, 1), dtype=TYPES[dtype], device="cpu", pinned=True)
                )
                self._flat = self._pinned.numpy()
        return self._array

    def host(self, shape: tuple[int, ...], dtype: type) -> tuple[npt.NDArray[Any], Any]:
        """What the host writes, in that shape, and the device's array that holds it after `upload`."""
        size = math.prod(shape)
        array = self.room(size, dtype)
        return self._flat[:size].reshape(shape), array

    def read(self, shape: tuple[int, ...]) -> npt.NDArray[Any]:
        """A copy of what the device holds."""
        return np.array(self._array.numpy()[: math.prod(shape)]).reshape(shape)

    def upload(self) -> None:
        """From the pinned memory to the device; nothing to do on the CPU."""
        if self._pinned is not None and self._pinned is not self._array:
            wp.copy(self._array, self._pinned)


class _Kept(NamedTuple):
    root: npt.NDArray[Any]
    """Flat; every view of it, and every view of a view, holds it."""
    flat: Any
    """The same memory as Warp's array."""


_ALONE = _Kept(np.zeros(0), None)
_IDLE = sys.getrefcount(_ALONE.root)
"""References to an array that only the ring holds."""
MOST_KEPT = 4
"""Messages hold two or three at a time; whoever holds more owns them."""


SHAPES = 2
"""Shapes whose arrays are kept: at a speed where the grid grows, it goes back and forth between two."""


class _Ring(NamedTuple):
    kept: list[_Kept]
    resident: Any
    """Where the device writes; None on the CPU, which writes into the host's own."""


class HostRing:
    """Arrays for what leaves in messages: one is handed out again only when nobody holds it or a view of it."""

    def __init__(self, device: str) -> None:
        self._on_cpu, self._device = device == "cpu", device
        self._rings: OrderedDict[tuple[tuple[int, ...], type], _Ring] = OrderedDict()
        self.made = 0
        """How many were allocated."""

    @property
    def where(self) -> int:
        """Of the shape taken last; changes when the device's memory moved; on the CPU the host's own is written."""
        ring = next(reversed(self._rings.values()), None)
        return 0 if ring is None or ring.resident is None else int(ring.resident.ptr or 0)

    def take(self, shape: tuple[int, ...], dtype: type) -> tuple[npt.NDArray[Any], Any, Any]:
        """An array of the host, its memory as Warp's array, and where the device writes it (on the CPU the same)."""
        size = math.prod(shape)
        ring = self._rings.pop((shape, dtype), None)
        if ring is None:
            while len(self._rings) >= SHAPES:
                self._rings.popitem(last=False)
            resident = None if self._on_cpu else wp.zeros(size, dtype=TYPES[dtype], device=self._device)
            ring = _Ring([], resident)
        self._rings[shape, dtype] = ring
        kept = next((k for k in ring.kept if sys.getrefcount(k.root) <= _IDLE), None)
        if kept is None:
            self.made += 1
            flat: Any = wp.zeros(size, dtype=TYPES[dtype], device="cpu", pinned=not self._on_cpu)
            kept = _Kept(flat.numpy(), flat)
            if len(ring.kept) < MOST_KEPT:
                ring.kept.append(kept)
        return kept.root.reshape(shape), kept.flat, kept.flat if self._on_cpu else ring.resident
