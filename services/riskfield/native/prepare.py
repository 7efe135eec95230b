"""What the slices share, computed before them: far field of each, static layer, and the paths."""

FAR = """
    // two levels: the smooth far field of one row of nodes of one slice, brought to the columns of the fine grid.
    // Node m lies at x = (m - 1) H, node k of a row at y = (k - 1) H
    auto far_row = [&](int slice, int m, int c0, int c1) {
        const float H = p.ratio * h, x = (m - 1) * H;
        const int first = c0 / p.ratio, count = (c1 - 1) / p.ratio - first + 5;
        float nodes[MOST + 5 + W];
        for (int k = 0; k < count + W; ++k) nodes[k] = 0.0f;
        const float* objects = p.objects.data + (long long)slice * p.objects_most * NO;
        for (int n = 0; n < objects_count; ++n) {
            const Object o = *(const Object*)(objects + n * NO);
            const float dx = x - o.x, rest = o.radius * o.radius - dx * dx;
            if (rest <= 0.0f) continue;
            const float half = sq(rest);
            int k0 = (int)floorf((o.y - half) / H) + 1 - first, k1 = (int)floorf((o.y + half) / H) + 2 - first;
            k0 = k0 > 0 ? k0 : 0; k1 = k1 < count ? k1 : count;
            for (int b = k0; b < k1; b += W)
                for (int k = b; k < b + W; ++k) nodes[k] += far_share(o, dx, (k + first - 1) * H - o.y);
        }
        // cubic through four nodes; the fine centre i of an interval lies at (i + 1/2) / ratio
        float w[4][32 + 4];
        for (int i = 0; i < p.ratio + 4; ++i) weights((i + 0.5f) / p.ratio, w[0][i], w[1][i], w[2][i], w[3][i]);
        float* out = p.far.data + ((long long)slice * p.far_rows + m) * p.far_pitch;
        for (int k = 0; (first + k) * p.ratio < c1; ++k) {
            const float a = nodes[k], b = nodes[k + 1], c = nodes[k + 2], d = nodes[k + 3];
            float* to = out + (first + k) * p.ratio;
            // four at a time: what is written beyond the interval the next one writes again
            for (int i = 0; i < p.ratio; i += 4)
                for (int j = i; j < i + 4; ++j) to[j] = a * w[0][j] + b * w[1][j] + c * w[2][j] + d * w[3][j];
        }
    };
"""

WEIGHTS = """
    auto weights = [](float t, float& a, float& b, float& c, float& d) {
        a = -t * (t - 1.0f) * (t - 2.0f) * 0.16666667f;
        b = (t + 1.0f) * (t - 1.0f) * (t - 2.0f) * 0.5f;
        c = -(t + 1.0f) * t * (t - 2.0f) * 0.5f;
        d = (t + 1.0f) * t * (t - 1.0f) * 0.16666667f;
    };
"""

STATIC = """
    auto static_run = [&](int row, int c0, int c1) {
        const int NL = LINE_SIZE;
        const float x = (row + 0.5f) * h;
        float best[2 * PITCH];
        int line[2 * PITCH];
        for (int j = 0; j < 2 * PITCH; ++j) { best[j] = 0.0f; line[j] = -1; }
        for (int k = 0; k < lines_count; ++k) {
            const float* g = p.lines.data + k * NL;
            if (x < g[14] || x > g[15]) continue;
            const float rx = x - g[0];
            float y0, y1;
            window(rx, g[2], g[3], inverse(g[2]), inverse(g[3]), g[16], g[17], g[18], g[19], y0, y1);
            if (y0 >= y1) continue;
            int j0, j1; clip(g[1] + y0, g[1] + y1, c0, c1, j0, j1);
            float* top = best + (g[12] > 0.5f ? PITCH : 0);
            int* name = line + (g[12] > 0.5f ? PITCH : 0);
            const int index = (int)g[13];
            for (int j = j0; j < j1; ++j) {
                const float ry = (j + 0.5f) * h - g[1];
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
    };
"""

TASKS = """
    const int objects_count = p.counts.data[0], lines_count = p.counts.data[1];
"""

PREPARE = """
    const int far_tasks = p.two_level ? p.slices * p.far_rows * runs : 0, static_tasks = p.rows * runs;
    if (task < far_tasks) {
        const int c0 = (task % runs) * p.run, c1 = c0 + p.run < p.columns ? c0 + p.run : p.columns;
        far_row(task / (p.far_rows * runs), (task / runs) % p.far_rows, c0, c1);
    } else if (task < far_tasks + static_tasks) {
        const int t = task - far_tasks, c0 = (t % runs) * p.run;
        static_run(t / runs, c0, c0 + p.run < p.columns ? c0 + p.run : p.columns);
    } else if (task - far_tasks - static_tasks < objects_count) {
        path_rows(task - far_tasks - static_tasks);
    }
"""
