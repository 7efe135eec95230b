"""The planner's two hot loops as Warp kernels on the CPU: looking paths up in the volume, rolling motions out.

The NumPy forms in `footprint.py` and `rollout.py` are the reference; a test holds that both give the same. Importing
this module compiles nothing; the first launch does (seconds when the cache is cold).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt
import warp as wp

from common.kernel_cache import kernel_cache
from services.planner.volume import Volume

F32 = npt.NDArray[np.float32]
F64 = npt.NDArray[np.float64]
I32 = npt.NDArray[np.int32]
Integers = npt.NDArray[np.integer[Any]]

MOST_SLICES = 256

wp.config.log_level = wp.LOG_ERROR
wp.set_module_options({"enable_backward": False, "cpu_compiler_flags": "-march=native -w"})


@wp.struct
class LookUp:
    """Paths to look up; flat arrays, C order."""

    slices: int  # from `first` on
    first: int
    rows: int
    columns: int
    samples: int
    later: int  # the last slice of `stays`, counted from `first`
    half: int  # 1: the volume is float16
    volume16: wp.array(dtype=wp.uint16)
    volume32: wp.array(dtype=float)
    x: wp.array(dtype=wp.float64)  # rear axle in grid coordinates [cells]
    y: wp.array(dtype=wp.float64)
    cos: wp.array(dtype=wp.float64)  # of the heading in the grid, per cell of h
    sin: wp.array(dtype=wp.float64)
    outline_x: wp.array(dtype=wp.float64)  # samples of the outline, frame of the rear axle [m]
    outline_y: wp.array(dtype=wp.float64)
    margin: wp.array(dtype=wp.float64)  # taken off each sample's risk for `contact`
    ahead_margin: wp.array(dtype=wp.float64)  # and for `ahead`
    points: int
    risk: wp.array(dtype=float)  # [n, slices, points]
    stays: wp.array(dtype=float)  # [n, points]
    whole: wp.array(dtype=wp.uint8)  # [n, points]
    contact: wp.array(dtype=float)  # [n, slices, points]
    ahead: wp.array(dtype=float)  # [n, slices, points]


_LOOK_UP = """
    float top[256], touch[256], ahead[256];
    const int path = task / p.points, point = task % p.points;
    const long long plane = (long long)p.rows * p.columns;
    float stays = 0.0f;
    bool whole = true;
    for (int j = 0; j < p.slices; ++j) { top[j] = 0.0f; touch[j] = 0.0f; ahead[j] = 0.0f; }
    for (int k = 0; k < p.samples; ++k) {
        const double ox = p.outline_x.data[k], oy = p.outline_y.data[k];
        double fi = p.x.data[task] + p.cos.data[task] * ox - p.sin.data[task] * oy;
        double fj = p.y.data[task] + p.sin.data[task] * ox + p.cos.data[task] * oy;
        if (!(fi >= 0.0 && fi <= p.rows && fj >= 0.0 && fj <= p.columns)) { whole = false; continue; }
        fi -= 0.5; fj -= 0.5;
        fi = fi < 0.0 ? 0.0 : (fi > p.rows - 1.0 ? p.rows - 1.0 : fi);
        fj = fj < 0.0 ? 0.0 : (fj > p.columns - 1.0 ? p.columns - 1.0 : fj);
        int i = (int)fi, j0 = (int)fj;
        i = i > p.rows - 2 ? p.rows - 2 : i; j0 = j0 > p.columns - 2 ? p.columns - 2 : j0;
        const float wi = (float)(fi - i), wj = (float)(fj - j0);
        const float a = (1.0f - wi) * (1.0f - wj), b = (1.0f - wi) * wj, c = wi * (1.0f - wj), d = wi * wj;
        const long long at = (long long)p.first * plane + (long long)i * p.columns + j0;
        const float margin = (float)p.margin.data[k], front = (float)p.ahead_margin.data[k];
        float least = 3e38f;
        for (int j = 0; j < p.slices; ++j) {
            float v;
            if (p.half) {
                const unsigned short* m = (const unsigned short*)p.volume16.data + at + j * plane;
                // every value is >= 0 and finite: the bits of float16, moved, times 2^112
                union { unsigned int i; float f; } q0, q1, q2, q3;
                q0.i = (unsigned int)m[0] << 13; q1.i = (unsigned int)m[1] << 13;
                q2.i = (unsigned int)m[p.columns] << 13; q3.i = (unsigned int)m[p.columns + 1] << 13;
                v = (q0.f * 5.192296858534828e33f) * a + (q1.f * 5.192296858534828e33f) * b
                  + (q2.f * 5.192296858534828e33f) * c + (q3.f * 5.192296858534828e33f) * d;
            } else {
                const float* m = p.volume32.data + at + j * plane;
                v = m[0] * a + m[1] * b + m[p.columns] * c + m[p.columns + 1] * d;
            }
            top[j] = v > top[j] ? v : top[j];
            touch[j] = v - margin > touch[j] ? v - margin : touch[j];
            ahead[j] = v - front > ahead[j] ? v - front : ahead[j];
            if (j <= p.later) least = v < least ? v : least;
        }
        stays = least - margin > stays ? least - margin : stays;
    }
    for (int j = 0; j < p.slices; ++j) {
        const long long at = ((long long)path * p.slices + j) * p.points + point;
        p.risk.data[at] = top[j]; p.contact.data[at] = touch[j]; p.ahead.data[at] = ahead[j];
    }
    p.stays.data[task] = stays;
    p.whole.data[task] = whole ? 1 : 0;
