"""Equations 2 to 4 at one cell: an object's potential and kinetic energy."""

OBJECTS = """
    struct Object {
        float x, y, c, s, i_c, i_s, half_length, half_width, A, A_e, radius, near, near_x, q0, f0, f1, f2, f3;
        float M2, inverse_L, reach, sign, s0, half, inverse_l, width, inverse_w2, low, high, first, last;
    };
    struct Segment {
        float x, y, tx, ty, i_tx, i_ty, s, low, high, bx, by, turn, before_most, nx, ny, n0, next_most, x_low, x_high;
        float bent;
    };
    const int NO = OBJECT_SIZE, NS = SEGMENT_SIZE;
"""

POTENTIAL = """
    const bool square = p.k1 == 2.0f, linear = p.k1 == 1.0f;
    const float taper_z = 1.0f / (p.taper_radius * (1.0f - p.taper_start));
    const float taper_0 = p.taper_start / (1.0f - p.taper_start), untouched = p.taper_radius * p.taper_start;
    const float k1 = p.k1;
    auto distance2 = [=](const Object& o, float dx, float dy) {
        const float al = o.c * dx + o.s * dy, be = o.c * dy - o.s * dx;
        const float lx = max0((al < 0.0f ? -al : al) - o.half_length), ly = max0((be < 0.0f ? -be : be) - o.half_width);
        return lx * lx + ly * ly;
    };
    auto taper = [=](float d) {
        float z = d * taper_z - taper_0; z = z > 0.0f ? z : 0.0f; z = z < 1.0f ? z : 1.0f;
        return 1.0f - z * z * (3.0f - 2.0f * z);
    };
    // k1 = 2, within 0.8 R of the centre
    auto inside = [=](const Object& o, float dx, float dy) { return o.A / (distance2(o, dx, dy) + o.A_e); };
    // k1 = 2
    auto tapered = [=](const Object& o, float dx, float dy) {
        const float d2 = distance2(o, dx, dy);
        return o.A * taper(sq(d2)) / (d2 + o.A_e);
    };
    auto potential = [=](const Object& o, float dx, float dy) {
        const float d2 = distance2(o, dx, dy), d = sq(d2);
        return o.A * taper(d) / ((square ? d2 : (linear ? d : powf(d, k1))) + o.A_e);
    };
    // two levels: within `near` of the body the potential gives way to a cubic in D² that fits to its second derivative
    auto smooth = [=](const Object& o, float z) { return z * (o.f1 + z * (o.f2 + z * o.f3)); };
    auto far_share = [=](const Object& o, float dx, float dy) {
        const float q = distance2(o, dx, dy), z = q < o.q0 ? q - o.q0 : 0.0f;
        return (o.A / ((q > o.q0 ? q : o.q0) + o.A_e) + smooth(o, z)) * taper(sq(q));
    };
    auto near_share = [=](const Object& o, float dx, float dy) {
        const float d2 = distance2(o, dx, dy), q = d2 < o.q0 ? d2 : o.q0;
        return o.A / (q + o.A_e) - o.f0 - smooth(o, q - o.q0);
    };
"""

KINETIC = """
    const float E_k = p.E_k, d0 = p.d0, inverse_e = 1.0f / p.e_max, e_max = p.e_max, horizon = p.t;
    // one object's lobe in one slice: what equation 4 needs, and between which arc lengths it is not 0
    struct Lobe { float M2, inverse_L, reach, sign, s0, half, inverse_l, inverse_w2, low, high; int slice; };
    // arc length on the path and squared distance beside it; whether the segment counts there
    auto bent_place = [=](const Segment& g, float rx, float ry, float& s, float& d2) {
        const float al = rx * g.tx + ry * g.ty, pe = ry * g.tx - rx * g.ty;
        const float below = al < g.low ? al - g.low : 0.0f, covered = rx * g.bx + ry * g.by;
        float back = max0(-covered), on = max0(rx * g.nx + ry * g.ny - g.n0);
        back = back < g.before_most ? back : g.before_most; on = on < g.next_most ? on : g.next_most;
        s = g.s + al - below + on - back;
        d2 = pe * pe + below * below;
        const float counts = al <= g.high ? 1.0f : 0.0f, met = covered > 0.0f ? 1.0f : 0.0f;
        return counts * (below < 0.0f ? met : 1.0f);
    };
    auto straight_place = [=](const Segment& g, float rx, float ry, float& s, float& d2) {
        const float al = rx * g.tx + ry * g.ty, pe = ry * g.tx - rx * g.ty;
        s = g.s + al;
        d2 = pe * pe;
        return al >= g.low ? (al <= g.high ? 1.0f : 0.0f) : 0.0f;
    };
    // b g sat(E_k ln(1 + K / K0)); sqrt(g) / (D_lo + d0) with one root
    auto sound = [=](const Lobe& o, float s, float d2) {
        const float lateral = max0(1.0f - d2 * o.inverse_w2), xi = o.sign * (s - o.s0) - o.half;
        const float b = max0(1.0f + (xi < 0.0f ? xi : 0.0f) * o.inverse_l), D = max0(xi) + d0;
        const float inverse_D_w = lateral / sq(lateral * D * D + 1.0e-20f);
        const float K = o.M2 * max0(inverse_D_w - o.inverse_L), v = E_k * ln1p(K);
        return b * lateral * v / (1.0f + v * inverse_e);
    };
    auto printed = [=](const Lobe& o, float s, float d2) {
        const float root = sq(max0(1.0f - d2 * o.inverse_w2)), ahead = o.sign * (s - o.s0);
        const float D_w = ahead / (root > 1.0e-6f ? root : 1.0e-6f), rest = o.reach - D_w;
        const float e = horizon / (D_w * rest > 1.0e-9f ? D_w * rest : 1.0e-9f);
        return ahead > 0.0f && rest > 0.0f && root > 1.0e-6f ? (e < e_max ? e : e_max) : 0.0f;
    };
"""
