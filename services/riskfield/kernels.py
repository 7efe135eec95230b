"""The risk field on the device: one Warp source for `cpu` and `cuda`.

A task is one run of columns of one row of blocks (4 grid rows) of one slice; objects are the outer loop and cells the
inner one, over a local accumulator, so that the compiler can vectorise. The length of a run is a launch parameter: wide
on the CPU, one block on CUDA. All coordinates are the grid's own, so that float32 keeps its digits on any map.

What is left out of a loop is exactly zero there: the potential ends at the taper's radius, the kinetic term at its
horizon and beside its strip, a static line at its half-width. Equations: `common.risk`.
"""

from __future__ import annotations

import warp as wp

OBJECT_FIELDS = (
    "x", "y", "cos", "sin", "half_length", "half_width", "A", "radius", "M2", "inverse_L", "reach", "sign", "s0",
    "length", "width", "kinetic_low", "kinetic_high", "segment_first", "segment_last",
)  # fmt: skip
"""A row of `objects`: one object in one slice, see `services.riskfield.packing`."""
SEGMENT_FIELDS = (
    "x", "y", "tx", "ty", "s", "low", "high", "before_x", "before_y", "turn", "before_most", "next_x", "next_y",
    "next_0", "next_most", "x_low", "x_high",
)  # fmt: skip
"""A row of `segments`: one segment of one object's path."""
LINE_FIELDS = (
    "x", "y", "tx", "ty", "length", "next_x", "next_y", "half_width", "k_s", "flat", "side", "depth", "kind", "index",
    "x_low", "x_high", "along_low", "along_high", "beside_low", "beside_high",
)  # fmt: skip
"""A row of `lines`: one segment of one static line."""
CPU_RUN = 256
"""Longest run of cells for one task on the CPU; CUDA takes one block."""

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
    objects_count: int
    segments_stride: int
    lines_count: int
    run: int
    half: int  # 1: float16 into volume16, 0: float32 into volume32
    paper: int  # 1: the printed kinetic term
    k1: float
    e_max: float
    taper_radius: float
    taper_start: float
    t: float
    d0: float
    E_k: float
    objects: wp.array(dtype=float)  # [slices, objects_count, len(OBJECT_FIELDS)]
    segments: wp.array(dtype=float)  # [objects_count, segments_stride, len(SEGMENT_FIELDS)]
    lines: wp.array(dtype=float)  # [lines_count, len(LINE_FIELDS)]
    static_sum: wp.array(dtype=float)  # [rows, columns]
    static_best: wp.array(dtype=float)  # largest single share
    static_line: wp.array(dtype=int)  # its line, −1: none
    volume16: wp.array(dtype=wp.uint16)  # bits of float16
    volume32: wp.array(dtype=float)
    dominant: wp.array(dtype=int)  # [slices, rows / 4, columns / 4]: 2 o, 2 o + 1, 2 objects_count + line, −1


# y-range of the cells of a row in which `al` and `pe` (along and beside a segment) may lie in their ranges
_WINDOW = """
    auto window = [&](float rx, float tx, float ty, float a0, float a1, float p0, float p1, float& lo, float& hi) {
        lo = -1.0e5f; hi = 1.0e5f;
        if (ty > 1.0e-4f || ty < -1.0e-4f) {
            const float i = 1.0f / ty, u = (a0 - rx * tx) * i, v = (a1 - rx * tx) * i;
            lo = u < v ? u : v; hi = u < v ? v : u;
        } else if (rx * tx < a0 - 1.0f || rx * tx > a1 + 1.0f) { hi = lo; return; }
        if (tx > 1.0e-4f || tx < -1.0e-4f) {
            const float i = 1.0f / tx, u = (p0 + rx * ty) * i, v = (p1 + rx * ty) * i;
            const float l = u < v ? u : v, m = u < v ? v : u;
            lo = l > lo ? l : lo; hi = m < hi ? m : hi;
        } else if (-rx * ty < p0 - 1.0f || -rx * ty > p1 + 1.0f) { hi = lo; return; }
    };
    auto clip = [&](float y0, float y1, int c0, int c1, int& j0, int& j1) {
        const float low = (float)c0, high = (float)c1;
        float a = y0 / p.h - 1.0f, b = y1 / p.h + 1.0f;
        a = a < low ? low : a; a = a > high ? high : a;
        b = b > high ? high : b; b = b < low ? low : b;
        j0 = (int)a; j1 = (int)b + 1; if (j1 > c1) j1 = c1;
        j1 = j0 + (j1 - j0 + W - 1) / W * W;  // whole vectors: what lies beyond is computed and not kept
    };
"""

