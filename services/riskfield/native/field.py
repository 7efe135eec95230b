"""M of one run of one row of blocks of a group of slices: start from what is prepared, add every object, write."""

START = """
    const int groups = (p.slices + p.group - 1) / p.group;
    const int slice0 = (task / (blocks * runs)) * p.group, block = (task / runs) % blocks;
    const int group = slice0 + p.group < p.slices ? p.group : p.slices - slice0;
    const int c0 = (task % runs) * p.run, c1 = c0 + p.run < p.columns ? c0 + p.run : p.columns, cells = c1 - c0;
    const float x_mid = (4 * block + 2) * h, x_low = x_mid - 2.0f * h, x_high = x_mid + 2.0f * h;
    float acc[G * 4 * PITCH];
    for (int g = 0; g < group; ++g)
        for (int r = 0; r < 4; ++r) {
            const int row = 4 * block + r;
            float* sum = acc + (4 * g + r) * PITCH;
            const float* still = p.static_sum.data + (long long)row * p.columns + c0;
            if (p.two_level) {
                const float t = (row + 0.5f) / p.ratio;
                const int m = (int)t, q = p.far_pitch;
                float a, b, c, d;
                weights(t - m, a, b, c, d);
                const float* u = p.far.data + ((long long)(slice0 + g) * p.far_rows + m) * q + c0;
                for (int j = 0; j < cells; ++j)
                    sum[j] = still[j] + max0(a * u[j] + b * u[j + q] + c * u[j + 2 * q] + d * u[j + 3 * q]);
            } else {
                for (int j = 0; j < cells; ++j) sum[j] = still[j];
            }
            for (int j = cells; j < cells + W; ++j) sum[j] = 0.0f;
        }
"""

ADD_POTENTIAL = """
    auto add_near = [&](const Object& o, float* to) {
        const float a = o.half_length + o.near, b = o.half_width + o.near;
        for (int r = 0; r < 4; ++r) {
            const float dx = (4 * block + r + 0.5f) * h - o.x;
            float y0, y1;
            int j0, j1;
            window(dx, o.c, o.s, o.i_c, o.i_s, -a, a, -b, b, y0, y1);
            if (y0 >= y1) continue;
            clip(o.y + y0, o.y + y1, c0, c1, j0, j1);
            float* sum = to + r * PITCH - c0;
            for (int k = j0; k < j1; k += W)
                for (int j = k; j < k + W; ++j) sum[j] += near_share(o, dx, (j + 0.5f) * h - o.y);
        }
    };
    auto add_whole = [&](const Object& o, float* to) {
        for (int r = 0; r < 4; ++r) {
            const float dx = (4 * block + r + 0.5f) * h - o.x, rest = o.radius * o.radius - dx * dx;
            if (rest <= 0.0f) continue;
            const float half = sq(rest), free = untouched * untouched - dx * dx, most = free > 0.0f ? sq(free) : -h;
            int j0, j1, i0, i1;
            clip(o.y - half, o.y + half, c0, c1, j0, j1);
            if (j0 >= j1) continue;
            clip(o.y - most + h, o.y + most - h, c0, c1, i0, i1);  // no taper there
            float* sum = to + r * PITCH - c0;
            // whole vectors counted from the run's beginning: what lies beyond the radius adds 0
            j0 = c0 + (j0 - c0) / W * W; i0 = c0 + (i0 - c0 + W - 1) / W * W; i1 = c0 + (i1 - c0) / W * W;
            if (!square) {
                for (int j = j0; j < j1; ++j) sum[j] += potential(o, dx, (j + 0.5f) * h - o.y);
                continue;
            }
            if (i0 >= i1) i0 = i1 = j1;
            for (int k = j0; k < i0; k += W)
                for (int j = k; j < k + W; ++j) sum[j] += tapered(o, dx, (j + 0.5f) * h - o.y);
            for (int k = i0; k < i1; k += W)
                for (int j = k; j < k + W; ++j) sum[j] += inside(o, dx, (j + 0.5f) * h - o.y);
            for (int k = i1 > j0 ? i1 : j0; k < j1; k += W)
                for (int j = k; j < k + W; ++j) sum[j] += tapered(o, dx, (j + 0.5f) * h - o.y);
        }
    };
"""

