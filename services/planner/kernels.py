"""The planner's hot loops as Warp kernels on the CPU: looking paths up, where contact is, rolling motions out.

The NumPy forms in `footprint.py` and `rollout.py` are the reference; a test holds that both give the same. Importing
this module compiles nothing; the first launch does (seconds when the cache is cold). Arrays are handed over by address:
building Warp's own array objects would take longer than the kernels do.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import warp as wp

from common.kernel_cache import kernel_cache
from common.messages import BLOCK
from services.planner.volume import Volume

F32 = npt.NDArray[np.float32]
F64 = npt.NDArray[np.float64]
U8 = npt.NDArray[np.uint8]
I32 = npt.NDArray[np.int32]
Integers = npt.NDArray[np.integer[Any]]

_CHUNK = 16
"""So many points of a path are looked up at a time: CHUNK in the kernel."""
MOST_SAMPLES = 128
"""So many samples of the outline are looked up at most."""

wp.config.log_level = wp.LOG_ERROR
wp.set_module_options({"enable_backward": False, "cpu_compiler_flags": "-march=native -w"})


@wp.struct
class LookUp:
    """Paths to look up; addresses of flat arrays, C order. Samples of the outline stand group by group."""

    slices: int  # from `first` on
    first: int
    rows: int
    columns: int
    block: int  # cells to a block of `dominant`
    block_columns: int
    block_plane: int
    samples: int
    padded: int  # the next multiple of 8
    groups: int
    later: int  # the last slice of `stays`, counted from `first`
    half: int  # 1: the volume is float16
    timed: int  # 1: each point in one slice only
    paths: int
    points: int
    r_hit: float  # from here on the source of a contact is looked up
    r0: float  # and from here on the source of a risk beside
    volume: wp.uint64  # of uint16 or float
    dominant: wp.uint64  # uint8 [slices, blocks, blocks]
    who_of: wp.uint64  # uint8 [256]: source of each slot
    x: wp.uint64  # double [n, points]: rear axle in grid coordinates [cells]
    y: wp.uint64
    cos: wp.uint64  # of the heading in the grid, per cell of h
    sin: wp.uint64
    outline_x: wp.uint64  # double [padded]: of the outline, frame of the rear axle [m]
    outline_y: wp.uint64
    begin: wp.uint64  # int [groups + 1]: of each group's samples
    outline: wp.uint64  # uint8 [padded]: whether it is of the outline, which must be known
    taken: wp.uint64  # float [2, groups, 8]: off each group for the four and `risk`; the second where the path leaves
    leaves: wp.uint64  # uint8 [n]
    slice_of: wp.uint64  # int [points], if timed
    risk: wp.uint64  # float [n, slices, points]
    stays: wp.uint64  # float [n, points]
    whole: wp.uint64  # uint8 [n, points]
    four: wp.uint64  # float [4, n, slices, points]: contact, contact ahead, left, right
    who: wp.uint64  # uint8 [4, n, slices, points]: of the four


_LOOK_UP = """
    typedef float v8f __attribute__((vector_size(32)));
    typedef unsigned int v8u __attribute__((vector_size(32)));
    const int CHUNK = 16, K = p.padded;  // samples are padded to whole vectors with weights of 0
    const int path = task % p.paths, from = task / p.paths * CHUNK;  // chunk by chunk: paths share what they read
    int cell[16 * 128];
    alignas(32) float w00[16 * 128], w01[16 * 128], w10[16 * 128], w11[16 * 128], least[16 * 128];
    const long long plane = (long long)p.rows * p.columns;
    const double* px = (const double*)p.x; const double* py = (const double*)p.y;
    const double* cosine = (const double*)p.cos; const double* sine = (const double*)p.sin;
    const double* outline_x = (const double*)p.outline_x; const double* outline_y = (const double*)p.outline_y;
    const int* begin = (const int*)p.begin; const int* slice_of = (const int*)p.slice_of;
    const unsigned char* outline = (const unsigned char*)p.outline;
    const float* taken = (const float*)p.taken + (((const unsigned char*)p.leaves)[path] ? 8 * p.groups : 0);
    const unsigned char* dominant = (const unsigned char*)p.dominant + (long long)p.first * p.block_plane;
    const unsigned char* who_of = (const unsigned char*)p.who_of;
    const int kept = p.timed ? 1 : p.slices;
    const long long all = (long long)p.paths * kept * p.points;
    // float16: every value is >= 0 and finite: its bits, moved, are the value / 2^112
    const float scale = p.half ? 5.192296858534828e33f : 1.0f;
    const int n = p.points - from < CHUNK ? p.points - from : CHUNK;
    for (int q = 0; q < n; ++q) {
        const long long point = (long long)path * p.points + from + q;
        const double x = px[point], y = py[point], co = cosine[point], si = sine[point];
        const double rows = p.rows, columns = p.columns;
        int missing = 0;
        for (int k = 0; k < K; ++k) {
            const int at = q * K + k;
            const double fi = x + co * outline_x[k] - si * outline_y[k];
            const double fj = y + si * outline_x[k] + co * outline_y[k];
            const bool in = (fi >= 0.0) & (fi <= rows) & (fj >= 0.0) & (fj <= columns);
            missing += !in & outline[k];
            double gi = fi - 0.5, gj = fj - 0.5;
            gi = gi > 0.0 ? gi : 0.0; gi = gi < rows - 1.0 ? gi : rows - 1.0;
            gj = gj > 0.0 ? gj : 0.0; gj = gj < columns - 1.0 ? gj : columns - 1.0;
            int i = (int)gi, j = (int)gj;
            i = i < p.rows - 2 ? i : p.rows - 2; j = j < p.columns - 2 ? j : p.columns - 2;
            const float wi = (float)(gi - i), wj = (float)(gj - j);
            const float part = in & (k < p.samples) ? scale : 0.0f;
            cell[at] = i * p.columns + j;
            w00[at] = part * (1.0f - wi) * (1.0f - wj); w01[at] = part * (1.0f - wi) * wj;
            w10[at] = part * wi * (1.0f - wj); w11[at] = part * wi * wj;
            least[at] = 3e38f;
        }
        ((unsigned char*)p.whole)[point] = missing == 0;
    }
    for (int j = 0; j < p.slices; ++j) {
        const unsigned short* volume16 = (const unsigned short*)p.volume + (p.first + j) * plane;
        const float* volume32 = (const float*)p.volume + (p.first + j) * plane;
        for (int q = 0; q < n; ++q) {
            if (p.timed && slice_of[from + q] != j) continue;
            alignas(32) float value[128];
            float high[128];
            for (int k = q * K; k < (q + 1) * K; k += 8) {
                v8f a, b, c, d;
                if (p.half) {
                    v8u near, far;  // two neighbours of a row at once
                    for (int l = 0; l < 8; ++l) {
                        unsigned int two;
                        __builtin_memcpy(&two, volume16 + cell[k + l], 4); near[l] = two;
                        __builtin_memcpy(&two, volume16 + cell[k + l] + p.columns, 4); far[l] = two;
                    }
                    a = (v8f)((near & 0xffffu) << 13); b = (v8f)(near >> 16 << 13);
                    c = (v8f)((far & 0xffffu) << 13); d = (v8f)(far >> 16 << 13);
                } else {
                    for (int l = 0; l < 8; ++l) {
                        const float* m = volume32 + cell[k + l];
                        a[l] = m[0]; b[l] = m[1]; c[l] = m[p.columns]; d[l] = m[p.columns + 1];
                    }
                }
                const v8f v = a * *(v8f*)(w00 + k) + b * *(v8f*)(w01 + k) + c * *(v8f*)(w10 + k)
                    + d * *(v8f*)(w11 + k);
                *(v8f*)(value + k - q * K) = v;
                if (j <= p.later) *(v8f*)(least + k) = __builtin_elementwise_min(v, *(v8f*)(least + k));
            }
            v8f most = {0.0f, 0.0f, 0.0f, 0.0f, 0.0f, 0.0f, 0.0f, 0.0f};
            for (int g = 0; g < p.groups; ++g) {
                float h = 0.0f;
                for (int k = begin[g]; k < begin[g + 1]; ++k) h = value[k] > h ? value[k] : h;
                high[g] = h;
                v8f off;
                __builtin_memcpy(&off, taken + 8 * g, 32);
                most = __builtin_elementwise_max(h - off, most);
            }
            const long long out = ((long long)path * kept + (p.timed ? 0 : j)) * p.points + from + q;
            ((float*)p.risk)[out] = most[4];
            for (int w = 0; w < 4; ++w) {
                ((float*)p.four)[w * all + out] = most[w];
                int name = 255;
                if (most[w] >= (w < 2 ? p.r_hit : p.r0)) {  // whose it is: the block of the sample that met it
                    int g = 0;
                    while (g + 1 < p.groups && high[g] - taken[8 * g + w] < most[w]) ++g;
                    int best = begin[g];
                    for (int k = best; k < begin[g + 1]; ++k) best = value[k] > value[best] ? k : best;
                    const long long point = (long long)path * p.points + from + q;
                    const double fi = px[point] + cosine[point] * outline_x[best] - sine[point] * outline_y[best];
                    const double fj = py[point] + sine[point] * outline_x[best] + cosine[point] * outline_y[best];
                    const int i = (int)fi < p.rows ? (int)fi : p.rows - 1;
                    const int c = (int)fj < p.columns ? (int)fj : p.columns - 1;
                    name = who_of[dominant[(long long)j * p.block_plane
                        + i / p.block * p.block_columns + c / p.block]];
                }
                ((unsigned char*)p.who)[w * all + out] = name;
            }
        }
    }
    for (int q = 0; q < n; ++q) {
        float stays = 0.0f;
        for (int g = 0; g < p.groups; ++g)
            for (int k = begin[g]; k < begin[g + 1]; ++k) {
                const float left = least[q * K + k] - taken[8 * g];
                stays = left > stays ? left : stays;
            }
        ((float*)p.stays)[(long long)path * p.points + from + q] = stays;
    }