_MATHS = """
    auto sq = [](float v) { return sqrtf(v); };
    auto ln1p = [](float v) {
#ifdef __CUDA_ARCH__
        return log1pf(v);
#else
        // ln(1 + v), v >= 0, to 1e-7: exponent and a polynomial in the mantissa, so that the loop vectorises
        union { float f; int i; } x; x.f = 1.0f + v;
        int e = (x.i >> 23) - 127;
        x.i = (x.i & 0x7fffff) | 0x3f800000;
        const int big = x.f > 1.41421356f ? 1 : 0;
        const float m = (big ? 0.5f * x.f : x.f) - 1.0f, ef = (float)(e + big), z = m * m;
        float y = 7.0376836292e-2f;
        y = y * m - 1.1514610310e-1f; y = y * m + 1.1676998740e-1f; y = y * m - 1.2420140846e-1f;
        y = y * m + 1.4249322787e-1f; y = y * m - 1.6668057665e-1f; y = y * m + 2.0000714765e-1f;
        y = y * m - 2.4999993993e-1f; y = y * m + 3.3333331174e-1f;
        return m - 0.5f * z + m * z * y + ef * 0.69314718056f;
#endif
    };
    auto max0 = [](float v) { return v > 0.0f ? v : 0.0f; };
"""

# one object's row as plain numbers, so that the loops over cells have nothing to load; both terms at a cell
_TERMS = """
    struct Object {
        float x, y, c, s, half_length, half_width, A, A_e, radius, M2, inverse_L, reach, sign, s0, half, inverse_l;
        float width, inverse_w2, low, high;
        int first, last;
    };
    auto read = [&](const float* q) {
        Object o;
        o.x = q[0]; o.y = q[1]; o.c = q[2]; o.s = q[3]; o.half_length = q[4]; o.half_width = q[5];
        o.A = q[6]; o.A_e = q[6] / p.e_max; o.radius = q[7]; o.M2 = q[8]; o.inverse_L = q[9]; o.reach = q[10];
        o.sign = q[11]; o.s0 = q[12]; o.half = 0.5f * q[13]; o.inverse_l = 1.0f / q[13];
        o.width = q[14]; o.inverse_w2 = 1.0f / (q[14] * q[14]);
        o.low = q[15]; o.high = q[16]; o.first = (int)q[17]; o.last = (int)q[18];
        return o;
    };
    const float taper_z = 1.0f / (p.taper_radius * (1.0f - p.taper_start));
    const float taper_0 = p.taper_start / (1.0f - p.taper_start);
    const float E_k = p.E_k, d0 = p.d0, inverse_e = 1.0f / p.e_max, k1 = p.k1, e_max = p.e_max, horizon = p.t;
    auto tapered = [=](const Object& o, float power, float d) {
        float z = d * taper_z - taper_0; z = z > 0.0f ? z : 0.0f; z = z < 1.0f ? z : 1.0f;
        return o.A * (1.0f - z * z * (3.0f - 2.0f * z)) / (power + o.A_e);
    };
    auto distance2 = [=](const Object& o, float dx, float dy) {
        const float al = o.c * dx + o.s * dy, be = o.c * dy - o.s * dx;
        const float lx = max0((al < 0.0f ? -al : al) - o.half_length), ly = max0((be < 0.0f ? -be : be) - o.half_width);
        return lx * lx + ly * ly;
    };
    auto potential = [=](const Object& o, float dx, float dy) {
        const float d2 = distance2(o, dx, dy), d = sq(d2);
        return tapered(o, square ? d2 : (linear ? d : powf(d, k1)), d);
    };
    struct Segment {
        float x, y, tx, ty, s, low, high, bx, by, turn, before_most, nx, ny, n0, next_most, x_low, x_high;
    };
    auto place = [=](const Object& o, const Segment& g, float rx, float ry, float& s, float& d2) {
        const float al = rx * g.tx + ry * g.ty, pe = ry * g.tx - rx * g.ty;
        const float below = al < g.low ? al - g.low : 0.0f, covered = rx * g.bx + ry * g.by;
        float back = max0(-covered), on = max0(rx * g.nx + ry * g.ny - g.n0);
        back = back < g.before_most ? back : g.before_most; on = on < g.next_most ? on : g.next_most;
        s = g.s + al - below + on - back - o.s0;
        d2 = pe * pe + below * below;
        const float counts = al <= g.high ? 1.0f : 0.0f, met = covered > 0.0f ? 1.0f : 0.0f;
        return counts * (below < 0.0f ? met : 1.0f);
    };
    auto sound = [=](const Object& o, const Segment& g, float rx, float ry) {
        float s, d2;
        const float counts = place(o, g, rx, ry, s, d2), lateral = max0(1.0f - d2 * o.inverse_w2);
        const float xi = o.sign * s - o.half, b = max0(1.0f + (xi < 0.0f ? xi : 0.0f) * o.inverse_l);
        const float K = o.M2 * max0(sq(lateral) / (max0(xi) + d0) - o.inverse_L), v = E_k * ln1p(K);
        return counts * b * lateral * v / (1.0f + v * inverse_e);
    };
    auto printed = [=](const Object& o, const Segment& g, float rx, float ry) {
        float s, d2;
        const float counts = place(o, g, rx, ry, s, d2), root = sq(max0(1.0f - d2 * o.inverse_w2));
        const float ahead = o.sign * s, D_w = ahead / (root > 1.0e-6f ? root : 1.0e-6f), rest = o.reach - D_w;
        if (!(counts > 0.0f && ahead > 0.0f && rest > 0.0f && root > 1.0e-6f)) return 0.0f;
        const float e = horizon / (D_w * rest > 1.0e-9f ? D_w * rest : 1.0e-9f);
        return e < e_max ? e : e_max;
    };
"""

