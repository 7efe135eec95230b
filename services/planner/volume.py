"""Reading the risk volume at points of the `map` frame: bilinear in space, piecewise constant in time.

Slices are times, not indices: slice j starts at t_j from the volume's `capture` + `t_offset`; here all times count
from the plan's own capture, so that an older volume is shifted by its age. Points beyond the grid are unknown.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from common.messages import BLOCK, NO_SLOT, Risk, Slot

F32 = npt.NDArray[np.float32]
F64 = npt.NDArray[np.float64]
Bools = npt.NDArray[np.bool_]
U8 = npt.NDArray[np.uint8]

OTHER = "other"
"""Label of the slot that sources share which have none of their own."""
NOBODY = 255
"""Source of what has none, or one that is not known."""


@dataclass(frozen=True)
class Volume:
    """A risk volume on the plan's clock, from the slice now in force on."""

    risk: Risk
    first: int  # index of the slice in force at the plan's time 0
    starts: F64  # start of that slice and of those after it, from the plan's capture [S] [s]

    @staticmethod
    def of(risk: Risk, capture_ns: int, plan_ns: int) -> Volume:
        """Shift a volume by its age against the plan."""
        starts = np.asarray(risk.slice_times) + risk.t_offset + (capture_ns - plan_ns) * 1e-9
        first = max(int(np.searchsorted(starts, 0.0, side="right")) - 1, 0)
        return Volume(risk, first, starts[first:])

    @cached_property
    def who(self) -> U8:
        """A number for the source of each slot [256]: its terms are one source; those that share a slot are NOBODY."""
        out = np.full(256, NOBODY, dtype=np.uint8)
        numbers: dict[tuple[int, int], int] = {}
        for i, slot in enumerate(self.risk.slots[:NO_SLOT]):
            if slot.label != OTHER:
                out[i] = min(numbers.setdefault((slot.id, slot.cls), len(numbers)), NOBODY)
        return out

    @cached_property
    def prepared(self) -> dict[int, Any]:
        """For the kernels: what they have made ready for looking this volume up."""
        return {}

    @property
    def slices(self) -> int:
        """Number of slices from now on."""
        return len(self.starts)

    def slice_at(self, t: npt.ArrayLike) -> npt.NDArray[np.intp]:
        """Which of those slices holds at plan times t [s]."""
        after = np.searchsorted(self.starts, np.asarray(t) + 1e-9, side="right")
        return np.asarray(np.minimum(np.maximum(after - 1, 0), self.slices - 1))

    def coordinates(self, x: F64, y: F64) -> tuple[F64, F64]:
        """Grid coordinates, in cells from the grid's corner."""
        g = self.risk.grid
        c, s = np.cos(g.heading), np.sin(g.heading)
        dx, dy = x - g.x, y - g.y
        return (c * dx + s * dy) / g.h, (-s * dx + c * dy) / g.h

    def known(self, x: F64, y: F64) -> Bools:
        """Whether points lie on the grid."""
        i, j = self.coordinates(x, y)
        return np.asarray((i >= 0) & (i <= self.risk.grid.rows) & (j >= 0) & (j <= self.risk.grid.columns))

    def sample(self, x: F64, y: F64, slices: Sequence[int] | None = None) -> tuple[F32, Bools]:
        """Risk at points of any shape [...] in every slice from now on [S, ...], 0 where unknown; and what is known.

        `slices`: only in these, counted from the one in force.
        """
        slices = range(self.slices) if slices is None else slices
        g = self.risk.grid
        fi, fj = self.coordinates(x, y)
        known = (fi >= 0) & (fi <= g.rows) & (fj >= 0) & (fj <= g.columns)
        fi, fj = np.clip(fi - 0.5, 0.0, g.rows - 1.0), np.clip(fj - 0.5, 0.0, g.columns - 1.0)
        i, j = np.minimum(fi.astype(np.int32), g.rows - 2), np.minimum(fj.astype(np.int32), g.columns - 2)
        wi, wj = (fi - i).astype(np.float32), (fj - j).astype(np.float32)
        wi, wj = np.where(known, wi, np.float32(0.0)), np.where(known, wj, np.float32(0.0))
        index = i * g.columns + j
        flat = self.risk.volume.reshape(self.risk.volume.shape[0], -1)
        weights = (
            (0, np.where(known, (1 - wi) * (1 - wj), np.float32(0.0))),
            (1, (1 - wi) * wj),
            (g.columns, wi * (1 - wj)),
            (g.columns + 1, wi * wj),
        )
        out = np.zeros((len(slices), *x.shape), dtype=np.float32)
        for row, j_slice in zip(out, slices, strict=True):
            cells = flat[self.first + j_slice]
            for shift, weight in weights:
                row += np.take(cells, index + shift) * weight
        return out, known

    def sample_at(self, x: F64, y: F64, slices: npt.NDArray[np.intp]) -> F32:
        """Risk at points [m, k], those of row i in slice `slices`[i] counted from the one in force; 0 where unknown."""
        g = self.risk.grid
        fi, fj = self.coordinates(x, y)
        known = (fi >= 0) & (fi <= g.rows) & (fj >= 0) & (fj <= g.columns)
        fi, fj = np.clip(fi - 0.5, 0.0, g.rows - 1.0), np.clip(fj - 0.5, 0.0, g.columns - 1.0)
        i, j = np.minimum(fi.astype(np.intp), g.rows - 2), np.minimum(fj.astype(np.intp), g.columns - 2)
        wi, wj = fi - i, fj - j
        m, at = self.risk.volume, (self.first + slices)[:, None]
        low = m[at, i, j] * (1 - wj) + m[at, i, j + 1] * wj
        high = m[at, i + 1, j] * (1 - wj) + m[at, i + 1, j + 1] * wj
        return np.where(known, low * (1 - wi) + high * wi, 0.0).astype(np.float32)

    def dominant_at(self, x: F64, y: F64, slices: npt.NDArray[np.intp]) -> U8:
        """Slot with the largest share at points [m, k], those of row i in slice `slices`[i]; nearest if off grid."""
        g = self.risk.grid
        i, j = self.coordinates(x, y)
        bi = np.clip(i, 0, g.rows - 1).astype(np.intp) // BLOCK
        bj = np.clip(j, 0, g.columns - 1).astype(np.intp) // BLOCK
        return np.asarray(self.risk.dominant[(self.first + slices)[:, None], bi, bj])

    def cell(self, x: float, y: float) -> tuple[int, int]:
        """The cell (i, j) in which a point lies, at the nearest edge if it lies beyond the grid."""
        g = self.risk.grid
        i, j = self.coordinates(np.asarray(x), np.asarray(y))
        return int(np.clip(i, 0, g.rows - 1)), int(np.clip(j, 0, g.columns - 1))

    def cell_centre(self, i: int, j: int) -> tuple[float, float]:
        """Centre of a cell, `map` frame [m]."""
        g = self.risk.grid
        c, s = np.cos(g.heading), np.sin(g.heading)
        a, b = (i + 0.5) * g.h, (j + 0.5) * g.h
        return float(g.x + c * a - s * b), float(g.y + s * a + c * b)

    def source(self, index: int, i: int, j: int) -> Slot | None:
        """The slot with the largest share at a cell of the volume's slice `index`."""
        slot: Any = self.risk.dominant[index, i // BLOCK, j // BLOCK]
        return self.risk.slots[int(slot)] if slot != NO_SLOT and int(slot) < len(self.risk.slots) else None
