"""Small made-up traffic for tests of learning."""

from __future__ import annotations

import gzip
from pathlib import Path

import numpy as np

from evaluation.trajectory_windows import Recorded, Recording

HEADER = "rec,track,type,frame,t,x,y,vx,vy,heading,length,width\n"


def track(name, x, y, *, cls=1, frame0=0, length=4.5, width=1.8):
    x, y = np.asarray(x, float), np.asarray(y, float)
    heading = np.arctan2(np.gradient(y), np.gradient(x))
    return Recorded(name, cls, length, width, frame0, x, y, heading)


def turning(k, speed, rate, *, x0=0.0, y0=0.0, heading=0.0, name="a", slow=0.0, frame0=0):
    """k frames at a speed [m/s] that falls by `slow` [m/s²] and a turn rate [rad/s]."""
    t = 0.1 * np.arange(k)
    v = np.maximum(speed - slow * t, 0.0)
    psi = heading + rate * t
    step = 0.1 * v
    x = x0 + np.concatenate(([0.0], np.cumsum(step[1:] * np.cos(psi[1:]))))
    y = y0 + np.concatenate(([0.0], np.cumsum(step[1:] * np.sin(psi[1:]))))
    return track(name, x, y, frame0=frame0)


def traffic(name="rec0", site="made", n=6, k=120, seed=0):
    rng = np.random.default_rng(seed)
    tracks = [
        turning(k, rng.uniform(4, 14), rng.uniform(-0.2, 0.2), x0=9.0 * i, y0=rng.uniform(-9, 9),
                heading=rng.uniform(-3, 3), name=f"t{i}", slow=rng.uniform(-0.5, 0.8))
        for i in range(n)
    ]  # fmt: skip
    return Recording(name, site, tuple(tracks))


def rows_of(recording: Recording) -> list[str]:
    rows = []
    for t in recording.tracks:
        for i in range(len(t.x)):
            f = t.frame0 + i
            rows.append(
                f"{recording.name},{t.name},car,{f},{f / 10:.1f},{t.x[i]:.4f},{t.y[i]:.4f},,,{t.heading[i]:.4f},"
                f"{t.length},{t.width}\n"
            )
    return rows


def table(path: Path, recordings: list[Recording]) -> Path:
    text = HEADER + "".join(row for r in recordings for row in rows_of(r))
    if path.name.endswith(".gz"):
        with gzip.open(path, "wt") as f:
            f.write(text)
    else:
        path.write_text(text)
    return path