_FIELD = (
    """
#ifdef __CUDA_ARCH__
    const int MOST = 16, W = 1;
#else
    const int MOST = 256, W = 16;
#endif
    const int NO = OBJECT_SIZE, NS = SEGMENT_SIZE;
    const float h = p.h;
    const bool square = p.k1 == 2.0f, linear = p.k1 == 1.0f;
    const int runs = (p.columns + p.run - 1) / p.run, blocks = p.rows / 4;
    const int slice = task / (blocks * runs), block = (task / runs) % blocks;
    const int c0 = (task % runs) * p.run, c1 = c0 + p.run < p.columns ? c0 + p.run : p.columns, cells = c1 - c0;
    const float* objects = p.objects.data + (long long)slice * p.objects_count * NO;
    const int PITCH = MOST + W;
    float acc[4 * PITCH], kin[PITCH];
"""
    + _WINDOW
    + _MATHS
    + _TERMS
    + """
    for (int r = 0; r < 4; ++r) {
        const int row = 4 * block + r;
        const float x = (row + 0.5f) * p.h;
        float* sum = acc + r * PITCH;
        const float* still = p.static_sum.data + (long long)row * p.columns + c0;
        for (int j = 0; j < cells; ++j) sum[j] = still[j];
        for (int j = cells; j < cells + W; ++j) sum[j] = 0.0f;
        for (int n = 0; n < p.objects_count; ++n) {
            const Object o = read(objects + n * NO);
            const float dx = x - o.x, ddx = o.radius * o.radius - dx * dx;
            int j0, j1;
            if (ddx > 0.0f) {
                const float half = sq(ddx);
                clip(o.y - half, o.y + half, c0, c1, j0, j1);
                if (square) {
                    for (int b = j0; b < j1; b += W)
                        for (int j = b; j < b + W; ++j) {
                            const float d2 = distance2(o, dx, (j + 0.5f) * h - o.y);
                            sum[j - c0] += tapered(o, d2, sq(d2));
                        }
                } else {
                    for (int j = j0; j < j1; ++j) sum[j - c0] += potential(o, dx, (j + 0.5f) * h - o.y);
                }
            }
            if (x < o.low || x > o.high) continue;
            const Segment* path = (const Segment*)(p.segments.data + (long long)n * p.segments_stride * NS);
            const float s_low = o.s0 - o.half - (o.sign > 0.0f ? 0.0f : o.reach);
            const float s_high = o.s0 + o.half + (o.sign > 0.0f ? o.reach : 0.0f);
            int low = c1, high = c0;
            for (int k = o.first; k <= o.last; ++k) {
                if (x < path[k].x_low - o.width || x > path[k].x_high + o.width) continue;
                const Segment g = path[k];
                const float rx = x - g.x;
                float a0 = s_low - g.s, a1 = s_high - g.s, y0, y1;
                // inside a bend the shared arc length lies up to its neighbours' turn off the segment's own
                a0 = (a0 - o.width > g.low ? a0 - o.width : g.low) - o.width * g.turn;
                a1 = a1 + o.width < g.high ? a1 + o.width : g.high;
                window(rx, g.tx, g.ty, a0 - 0.01f, a1 + 0.01f, -o.width, o.width, y0, y1);
                if (y0 >= y1) continue;
                clip(g.y + y0, g.y + y1, c0, c1, j0, j1);
                if (j0 >= j1) continue;
                if (low >= high) { low = j0; high = j1; for (int j = j0; j < j1; ++j) kin[j - c0] = 0.0f; }
                for (int j = j0; j < low; ++j) kin[j - c0] = 0.0f;
                for (int j = high; j < j1; ++j) kin[j - c0] = 0.0f;
                low = j0 < low ? j0 : low; high = j1 > high ? j1 : high;
                if (p.paper) {
                    for (int j = j0; j < j1; ++j) {
                        const float e = printed(o, g, rx, (j + 0.5f) * h - g.y);
                        kin[j - c0] = e > kin[j - c0] ? e : kin[j - c0];
                    }
                } else {
                    for (int b = j0; b < j1; b += W)
                        for (int j = b; j < b + W; ++j) {
                            const float e = sound(o, g, rx, (j + 0.5f) * h - g.y);
                            kin[j - c0] = e > kin[j - c0] ? e : kin[j - c0];
                        }
                }
            }
            for (int j = low; j < high; ++j) sum[j - c0] += kin[j - c0];
        }
        const long long at = ((long long)slice * p.rows + row) * p.columns + c0;
        if (p.half) {
            unsigned short* out = (unsigned short*)p.volume16.data + at;
            for (int j = 0; j < cells; ++j) {
                // round to nearest even; every value is >= 0 and below 65504
                union { float f; unsigned int i; } v; v.f = (sum[j] < 6.0e4f ? sum[j] : 6.0e4f) * 1.92592994e-34f;
                out[j] = (unsigned short)((v.i + 0xfffu + ((v.i >> 13) & 1u)) >> 13);
            }
        } else {
            float* out = p.volume32.data + at;
            for (int j = 0; j < cells; ++j) out[j] = sum[j] < 6.0e4f ? sum[j] : 6.0e4f;
        }
    }

    // the source with the largest share at each block's highest cell
    const int bs = (cells + 3) / 4;
    float bx[MOST / 4 + W], by[MOST / 4 + W], best[MOST / 4 + W];
    int id[MOST / 4 + W];
    for (int b = bs; b < bs + W; ++b) { bx[b] = by[b] = best[b] = 0.0f; id[b] = -1; }
    for (int b = 0; b < bs; ++b) {
        float top = -1.0f; int tr = 0, tc = 0;
        for (int r = 0; r < 4; ++r)
            for (int c = 4 * b; c < 4 * b + 4 && c < cells; ++c)
                if (acc[r * PITCH + c] > top) { top = acc[r * PITCH + c]; tr = r; tc = c; }
        const long long at = (long long)(4 * block + tr) * p.columns + c0 + tc;
        bx[b] = (4 * block + tr + 0.5f) * p.h; by[b] = (c0 + tc + 0.5f) * p.h;
        best[b] = p.static_best.data[at];
        id[b] = best[b] > 0.0f ? 2 * p.objects_count + p.static_line.data[at] : -1;
    }
    const float x_mid = (4 * block + 2) * p.h;
    for (int n = 0; n < p.objects_count; ++n) {
        const Object o = read(objects + n * NO);
        float dx = x_mid - o.x; dx = max0((dx < 0.0f ? -dx : dx) - 2.0f * h);
        const float ddx = o.radius * o.radius - dx * dx;
        int j0, j1;
        if (ddx > 0.0f) {
            const float half = sq(ddx);
            clip(o.y - half, o.y + half, c0, c1, j0, j1);
            const int b0 = (j0 - c0) / 4, b1 = (j1 - c0 + 3) / 4 < bs ? (j1 - c0 + 3) / 4 : bs;
            if (square) {
                for (int c = b0; c < b1; c += W)
                    for (int b = c; b < c + W; ++b) {
                        const float d2 = distance2(o, bx[b] - o.x, by[b] - o.y), e = tapered(o, d2, sq(d2));
                        id[b] = e > best[b] ? 2 * n : id[b]; best[b] = e > best[b] ? e : best[b];
                    }
            } else {
                for (int b = b0; b < b1; ++b) {
                    const float e = potential(o, bx[b] - o.x, by[b] - o.y);
                    id[b] = e > best[b] ? 2 * n : id[b]; best[b] = e > best[b] ? e : best[b];
                }
            }
        }
        if (x_mid + 2.0f * h < o.low || x_mid - 2.0f * h > o.high) continue;
        const Segment* path = (const Segment*)(p.segments.data + (long long)n * p.segments_stride * NS);
        for (int k = o.first; k <= o.last; ++k) {
            if (x_mid + 2.0f * h < path[k].x_low - o.width || x_mid - 2.0f * h > path[k].x_high + o.width) continue;
            const Segment g = path[k];
            // the blocks a segment may reach: its own extent, widened by the strip
            float a0 = g.low - o.width * g.turn, a1 = g.high;
            const float span = o.half + o.reach + o.width, s_low = o.s0 - span - g.s, s_high = o.s0 + span - g.s;
            a0 = a0 > s_low ? a0 : s_low; a1 = a1 < s_high ? a1 : s_high;
            const float xa = g.x + a0 * g.tx, xb = g.x + a1 * g.tx, ya = g.y + a0 * g.ty, yb = g.y + a1 * g.ty;
            if ((xa < xb ? xb : xa) + o.width < x_mid - 2.0f * h) continue;
            if ((xa < xb ? xa : xb) - o.width > x_mid + 2.0f * h) continue;
            clip((ya < yb ? ya : yb) - o.width, (ya < yb ? yb : ya) + o.width, c0, c1, j0, j1);
            const int b0 = (j0 - c0) / 4, b1 = (j1 - c0 + 3) / 4 < bs ? (j1 - c0 + 3) / 4 : bs;
            if (p.paper) {
                for (int b = b0; b < b1; ++b) {
                    const float e = printed(o, g, bx[b] - g.x, by[b] - g.y);
                    id[b] = e > best[b] ? 2 * n + 1 : id[b]; best[b] = e > best[b] ? e : best[b];
                }
            } else {
                for (int c = b0; c < b1; c += W)
                    for (int b = c; b < c + W; ++b) {
                        const float e = sound(o, g, bx[b] - g.x, by[b] - g.y);
                        id[b] = e > best[b] ? 2 * n + 1 : id[b]; best[b] = e > best[b] ? e : best[b];
                    }
            }
        }
    }
    const int block_columns = (p.columns + 3) / 4;
    int* named = p.dominant.data + ((long long)slice * blocks + block) * block_columns + c0 / 4;
    for (int b = 0; b < bs; ++b) named[b] = id[b];
"""
)

