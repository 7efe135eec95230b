"""The source with the largest share at each block's highest cell."""

NAME = """
    const int bs = cells / 4;
    for (int g = 0; g < group; ++g) {
        const float* sum = acc + 4 * g * PITCH;
        const float* lobe = most + 4 * g * PITCH;
        const int* lobe_of = whose + 4 * g * PITCH;
        float bx[MOST / 4 + W], by[MOST / 4 + W], best[MOST / 4 + W], top[PITCH], top_row[PITCH];
        int id[MOST / 4 + W];
        for (int b = bs; b < bs + W; ++b) { bx[b] = by[b] = best[b] = 0.0f; id[b] = -1; }
        for (int j = 0; j < cells; ++j) {
            float highest = sum[j], at = 0.0f;
            for (int r = 1; r < 4; ++r) {
                const float v = sum[r * PITCH + j];
                at = v > highest ? (float)r : at; highest = v > highest ? v : highest;
            }
            top[j] = highest; top_row[j] = at;
        }
        for (int b = 0; b < bs; ++b) {
            float highest = top[4 * b], row = top_row[4 * b], column = 0.0f;
            for (int c = 1; c < 4; ++c) {
                const float v = top[4 * b + c];
                row = v > highest ? top_row[4 * b + c] : row; column = v > highest ? (float)c : column;
                highest = v > highest ? v : highest;
            }
            bx[b] = (4 * block + 0.5f + row) * h; by[b] = (c0 + 4 * b + 0.5f + column) * h;
            const int r = (int)row, c = 4 * b + (int)column;
            const long long at = (long long)(4 * block + r) * p.columns + c0 + c;
            const float still = p.static_best.data[at], moving = lobe[r * PITCH + c];
            best[b] = moving > still ? moving : still;
            id[b] = moving > still ? 2 * lobe_of[r * PITCH + c] + 1
                                   : (p.static_line.data[at] >= 0 ? 2 * objects_count + p.static_line.data[at] : -1);
        }
        const float* objects = p.objects.data + (long long)(slice0 + g) * p.objects_most * NO;
        for (int n = 0; n < objects_count; ++n) {
            const Object& q = *(const Object*)(objects + n * NO);
            const float dx = max0((x_mid > q.x ? x_mid - q.x : q.x - x_mid) - 2.0f * h);
            const float rest = q.radius * q.radius - dx * dx;
            if (rest <= 0.0f) continue;
            const Object o = q;
            const float half = sq(rest) + 2.0f * h;
            int j0, j1;
            clip(o.y - half, o.y + half, c0, c1, j0, j1);
            const int b0 = (j0 - c0) / 4, b1 = (j1 - c0 + 3) / 4 < bs ? (j1 - c0 + 3) / 4 : bs;
            if (square) {
                for (int c = b0; c < b1; c += W)
                    for (int b = c; b < c + W; ++b) {
                        const float e = tapered(o, bx[b] - o.x, by[b] - o.y);
                        id[b] = e > best[b] ? 2 * n : id[b]; best[b] = e > best[b] ? e : best[b];
                    }
            } else {
                for (int b = b0; b < b1; ++b) {
                    const float e = potential(o, bx[b] - o.x, by[b] - o.y);
                    id[b] = e > best[b] ? 2 * n : id[b]; best[b] = e > best[b] ? e : best[b];
                }
            }
        }
        int* named = p.dominant.data + ((long long)(slice0 + g) * blocks + block) * (p.columns / 4) + c0 / 4;
        for (int b = 0; b < bs; ++b) named[b] = id[b];
    }
"""
