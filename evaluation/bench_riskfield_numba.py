"""The risk field in numba, as fast as we could write it: parallel, fastmath, two levels, windows around every term.

It takes the same short cuts as our kernels: the far potential from nodes a metre apart, exact values near the bodies,
paths placed once for all slices, a logarithm that vectorises. The extra `bench` brings numba.
"""

from __future__ import annotations

import math

import numba as nb
import numpy as np

from common.messages import F32
from evaluation.bench_riskfield_naive import LINE, OBJECT, SEGMENT
from evaluation.bench_riskfield_rivals import Rows
from services.riskfield.packing import nodes_every

X, Y, C, SN, HL, HW, A, AE, R, NEAR, NEAR_X, Q0, F0, F1, F2, F3 = (
    OBJECT[k]
    for k in (
        "x", "y", "cos", "sin", "half_length", "half_width", "A", "A_e", "radius", "near", "near_x", "q0", "f0", "f1",
        "f2", "f3",
    )
)  # fmt: skip
M2, IL, REACH, SIGN, S0, HALF, INV_L, WIDTH, INV_W2, LOW, HIGH, FIRST, LAST = (
    OBJECT[k]
    for k in (
        "M2", "inverse_L", "reach", "sign", "s0", "half", "inverse_l", "width", "inverse_w2", "low", "high", "first",
        "last",
    )
)  # fmt: skip
GX, GY, TX, TY, GS, GLOW, GHIGH, BX, BY, TURN, BMOST, NX, NY, N0, NMOST, XLOW, XHIGH, BENT = (
    SEGMENT[k]
    for k in (
        "x", "y", "tx", "ty", "s", "low", "high", "before_x", "before_y", "turn", "before_most", "next_x", "next_y",
        "next_0", "next_most", "x_low", "x_high", "bent",
    )
)  # fmt: skip
LX, LY, LTX, LTY, LLEN, LNX, LNY, LHALF, LK, LFLAT, LSIDE, LDEPTH, LKIND, LXLOW, LXHIGH, LA0, LA1, LB0, LB1 = (
    LINE[k]
    for k in (
        "x", "y", "tx", "ty", "length", "next_x", "next_y", "half_width", "k_s", "flat", "side", "depth", "kind",
        "x_low", "x_high", "along_low", "along_high", "beside_low", "beside_high",
    )
)  # fmt: skip
ZERO, ONE = np.float32(0.0), np.float32(1.0)
F = nb.float32
fast = nb.njit(fastmath=True, inline="always", error_model="numpy")


@fast
def _distance2(c, s, hl, hw, dx, dy):
    lx = max(abs(c * dx + s * dy) - hl, ZERO)
    ly = max(abs(c * dy - s * dx) - hw, ZERO)
    return lx * lx + ly * ly


@fast
def _taper(d, radius, start):
    z = min(max((d / radius - start) / (ONE - start), ZERO), ONE)
    return ONE - z * z * (F(3.0) - F(2.0) * z)


@fast
def _weights(t):
    return (
        -t * (t - ONE) * (t - F(2)) / F(6), (t + ONE) * (t - ONE) * (t - F(2)) / F(2),
        -(t + ONE) * t * (t - F(2)) / F(2), (t + ONE) * t * (t - ONE) / F(6),
    )  # fmt: skip