"""


@wp.func_native(_LOOK_UP)
def look_up_point(p: LookUp, task: int):  # noqa: D103
    ...


@wp.kernel
def look_up_kernel(p: LookUp):
    """The footprint's maximum at one point of one path, in every slice."""
    look_up_point(p, wp.tid())


@wp.struct
class Roll:
    """Motions to roll out; see `rollout.roll_out` for the meaning of each value."""

    steps: int
    points: int
    slices: int
    soft: int
    tier: int
    step: wp.float64
    dt: wp.float64
    speed: wp.float64
    acceleration: wp.float64
    look: wp.float64
    gain: wp.float64
    down: wp.float64
    up_brake: wp.float64
    up_gas: wp.float64
    up_comfort: wp.float64
    brake: wp.float64
    accel: wp.float64
    hard: wp.float64  # decelerations beyond this are let go fast [m/s²]
    jerk: wp.float64
    hold_s: wp.float64
    clear: wp.float64
    soft_after: wp.float64
    until: wp.float64  # checks end here [s]
    headway: wp.float64
    stop_brake: wp.float64
    slice_of: wp.array(dtype=int)  # [steps + 1]
    path: wp.array(dtype=int)  # [K]
    target: wp.array(dtype=wp.float64)  # [K]
    hold: wp.array(dtype=wp.float64)  # [K]
    hit: wp.array(dtype=wp.float64)  # [n, S, p], as the next ones
    hit_ahead: wp.array(dtype=wp.float64)
    room: wp.array(dtype=wp.float64)
    away: wp.array(dtype=wp.float64)
    law: wp.array(dtype=wp.float64)
    stays: wp.array(dtype=wp.float64)  # [n, p]
    cap_squared: wp.array(dtype=wp.float64)  # [n, p]
    end: wp.array(dtype=wp.float64)  # [n]
    s: wp.array(dtype=wp.float64)  # [K, steps + 1], as the next ones
    v: wp.array(dtype=wp.float64)
    a: wp.array(dtype=wp.float64)
    failure: wp.array(dtype=int)  # [K]
    failed_at: wp.array(dtype=int)  # [K]


