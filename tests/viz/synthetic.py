"""A made-up drive that needs no service: two lanes, a slow car ahead, others beside; plausible, not the equations."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from common.messages import (
    BLOCK,
    NO_SLOT,
    Candidates,
    Cause,
    Closures,
    Decision,
    Ego,
    Goal,
    Grid,
    InputHealth,
    Lane,
    LeftOut,
    Map,
    Objects,
    Obstacle,
    Plan,
    Prediction,
    Risk,
    Route,
    SliceRisk,
    Slot,
    Stamped,
    Status,
    Trajectory,
)  # fmt: skip

SLICES = 13
ROWS, COLUMNS, H, BEHIND = 400, 160, 0.4, 30.0 * 1.0
BOOT = "synthetic0"


def of_blocks(volume: np.ndarray, source: np.ndarray) -> np.ndarray:
    """What `source` names at the highest cell of each block."""
    pad = [(0, 0), (0, -volume.shape[1] % BLOCK), (0, -volume.shape[2] % BLOCK)]
    wide, named = np.pad(volume, pad, constant_values=-1.0), np.pad(source, pad)
    shape = (len(wide), wide.shape[1] // BLOCK, BLOCK, wide.shape[2] // BLOCK, BLOCK)
    cells = [a.reshape(shape).swapaxes(2, 3).reshape(*shape[:2], shape[3], BLOCK**2) for a in (wide, named)]
    return np.take_along_axis(cells[1], cells[0].argmax(axis=-1)[..., None], axis=-1)[..., 0]


@dataclass(frozen=True)
class Drive:
    """A straight drive along a road at `angle` [rad] from (x0, y0) at `speed` [m/s]."""

    angle: float = 0.0
    x0: float = 0.0
    y0: float = 0.0
    speed: float = 14.0
    rows: int = ROWS
    columns: int = COLUMNS
    h: float = 0.4

    def world(self, s: Any, d: Any) -> tuple[np.ndarray, np.ndarray]:
        """Road coordinates (along, left) to the map frame [m]."""
        s, d = np.asarray(s, float), np.asarray(d, float)
        c, n = np.cos(self.angle), np.sin(self.angle)
        return self.x0 + c * s - n * d, self.y0 + n * s + c * d

    def line(self, s: Any, d: Any) -> np.ndarray:
        return np.stack(self.world(*np.broadcast_arrays(s, d)), axis=-1)

    def velocity(self, speed: Any) -> tuple[np.ndarray, np.ndarray]:
        return np.asarray(speed) * np.cos(self.angle), np.asarray(speed) * np.sin(self.angle)

    def map(self) -> Map:
        s = np.linspace(-100.0, 600.0, 71)
        kinds = (("solid", "dashed"), ("dashed", "kerb"))
        lanes = [
            Lane(
                id=i + 1, centre=self.line(s, d), left=self.line(s, d + 1.75), right=self.line(s, d - 1.75),
                left_type="barrier" if i == 0 else "dashed", right_type="dashed" if i == 0 else kinds[1][1],
                speed_limit=16.7,
            )
            for i, d in enumerate((3.5, 0.0))
        ]  # fmt: skip
        stop = Obstacle(id=50, kind="stop_line", points=self.line([230.0, 230.0], [-1.75, 5.25]), width=0.5)
        return Map(lanes=lanes, obstacles=[stop])

    def route(self) -> Route:
        x, y = self.world(400.0, 0.0)
        goal = Goal(x=float(x), y=float(y), radius=5.0, stop=True)
        return Route(reference=self.line(np.linspace(-10, 450, 93), 0.0), goal=goal, lane_ids=[2], speed_limit=15.0)

    def others(self, t: float) -> tuple[np.ndarray, ...]:
        """Along, left, speed, class, length, width of everyone else."""
        speed = np.array([8.0, 11.0, 15.0, 5.0, 0.0])
        s = np.array([38.0, 12.0, -14.0, 70.0, 95.0]) + speed * t
        d = np.array([0.0, 3.6, 3.4, -1.4, -4.2])
        return s, d, speed, np.array([1, 2, 1, 5, 6], np.uint8), np.array([4.6, 9.5, 4.4, 1.8, 0.6]), np.array(
            [1.9, 2.5, 1.8, 0.7, 0.6]
        )  # fmt: skip

    def ego(self, t: float) -> Ego:
        x, y = self.world(self.speed * t, 0.0)
        vx, vy = self.velocity(self.speed)
        return Ego(
            x=float(x), y=float(y), heading=self.angle, vx=float(vx), vy=float(vy), acceleration=-0.4, yaw_rate=0.0,
            length=4.7, width=1.9, wheelbase=2.8,
        )  # fmt: skip

    def objects(self, t: float) -> Objects:
        s, d, speed, cls, length, width = self.others(t)
        x, y = self.world(s, d)
        vx, vy = self.velocity(speed)
        n = len(s)
        return Objects(
            id=np.arange(n) + 11, cls=cls, x=x, y=y, heading=np.full(n, self.angle), vx=vx, vy=vy, length=length,
            width=width, mass=np.zeros(n),
        )  # fmt: skip

    def prediction(self, t: float) -> Prediction:
        s, d, speed, cls, length, width = self.others(t)
        n, f = len(s), (np.arange(60) + 1) * 0.1
        p = -np.arange(29, 0, -1) * 0.1
        x0, y0 = self.world(s, d)
        x, y = self.world(s[:, None] + speed[:, None] * f, d[:, None] + 0 * f)
        px, py = self.world(s[:, None] + speed[:, None] * p, d[:, None] + 0 * p)
        vx, vy = self.velocity(speed)
        return Prediction(
            id=np.arange(n) + 11, cls=cls, x0=x0, y0=y0, heading0=np.full(n, self.angle), vx0=vx, vy0=vy,
            length=length, width=width, mass=np.zeros(n), x=x, y=y,
            heading=np.full((n, 60), self.angle, np.float32),
            speed=np.repeat(speed[:, None], 60, 1).astype(np.float32), past_x=px, past_y=py,
            method=np.full(n, 2, np.uint8),
        )  # fmt: skip

    def grid(self, t: float) -> Grid:
        back, half = self.rows * self.h * 30 / 160, self.columns * self.h / 2
        x, y = self.world(self.speed * t - back, -half)
        return Grid(x=float(x), y=float(y), heading=self.angle, rows=self.rows, columns=self.columns, h=self.h)

    def risk(self, t: float) -> Risk:
        back, half = self.rows * self.h * 30 / 160, self.columns * self.h / 2
        gs = ((np.arange(self.rows) + 0.5)[:, None] * self.h - back + self.speed * t).astype(np.float32)
        gd = ((np.arange(self.columns) + 0.5)[None, :] * self.h - half).astype(np.float32)
        times = [0.5 * j for j in range(SLICES)]
        volume = np.zeros((SLICES, self.rows, self.columns), np.float32)
        most = np.zeros_like(volume)
        source = np.full(volume.shape, NO_SLOT, np.uint8)
        s, d, speed, _, length, width = self.others(t)

        def add(j: int, slot: int, share: np.ndarray) -> None:
            volume[j] += share
            larger = share > most[j]
            most[j] = np.maximum(most[j], share)
            source[j][larger] = slot

        # beyond the road's edges the field stays at its peak
        edges = ((-1.75 - gd, 1.5), (-np.abs(gd - 1.75), 0.1), (gd - 5.25, 1.5))
        static = [peak * np.clip(1 + far / 0.6, 0, 1) ** 2 + 0 * gs for far, peak in edges]
        for j, tj in enumerate(times):
            for i in range(len(s)):
                lo = np.maximum(np.abs(gs - s[i] - speed[i] * tj) - length[i] / 2, 0)
                la = np.maximum(np.abs(gd - d[i]) - width[i] / 2, 0)
                distance = np.hypot(lo, la)
                near = np.where(distance < 25, 1.0 / (1.0 + 0.8 * np.square(distance)), 0.0)
                front = np.clip(1 - (gs - s[i] - speed[i] * tj - length[i] / 2) / (3 * speed[i] + 1), 0, 1)
                ahead = gs > s[i] + speed[i] * tj
                add(j, i, near + 0.5 * front * ahead * np.maximum(0, 1 - (gd - d[i]) ** 2 / 3.2))
            for k, share in enumerate(static):
                add(j, len(s) + k, share)
        return Risk(
            grid=self.grid(t),
            slice_times=times,
            slots=[
                *(Slot(i + 11, "potential", int(c)) for i, c in enumerate(self.others(t)[3])),
                *(Slot(k, "static", -1, label) for k, label in enumerate(("kerb", "lane_line", "barrier"))),
            ],
            left_out=[LeftOut(13, "follows")],
            volume=volume.astype(np.float16),
            dominant=of_blocks(volume, source),
        )

    def trajectory(self, t: float, d_end: float, accel: float, t0: float, t1: float, v0: float) -> Trajectory:
        tau = np.arange(t0, t1 + 1e-9, 0.1)
        v = np.maximum(v0 + accel * (tau - t0), 0.0)
        s = np.concatenate(([0.0], np.cumsum((v[1:] + v[:-1]) / 2 * 0.1))) + v0 * t0
        share = np.clip(s / 45.0, 0, 1)
        d = d_end * share**2 * (3 - 2 * share)
        x, y = self.world(self.speed * t + s, d)
        slope = np.gradient(d, s + 1e-3 * np.arange(len(s)))
        v[-1] = 0.0 if accel < -2 else v[-1]
        return Trajectory(
            t=tau, x=x, y=y, heading=self.angle + np.arctan(slope), curvature=np.zeros(len(tau)), speed=v,
            acceleration=np.full(len(tau), accel),
        )  # fmt: skip

    def plan(self, t: float, age: float = 0.0) -> Plan:
        ends = np.linspace(-1.0, 4.5, 12)
        lengths = (40.0, 60.0, 80.0)
        xs, ys, speeds = [], [], []
        share = np.linspace(0, 1, 40)
        for reach in lengths:
            for end in ends:
                x, y = self.world(self.speed * t + share * reach, end * share**2 * (3 - 2 * share))
                xs.append(x)
                ys.append(y)
                speeds.append(4.0 + 9.0 * np.exp(-((end - 3.4) ** 2)) * reach / 80.0)
        lead_x, lead_y = self.world(38.0 + 8.0 * t + 8.0 * 3.0, 0.0)
        times = np.arange(SLICES) * 0.5
        x, y = self.world(self.speed * t + self.speed * times, 0 * times)
        grid = self.grid(t)
        cell = (int((38.0 + 8.0 * t + 24.0 - self.speed * t + 30.0) / grid.h), self.columns // 2)
        return Plan(
            mode="drive", reason="following the route", planner="default",
            profile=self.trajectory(t, 3.4, -0.5, 0.0, 6.0, self.speed),
            tail=self.trajectory(t, 3.4, -4.0, 0.3, 0.3 + self.speed / 4.0 + 0.1, self.speed), desired_speed=11.3,
            chosen=9, candidates=Candidates(x=np.array(xs), y=np.array(ys), desired_speed=np.array(speeds),
                                            score=-np.array(speeds)),
            slice_risk=SliceRisk(
                t=times, risk=0.3 + 0.4 * np.exp(-((times - 3) ** 2)) * (1 + 0.2 * np.sin(t)), x=x, y=y
            ),
            decision=Decision(
                sentence=f"Slows to 11.3 m/s: the kinetic term of car 11 reaches 0.62 at 3.0 s, {24.0:.0f} m ahead.",
                slice=6, slice_s=3.0 - age, cell=cell, x=float(lead_x), y=float(lead_y), source_id=11, source_cls=1,
                term="kinetic", risk=0.62,
            ),
        )  # fmt: skip

    def status(self, service: str, t: float) -> Status:
        inputs = {"objects": InputHealth(alive=True, rate_ok=True, valid=True, age_s=0.01, rate_hz=10.0)}
        return Status(
            service=service, state="ready" if t > 0.5 else "waiting", reason="working" if t > 0.5 else "no objects yet",
            uptime_s=t + 1.0, inputs=inputs, counters={"objects:overwritten": 2, "prediction:sent": 9},
            work_ms={"p50": 4.0, "p95": 6.0, "p99": 7.0, "max": 9.0},
        )  # fmt: skip


def messages(drive: Drive, frames: int, start_ns: int = 10**12) -> Iterator[tuple[str, Stamped[Any]]]:
    """(topic, message) in the order in which viz would receive them: objects at 10 Hz, plans at 20 Hz."""

    def stamp(value: Any, capture: int, delay_ms: float, cause: int | None, seq: int, work_ms: float) -> Stamped[Any]:
        received = capture + round(delay_ms * 1e6)
        origin = None if cause is None else Cause(BOOT, cause)
        return Stamped(value, capture, received, origin, "synthetic", BOOT, seq, round(work_ms * 1e6))

    yield "map", stamp(drive.map(), start_ns - 10**9, 5, None, 0, 0)
    yield "route", stamp(drive.route(), start_ns - 10**9, 5, None, 0, 0)
    yield "closures", stamp(Closures(ids=[50]), start_ns - 10**9, 5, None, 0, 0)
    for n in range(frames):
        t = n * 0.1
        now = start_ns + round(t * 1e9)
        yield "ego", stamp(drive.ego(t), now, 1, None, 2 * n, 0)
        yield "objects", stamp(drive.objects(t), now, 1, None, n, 0)
        yield "prediction", stamp(drive.prediction(t), now + 20_000, 6, n, n, 4.2 + np.sin(n))
        yield "risk", stamp(drive.risk(t), now + 30_000, 30, n, n, 21.0 + 3 * np.sin(n / 3))
        yield "plan", stamp(drive.plan(t), now, 42, n, 2 * n, 9.0 + np.cos(n / 2))
        half = now + 50_000_000
        yield "ego", stamp(drive.ego(t + 0.05), half, 1, None, 2 * n + 1, 0)
        yield "plan", stamp(drive.plan(t + 0.05, 0.05), half, 10, n, 2 * n + 1, 9.0)
        if n % 5 == 0:
            for service in ("predictor", "riskfield", "planner"):
                yield f"status/{service}", stamp(drive.status(service, t), now, 60, None, n, 0)


def give(scene: Any, heard: Iterable[tuple[str, Stamped[Any]]]) -> None:
    """Give a scene what was heard."""
    for topic, message in heard:
        getattr(scene, topic.split("/")[0])(message)