@nb.njit(parallel=True, fastmath=True, error_model="numpy", cache=True)
def _far(objects, far, h, ratio, radius, start):
    """The smooth far field of every slice at the nodes, brought to the columns of the fine grid."""
    slices, rows, columns = far.shape
    H = h * F(ratio)
    count = (columns - 1) // ratio + 5
    for task in nb.prange(slices * rows):
        k, m = task // rows, task % rows
        nodes = np.zeros(count, dtype=np.float32)
        x = F(m - 1) * H
        for n in range(objects.shape[1]):
            o = objects[k, n]
            dx = x - o[X]
            rest = o[R] * o[R] - dx * dx
            if rest <= ZERO:
                continue
            half = math.sqrt(rest)
            i0 = max(math.floor((o[Y] - half) / H) + 1, 0)
            i1 = min(math.floor((o[Y] + half) / H) + 2, count)
            oy, c, s, hl, hw, a, ae, q0 = o[Y], o[C], o[SN], o[HL], o[HW], o[A], o[AE], o[Q0]
            f1, f2, f3 = o[F1], o[F2], o[F3]
            for i in range(i0, i1):
                q = _distance2(c, s, hl, hw, dx, F(i - 1) * H - oy)
                z = min(q - q0, ZERO)
                share = a / (max(q, q0) + ae) + z * (f1 + z * (f2 + z * f3))
                nodes[i] += share * _taper(math.sqrt(q), radius, start)
        out = far[k, m]
        for i in range(ratio):
            a0, a1, a2, a3 = _weights(F(i + 0.5) / F(ratio))
            for b in range((columns - i + ratio - 1) // ratio):
                out[b * ratio + i] = a0 * nodes[b] + a1 * nodes[b + 1] + a2 * nodes[b + 2] + a3 * nodes[b + 3]


@fast
def _window(rx, tx, ty, a0, a1, p0, p1):
    """y-range in which a place along and one beside a direction may lie in their ranges."""
    lo, hi = F(-1e5), F(1e5)
    if abs(ty) > F(1e-4):
        u, v = (a0 - rx * tx) / ty, (a1 - rx * tx) / ty
        lo, hi = min(u, v), max(u, v)
    elif rx * tx < a0 - ONE or rx * tx > a1 + ONE:
        hi = lo
    if abs(tx) > F(1e-4):
        u, v = (p0 + rx * ty) / tx, (p1 + rx * ty) / tx
        lo, hi = max(lo, min(u, v)), min(hi, max(u, v))
    elif -rx * ty < p0 - ONE or -rx * ty > p1 + ONE:
        hi = lo
    return lo, hi


@nb.njit(parallel=True, fastmath=True, error_model="numpy", cache=True)
def _static(lines, still, h):
    """Lines and barriers, each segment in its window; the nearest of each kind counts."""
    rows, columns = still.shape
    for row in nb.prange(rows):
        x = (F(row) + F(0.5)) * h
        kinds = np.zeros((2, columns), dtype=np.float32)
        for k in range(len(lines)):
            g = lines[k]
            if x < g[LXLOW] or x > g[LXHIGH]:
                continue
            rx, tx, ty, length, side = x - g[LX], g[LTX], g[LTY], g[LLEN], g[LSIDE]
            y0, y1 = _window(rx, tx, ty, g[LA0], g[LA1], g[LB0], g[LB1])
            if y0 >= y1:
                continue
            j0 = min(max(int((y0 + g[LY]) / h), 0), columns)
            j1 = min(max(int((y1 + g[LY]) / h + ONE), 0), columns)
            top = kinds[1 if g[LKIND] > F(0.5) else 0]
            for j in range(j0, j1):
                ry = (F(j) + F(0.5)) * h - g[LY]
                al, pe = rx * tx + ry * ty, ry * tx - rx * ty
                over = al - min(max(al, ZERO), length)
                d = math.sqrt(pe * pe + over * over)
                dis = max(d - g[LFLAT], ZERO)
                past = (rx - length * tx) * g[LNX] + (ry - length * ty) * g[LNY]
                covered = (al >= ZERO and al <= length) or (al > length and past < ZERO)
                if side != ZERO and covered and side * pe >= ZERO:
                    dis = min(dis, max(d - g[LDEPTH], ZERO))
                rest = max(g[LHALF] - dis, ZERO)
                top[j] = max(top[j], g[LK] * rest * rest)
        for j in range(columns):
            still[row, j] = kinds[0, j] + kinds[1, j]


@nb.njit(parallel=True, fastmath=True, error_model="numpy", cache=True)
def _field(objects, segments, still, far, volume, h, ratio, d0, E_k, e_max):
    slices, rows, columns = volume.shape
    count = objects.shape[1]
    for row in nb.prange(rows):
        x = (F(row) + F(0.5)) * h
        acc = np.empty((slices, columns), dtype=np.float32)
        best = np.zeros((slices, columns), dtype=np.float32)
        s_at, d2_at, counts = (
            np.empty(columns, np.float32),
            np.empty(columns, np.float32),
            np.empty(columns, np.float32),
        )
        K = np.empty(columns, dtype=np.float32)
        gone = np.empty(columns, dtype=np.float32)
        power = np.empty(columns, dtype=np.int32)
        mantissa = np.empty(columns, dtype=np.float32)
        bits, out_bits = K.view(np.int32), mantissa.view(np.int32)
        m = int((F(row) + F(0.5)) / F(ratio))
        w0, w1, w2, w3 = _weights((F(row) + F(0.5)) / F(ratio) - F(m))
        for k in range(slices):
            a, b, c_, d, sum_ = far[k, m], far[k, m + 1], far[k, m + 2], far[k, m + 3], acc[k]
            for j in range(columns):
                sum_[j] = still[row, j] + max(w0 * a[j] + w1 * b[j] + w2 * c_[j] + w3 * d[j], ZERO)
            for n in range(count):
                o = objects[k, n]
                dx = x - o[X]
                if abs(dx) >= o[NEAR_X]:
                    continue
                al, be = o[HL] + o[NEAR], o[HW] + o[NEAR]
                y0, y1 = _window(dx, o[C], o[SN], -al, al, -be, be)
                if y0 >= y1:
                    continue
                j0 = min(max(int((y0 + o[Y]) / h), 0), columns)
                j1 = min(max(int((y1 + o[Y]) / h + ONE), 0), columns)
                oy, c, s, hl, hw, am, ae, q0 = o[Y], o[C], o[SN], o[HL], o[HW], o[A], o[AE], o[Q0]
                f0, f1, f2, f3 = o[F0], o[F1], o[F2], o[F3]
                for j in range(j0, j1):
                    q = min(_distance2(c, s, hl, hw, dx, (F(j) + F(0.5)) * h - oy), q0)
                    z = q - q0
                    sum_[j] += am / (q + ae) - f0 - z * (f1 + z * (f2 + z * f3))
        for n in range(count):
            first, last, width, low, high = segments.shape[1], -1, ZERO, F(1e9), F(-1e9)
            for k in range(slices):
                o = objects[k, n]
                if x < o[LOW] or x > o[HIGH]:
                    continue
                first, last, width = min(first, int(o[FIRST])), max(last, int(o[LAST])), max(width, o[WIDTH])
                low = min(low, o[S0] - o[HALF] - (ZERO if o[SIGN] > ZERO else o[REACH]))
                high = max(high, o[S0] + o[HALF] + (o[REACH] if o[SIGN] > ZERO else ZERO))
            from_, upto = columns, 0
            for q_ in range(first, last + 1):
                g = segments[n, q_]
                if x < g[XLOW] - width or x > g[XHIGH] + width:
                    continue
                slack = width * g[BENT]
                a0 = max(low - g[GS] - slack, g[GLOW]) - width * g[TURN] - F(0.01)
                a1 = min(high - g[GS] + slack, g[GHIGH]) + F(0.01)
                if a0 >= a1:
                    continue
                rx = x - g[GX]
                y0, y1 = _window(rx, g[TX], g[TY], a0, a1, -width, width)
                if y0 >= y1:
                    continue
                j0 = min(max(int((y0 + g[GY]) / h), 0), columns)
                j1 = min(max(int((y1 + g[GY]) / h + ONE), 0), columns)
                if j0 >= j1:
                    continue
                from_, upto = min(from_, j0), max(upto, j1)
                gy, tx, ty, gs, glow, ghigh = g[GY], g[TX], g[TY], g[GS], g[GLOW], g[GHIGH]
                bx, by, bmost, nx, ny, n0, nmost = g[BX], g[BY], g[BMOST], g[NX], g[NY], g[N0], g[NMOST]
                for j in range(j0, j1):
                    ry = (F(j) + F(0.5)) * h - gy
                    al, pe = rx * tx + ry * ty, ry * tx - rx * ty
                    below, covered = min(al - glow, ZERO), rx * bx + ry * by
                    back, on = min(max(-covered, ZERO), bmost), min(max(rx * nx + ry * ny - n0, ZERO), nmost)
                    s_at[j] = gs + al - below + on - back
                    d2_at[j] = pe * pe + below * below
                    counts[j] = (ONE if al <= ghigh else ZERO) * (
                        ONE if below >= ZERO else (ONE if covered > ZERO else ZERO)
                    )
                s_low, s_high = gs + a0 - slack, gs + a1 + slack
                for k in range(slices):
                    o = objects[k, n]
                    o_low = o[S0] - o[HALF] - (ZERO if o[SIGN] > ZERO else o[REACH])
                    o_high = o[S0] + o[HALF] + (o[REACH] if o[SIGN] > ZERO else ZERO)
                    if x < o[LOW] or x > o[HIGH] or s_high < o_low or s_low > o_high:
                        continue
                    m2, il, sign, s0, half, inv_l, iw2 = o[M2], o[IL], o[SIGN], o[S0], o[HALF], o[INV_L], o[INV_W2]
                    for j in range(j0, j1):
                        lateral = max(ONE - d2_at[j] * iw2, ZERO)
                        xi = sign * (s_at[j] - s0) - half
                        D = max(xi, ZERO) + d0
                        K[j] = ONE + m2 * max(lateral / math.sqrt(lateral * D * D + F(1e-20)) - il, ZERO)
                        gone[j] = counts[j] * lateral * max(ONE + min(xi, ZERO) * inv_l, ZERO)
                    for j in range(j0, j1):
                        e = (bits[j] - np.int32(0x3F2AAAAB)) >> np.int32(23)
                        power[j] = e
                        out_bits[j] = bits[j] - (e << np.int32(23))
                    row_best = best[k]
                    for j in range(j0, j1):
                        z = mantissa[j] - ONE
                        ln = F(0.17447373270988464)
                        ln = ln * z - F(0.1968492865562439)
                        ln = ln * z + F(0.19730514287948608)
                        ln = ln * z - F(0.2479877918958664)
                        ln = ln * z + F(0.3334149122238159)
                        ln = ln * z - F(0.5000371336936951)
                        ln = ln * z + F(0.9999994039535522)
                        v = E_k * (ln * z + F(power[j]) * F(0.69314718056))
                        row_best[j] = max(row_best[j], gone[j] * v / (ONE + v / e_max))
            for k in range(slices):
                sum_, row_best = acc[k], best[k]
                for j in range(from_, upto):
                    sum_[j] += row_best[j]
                    row_best[j] = ZERO
        for k in range(slices):
            for j in range(columns):
                volume[k, row, j] = acc[k, j]


class NumbaField:
    """The rival with its buffers kept."""

    def __init__(self, r: Rows) -> None:
        self._r, self._ratio = r, nodes_every(r.grid.h)
        self._far = np.empty((len(r.objects), (r.grid.rows - 1) // self._ratio + 5, r.grid.columns), np.float32)
        self._still = np.empty(r.shape[1:], np.float32)
        self._out = np.empty(r.shape, np.float32)

    def __call__(self) -> F32:
        """One frame."""
        r, p, far, still = self._r, self._r.p, self._far, self._still
        h, f4 = np.float32(r.grid.h), np.float32
        _static(r.lines, still, h)
        _far(r.objects, far, h, self._ratio, f4(p.taper_radius), f4(p.taper_start))
        _field(r.objects, r.segments, still, far, self._out, h, self._ratio, f4(p.d0), f4(p.E_k), f4(p.e_max))
        return self._out
