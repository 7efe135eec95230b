"""What the risk field is measured against: NumPy as a user would write it; the same text on a GPU with torch or CuPy.

All rivals read what our kernels read (`Rows`: float32 in the grid's frame, paths already cut to segments, straight runs
made one) and write the same volume in float32. None names the dominant source, which ours does in the same time.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from common.messages import F32, Grid
from common.risk import RiskParameters
from services.riskfield.layout import LINE_FIELDS, OBJECT_FIELDS, SEGMENT_FIELDS


@dataclass(frozen=True)
class Rows:
    """One frame as the kernels read it."""

    grid: Grid
    objects: F32
    """[slices, n, len(OBJECT_FIELDS)]."""
    segments: F32
    """[n, most, len(SEGMENT_FIELDS)]."""
    lines: F32
    """[m, len(LINE_FIELDS)]."""
    p: RiskParameters

    @property
    def shape(self) -> tuple[int, int, int]:
        """Of the volume."""
        return len(self.objects), self.grid.rows, self.grid.columns


class Library:
    """NumPy, or a library with its names (CuPy, torch on a GPU), so that one text serves all of them."""

    def __init__(self, xp: Any = np, device: str = "cpu") -> None:
        self.xp, self._device, self._torch = xp, device, xp.__name__ == "torch"

    def array(self, a: F32) -> Any:
        """An array of the library's own."""
        return self.xp.asarray(a, **({"device": self._device} if self._torch else {}))

    def positive(self, a: Any) -> Any:
        """max(a, 0)."""
        return a.clamp_min(0.0) if self._torch else self.xp.maximum(a, 0.0)

    def negative(self, a: Any) -> Any:
        """min(a, 0)."""
        return a.clamp_max(0.0) if self._torch else self.xp.minimum(a, 0.0)


NUMPY = Library()


def array_volume(r: Rows, lib: Library = NUMPY) -> Any:
    """Vectorised over cells, a loop over objects; the kinetic term in a window around each piece of the path."""
    slices, rows, columns = r.shape
    x = lib.array(((np.arange(rows) + 0.5) * r.grid.h).astype(np.float32))[:, None]
    y = lib.array(((np.arange(columns) + 0.5) * r.grid.h).astype(np.float32))[None, :]
    still = _static(r, x, y, lib)
    xp, p = lib.xp, r.p
    volume = xp.stack([still] * slices)
    for j in range(slices):
        M = volume[j]
        for row, path in zip(r.objects[j], r.segments, strict=True):
            o = dict(zip(OBJECT_FIELDS, row.tolist(), strict=True))
            dx, dy = x - o["x"], y - o["y"]
            lx = lib.positive(abs(o["cos"] * dx + o["sin"] * dy) - o["half_length"])
            ly = lib.positive(abs(o["cos"] * dy - o["sin"] * dx) - o["half_width"])
            d2 = lx * lx + ly * ly
            z = xp.clip((xp.sqrt(d2) / p.taper_radius - p.taper_start) / (1.0 - p.taper_start), 0.0, 1.0)
            M += o["A"] / (d2 + o["A_e"]) * (1.0 - z * z * (3.0 - 2.0 * z))
            if o["sign"] != 0.0:
                _kinetic_windows(M, x, y, o, path, r, lib)
    return volume