_STATIC = (
    """
#ifdef __CUDA_ARCH__
    const int MOST = 16, W = 1;
#else
    const int MOST = 256, W = 16;
#endif
    const int NL = LINE_SIZE;
    const int runs = (p.columns + p.run - 1) / p.run, row = task / runs;
    const int c0 = (task % runs) * p.run, c1 = c0 + p.run < p.columns ? c0 + p.run : p.columns;
    const float x = (row + 0.5f) * p.h;
    const int PITCH = MOST + W;
    float best[2 * PITCH];
    int line[2 * PITCH];
"""
    + _WINDOW
    + _MATHS
    + """
    for (int j = 0; j < 2 * PITCH; ++j) { best[j] = 0.0f; line[j] = -1; }
    for (int k = 0; k < p.lines_count; ++k) {
        const float* g = p.lines.data + k * NL;
        if (x < g[14] || x > g[15]) continue;
        const float rx = x - g[0];
        float y0, y1;
        window(rx, g[2], g[3], g[16], g[17], g[18], g[19], y0, y1);
        if (y0 >= y1) continue;
        int j0, j1; clip(g[1] + y0, g[1] + y1, c0, c1, j0, j1);
        float* top = best + (g[12] > 0.5f ? PITCH : 0);
        int* name = line + (g[12] > 0.5f ? PITCH : 0);
        const int index = (int)g[13];
        for (int j = j0; j < j1; ++j) {
            const float ry = (j + 0.5f) * p.h - g[1];
            const float al = rx * g[2] + ry * g[3], pe = ry * g[2] - rx * g[3];
            const float over = al < 0.0f ? al : (al > g[4] ? al - g[4] : 0.0f);
            const float d = sq(pe * pe + over * over);
            float dis = max0(d - g[9]);
            const float nx = rx - g[4] * g[2], ny = ry - g[4] * g[3];
            const bool covered = (al >= 0.0f && al <= g[4]) || (al > g[4] && nx * g[5] + ny * g[6] < 0.0f);
            const float far = max0(d - g[11]);
            dis = (g[10] != 0.0f && covered && g[10] * pe >= 0.0f && far < dis) ? far : dis;
            const float rest = max0(g[7] - dis), e = g[8] * rest * rest;
            name[j - c0] = e > top[j - c0] ? index : name[j - c0];
            top[j - c0] = e > top[j - c0] ? e : top[j - c0];
        }
    }
    for (int j = c0; j < c1; ++j) {
        const long long at = (long long)row * p.columns + j;
        const float a = best[j - c0], b = best[j - c0 + PITCH];
        p.static_sum.data[at] = a + b;
        p.static_best.data[at] = a > b ? a : b;
        p.static_line.data[at] = a > b ? line[j - c0] : line[j - c0 + PITCH];
    }
"""
)


def _sized(snippet: str) -> str:
    for name, fields in (("OBJECT", OBJECT_FIELDS), ("SEGMENT", SEGMENT_FIELDS), ("LINE", LINE_FIELDS)):
        snippet = snippet.replace(f"{name}_SIZE", str(len(fields)))
    return snippet


@wp.func_native(_sized(_FIELD))
def field_run(p: Volume, task: int):
    """One task of `field_kernel`."""


@wp.func_native(_sized(_STATIC))
def static_run(p: Volume, task: int):
    """One task of `static_kernel`."""


@wp.kernel
def field_kernel(p: Volume, first: int):
    """M and `dominant` of one run of one row of blocks of one slice, from task `first` on; needs `static_kernel`."""
    task = wp.tid()
    field_run(p, first + task)  # type: ignore[operator]


@wp.kernel
def static_kernel(p: Volume):
    """The static layer of one run of one row, the same for every slice."""
    static_run(p, wp.tid())