"""


@wp.func_native(_LOOK_UP)
def look_up_chunk(p: LookUp, task: int):  # noqa: D103
    ...


@wp.kernel
def look_up_kernel(p: LookUp):
    """The footprint's maximum along a part of one path, in every slice."""
    look_up_chunk(p, wp.tid())


@wp.struct
class Roll:
    """Motions to roll out; see `rollout.roll_out` for the meaning of each value."""

    steps: int
    points: int
    slices: int
    soft: int
    tier: int
    step: wp.float64
    dt: wp.float64
    speed: wp.float64
    acceleration: wp.float64
    look: wp.float64
    gain: wp.float64
    down: wp.float64
    up_brake: wp.float64
    up_gas: wp.float64
    up_comfort: wp.float64
    brake: wp.float64
    accel: wp.float64
    hard: wp.float64  # decelerations beyond this are let go fast [m/s²]
    jerk: wp.float64
    hold_s: wp.float64
    clear: wp.float64
    soft_after: wp.float64
    lateral: wp.float64  # largest lateral acceleration [m/s²]
    until: wp.float64  # checks end here [s]
    headway: wp.float64
    ease: wp.float64
    ease_s: wp.float64
    gap: wp.float64
    stop_brake: wp.float64
    slice_of: wp.uint64  # int [steps + 1]
    into: wp.uint64  # double [steps + 1]: how far into its slice each step is [s]
    path: wp.uint64  # int [K]
    target: wp.uint64  # double [K]
    hold: wp.uint64  # double [K]
    hit: wp.uint64  # double [n, S, p], as the next ones
    rate: wp.uint64
    hit_ahead: wp.uint64
    rate_ahead: wp.uint64
    away: wp.uint64
    law: wp.uint64
    law_now: wp.uint64
    stays: wp.uint64  # double [n, p]
    cap_squared: wp.uint64  # double [n, p]
    bend: wp.uint64  # double [n, p]
    end: wp.uint64  # double [n]
    s: wp.uint64  # double [K, steps + 1], as the next ones
    v: wp.uint64
    a: wp.uint64
    failure: wp.uint64  # int [K]
    failed_at: wp.uint64  # int [K]