_ROLL = """
    const int n = p.steps, path = p.path.data[k];
    const double target = p.target.data[k], hold = p.hold.data[k];
    const double* cap2 = p.cap_squared.data + (long long)path * p.points;
    const double inverse = 1.0 / p.step, last = p.points - 1.001;
    double s = 0.0, v = p.speed, a = p.acceleration;
    double* out_s = p.s.data + (long long)k * (n + 1);
    double* out_v = p.v.data + (long long)k * (n + 1);
    double* out_a = p.a.data + (long long)k * (n + 1);
    const double* hit = p.soft ? p.hit.data : p.hit_ahead.data;
    int failure = 0, failed_at = n;
    for (int i = 0; i <= n; ++i) {
        out_s[i] = s; out_v[i] = v; out_a[i] = a;
        if (failure == 0) {
            // the checks, in the order of their names
            const double t = p.dt * i;
            int cell = (int)(s * inverse); cell = cell > p.points - 1 ? p.points - 1 : cell;
            const long long here = ((long long)path * p.slices + p.slice_of.data[i]) * p.points + cell;
            const bool moving = v > 0.05;
            int bad = s + (moving ? p.clear : 0.0) < hit[here] ? 0 : 1;
            if (p.soft) {
                const double law = p.law.data[here];
                double left = t - p.hold_s; left = target - p.brake * (left > 0.0 ? left : 0.0);
                left = left > 0.0 ? left : 0.0;
                const bool above = t <= (hold < p.hold_s ? hold : p.hold_s)
                    ? target > law + 1e-9 : v > (law > left ? law : left) + 0.05;
                if (bad == 0 && above) bad = 2;
                if (t >= p.soft_after - 1e-9 && bad == 0 && moving) {
                    const double need = v * p.headway + v * v * (0.5 / p.stop_brake) + s;
                    if (need > p.room.data[here] && v > 0.85 * p.away.data[here] + 0.05) bad = 3;
                    else if (need > p.stays.data[(long long)path * p.points + cell]) bad = 4;
                }
            }
            if (bad == 0 && s > p.end.data[path] && moving) bad = 5;
            if (bad && t < p.until - 1e-9) { failure = bad; failed_at = i; }
        }
        if (i == n) break;
        double ahead = (s + v * p.look) * inverse; ahead = ahead < last ? ahead : last;
        const int c = (int)ahead;
        const double squared = cap2[c] + (ahead - c) * (cap2[c + 1] - cap2[c]);
        const double at = s * inverse;
        const double cap = sqrt(cap2[(int)(at < last ? at : last)]), soon = sqrt(squared);
        const bool stopping = hold <= p.dt * i + 1e-9;
        double wanted = target < soon ? target : soon; wanted = wanted < cap ? wanted : cap;
        if (stopping) wanted = 0.0;
        double aw = stopping ? -p.brake : (wanted - v) * p.gain;
        const bool rest = wanted <= 0.0;
        if (p.tier == 0) { const double soft = -0.15 - sqrt(2.0 * p.jerk * v); aw = aw > soft ? aw : soft; }
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
    p.failure.data[k] = failure;
    p.failed_at.data[k] = failed_at;
"""


@wp.func_native(_ROLL)
def roll_one(p: Roll, k: int):  # noqa: D103
    ...


@wp.kernel
def roll_kernel(p: Roll):
    """One motion: the driven controller step by step, and its first failed check."""
    roll_one(p, wp.tid())


_ready = False


def _initialise() -> None:
    global _ready
    if not _ready:
        wp.config.kernel_cache_dir = str(kernel_cache())
        wp.init()
        _ready = True


def warm_up() -> None:
    """Compile the kernels now (seconds when the cache is cold) and not in the first plan."""
    _initialise()
    wp.load_module(__name__, device="cpu")


def _in(a: npt.NDArray[Any], kind: Any) -> Any:
    return wp.array(np.ascontiguousarray(a).reshape(-1), dtype=kind, device="cpu", copy=False)