def _kinetic_windows(M: Any, x: Any, y: Any, o: dict[str, float], path: F32, r: Rows, lib: Library) -> None:
    """Add one object's kinetic energy: the largest over the segments of its path."""
    h, p, xp, w = r.grid.h, r.p, lib.xp, o["width"]
    low = o["s0"] - o["half"] - (0.0 if o["sign"] > 0 else o["reach"])
    high = o["s0"] + o["half"] + (o["reach"] if o["sign"] > 0 else 0.0)
    windows = []
    for row in path[int(o["first"]) : int(o["last"]) + 1]:
        g = dict(zip(SEGMENT_FIELDS, row.tolist(), strict=True))
        slack = w * g["bent"]
        a0 = max(low - g["s"] - slack, g["low"]) - w * g["turn"]
        a1 = min(high - g["s"] + slack, g["high"])
        if a0 >= a1:
            continue
        i, j = (_cut((g[c] + a0 * g["t" + c], g[c] + a1 * g["t" + c]), w, h, M.shape[k]) for k, c in enumerate("xy"))
        if i.start < i.stop and j.start < j.stop:
            windows.append((g, i, j))
    if not windows:
        return
    i0, j0 = min(w[1].start for w in windows), min(w[2].start for w in windows)
    whole = M[i0 : max(w[1].stop for w in windows), j0 : max(w[2].stop for w in windows)]
    best = xp.zeros_like(whole)
    for g, i, j in windows:
        rx, ry = x[i] - g["x"], y[:, j] - g["y"]
        al, pe = rx * g["tx"] + ry * g["ty"], ry * g["tx"] - rx * g["ty"]
        counts = al <= g["high"]
        s = al + g["s"]
        if g["bent"]:
            below, covered = lib.negative(al - g["low"]), rx * g["before_x"] + ry * g["before_y"]
            s = s - below - xp.clip(-covered, 0.0, g["before_most"])
            s = s + xp.clip(rx * g["next_x"] + ry * g["next_y"] - g["next_0"], 0.0, g["next_most"])
            d2 = pe * pe + below * below
            counts = counts & ((below >= 0.0) | (covered > 0.0))
        else:
            d2 = pe * pe
            counts = counts & (al >= g["low"])
        lateral = lib.positive(1.0 - d2 * o["inverse_w2"])
        xi = o["sign"] * (s - o["s0"]) - o["half"]
        b = lib.positive(1.0 + lib.negative(xi) * o["inverse_l"])
        K = o["M2"] * lib.positive(xp.sqrt(lateral) / (lib.positive(xi) + p.d0) - o["inverse_L"])
        v = p.E_k * xp.log1p(K)
        part = best[i.start - i0 : i.stop - i0, j.start - j0 : j.stop - j0]
        xp.maximum(part, counts * (b * lateral * v / (1.0 + v / p.e_max)), out=part)
    whole += best


def _cut(ends: tuple[float, ...], margin: float, h: float, cells: int) -> slice:
    """Cells between the least and the largest coordinate, with a margin."""
    low, high = int((min(ends) - margin) / h), int((max(ends) + margin) / h) + 2
    return slice(min(max(low, 0), cells), min(max(high, 0), cells))


def _static(r: Rows, x: Any, y: Any, lib: Library) -> Any:
    """Lines and barriers, each segment in its window; the nearest of each kind counts."""
    xp = lib.xp
    kinds = lib.array(np.zeros((2, r.grid.rows, r.grid.columns), dtype=np.float32))
    for row in r.lines:
        g = dict(zip(LINE_FIELDS, row.tolist(), strict=True))
        corners = [
            (g["x"] + a * g["tx"] - b * g["ty"], g["y"] + a * g["ty"] + b * g["tx"])
            for a in (g["along_low"], g["along_high"])
            for b in (g["beside_low"], g["beside_high"])
        ]
        i, j = (_cut(tuple(c[k] for c in corners), 0.0, r.grid.h, r.shape[1 + k]) for k in (0, 1))
        if i.start >= i.stop or j.start >= j.stop:
            continue
        rx, ry = x[i] - g["x"], y[:, j] - g["y"]
        al, pe = rx * g["tx"] + ry * g["ty"], ry * g["tx"] - rx * g["ty"]
        d = xp.hypot(pe, al - xp.clip(al, 0.0, g["length"]))
        dis = lib.positive(d - g["flat"])
        if g["side"]:
            past = (rx - g["length"] * g["tx"]) * g["next_x"] + (ry - g["length"] * g["ty"]) * g["next_y"]
            covered = ((al >= 0.0) & (al <= g["length"])) | ((al > g["length"]) & (past < 0.0))
            beyond = covered & (g["side"] * pe >= 0.0)
            dis = xp.where(beyond, xp.minimum(dis, lib.positive(d - g["depth"])), dis)
        rest = lib.positive(g["half_width"] - dis)
        part = kinds[int(g["kind"] > 0.5)][i, j]
        xp.maximum(part, g["k_s"] * rest * rest, out=part)
    return kinds.sum(0)
