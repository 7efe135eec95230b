"""Constants of a task, the windows in which a term can be other than 0, and elementary functions that vectorise."""

SIZES = """
#ifndef __CUDA_ARCH__
#pragma clang fp contract(fast)
#endif
#ifdef __CUDA_ARCH__
    const int MOST = 16, W = 1, G = 1;
#else
    const int MOST = 512, W = 16, G = 16;
#endif
    const int PITCH = MOST + 2 * W;
    const float h = p.h, inverse_h = 1.0f / p.h;
    const int runs = (p.columns + p.run - 1) / p.run, blocks = p.rows / 4;
"""

WINDOW = """
    // y-range of a row in which `al` and `pe` (along and beside a direction) may lie in their ranges
    auto window = [](float rx, float tx, float ty, float i_tx, float i_ty, float a0, float a1, float p0, float p1,
                     float& lo, float& hi) {
        lo = -1.0e5f; hi = 1.0e5f;
        if (i_ty != 0.0f) {
            const float u = (a0 - rx * tx) * i_ty, v = (a1 - rx * tx) * i_ty;
            lo = u < v ? u : v; hi = u < v ? v : u;
        } else if (rx * tx < a0 - 1.0f || rx * tx > a1 + 1.0f) { hi = lo; return; }
        if (i_tx != 0.0f) {
            const float u = (p0 + rx * ty) * i_tx, v = (p1 + rx * ty) * i_tx;
            const float l = u < v ? u : v, m = u < v ? v : u;
            lo = l > lo ? l : lo; hi = m < hi ? m : hi;
        } else if (-rx * ty < p0 - 1.0f || -rx * ty > p1 + 1.0f) { hi = lo; return; }
    };
    auto inverse = [](float v) { return v > 1.0e-4f || v < -1.0e-4f ? 1.0f / v : 0.0f; };
    // columns [j0, j1) of the run whose centres lie between y0 and y1; a hundredth of a cell is allowed for rounding
    auto clip = [=](float y0, float y1, int c0, int c1, int& j0, int& j1) {
        const float least = (float)c0, most = (float)c1;
        float a = y0 * inverse_h - 0.51f, b = y1 * inverse_h + 0.51f;
        a = a < least ? least : a; a = a > most ? most : a;
        b = b > most ? most : b; b = b < least ? least : b;
        j0 = (int)ceilf(a); j1 = (int)b;
    };
"""

FUNCTIONS = """
    auto sq = [](float v) { return sqrtf(v); };
    auto max0 = [](float v) { return v > 0.0f ? v : 0.0f; };
    auto ln1p = [](float v) {
#ifdef __CUDA_ARCH__
        return log1pf(v);
#else
        // ln(1 + v), v >= 0, to 3e-7: exponent, and a polynomial in the mantissa between 2/3 and 4/3, to vectorise
        union { float f; int i; } x; x.f = 1.0f + v;
        const int e = (x.i - 0x3f2aaaab) >> 23;
        x.i -= e << 23;
        const float m = x.f - 1.0f;
        float y = 0.17447373270988464f;
        y = y * m - 0.1968492865562439f; y = y * m + 0.19730514287948608f; y = y * m - 0.2479877918958664f;
        y = y * m + 0.3334149122238159f; y = y * m - 0.5000371336936951f; y = y * m + 0.9999994039535522f;
        return y * m + (float)e * 0.69314718056f;
#endif
    };
"""
