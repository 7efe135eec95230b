"""Where contact begins on n paths, and how it moves; see `contact.Contact`."""

from __future__ import annotations

from services.planner.native.parameters import structure

Crossing = structure(
    "Crossing",
    """
    int slices;
    int points;
    int over;             // slices before and after, over which a speed is read
    float r_hit;
    double far;
    double step;
    const double* starts; // [S]
    const float* risk;    // [n, S, p]
    const unsigned char* who;        // [n, S, p]
    double* hit;          // [n, S, p], as the next ones
    double* rate;
    double* away;
    """,
)

SOURCE = Crossing.cpp + (
    """
    const int S = p.slices, P = p.points;
    const long long base = (long long)path * S * P;
    const float* risk = p.risk + base;
    const unsigned char* who = p.who + base;
    double* hit = p.hit + base; double* rate = p.rate + base; double* away = p.away + base;
    // the first crossing at or beyond each station; who it is goes along in `away` for now
    for (int j = 0; j < S; ++j) {
        const float* r = risk + (long long)j * P;
        float most = 0.0f;
        for (int i = 0; i < P; ++i) most = r[i] > most ? r[i] : most;
        double next = p.far; int name = 255;
        if (most < p.r_hit) {
            for (int i = 0; i < P; ++i) { hit[(long long)j * P + i] = next; away[(long long)j * P + i] = name; }
            continue;
        }
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
        double* h = hit + (long long)j * P; double* v = rate + (long long)j * P; double* u = away + (long long)j * P;
        const bool last = j + 1 >= S;
        if (h[0] >= p.far && (last || h[P] >= p.far)) {  // no contact, neither now nor next
            for (int i = 0; i < P; ++i) { v[i] = 0.0; u[i] = -1.0; }
            continue;
        }
        const double span = last ? 1.0 : p.starts[j + 1] - p.starts[j];
        for (int i = 0; i < P; ++i) {
            const double a = h[i];
            double r = 0.0, off = 0.0, from = a;
            bool arrives = false;
            if (!last) {
                const double b = h[i + P];
                const bool same = u[i] == u[i + P] && u[i] != 255.0;
                if (a < p.far && b < p.far && same) {
                    r = (b - a) / span;
                    r = r < -60.0 ? -60.0 : (r > 60.0 ? 60.0 : r);
                } else if (b < a) { from = b; arrives = true; }
            }
            off = arrives ? 1.0 : a < p.far ? 0.0 : -1.0;  // for the last pass
            h[i] = from; v[i] = r; u[i] = off;
        }
    }
    // how fast it moves away: over as many slices before as after, while it moves steadily
    for (int j = 0; j + 1 < S; ++j) {
        const double* v = rate + (long long)j * P; double* u = away + (long long)j * P;
        for (int i = 0; i < P; ++i) {
            if (v[i] == 0.0) continue;
            double sum = v[i] * (p.starts[j + 1] - p.starts[j]), mean = v[i];
            for (int k = 1; k <= p.over && j - k >= 0 && j + k < S - 1; ++k) {
                const double before = v[i - (long long)k * P], after = v[i + (long long)k * P];
                if (before == 0.0 || after == 0.0) break;
                sum += before * (p.starts[j - k + 1] - p.starts[j - k]);
                sum += after * (p.starts[j + k + 1] - p.starts[j + k]);
                mean = sum / (p.starts[j + k + 1] - p.starts[j - k]);
            }
            u[i] = mean > 0.0 ? mean : 0.0;
        }
    }
    // who is alone now went as he came; who arrives goes on as he does then
    for (int j = 0; j < S; ++j) {
        const double* v = rate + (long long)j * P; double* u = away + (long long)j * P;
        for (int i = 0; i < P; ++i) {
            if (v[i] != 0.0) continue;
            if (u[i] > 0.5) u[i] = j + 1 < S && v[i + P] != 0.0 ? u[i + P] : 0.0;
            else u[i] = u[i] > -0.5 && j > 0 && v[i - P] != 0.0 ? u[i - P] : 0.0;
        }
    }
"""
)
