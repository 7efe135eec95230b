"""Motions rolled out and checked, one by one or in search of each path's highest target speed; see `rollout.roll_out`.

A motion that is only judged ends at its first failure. The search tries targets from the highest down and stops at the
first that passes: what is slower says nothing more.
"""

from __future__ import annotations

from services.planner.native.parameters import structure

_FIELD = """
    int steps;
    int points;
    int slices;
    int soft;
    int tier;
    double step;
    double dt;
    double speed;
    double acceleration;
    double look;
    double gain;
    double down;
    double up_brake;
    double up_gas;
    double up_comfort;
    double brake;
    double accel;
    double hard;          // decelerations beyond this are let go fast [m/s2]
    double jerk;
    double hold_s;
    double clear;         // short of a contact while moving, less of what moves away [m]
    double least_clear;   // but never less than this [m]
    double soft_after;
    double lateral;       // largest lateral acceleration [m/s2]
    double until;         // checks end here [s]
    double headway;
    double ease;
    double ease_s;
    double closing;       // who closes in so fast must have all of the headway [m/s]
    double gap;
    double stop_brake;
    const int* slice_of;  // [steps + 1]
    const double* into;   // [steps + 1]: how far into its slice each step is [s]
    const double* hit;    // [n, S, p], as the next ones
    const double* rate;
    const double* away;
    const double* law;
    const double* law_now;
    const double* stays;  // [n, p]
    const double* cap;    // [n, p]
    const double* cap_squared;       // [n, p]
    const double* bend;   // [n, p]
    const double* end;    // [n]
    const int* path;      // [K]
"""

Roll = structure(
    "Roll",
    _FIELD
    + """
    const double* target; // [K]
    const double* hold;   // [K]
    int traced;           // 0: only judged, up to the first failure
    double* s;            // [K, steps + 1], as the next ones; if traced
    double* v;
    double* a;
    int* failure;         // [K]
    int* failed_at;       // [K]
    """,
)

Search = structure(
    "Search",
    _FIELD
    + """
    int coarse;           // targets tried at first
    int fine;             // and between two of them, twice
    int paths;            // K
    const double* s_max;  // [K]: the highest target
    const double* shares; // [coarse] of it, increasing
    int* passed;          // [2, K]: going on, stopping after the hold; as the next ones
    double* desired;
    double* rest;
    int* failure;
    int* failed_at;
    double* failed_distance;
    """,
)