ADD_KINETIC = """
    // largest single kinetic share at each cell and whose it is
    float most[G * 4 * PITCH];
    int whose[G * 4 * PITCH];
    for (int g = 0; g < 4 * group; ++g)
        for (int j = 0; j < cells + W; ++j) { most[g * PITCH + j] = 0.0f; whose[g * PITCH + j] = -1; }

    // where a segment lies does not change from slice to slice: its place is computed once for all of them
    auto add_kinetic = [&](int n, const Lobe* lobes, int active, float width, int first, int last) {
        const Segment* path = (const Segment*)(p.segments.data + (long long)n * p.segments_most * NS);
        float low = lobes[0].low, high = lobes[0].high;
        for (int q = 1; q < active; ++q) {
            low = lobes[q].low < low ? lobes[q].low : low; high = lobes[q].high > high ? lobes[q].high : high;
        }
        for (int r = 0; r < 4; ++r) {
            const float x = (4 * block + r + 0.5f) * h;
            int found = 0, lo = c1, hi = c0, seg[VERTICES], from[VERTICES], upto[VERTICES];
            for (int k = first; k <= last; ++k) {
                const Segment& g = path[k];
                if (x < g.x_low - width || x > g.x_high + width) continue;
                // inside a bend the shared arc length lies up to its neighbours' turn off the segment's own
                float a0 = low - g.s - width * g.bent, a1 = high - g.s + width * g.bent, y0, y1;
                a0 = (a0 > g.low ? a0 : g.low) - width * g.turn - 0.01f; a1 = (a1 < g.high ? a1 : g.high) + 0.01f;
                if (a0 >= a1) continue;
                window(x - g.x, g.tx, g.ty, g.i_tx, g.i_ty, a0, a1, -width, width, y0, y1);
                if (y0 >= y1) continue;
                int j0, j1;
                clip(g.y + y0, g.y + y1, c0, c1, j0, j1);
                if (j0 >= j1) continue;
                seg[found] = k; from[found] = j0; upto[found] = j1; ++found;
                lo = j0 < lo ? j0 : lo; hi = j1 > hi ? j1 : hi;
            }
            for (int b = lo; b < hi; b += W) {
                float here[G * W], s[W], d2[W], counts[W];
                int touched = 0;
                for (int f = 0; f < found; ++f) {
                    if (upto[f] <= b || from[f] >= b + W) continue;
                    const Segment g = path[seg[f]];
                    const float rx = x - g.x, ry = (b + 0.5f) * h - g.y;
                    if (g.bent != 0.0f) {
                        for (int i = 0; i < W; ++i) counts[i] = bent_place(g, rx, ry + i * h, s[i], d2[i]);
                    } else {
                        for (int i = 0; i < W; ++i) counts[i] = straight_place(g, rx, ry + i * h, s[i], d2[i]);
                    }
                    const float one = rx * g.tx + ry * g.ty, two = one + (W - 1) * h * g.ty, slack = width * g.bent;
                    float s0 = one < two ? one : two, s1 = one < two ? two : one;
                    s0 = s0 > g.low ? s0 : g.low; s1 = s1 < g.high ? s1 : g.high;
                    s0 += g.s - slack; s1 += g.s + slack;
                    for (int q = 0; q < active; ++q) {
                        if (s1 < lobes[q].low || s0 > lobes[q].high) continue;
                        const Lobe o = lobes[q];
                        float* e = here + q * W;
                        if (!(touched >> q & 1)) {
                            touched |= 1 << q;
                            for (int i = 0; i < W; ++i) e[i] = 0.0f;
                        }
                        if (p.paper) {
                            for (int i = 0; i < W; ++i) {
                                const float v = counts[i] * printed(o, s[i], d2[i]);
                                e[i] = v > e[i] ? v : e[i];
                            }
                        } else {
                            for (int i = 0; i < W; ++i) {
                                const float v = counts[i] * sound(o, s[i], d2[i]);
                                e[i] = v > e[i] ? v : e[i];
                            }
                        }
                    }
                }
                for (int q = 0; q < active; ++q) {
                    if (!(touched >> q & 1)) continue;
                    const int at = (4 * lobes[q].slice + r) * PITCH + b - c0;
                    for (int i = 0; i < W; ++i) {
                        const float e = here[q * W + i];
                        acc[at + i] += e;
                        whose[at + i] = e > most[at + i] ? n : whose[at + i];
                        most[at + i] = e > most[at + i] ? e : most[at + i];
                    }
                }
            }
        }
    };
"""

