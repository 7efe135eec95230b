"""Candidate paths from their offsets, and the way to brake before a lower cap; see `bezier.build_paths`."""

from __future__ import annotations

from services.planner.native.parameters import structure

Build = structure(
    "Build",
    """
    int samples;          // m: arc lengths on the reference line
    int points;           // p: of a path
    double step;
    double max_curvature;
    double d;             // the start's offset, slope and bend
    double d1;
    double d2;
    const double* s;      // [m], as the next ones: the reference line there
    const double* x;
    const double* y;
    const double* heading;
    const double* sin;
    const double* cos;
    const double* curvature;
    const double* curvature_rate;
    const int* kind;      // [n]: which of the targets
    const double* offset; // [targets, m], as the next ones
    const double* slope;
    const double* bend;
    const double* length; // [n]
    double* out;          // [6, n, p]: x, y, heading, curvature, s, d
    double* end;          // [n]
    int paths;            // n
    """,
)

BUILD = Build.cpp + (
    """
    const int m = p.samples, P = p.points;
    const double* offset = p.offset + (long long)p.kind[path] * m;
    const double* slope = p.slope + (long long)p.kind[path] * m;
    const double* bend = p.bend + (long long)p.kind[path] * m;
    const double length = p.length[path];
    const double b0 = p.d - offset[0], b1 = b0 + (p.d1 - slope[0]) * length / 5.0;
    const double b2 = 2.0 * b1 - b0 + (p.d2 - bend[0]) * (length * length) / 20.0;
    const double g0 = b1 - b0, g1 = b2 - b1, g2 = -b2;
    const double h0 = g1 - g0, h1 = g2 - g1, h2 = -g2;
    struct Point { double x, y, heading, curvature, s, d, gauge, along; bool folded; };
    auto at = [&](int i) -> Point {
        double u = (p.s[i] - p.s[0]) / length; u = u < 0.0 ? 0.0 : (u > 1.0 ? 1.0 : u);
        const double w = 1.0 - u, uw = u * w, u2 = u * u, w2 = w * w;
        const double d = offset[i] + w2 * w * (b0 * w2 + 5.0 * b1 * uw + 10.0 * b2 * u2);
        const double d1 = slope[i] + 5.0 / length * w2 * (g0 * w2 + 4.0 * g1 * uw + 6.0 * g2 * u2);
        const double d2 = bend[i] + 20.0 / (length * length) * w * (h0 * w2 + 3.0 * h1 * uw + 3.0 * h2 * u2);
        const double k = p.curvature[i];
        double q = 1.0 - k * d;
        const bool folded = q < 0.15;  // inside the centre of the curve
        q = folded ? 0.15 : q;
        const double gauge = sqrt(q * q + d1 * d1), cosine = q / gauge, tangent = d1 / q;
        const double curvature =
            ((d2 + (p.curvature_rate[i] * d + k * d1) * tangent) * (cosine * cosine) / q + k) * cosine / q;
        return {p.x[i] - d * p.sin[i], p.y[i] + d * p.cos[i], p.heading[i] + atan2(d1, q), curvature, p.s[i], d,
            gauge, 0.0, folded};
    };
    // to even spacing along the path
    double* out[6];
    for (int f = 0; f < 6; ++f) out[f] = p.out + ((long long)f * p.paths + path) * P;
    Point a = at(0);
    int k = 0, bad = -1;
    for (int i = 0; i + 1 < m && k < P; ++i) {
        Point b = at(i + 1);
        b.along = a.along + 0.5 * (b.gauge + a.gauge) * (p.s[i + 1] - p.s[i]);
        const double span = b.along - a.along > 1e-9 ? b.along - a.along : 1e-9;
        for (; k < P && (p.step * k < b.along || i + 2 == m); ++k) {
            const double w = (p.step * k - a.along) / span;
            out[0][k] = a.x + w * (b.x - a.x); out[1][k] = a.y + w * (b.y - a.y);
            out[2][k] = a.heading + w * (b.heading - a.heading);
            const double curvature = out[3][k] = a.curvature + w * (b.curvature - a.curvature);
            out[4][k] = a.s + w * (b.s - a.s); out[5][k] = a.d + w * (b.d - a.d);
            const double bent = curvature < 0.0 ? -curvature : curvature;
            if (bad < 0 && k > 0 && (bent > p.max_curvature || a.folded || w > 1.0 + 1e-9)) bad = k;
        }
        a = b;
    }
    p.end[path] = p.step * (bad < 0 ? P - 1 : bad - 1);
"""
)

Brake = structure(
    "Brake",
    """
    int points;           // p
    double drop;          // of the squared speed from one point to the next
    const double* cap;    // [n, p]
    double* lowered;      // [n, p]
    """,
)

BRAKE = Brake.cpp + (
    """
    const double* cap = p.cap + (long long)row * p.points;
    double* lowered = p.lowered + (long long)row * p.points;
    double least = __builtin_inf();
    for (int i = p.points - 1; i >= 0; --i) {
        const double own = cap[i] * cap[i];
        least = own < least + p.drop ? own : least + p.drop;
        lowered[i] = sqrt(least);
    }
"""
)
