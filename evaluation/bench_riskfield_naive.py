"""The risk field as a plain Warp kernel: one thread for each cell, a loop over the objects."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

from common.messages import F32
from evaluation.bench_riskfield_rivals import Rows
from services.riskfield.layout import LINE_FIELDS, OBJECT_FIELDS, SEGMENT_FIELDS

OBJECT, SEGMENT, LINE = ({name: k for k, name in enumerate(f)} for f in (OBJECT_FIELDS, SEGMENT_FIELDS, LINE_FIELDS))
"""Column of each field."""


@wp.func
def _potential(o: wp.array(dtype=float), dx: float, dy: float, radius: float, start: float):
    c, s = o[wp.static(OBJECT["cos"])], o[wp.static(OBJECT["sin"])]
    lx = wp.max(wp.abs(c * dx + s * dy) - o[wp.static(OBJECT["half_length"])], 0.0)
    ly = wp.max(wp.abs(c * dy - s * dx) - o[wp.static(OBJECT["half_width"])], 0.0)
    d2 = lx * lx + ly * ly
    z = wp.clamp((wp.sqrt(d2) / radius - start) / (1.0 - start), 0.0, 1.0)
    return o[wp.static(OBJECT["A"])] / (d2 + o[wp.static(OBJECT["A_e"])]) * (1.0 - z * z * (3.0 - 2.0 * z))


@wp.func
def _kinetic(
    o: wp.array(dtype=float), g: wp.array(dtype=float), x: float, y: float, d0: float, E_k: float, e_max: float
):
    rx, ry = x - g[wp.static(SEGMENT["x"])], y - g[wp.static(SEGMENT["y"])]
    al, pe = (
        rx * g[wp.static(SEGMENT["tx"])] + ry * g[wp.static(SEGMENT["ty"])],
        ry * g[wp.static(SEGMENT["tx"])] - rx * g[wp.static(SEGMENT["ty"])],
    )
    below = wp.min(al - g[wp.static(SEGMENT["low"])], 0.0)
    covered = rx * g[wp.static(SEGMENT["before_x"])] + ry * g[wp.static(SEGMENT["before_y"])]
    if al > g[wp.static(SEGMENT["high"])] or (below < 0.0 and covered <= 0.0):
        return 0.0
    d2 = pe * pe + below * below
    lateral = 1.0 - d2 * o[wp.static(OBJECT["inverse_w2"])]
    if lateral <= 0.0:
        return 0.0
    back = wp.clamp(-covered, 0.0, g[wp.static(SEGMENT["before_most"])])
    on = wp.clamp(
        rx * g[wp.static(SEGMENT["next_x"])] + ry * g[wp.static(SEGMENT["next_y"])] - g[wp.static(SEGMENT["next_0"])],
        0.0,
        g[wp.static(SEGMENT["next_most"])],
    )
    xi = (
        o[wp.static(OBJECT["sign"])]
        * (g[wp.static(SEGMENT["s"])] + al - below + on - back - o[wp.static(OBJECT["s0"])])
        - o[wp.static(OBJECT["half"])]
    )
    b = wp.max(1.0 + wp.min(xi, 0.0) * o[wp.static(OBJECT["inverse_l"])], 0.0)
    K = o[wp.static(OBJECT["M2"])] * wp.max(
        wp.sqrt(lateral) / (wp.max(xi, 0.0) + d0) - o[wp.static(OBJECT["inverse_L"])], 0.0
    )
    v = E_k * wp.log(1.0 + K)
    return b * lateral * v / (1.0 + v / e_max)


@wp.kernel
def naive_static_kernel(lines: wp.array2d(dtype=float), still: wp.array2d(dtype=float), h: float):
    """One thread for each cell, a loop over the segments of all lines."""
    i, j = wp.tid()
    x, y = (float(i) + 0.5) * h, (float(j) + 0.5) * h
    line, barrier = float(0.0), float(0.0)  # noqa: UP018 (to Warp a literal is a constant)
    for k in range(lines.shape[0]):
        g = lines[k]
        if x < g[wp.static(LINE["x_low"])] or x > g[wp.static(LINE["x_high"])]:
            continue
        rx, ry, length = x - g[wp.static(LINE["x"])], y - g[wp.static(LINE["y"])], g[wp.static(LINE["length"])]
        tx, ty = g[wp.static(LINE["tx"])], g[wp.static(LINE["ty"])]
        al, pe = rx * tx + ry * ty, ry * tx - rx * ty
        over = al - wp.clamp(al, 0.0, length)
        d = wp.sqrt(pe * pe + over * over)
        dis = wp.max(d - g[wp.static(LINE["flat"])], 0.0)
        past = (rx - length * tx) * g[wp.static(LINE["next_x"])] + (ry - length * ty) * g[wp.static(LINE["next_y"])]
        covered = (al >= 0.0 and al <= length) or (al > length and past < 0.0)
        side = g[wp.static(LINE["side"])]
        if side != 0.0 and covered and side * pe >= 0.0:
            dis = wp.min(dis, wp.max(d - g[wp.static(LINE["depth"])], 0.0))
        rest = wp.max(g[wp.static(LINE["half_width"])] - dis, 0.0)
        e = g[wp.static(LINE["k_s"])] * rest * rest
        if g[wp.static(LINE["kind"])] > 0.5:
            barrier = wp.max(barrier, e)
        else:
            line = wp.max(line, e)
    still[i, j] = line + barrier


@wp.kernel
def naive_kernel(
    objects: wp.array3d(dtype=float),
    segments: wp.array3d(dtype=float),
    still: wp.array2d(dtype=float),
    volume: wp.array3d(dtype=float),
    h: float, radius: float, start: float, d0: float, E_k: float, e_max: float,
):  # fmt: skip
    """One thread for each cell, a loop over the objects; far objects are skipped by their distance."""
    k, i, j = wp.tid()
    x, y = (float(i) + 0.5) * h, (float(j) + 0.5) * h
    M = still[i, j]
    for n in range(objects.shape[1]):
        o = objects[k, n]
        dx, dy = x - o[wp.static(OBJECT["x"])], y - o[wp.static(OBJECT["y"])]
        d2 = dx * dx + dy * dy
        if d2 < o[wp.static(OBJECT["radius"])] * o[wp.static(OBJECT["radius"])]:
            M += _potential(o, dx, dy, radius, start)
        span = o[wp.static(OBJECT["reach"])] + o[wp.static(OBJECT["half"])] + 2.0 * o[wp.static(OBJECT["width"])]
        if o[wp.static(OBJECT["M2"])] > 0.0 and d2 < span * span:
            most = float(0.0)  # noqa: UP018
            for q in range(int(o[wp.static(OBJECT["first"])]), int(o[wp.static(OBJECT["last"])]) + 1):
                most = wp.max(most, _kinetic(o, segments[n, q], x, y, d0, E_k, e_max))
            M += most
    volume[k, i, j] = M


class NaiveWarp:
    """The plain kernel with its arrays already on the device."""

    def __init__(self, r: Rows, device: str = "cpu") -> None:
        self._r, self._device = r, device
        self._still: Any = wp.empty(r.shape[1:], dtype=float, device=device)
        self._out: Any = wp.empty(r.shape, dtype=float, device=device)

    def __call__(self) -> F32:
        """One frame."""
        r, p = self._r, self._r.p
        objects, segments, lines = (
            wp.array(a, dtype=float, device=self._device) for a in (r.objects, r.segments, r.lines)
        )
        numbers = [r.grid.h, p.taper_radius, p.taper_start, p.d0, p.E_k, p.e_max]
        wp.launch(naive_static_kernel, r.shape[1:], inputs=[lines, self._still, r.grid.h], device=self._device)
        inputs = [objects, segments, self._still, self._out, *numbers]
        wp.launch(naive_kernel, r.shape, inputs=inputs, device=self._device)
        return np.asarray(self._out.numpy())