def look_up(
    volume: Volume, outline: tuple[F64, F64, F64, F64], x: F64, y: F64, heading: F64, later: int
) -> tuple[F32, F32, npt.NDArray[np.bool_], F32, F32]:
    """Risk [n, S, p], stays [n, p], whether the outline is known [n, p]; risk less either margin [n, S, p].

    Args:
        volume: the volume on the plan's clock.
        outline: samples of the footprint, frame of the rear axle [m], and their margins [E_max].
        x: rear axle along n paths of p points, `map` frame [n, p] [m].
        y: the same.
        heading: of the body there [rad].
        later: the last slice in which something must be there to count for `stays`.
    """
    _initialise()
    n, points = x.shape
    g = volume.risk.grid
    i, j = volume.coordinates(x, y)
    q = LookUp()
    q.slices, q.first, q.rows, q.columns = volume.slices, volume.first, g.rows, g.columns
    q.samples, q.later, q.points = len(outline[0]), later, points
    m = volume.risk.volume
    q.half = int(m.dtype == np.float16)
    q.volume16 = _in(m.view(np.uint16) if q.half else np.zeros(1, np.uint16), wp.uint16)
    q.volume32 = _in(np.zeros(1, np.float32) if q.half else m, wp.float32)
    q.x, q.y = _in(i, wp.float64), _in(j, wp.float64)
    q.cos, q.sin = (
        _in(np.cos(heading - g.heading) / g.h, wp.float64),
        _in(np.sin(heading - g.heading) / g.h, wp.float64),
    )
    q.outline_x, q.outline_y = _in(outline[0], wp.float64), _in(outline[1], wp.float64)
    q.margin, q.ahead_margin = _in(outline[2], wp.float64), _in(outline[3], wp.float64)
    risk, stays = np.empty((n, volume.slices, points), np.float32), np.empty((n, points), np.float32)
    contact, ahead = (np.empty((n, volume.slices, points), np.float32) for _ in range(2))
    q.contact, q.ahead = _in(contact, wp.float32), _in(ahead, wp.float32)
    whole = np.empty((n, points), np.uint8)
    q.risk, q.stays, q.whole = _in(risk, wp.float32), _in(stays, wp.float32), _in(whole, wp.uint8)
    wp.launch(look_up_kernel, dim=n * points, inputs=[q], device="cpu")
    return risk, stays, whole.view(np.bool_), contact, ahead


def roll_field(arrays: Mapping[str, F64]) -> Roll:
    """Hand over what every motion of a cycle looks up: the arrays of `Roll`, by name."""
    _initialise()
    q = Roll()
    for name, values in arrays.items():
        setattr(q, name, _in(values, wp.float64))
    return q


def roll(
    q: Roll, constants: Mapping[str, float], slice_of: Integers, path: Integers, target: F64, hold: F64
) -> tuple[F64, F64, F64, I32, I32]:
    """Roll K motions out; returns distance, speed, acceleration [K, steps + 1], failure and its step [K].

    Args:
        q: the field, from `roll_field`.
        constants: the numbers of `Roll`, by name.
        slice_of: slice in force at each step [steps + 1].
        path: path of each motion [K].
        target: target speed [K] [m/s].
        hold: when the braking starts [K] [s].
    """
    k, n = len(path), len(slice_of)
    q.steps = n - 1
    for name, value in constants.items():
        setattr(q, name, value)
    q.slice_of, q.path = _in(slice_of.astype(np.int32), wp.int32), _in(path.astype(np.int32), wp.int32)
    q.target, q.hold = _in(target, wp.float64), _in(hold, wp.float64)
    out: F64 = np.empty((3, k, n))
    failure, failed_at = np.empty(k, np.int32), np.empty(k, np.int32)
    q.s, q.v, q.a = (_in(part, wp.float64) for part in out)
    q.failure, q.failed_at = _in(failure, wp.int32), _in(failed_at, wp.int32)
    wp.launch(roll_kernel, dim=k, inputs=[q], device="cpu")
    return out[0], out[1], out[2], failure, failed_at