_ROLL = """
    const int n = p.steps, path = ((const int*)p.path)[k];
    const double target = ((const double*)p.target)[k], hold = ((const double*)p.hold)[k];
    const double* cap2 = (const double*)p.cap_squared + (long long)path * p.points;
    const double inverse = 1.0 / p.step, last = p.points - 1.001;
    double s = 0.0, v = p.speed, a = p.acceleration;
    double* out_s = (double*)p.s + (long long)k * (n + 1);
    double* out_v = (double*)p.v + (long long)k * (n + 1);
    double* out_a = (double*)p.a + (long long)k * (n + 1);
    const double* hits = (const double*)(p.soft ? p.hit : p.hit_ahead);
    const double* rates = (const double*)(p.soft ? p.rate : p.rate_ahead);
    const double* laws = (const double*)p.law; const double* laws_now = (const double*)p.law_now;
    const double* aways = (const double*)p.away;
    const double* put = (const double*)p.stays + (long long)path * p.points;
    const double* intos = (const double*)p.into; const int* slice_of = (const int*)p.slice_of;
    const double end = ((const double*)p.end)[path];
    const double* bend = (const double*)p.bend + (long long)path * p.points;
    int failure = 0, failed_at = n;
    for (int i = 0; i <= n; ++i) {
        out_s[i] = s; out_v[i] = v; out_a[i] = a;
        if (failure == 0) {
            // the checks, in the order of their names
            const double t = p.dt * i;
            int cell = (int)(s * inverse); cell = cell > p.points - 1 ? p.points - 1 : cell;
            const long long here = ((long long)path * p.slices + slice_of[i]) * p.points + cell;
            const double hit = hits[here] + rates[here] * intos[i];
            const bool moving = v > 0.05;
            int bad = s + (moving ? p.clear : 0.0) < hit ? 0 : 1;
            if (p.soft) {
                double law = laws[here];
                if (intos[i] < p.dt - 1e-9 && laws_now[here] < law) law = laws_now[here];
                double left = t - p.hold_s; left = target - p.brake * (left > 0.0 ? left : 0.0);
                left = left > 0.0 ? left : 0.0;
                const bool above = t <= (hold < p.hold_s ? hold : p.hold_s)
                    ? target > law + 1e-9 : v > (law > left ? law : left) + 0.05;
                if (bad == 0 && above) bad = 2;
                if (t >= p.soft_after - 1e-9 && bad == 0 && moving) {
                    const double way = v * v * (0.5 / p.stop_brake) + s;
                    double ease = p.ease + (1.0 - p.ease) * (t - p.soft_after) / p.ease_s;
                    const double away = aways[here];
                    ease = ease < 1.0 && v <= away + 0.5 ? ease : 1.0;
                    const double need = v * p.headway * ease + way;
                    const double room = hit - p.gap + away * away * (0.5 / p.stop_brake);
                    if (need > room && v > 0.85 * away + 0.05) bad = 3;
                    else if (v * p.headway + way > put[cell]) bad = 4;
                }
            }
            if (bad == 0 && s > end && moving) bad = 5;
            if (bad == 0 && bend[cell] * v * v > p.lateral) bad = 6;
            if (bad && t < p.until - 1e-9) { failure = bad; failed_at = i; }
        }
        if (i == n) break;
        double ahead = (s + v * p.look) * inverse; ahead = ahead < last ? ahead : last;
        const int c = (int)ahead;
        const double squared = cap2[c] + (ahead - c) * (cap2[c + 1] - cap2[c]);
        const double at = s * inverse;
        const double cap = sqrt(cap2[(int)(at < last ? at : last)]), soon = sqrt(squared);
        const bool stopping = hold <= p.dt * i + 1e-9;
        double wanted = target < soon ? target : soon; wanted = wanted < cap ? wanted : cap;
        if (stopping) wanted = 0.0;
        double aw = stopping ? -p.brake : (wanted - v) * p.gain;
        const bool rest = wanted <= 0.0;
        if (p.tier == 0) { const double soft = -0.15 - sqrt(2.0 * p.jerk * v); aw = aw > soft ? aw : soft; }
        if (rest && v > 0.0) aw = aw < -0.15 ? aw : -0.15;
        aw = aw > -p.brake ? aw : -p.brake; aw = aw < p.accel ? aw : p.accel;
        const double up = a < p.hard ? p.up_brake : (a < 0.0 ? p.up_comfort : p.up_gas);
        double change = aw - a; change = change > p.down ? change : p.down; change = change < up ? change : up;
        double an = a + change;
        const double mean = 0.5 * (a + an);
        double vn = v + mean * p.dt, moved = 0.5 * p.dt * (v + vn);
        if (vn <= 1e-3) {
            const double most = -2.0 * mean > 1e-6 ? -2.0 * mean : 1e-6;
            const double way = v > 0.0 ? v * v / most : 0.0;
            moved = way < v * p.dt ? way : v * p.dt;
            vn = 0.0;
            an = rest ? 0.0 : (an > 0.0 ? an : 0.0);
        }
        s += moved; v = vn; a = an;
    }
    ((int*)p.failure)[k] = failure;
    ((int*)p.failed_at)[k] = failed_at;
"""


