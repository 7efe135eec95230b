"""One object's path as the segments that the kinetic term reads, from its vertices in float64."""

PATHS = """
    auto path_rows = [&](int n) {
        const double* v = p.vertices.data + (long long)n * p.vertices_most * 2;
        const double* arc = p.arcs.data + (long long)n * p.vertices_most;
        const int count = p.vertex_counts.data[n], last = count - 1;  // at least 3 vertices
        const double gx = p.pose.data[0], gy = p.pose.data[1], gc = p.pose.data[2], gs = p.pose.data[3];
        const double origin = p.origins.data[n];
        double x[VERTICES], y[VERTICES], tx[VERTICES], ty[VERTICES], length[VERTICES], cross[VERTICES], dot[VERTICES];
        bool turns[VERTICES];
        for (int i = 0; i < count; ++i) {
            const double dx = v[2 * i] - gx, dy = v[2 * i + 1] - gy;
            x[i] = gc * dx + gs * dy; y[i] = gc * dy - gs * dx;
        }
        for (int i = 0; i < last; ++i) {
            const double dx = x[i + 1] - x[i], dy = y[i + 1] - y[i];
            length[i] = sqrt(dx * dx + dy * dy);
            const double per = length[i] > 0.0 ? 1.0 / length[i] : 1.0;
            tx[i] = dx * per; ty[i] = dy * per;
        }
        turns[0] = turns[last] = false;
        for (int i = 1; i < last; ++i) {
            const double c = tx[i - 1] * ty[i] - ty[i - 1] * tx[i];
            cross[i] = c < 0.0 ? -c : c;
            dot[i] = tx[i - 1] * tx[i] + ty[i - 1] * ty[i];
            turns[i] = cross[i] > STRAIGHT || dot[i] < 0.0;
        }
        auto reach = [&](int k) { return k == 0 || k == last - 1 ? FAR : length[k]; };
        // straight runs become one segment, but for the pieces next to a turn: the arc length that they share with the
        // other side of it ends with them. The first segment has no beginning: vertex 1 always stays
        Segment* out = (Segment*)(p.segments.data + (long long)n * p.segments_most * NS);
        float ends[VERTICES];
        int size = 0;
        for (int a = 0, b; a < last; a = b) {
            for (b = a + 1; b < last && b != 1 && !(turns[b - 1] || turns[b] || turns[b + 1]); ) ++b;
            const bool first = a == 0;
            const int at = first ? b : a;
            const bool turn_a = turns[a], turn_b = turns[b];
            const double low = first ? -FAR : 0.0, high = first ? 0.0 : (b == last ? FAR : arc[b] - arc[a]);
            Segment& g = out[size];
            g.x = x[at]; g.y = y[at]; g.tx = tx[a]; g.ty = ty[a]; g.s = arc[at] - origin; g.low = low; g.high = high;
            g.i_tx = inverse(g.tx); g.i_ty = inverse(g.ty);
            g.bx = turn_a ? tx[a - 1] : 0.0; g.by = turn_a ? ty[a - 1] : 0.0;
            g.turn = turn_a ? (dot[a] >= 0.0 ? cross[a] : 1.0) : 0.0;
            g.before_most = turn_a && dot[a] >= COUPLED ? reach(a - 1) : 0.0;
            g.nx = turn_b ? tx[b] : 0.0; g.ny = turn_b ? ty[b] : 0.0;
            g.n0 = turn_b ? high * dot[b] : 0.0;
            g.next_most = turn_b && dot[b] >= COUPLED ? reach(b) : 0.0;
            const double xa = x[at] + low * tx[a], xb = x[at] + high * tx[a];
            g.x_low = xa < xb ? xa : xb; g.x_high = xa < xb ? xb : xa;
            g.bent = turn_a || turn_b ? 1.0f : 0.0f;
            ends[size++] = b == last ? 1.0e9f : (float)(arc[b] - origin);
        }

        // which of them each slice needs: inside a bend the arc length that neighbours share lies less than one width
        // off a segment's own
        float width = 0.0f;
        for (int slice = 0; slice < p.slices; ++slice) {
            Object& o = *(Object*)(p.objects.data + ((long long)slice * p.objects_most + n) * NO);
            const float low = o.s0 - o.half - o.width - (o.sign > 0.0f ? 0.0f : o.reach);
            const float high = o.s0 + o.half + o.width + (o.sign > 0.0f ? o.reach : 0.0f);
            int first = 0, upto = 0;
            for (int k = 0; k < size; ++k) { first += ends[k] < low ? 1 : 0; upto += ends[k] <= high ? 1 : 0; }
            o.first = first; o.last = upto < size ? upto : size - 1;
            width = o.width > width ? o.width : width;
        }
        // and the first and the last that may reach each row of blocks
        int* span = p.crossings.data + (long long)n * blocks * 2;
        for (int b = 0; b < blocks; ++b) { span[2 * b] = 1 << 30; span[2 * b + 1] = -1; }
        const float per = 0.25f * inverse_h;
        for (int k = 0; k < size; ++k) {
            float a = (out[k].x_low - width) * per, z = (out[k].x_high + width) * per;
            if (z < 0.0f || a >= (float)blocks) continue;
            a = a > 0.0f ? a : 0.0f; z = z < (float)(blocks - 1) ? z : (float)(blocks - 1);
            for (int b = (int)a; b <= (int)z; ++b) {
                span[2 * b] = k < span[2 * b] ? k : span[2 * b];
                span[2 * b + 1] = k;
            }
        }
    };
"""
