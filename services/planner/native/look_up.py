"""Looking paths up in the risk volume: the footprint's maximum at each station, in every slice.

Eight stations are looked up side by side, sample by sample of the outline, so that maxima are taken lane by lane.
"""

from __future__ import annotations

from common.messages import BLOCK
from services.planner.native.parameters import structure

MOST_SAMPLES = 128
"""So many samples of the outline are looked up at most."""
LANES = 8
"""So many stations of a path are looked up at a time."""

LookUp = structure(
    "LookUp",
    """
    int slices;           // from `first` on; 1 if timed
    int first;
    int rows;
    int columns;
    int block_columns;
    int block_plane;
    int samples;
    int groups;
    int later;            // the last slice of `stays`, counted from `first`
    int half;             // 1: the volume is float16
    int timed;            // 1: each point in one slice only
    int paths;
    int points;
    float r_hit;          // from here on the source of a contact is looked up
    float r0;             // and from here on the source of a risk beside
    const void* volume;   // of uint16 or float
    const unsigned char* dominant;   // [slices, blocks, blocks]
    const unsigned char* who_of;     // [256]: source of each slot
    double grid_x;        // corner of cell (0, 0) [m]
    double grid_y;
    double grid_cos;      // of the grid's heading
    double grid_sin;
    double grid_heading;
    double h;             // side of a cell [m]
    const double* x;      // [n, points]: rear axle, `map` frame [m]
    const double* y;
    const double* heading;
    const double* outline_x;         // [samples]: of the outline, frame of the rear axle [m]; group by group
    const double* outline_y;
    const int* begin;     // [groups + 1]: of each group's samples
    const unsigned char* outline;    // [samples]: whether it is of the outline, which must be known
    const float* taken;   // [2, groups, 5]: off each group for the four and `risk`; the second where the path leaves
    const unsigned char* counts;     // [2, groups]: whether anything of the group can count
    const unsigned char* leaves;     // [n]
    const int* slice_of;  // [points], if timed
    float* risk;          // [n, slices, points]
    float* stays;         // [n, points]
    unsigned char* whole; // [n, points]
    float* four;          // [4, n, slices, points]: contact, contact ahead, left, right
    unsigned char* who;   // [4, n, slices, points]: of the four
    """,
)