@wp.func_native(_ROLL)
def roll_one(p: Roll, k: int):  # noqa: D103
    ...


@wp.kernel
def roll_kernel(p: Roll):
    """One motion: the driven controller step by step, and its first failed check."""
    roll_one(p, wp.tid())


@wp.struct
class Crossing:
    """Where contact begins on n paths, and how it moves; see `contact.Contact`."""

    slices: int
    points: int
    far: wp.float64
    r_hit: float
    step: wp.float64
    starts: wp.uint64  # double [S]
    risk: wp.uint64  # float [n, S, p]
    who: wp.uint64  # uint8 [n, S, p]
    hit: wp.uint64  # double [n, S, p], as the next ones
    rate: wp.uint64
    away: wp.uint64


_CROSSING = """
    const int S = p.slices, P = p.points;
    const long long base = (long long)path * S * P;
    const float* risk = (const float*)p.risk + base;
    const unsigned char* who = (const unsigned char*)p.who + base;
    double* hit = (double*)p.hit + base; double* rate = (double*)p.rate + base; double* away = (double*)p.away + base;
    const double* starts = (const double*)p.starts;
    // the first crossing at or beyond each station; who it is goes along in `away` for now
    for (int j = 0; j < S; ++j) {
        const float* r = risk + (long long)j * P;
        double next = p.far; int name = 255;
        for (int i = P - 1; i >= 0; --i) {
            if (r[i] >= p.r_hit) { next = p.step * i; name = who[(long long)j * P + i]; }
            else if (i + 1 < P && r[i + 1] >= p.r_hit) {
                const double a = r[i], b = r[i + 1];
                const double d = b - a > 1e-9 ? b - a : 1e-9;
                double w = (p.r_hit - a) / d; w = w < 0.0 ? 0.0 : (w > 1.0 ? 1.0 : w);
                next = p.step * (i + w);
            }
            hit[(long long)j * P + i] = next; away[(long long)j * P + i] = name;
        }
    }
    for (int j = 0; j < S; ++j) {
        for (int i = 0; i < P; ++i) {
            const long long at = (long long)j * P + i;
            const double a = hit[at];
            double r = 0.0, u = 0.0, from = a;
            if (j + 1 < S) {
                const double b = hit[at + P];
                const bool same = away[at] == away[at + P] && away[at] != 255.0;
                if (a < p.far && b < p.far && same) {
                    r = (b - a) / (starts[j + 1] - starts[j]);
                    r = r < -60.0 ? -60.0 : (r > 60.0 ? 60.0 : r);
                    u = r > 0.0 ? r : 0.0;
                } else if (b < a) from = b;
            }
            if (r == 0.0 && j > 0 && a < p.far) u = rate[at - P] > 0.0 ? rate[at - P] : 0.0;
            hit[at] = from; rate[at] = r; away[at] = u;
        }
    }
"""