_ONE = """
    struct Judged { int failure, failed_at; double failed_distance, rest; };
    auto roll = [&](int path, double target, double hold, double* out_s, double* out_v, double* out_a) -> Judged {
        const int n = p.steps;
        const double* cap2 = p.cap_squared + (long long)path * p.points;
        const double* caps = p.cap + (long long)path * p.points;
        const double inverse = 1.0 / p.step, last = p.points - 1.001;
        const double* put = p.stays + (long long)path * p.points;
        const double* bend = p.bend + (long long)path * p.points;
        const double end = p.end[path];
        double s = 0.0, v = p.speed, a = p.acceleration;
        Judged judged = {0, n, 0.0, 0.0};
        for (int i = 0; i <= n; ++i) {
            if (out_s) { out_s[i] = s; out_v[i] = v; out_a[i] = a; }
            if (judged.failure == 0) {
                // the checks, in the order of their names
                const double t = p.dt * i;
                int cell = (int)(s * inverse); cell = cell > p.points - 1 ? p.points - 1 : cell;
                const long long here = ((long long)path * p.slices + p.slice_of[i]) * p.points + cell;
                const double hit = p.hit[here] + p.rate[here] * p.into[i];
                const bool moving = v > 0.05;
                const double away = p.away[here];
                double clear = p.clear - away * away * (0.5 / p.stop_brake);
                clear = !moving ? 0.0 : clear > p.least_clear ? clear : p.least_clear;
                int bad = s + clear < hit ? 0 : 1;
                if (p.soft) {
                    double law = p.law[here];
                    if (p.into[i] < p.dt - 1e-9 && p.law_now[here] < law) law = p.law_now[here];
                    double left = t - p.hold_s; left = target - p.brake * (left > 0.0 ? left : 0.0);
                    left = left > 0.0 ? left : 0.0;
                    const bool above = t <= (hold < p.hold_s ? hold : p.hold_s)
                        ? target > law + 1e-9 : v > (law > left ? law : left) + 0.05;
                    if (bad == 0 && above) bad = 2;
                    if (t >= p.soft_after - 1e-9 && bad == 0 && moving) {
                        const double way = v * v * (0.5 / p.stop_brake) + s;
                        double ease = p.ease + (1.0 - p.ease) * (t - p.soft_after) / p.ease_s;
                        ease = ease < 1.0 ? ease : 1.0;
                        double closes = (v - away) / p.closing; closes = closes > 0.0 ? closes : 0.0;
                        ease += (1.0 - ease) * (closes < 1.0 ? closes : 1.0);
                        const double need = v * p.headway * ease + way;
                        const double room = hit - p.gap + away * away * (0.5 / p.stop_brake);
                        if (need > room && v > 0.85 * away + 0.05) bad = 3;
                        else if (v * p.headway + way > put[cell]) bad = 4;
                    }
                }
                if (bad == 0 && s > end && moving) bad = 5;
                if (bad == 0 && bend[cell] * v * v > p.lateral) bad = 6;
                if (bad && t < p.until - 1e-9) {
                    judged.failure = bad; judged.failed_at = i; judged.failed_distance = s;
                    if (!out_s) return judged;
                }
            }
            if (i == n) break;
            double ahead = (s + v * p.look) * inverse; ahead = ahead < last ? ahead : last;
            const int c = (int)ahead;
            const double soon = sqrt(cap2[c] + (ahead - c) * (cap2[c + 1] - cap2[c]));
            const double at = s * inverse;
            const double cap = caps[(int)(at < last ? at : last)];
            const bool stopping = hold <= p.dt * i + 1e-9;
            double wanted = target < soon ? target : soon; wanted = wanted < cap ? wanted : cap;
            if (stopping) wanted = 0.0;
            double aw = stopping ? -p.brake : (wanted - v) * p.gain;
            const bool rest = wanted <= 0.0;
            if (p.tier == 0 && aw < -0.15) {
                const double soft = -0.15 - sqrt(2.0 * p.jerk * v); aw = aw > soft ? aw : soft;
            }
            if (rest && v > 0.0) aw = aw < -0.15 ? aw : -0.15;
            aw = aw > -p.brake ? aw : -p.brake; aw = aw < p.accel ? aw : p.accel;
            const double up = a < p.hard ? p.up_brake : (a < 0.0 ? p.up_comfort : p.up_gas);
            double change = aw - a; change = change > p.down ? change : p.down; change = change < up ? change : up;
            double an = a + change;
            const double mean = 0.5 * (a + an);
            double vn = v + mean * p.dt, moved = 0.5 * p.dt * (v + vn);
            if (vn <= 1e-3) {
                const double most = -2.0 * mean > 1e-6 ? -2.0 * mean : 1e-6;
                const double way = v > 0.0 ? v * v / most : 0.0;
                moved = way < v * p.dt ? way : v * p.dt;
                vn = 0.0;
                an = rest ? 0.0 : (an > 0.0 ? an : 0.0);
            }
            s += moved; v = vn; a = an;
        }
        judged.rest = s;
        return judged;
    };
"""

ROLL = Roll.cpp + (
    _ONE
    + """
    const long long out = (long long)k * (p.steps + 1);
    const Judged judged = p.traced ? roll(p.path[k], p.target[k], p.hold[k], p.s + out, p.v + out, p.a + out)
        : roll(p.path[k], p.target[k], p.hold[k], nullptr, nullptr, nullptr);
    p.failure[k] = judged.failure;
    p.failed_at[k] = judged.failed_at;
"""
)

SEARCH = Search.cpp + (
    _ONE
    + """
    struct Best { int passed; double desired, rest; Judged fails; };
    // the highest target that passes, looked for only as long as it may be above `floor`
    auto highest = [&](double hold, double floor) -> Best {
        const double s_max = p.s_max[k];
        Best best = {0, 0.0, 0.0, {0, 0, 0.0, 0.0}};
        double low = -1.0, high = 1.0;
        for (int round = 0; round < 3; ++round) {
            if (round > 0 && (!best.passed || low >= 1.0)) break;
            const int m = round ? p.fine : p.coarse;
            const double from = low, span = high - low;
            for (int i = m - 1; i >= 0; --i) {
                if (high * s_max <= floor) return {0, 0.0, 0.0, {0, 0, 0.0, 0.0}};
                const double share = round ? from + (i + 1.0) / (m + 1) * span : p.shares[i];
                const double target = share * s_max;
                const Judged judged = roll(p.path[k], target, hold, nullptr, nullptr, nullptr);
                if (judged.failure == 0) {
                    best.passed = 1; best.desired = target; best.rest = judged.rest; low = share;
                    break;
                }
                high = share; best.fails = judged;
            }
        }
        return best;
    };
    Best found[2];
    found[0] = highest(1e300, -1.0);
    found[1] = highest(p.hold_s, found[0].passed ? found[0].desired : -1.0);
    for (int way = 0; way < 2; ++way) {
        const int at = way * p.paths + k;
        p.passed[at] = found[way].passed;
        p.desired[at] = found[way].desired;
        p.rest[at] = found[way].rest;
        p.failure[at] = found[way].fails.failure;
        p.failed_at[at] = found[way].fails.failed_at;
        p.failed_distance[at] = found[way].fails.failed_distance;
    }
"""
)