SUM = """
    for (int g = 0; g < group; ++g) {
        const float* objects = p.objects.data + (long long)(slice0 + g) * p.objects_most * NO;
        for (int n = 0; n < objects_count; ++n) {
            const Object& o = *(const Object*)(objects + n * NO);
            const float away = (x_mid > o.x ? x_mid - o.x : o.x - x_mid) - 2.0f * h;
            if (away >= (p.two_level ? o.near_x : o.radius)) continue;
            const Object q = o;
            if (p.two_level) add_near(q, acc + 4 * g * PITCH); else add_whole(q, acc + 4 * g * PITCH);
        }
    }
    for (int n = 0; n < objects_count; ++n) {
        const int* span = p.crossings.data + ((long long)n * blocks + block) * 2;
        if (span[0] > span[1]) continue;
        Lobe lobes[G];
        int active = 0, first = span[1], last = span[0];
        float width = 0.0f;
        for (int g = 0; g < group; ++g) {
            const Object& o = *(const Object*)(p.objects.data + ((long long)(slice0 + g) * p.objects_most + n) * NO);
            if (x_high < o.low || x_low > o.high || (int)o.first > span[1] || (int)o.last < span[0]) continue;
            Lobe& l = lobes[active++];
            l.M2 = o.M2; l.inverse_L = o.inverse_L; l.reach = o.reach; l.sign = o.sign; l.s0 = o.s0; l.half = o.half;
            l.inverse_l = o.inverse_l; l.inverse_w2 = o.inverse_w2; l.slice = g;
            l.low = o.s0 - o.half - (o.sign > 0.0f ? 0.0f : o.reach);
            l.high = o.s0 + o.half + (o.sign > 0.0f ? o.reach : 0.0f);
            width = o.width > width ? o.width : width;
            first = (int)o.first < first ? (int)o.first : first; last = (int)o.last > last ? (int)o.last : last;
        }
        first = first > span[0] ? first : span[0]; last = last < span[1] ? last : span[1];
        if (active) add_kinetic(n, lobes, active, width, first, last);
    }
"""

WRITE = """
    for (int g = 0; g < 4 * group; ++g) {
        const float* sum = acc + g * PITCH;
        const long long at = ((long long)(slice0 + g / 4) * p.rows + 4 * block + g % 4) * p.columns + c0;
        if (p.half) {
            unsigned short* out = (unsigned short*)p.volume16.data + at;
            for (int j = 0; j < cells; ++j) {
                // round to nearest even; every value is >= 0 and below 65504
                union { float f; unsigned int i; } v;
                v.f = (sum[j] < 6.0e4f ? max0(sum[j]) : 6.0e4f) * 1.92592994e-34f;
                out[j] = (unsigned short)((v.i + 0xfffu + ((v.i >> 13) & 1u)) >> 13);
            }
        } else {
            float* out = p.volume32.data + at;
            for (int j = 0; j < cells; ++j) out[j] = sum[j] < 6.0e4f ? max0(sum[j]) : 6.0e4f;
        }
    }
"""