@wp.func_native(_CROSSING)
def crossing_of(p: Crossing, path: int):  # noqa: D103
    ...


@wp.kernel
def crossing_kernel(p: Crossing):
    """Where contact begins on one path."""
    crossing_of(p, wp.tid())


@wp.struct
class Law:
    """The speed that the risk beside n paths allows; see `beside.beside_law`."""

    slices: int
    points: int
    s_max: wp.float64
    r0: wp.float64
    r1: wp.float64
    along: wp.float64
    step: wp.float64
    starts: wp.uint64  # double [S]
    left: wp.uint64  # float [n, S, p]
    right: wp.uint64
    who_left: wp.uint64  # uint8 [n, S, p]
    who_right: wp.uint64
    law: wp.uint64  # double [n, S, p]
    law_now: wp.uint64  # double [n, S, p]
    going: wp.float64  # from this speed on a source goes along [m/s]


_LAW = """
    const int S = p.slices, P = p.points, MOST = 128, T = S < 32 ? S : 32;
    const long long base = (long long)path * S * P;
    const double* starts = (const double*)p.starts;
    double* law = (double*)p.law + base; double* law_now = (double*)p.law_now + base;
    const double none = -1e9;
    double front[32][128], back[32][128], speed[32][128];
    const double span = p.r1 - p.r0 > 1e-9 ? p.r1 - p.r0 : 1e-9;
    for (int side = 0; side < 2; ++side) {
        const float* risk = (const float*)(side ? p.right : p.left) + base;
        const unsigned char* who = (const unsigned char*)(side ? p.who_right : p.who_left) + base;
        bool any = false;
        // between which stations each source makes itself felt, where that is known
        for (int j = 0; j < T; ++j) {
            for (int k = 0; k < MOST; ++k) { front[j][k] = none; back[j][k] = none; }
            const float* r = risk + (long long)j * P;
            for (int i = 0; i < P; ++i) {
                const int k = who[(long long)j * P + i];
                if (k >= MOST) continue;
                any = true;
                if (back[j][k] == none && front[j][k] == none && i > 0) {
                    const double w = r[i - 1] < p.r0 ? (p.r0 - r[i - 1]) / (r[i] - r[i - 1] + 1e-12) : 0.5;
                    back[j][k] = i - 1 + w;
                }
                front[j][k] = i + 1 >= P ? none
                    : i + (r[i + 1] < p.r0 ? (r[i] - p.r0) / (r[i] - r[i + 1] + 1e-12) : 0.5);
            }
        }
        if (any) {
            for (int j = 0; j < T; ++j) {
                for (int k = 0; k < MOST; ++k) {
                    speed[j][k] = none;
                    if (front[j][k] == none && back[j][k] == none) continue;
                    double best = none;
                    for (int way = 0; way < 2 && best == none; ++way) {  // over the next slices, otherwise the last
                        int a = j, b = j;
                        if (way == 0)
                            while (b + 1 < T && b < j + 4 && (front[b + 1][k] != none || back[b + 1][k] != none)) ++b;
                        else if (j > 0) a = j - 1;
                        if (a == b) continue;
                        const double dt = starts[b] - starts[a];
                        const bool f = front[a][k] != none && front[b][k] != none;
                        const bool g = back[a][k] != none && back[b][k] != none;
                        const double uf = p.step * (front[b][k] - front[a][k]) / dt;
                        const double ug = p.step * (back[b][k] - back[a][k]) / dt;
                        if (f && g) best = uf < ug ? uf : ug;
                        else if (f) best = uf;
                        else if (g) best = ug;
                    }
                    speed[j][k] = best;
                }
            }
        }
        for (int j = 0; j < S; ++j) {
            for (int i = 0; i < P; ++i) {
                const long long at = (long long)j * P + i;
                double allowed = 1e18, now = 1e18;
                for (int m = j; m <= j + 1 && m < S; ++m) {
                    const long long there = (long long)m * P + i;
                    double share = (p.r1 - risk[there]) / span;
                    share = share < 0.0 ? 0.0 : (share > 1.0 ? 1.0 : share);
                    double one = p.s_max * share;
                    const int k = who[there];
                    if (k < MOST && m < T && p.along * speed[m][k] > one) one = p.along * speed[m][k];
                    if (k < MOST && m < T && speed[m][k] >= p.going) { if (m == j) now = one; }
                    else allowed = one < allowed ? one : allowed;
                }
                if (side == 0 || allowed < law[at]) law[at] = allowed;
                if (side == 0 || now < law_now[at]) law_now[at] = now;
            }
        }
    }
"""


