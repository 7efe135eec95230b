"""The speed that the risk beside n paths allows; see `beside.beside_law`."""

from __future__ import annotations

from services.planner.native.parameters import structure

Law = structure(
    "Law",
    """
    int slices;
    int points;
    double s_max;
    double r0;
    double r1;
    double along;
    double step;
    double going;         // from this speed on a source goes along [m/s]
    const double* starts; // [S]
    const float* left;    // [n, S, p]
    const float* right;
    const unsigned char* who_left;   // [n, S, p]
    const unsigned char* who_right;
    double* law;          // [n, S, p]
    double* law_now;      // [n, S, p]
    double* allowed;      // [n, p]: for this loop alone
    """,
)

SOURCE = Law.cpp + (
    """
    const int S = p.slices, P = p.points, MOST = 128, T = S < 32 ? S : 32;
    const long long base = (long long)path * S * P;
    const double* starts = p.starts;
    double* law = p.law + base; double* law_now = p.law_now + base;
    const double none = -1e9, any = 1e18;
    double front[128][32], back[128][32], speed[128][32];
    int first[128][32], last[128][32];
    const double span = p.r1 - p.r0 > 1e-9 ? p.r1 - p.r0 : 1e-9;
    for (int side = 0; side < 2; ++side) {
        const float* risk = (side ? p.right : p.left) + base;
        const unsigned char* who = (side ? p.who_right : p.who_left) + base;
        bool met[128] = {};
        int names[128], sources = 0;
        // between which stations each source makes itself felt, where that is known
        for (int j = 0; j < T; ++j) {
            for (int i = 0; i < P; ++i) {
                const int k = who[(long long)j * P + i];
                if (k >= MOST) continue;
                if (!met[k]) {
                    met[k] = true; names[sources++] = k;
                    for (int m = 0; m < T; ++m) last[k][m] = -1;
                }
                if (last[k][j] < 0) first[k][j] = i;
                last[k][j] = i;
            }
        }
        for (int m = 0; m < sources; ++m) {
            const int k = names[m];
            for (int j = 0; j < T; ++j) {
                front[k][j] = none; back[k][j] = none;
                if (last[k][j] < 0) continue;
                const float* r = risk + (long long)j * P;
                int i = first[k][j];
                if (i > 0)
                    back[k][j] = i - 1 + (r[i - 1] < p.r0 ? (p.r0 - r[i - 1]) / (r[i] - r[i - 1] + 1e-12) : 0.5);
                i = last[k][j];
                if (i + 1 < P)
                    front[k][j] = i + (r[i + 1] < p.r0 ? (r[i] - p.r0) / (r[i] - r[i + 1] + 1e-12) : 0.5);
            }
        }
        for (int m = 0; m < sources; ++m) {
            const int k = names[m];
            for (int j = 0; j < T; ++j) {
                speed[k][j] = none;
                if (front[k][j] == none && back[k][j] == none) continue;
                double best = none;
                for (int way = 0; way < 2 && best == none; ++way) {  // over the next slices, otherwise the last
                    int a = j, b = j;
                    if (way == 0)
                        while (b + 1 < T && b < j + 4 && (front[k][b + 1] != none || back[k][b + 1] != none)) ++b;
                    else if (j > 0) a = j - 1;
                    if (a == b) continue;
                    const double dt = starts[b] - starts[a];
                    const bool f = front[k][a] != none && front[k][b] != none;
                    const bool g = back[k][a] != none && back[k][b] != none;
                    const double uf = p.step * (front[k][b] - front[k][a]) / dt;
                    const double ug = p.step * (back[k][b] - back[k][a]) / dt;
                    if (f && g) best = uf < ug ? uf : ug;
                    else if (f) best = uf;
                    else if (g) best = ug;
                }
                speed[k][j] = best;
            }
        }
        // from the last slice on back: what holds in j is read in j and in j + 1
        for (int j = S - 1; j >= 0; --j) {
            const long long row = (long long)j * P;
            for (int i = 0; i < P; ++i) {
                const double r = risk[row + i];
                double one = p.s_max;
                if (p.r1 - r < span) {
                    double share = (p.r1 - r) / span;
                    share = share < 0.0 ? 0.0 : (share > 1.0 ? 1.0 : share);
                    one = p.s_max * share;
                }
                double standing = one, moving = any;
                const int k = who[row + i];
                if (k < MOST && j < T) {
                    const double u = speed[k][j];
                    if (p.along * u > one) one = p.along * u;
                    if (u >= p.going) { moving = one; standing = any; } else standing = one;
                }
                const double next = j + 1 < S ? p.allowed[(long long)path * P + i] : any;
                const double least = standing < next ? standing : next;
                p.allowed[(long long)path * P + i] = standing;
                if (side == 0 || least < law[row + i]) law[row + i] = least;
                if (side == 0 || moving < law_now[row + i]) law_now[row + i] = moving;
            }
        }
    }
"""
)