SOURCE = LookUp.cpp + (
    """
    typedef float v8f __attribute__((vector_size(32)));
    typedef int v8i __attribute__((vector_size(32)));
    typedef unsigned int v8u __attribute__((vector_size(32)));
    const int L = 8, K = p.samples, BLOCK = @BLOCK;
    const int path = task % p.paths, from = task / p.paths * L;  // paths share what they read
    const int n = p.points - from < L ? p.points - from : L;
    const long long start = (long long)path * p.points + from;
    alignas(32) int cell[8 * 128];
    alignas(32) int block[8 * 128];
    alignas(32) float w00[8 * 128], w01[8 * 128], w10[8 * 128], w11[8 * 128], least[8 * 128];
    const int plane = p.rows * p.columns;
    const int leaves = p.leaves[path];
    const float* taken = p.taken + leaves * 5 * p.groups;
    const unsigned char* counts = p.counts + leaves * p.groups;
    const unsigned char* dominant = p.dominant + (long long)p.first * p.block_plane;
    // float16: every value is >= 0 and finite: its bits, moved, are the value / 2^112
    const float scale = p.half ? 5.192296858534828e33f : 1.0f;
    double x[L], y[L], co[L], si[L];
    int missing[L], slice[L];
    for (int q = 0; q < L; ++q) {  // lanes beyond the last station repeat it
        const int at = q < n ? q : n - 1;
        const double dx = p.x[start + at] - p.grid_x, dy = p.y[start + at] - p.grid_y;
        const double turn = p.heading[start + at] - p.grid_heading;
        x[q] = (p.grid_cos * dx + p.grid_sin * dy) / p.h; y[q] = (-p.grid_sin * dx + p.grid_cos * dy) / p.h;
        co[q] = cos(turn) / p.h; si[q] = sin(turn) / p.h;
        missing[q] = 0;
        slice[q] = p.timed ? p.slice_of[from + at] : 0;
    }
    const double rows = p.rows, columns = p.columns;
    for (int k = 0; k < K; ++k) {
        const double ox = p.outline_x[k], oy = p.outline_y[k];
        const int must = p.outline[k];
        for (int q = 0; q < L; ++q) {
            const int at = k * L + q;
            const double fi = x[q] + co[q] * ox - si[q] * oy;
            const double fj = y[q] + si[q] * ox + co[q] * oy;
            const bool in = (fi >= 0.0) & (fi <= rows) & (fj >= 0.0) & (fj <= columns);
            missing[q] += !in & must;
            double gi = fi - 0.5, gj = fj - 0.5;
            gi = gi > 0.0 ? gi : 0.0; gi = gi < rows - 1.0 ? gi : rows - 1.0;
            gj = gj > 0.0 ? gj : 0.0; gj = gj < columns - 1.0 ? gj : columns - 1.0;
            int i = (int)gi, j = (int)gj;
            i = i < p.rows - 2 ? i : p.rows - 2; j = j < p.columns - 2 ? j : p.columns - 2;
            const float wi = (float)(gi - i), wj = (float)(gj - j);
            const float part = in ? scale : 0.0f;
            cell[at] = i * p.columns + j + slice[q] * plane;
            w00[at] = part * (1.0f - wi) * (1.0f - wj); w01[at] = part * (1.0f - wi) * wj;
            w10[at] = part * wi * (1.0f - wj); w11[at] = part * wi * wj;
            least[at] = 3e38f;
            double bi = fi > 0.0 ? fi : 0.0, bj = fj > 0.0 ? fj : 0.0;
            bi = bi < rows - 1.0 ? bi : rows - 1.0; bj = bj < columns - 1.0 ? bj : columns - 1.0;
            block[at] = (int)bi / BLOCK * p.block_columns + (int)bj / BLOCK + slice[q] * p.block_plane;
        }
    }
    for (int q = 0; q < n; ++q) p.whole[start + q] = missing[q] == 0;

    const long long all = (long long)p.paths * p.slices * p.points;
    for (int j = 0; j < p.slices; ++j) {
        const unsigned short* volume16 = (const unsigned short*)p.volume + (long long)(p.first + j) * plane;
        const float* volume32 = (const float*)p.volume + (long long)(p.first + j) * plane;
        v8f most[5];
        v8i best[5];
        for (int w = 0; w < 5; ++w) { most[w] = (v8f){}; best[w] = (v8i){}; }
        for (int g = 0; g < p.groups; ++g) {
            if (!counts[g]) continue;
            v8f high = {};
            v8i which = (v8i){} + p.begin[g];
            for (int k = p.begin[g]; k < p.begin[g + 1]; ++k) {
                const int* c = cell + k * L;
                v8f a, b, d, e;
                if (p.half) {
                    v8u near, far;  // two neighbours of a row at once
                    for (int l = 0; l < L; ++l) {
                        unsigned int two;
                        __builtin_memcpy(&two, volume16 + c[l], 4); near[l] = two;
                        __builtin_memcpy(&two, volume16 + c[l] + p.columns, 4); far[l] = two;
                    }
                    a = (v8f)((near & 0xffffu) << 13); b = (v8f)(near >> 16 << 13);
                    d = (v8f)((far & 0xffffu) << 13); e = (v8f)(far >> 16 << 13);
                } else {
                    for (int l = 0; l < L; ++l) {
                        const float* m = volume32 + c[l];
                        a[l] = m[0]; b[l] = m[1]; d[l] = m[p.columns]; e[l] = m[p.columns + 1];
                    }
                }
                const v8f v = a * *(v8f*)(w00 + k * L) + b * *(v8f*)(w01 + k * L) + d * *(v8f*)(w10 + k * L)
                    + e * *(v8f*)(w11 + k * L);
                which = v > high ? (v8i){} + k : which;
                high = __builtin_elementwise_max(v, high);
                if (j <= p.later) *(v8f*)(least + k * L) = __builtin_elementwise_min(v, *(v8f*)(least + k * L));
            }
            for (int w = 0; w < 5; ++w) {
                const v8f left = high - taken[5 * g + w];
                best[w] = left > most[w] ? which : best[w];
                most[w] = __builtin_elementwise_max(left, most[w]);
            }
        }
        const long long out = ((long long)path * p.slices + j) * p.points + from;
        if (n == L) {
            __builtin_memcpy(p.risk + out, &most[4], 32);
            for (int w = 0; w < 4; ++w) __builtin_memcpy(p.four + w * all + out, &most[w], 32);
        } else {
            for (int q = 0; q < n; ++q) p.risk[out + q] = most[4][q];
            for (int w = 0; w < 4; ++w)
                for (int q = 0; q < n; ++q) p.four[w * all + out + q] = most[w][q];
        }
        for (int w = 0; w < 4; ++w) {  // whose it is: the block of the sample that met it
            const float bound = w < 2 ? p.r_hit : p.r0;
            unsigned char name[8] = {255, 255, 255, 255, 255, 255, 255, 255};
            unsigned int some = 0;
            for (int q = 0; q < L; ++q) some |= (unsigned int)(most[w][q] >= bound) << q;
            for (; some; some &= some - 1) {
                const int q = __builtin_ctz(some);
                name[q] = p.who_of[dominant[(long long)j * p.block_plane + block[best[w][q] * L + q]]];
            }
            __builtin_memcpy(p.who + w * all + out, name, n);
        }
    }
    v8f stays = {};
    for (int g = 0; g < p.groups; ++g)
        if (counts[g])
            for (int k = p.begin[g]; k < p.begin[g + 1]; ++k)
                stays = __builtin_elementwise_max(*(v8f*)(least + k * L) - taken[5 * g], stays);
    for (int q = 0; q < n; ++q) p.stays[start + q] = stays[q];
""".replace("@BLOCK", str(BLOCK))
)