@wp.func_native(_LAW)
def law_along(p: Law, path: int):  # noqa: D103
    ...


@wp.kernel
def law_kernel(p: Law):
    """What the risk beside one path allows."""
    law_along(p, wp.tid())


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


class _Arrays:
    """Addresses of arrays in C order, kept alive as long as this object is."""

    def __init__(self) -> None:
        self._kept: list[npt.NDArray[Any]] = []

    def at(self, a: npt.NDArray[Any], kind: Any) -> int:
        """The address of `a` as an array of `kind`, copied only if it is not that already."""
        a = np.ascontiguousarray(a, dtype=kind)
        self._kept.append(a)
        return int(a.__array_interface__["data"][0])


@dataclass(frozen=True)
class Outline:
    """Samples of a footprint as the kernel wants them: group by group, padded to whole vectors."""

    samples: int
    x: F64  # [padded] [m]
    y: F64
    counts: U8  # whether it must be known [padded]
    begin: I32  # of each group's samples, the end included [groups + 1]
    taken: F32  # [2, groups, 8] [E_max]


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
    off = np.zeros((2, len(begin) - 1, 8), np.float32)
    off[..., :5] = taken[..., order[begin[:-1]]].transpose(0, 2, 1)
    more = (0, -len(order) % 8)
    counts = np.pad((order < outlined).astype(np.uint8), more)
    return Outline(len(order), np.pad(x[order], more), np.pad(y[order], more), counts, begin, off)


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
    _initialise()
    n, points = x.shape
    g = volume.risk.grid
    i, j = volume.coordinates(x, y)
    keep = _Arrays()
    q: Any = LookUp()
    q.slices, q.first, q.rows, q.columns = volume.slices, volume.first, g.rows, g.columns
    dominant = volume.risk.dominant
    q.block, q.block_columns = BLOCK, dominant.shape[2]
    q.block_plane = dominant.shape[1] * dominant.shape[2]
    q.samples, q.padded, q.groups = outline.samples, len(outline.x), len(outline.begin) - 1
    q.later, q.paths, q.points = later, n, points
    q.r_hit, q.r0 = named
    q.timed = int(slice_of is not None)
    q.slice_of = keep.at(np.zeros(1, np.int32) if slice_of is None else slice_of, np.int32)
    m = volume.risk.volume
    q.half = int(m.dtype == np.float16)
    q.volume = keep.at(m, m.dtype)
    q.dominant, q.who_of = keep.at(dominant, np.uint8), keep.at(volume.who, np.uint8)
    q.x, q.y = keep.at(i, np.float64), keep.at(j, np.float64)
    turn = heading - g.heading
    q.cos, q.sin = keep.at(np.cos(turn) / g.h, np.float64), keep.at(np.sin(turn) / g.h, np.float64)
    q.outline_x, q.outline_y = keep.at(outline.x, np.float64), keep.at(outline.y, np.float64)
    q.outline, q.begin = keep.at(outline.counts, np.uint8), keep.at(outline.begin, np.int32)
    q.taken, q.leaves = keep.at(outline.taken, np.float32), keep.at(leaves, np.uint8)
    kept = volume.slices if slice_of is None else 1
    risk, four = np.empty((n, kept, points), np.float32), np.empty((4, n, kept, points), np.float32)
    stays, whole = np.empty((n, points), np.float32), np.empty((n, points), np.uint8)
    who = np.empty(four.shape, np.uint8)
    q.risk, q.four = keep.at(risk, np.float32), keep.at(four, np.float32)
    q.stays, q.whole, q.who = keep.at(stays, np.float32), keep.at(whole, np.uint8), keep.at(who, np.uint8)
    wp.launch(look_up_kernel, dim=n * -(-points // _CHUNK), inputs=[q], device="cpu")
    return risk, stays, whole.view(np.bool_), four, who


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
    _initialise()
    keep = _Arrays()
    q: Any = Law()
    q.slices, q.points, q.step = sides.shape[2], sides.shape[3], step
    q.s_max, q.r0, q.r1, q.along = s_max, r0, r1, along
    q.starts = keep.at(starts, np.float64)
    q.left, q.right = (keep.at(part, np.float32) for part in sides)
    q.who_left, q.who_right = (keep.at(part, np.uint8) for part in who)
    q.going = going
    out: F64 = np.empty((2, *sides.shape[1:]))
    q.law, q.law_now = (keep.at(part, np.float64) for part in out)
    wp.launch(law_kernel, dim=sides.shape[1], inputs=[q], device="cpu")
    return out[0], out[1]


def crossings(risk: F32, who: U8, starts: F64, r_hit: float, step: float, far: float) -> tuple[F64, F64, F64]:
    """Where contact begins at or beyond each station, how fast that moves, and how fast it moves away [n, S, p]."""
    _initialise()
    keep = _Arrays()
    q: Any = Crossing()
    q.slices, q.points, q.far, q.r_hit, q.step = risk.shape[1], risk.shape[2], far, r_hit, step
    q.starts, q.risk, q.who = keep.at(starts, np.float64), keep.at(risk, np.float32), keep.at(who, np.uint8)
    out: F64 = np.empty((3, *risk.shape))
    q.hit, q.rate, q.away = (keep.at(part, np.float64) for part in out)
    wp.launch(crossing_kernel, dim=len(risk), inputs=[q], device="cpu")
    return out[0], out[1], out[2]


class RollField:
    """What every motion of a cycle looks up, handed over once: the arrays of `Roll`, by name."""

    def __init__(self, arrays: Mapping[str, F64]) -> None:
        _initialise()
        self.keep = _Arrays()
        self.q: Any = Roll()
        for name, values in arrays.items():
            setattr(self.q, name, self.keep.at(values, np.float64))


def roll(
    field: RollField,
    constants: Mapping[str, float],
    slice_of: Integers,
    into: F64,
    path: Integers,
    target: F64,
    hold: F64,
) -> tuple[F64, F64, F64, I32, I32]:
    """Roll K motions out; returns distance, speed, acceleration [K, steps + 1], failure and its step [K].

    Args:
        field: what they look up.
        constants: the numbers of `Roll`, by name.
        slice_of: slice in force at each step [steps + 1].
        into: how far into it each step is [steps + 1] [s].
        path: path of each motion [K].
        target: target speed [K] [m/s].
        hold: when the braking starts [K] [s].
    """
    keep, q = _Arrays(), field.q
    k, n = len(path), len(slice_of)
    q.steps = n - 1
    for name, value in constants.items():
        setattr(q, name, value)
    q.slice_of, q.path = keep.at(slice_of, np.int32), keep.at(path, np.int32)
    q.into, q.target, q.hold = (keep.at(part, np.float64) for part in (into, target, hold))
    out: F64 = np.empty((3, k, n))
    failure, failed_at = np.empty(k, np.int32), np.empty(k, np.int32)
    q.failure, q.failed_at = keep.at(failure, np.int32), keep.at(failed_at, np.int32)
    q.s, q.v, q.a = (keep.at(part, np.float64) for part in out)
    wp.launch(roll_kernel, dim=k, inputs=[q], device="cpu")
    return out[0], out[1], out[2], failure, failed_at
