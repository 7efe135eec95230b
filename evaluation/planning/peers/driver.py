"""A peer in our closed loop: what it is told of the world, and what of its answer becomes a plan.

It is told what the default planner's services know, by the same messages: the route's line, the lanes, barriers and
closed lines; the ego's state; the others as our predictor predicts them (they are what its collision checker asks for);
and as wanted speed the limit, lowered ahead of curves as for the IDM driver. It plans as often as it says, from its own
last plan as long as the ego is on it, and its trajectory is driven until the next. Where it finds none, the last one is
driven on until it is 1 s old and then braked along with 3 m/s²; such cycles are counted by what the peer says of them.
"""

from __future__ import annotations

import atexit
import math
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np

from common import config
from common.geometry import wrap_angle
from common.messages import F64, FRAME_S, Closures, Ego, Map, Objects, Plan, Prediction, Route, Stamped, Trajectory
from common.risk import RiskParameters
from evaluation.planning.idm_driver import Way
from evaluation.planning.peers.process import INSTALL, Line, PeerError, Process, python
from services.predictor.core import Predictor
from services.predictor.learned import load_learned
from services.predictor.settings import PredictorSettings

SCRIPTS = {"commonroad-reactive": "commonroad_reactive.py", "frenetix": "frenetix_planner.py"}
"""Peers by the name of `--planner`."""
ON_PLAN_M, ON_PLAN_MPS = 0.3, 0.5
"""The ego is on the last plan when it is as near to it as this."""
HELD_S, BRAKE, VALID_S = 1.0, 3.0, 0.5
"""How long a plan is driven on where no new one is found; the brake after that [m/s²]; how long each is valid."""
RETRY_S = 0.1
AROUND_M = 60.0
"""The route's line is prolonged by so much at both ends: peers' coordinate systems end with it."""
STEPS = 61
COLUMNS = ("t", "x", "y", "heading", "speed", "acceleration", "curvature")


class PeerDriver:
    """Drives with a peer; its process outlives the drive and serves the next."""

    def __init__(self, command: list[str], tree: config.Tree, patience_s: float = 120.0) -> None:
        risk = config.section(tree, "risk", RiskParameters)
        settings = config.section(tree, "predictor", PredictorSettings)
        self._predictor = Predictor(settings, risk, load_learned(settings, risk)[0])
        self._process = _running(tuple(command), patience_s)
        self._way: Way | None = None
        self._period_s = RETRY_S
        self._seen_ns = self._asked_ns = self._found_ns = -1
        self._prediction: Prediction | None = None
        self._rows: dict[str, F64] | None = None
        self.failures: Counter[str] = Counter()
        """Cycles without a trajectory, by what was said of them."""
        self.took_ms = math.nan
        """The peer's own time for the last plan; NaN: the last trajectory is driven on."""

    def plan(
        self, ego: Stamped[Ego], objects: Stamped[Objects], map: Map | None, route: Route, closures: Closures
    ) -> Plan:
        """The peer's newest trajectory, counted from the ego's capture.

        Raises:
            PeerError: it died or answered nonsense.
        """
        if objects.capture_ns != self._seen_ns:
            self._prediction, self._seen_ns = self._predictor.step(objects, ego, map), objects.capture_ns
        if self._way is None:
            self._way = Way(route, map, ego.value.width / 2)
            self._start(ego.value, map, route)
        now, self.took_ms = ego.capture_ns, math.nan
        fresh = self._found_ns == self._asked_ns >= 0
        due = self._asked_ns + (self._period_s if fresh else RETRY_S) * 1e9
        if self._asked_ns < 0 or now >= due - 1e6:
            self._ask(ego, map, closures)
        return self._driven(ego)

    def _start(self, e: Ego, map: Map | None, route: Route) -> None:
        lanes = [] if map is None else map.lanes
        walls = [] if map is None else [o.points.tolist() for o in map.obstacles if o.kind != "stop_line"]
        for k in lanes:
            walls += [k.left.tolist()] if k.left_type in ("kerb", "barrier") else []
            walls += [k.right.tolist()] if k.right_type in ("kerb", "barrier") else []
        answer = self._process.ask(
            {
                "do": "start",
                "route": _prolonged(route.reference).tolist(),
                "lanes": [
                    {
                        "id": k.id, "left": k.left.tolist(), "centre": k.centre.tolist(), "right": k.right.tolist(),
                        "successors": list(k.successors),
                    }
                    for k in lanes
                ],
                "walls": walls,
                "wall_width": 0.2,
                "ego": {"length": e.length, "width": e.width, "wheelbase": e.wheelbase},
            }
        )  # fmt: skip
        if "error" in answer:
            raise PeerError(f"the peer cannot start: {answer['error']}")
        self._period_s = float(answer.get("period_s", RETRY_S))

    def _ask(self, ego: Stamped[Ego], map: Map | None, closures: Closures) -> None:
        e, now = ego.value, ego.capture_ns
        assert self._way is not None
        s, _ = self._way.line.project(np.array([e.x, e.y]))
        wanted = self._way.wanted(float(s))
        if math.isfinite(self._way.goal_s):  # comes to rest at the goal
            wanted = min(wanted, math.sqrt(2.0 * max(self._way.goal_s - float(s), 0.0)))
        answer = self._process.ask(
            {
                "do": "plan",
                "ego": {
                    "x": e.x, "y": e.y, "heading": e.heading, "speed": max(e.speed, 0.0),
                    "acceleration": e.acceleration, "yaw_rate": e.yaw_rate,
                },
                "again": self._row(ego),
                "wanted": wanted,
                "others": self._others(now),
                "closed": _closed(map, closures),
            }
        )  # fmt: skip
        self._asked_ns, self.took_ms = now, float(answer.get("ms", math.nan))
        why = answer.get("error") or answer.get("none")
        if why is not None:
            self.failures[str(why)[:120]] += 1
            return
        if answer.get("stopping"):
            self.failures["every drivable sample collides: its own stopping trajectory"] += 1
        self._rows, self._found_ns = _trajectory(answer), now

    def _row(self, ego: Stamped[Ego]) -> int | None:
        """Row of the last answer at which the ego is now; None: it is elsewhere."""
        if self._rows is None:
            return None
        k = round((ego.capture_ns - self._found_ns) * 1e-9 / FRAME_S)
        r, e = self._rows, ego.value
        if not 0 < k < len(r["t"]) or abs(r["speed"][k] - e.speed) > ON_PLAN_MPS:
            return None
        return k if math.hypot(r["x"][k] - e.x, r["y"][k] - e.y) <= ON_PLAN_M else None

    def _others(self, now: int) -> list[Line]:
        """Everybody at every 0.1 s from `now`, as predicted."""
        p = self._prediction
        assert p is not None
        frames = np.arange(p.x.shape[1] + 1) * FRAME_S
        at = np.minimum((now - self._seen_ns) * 1e-9 + np.arange(STEPS) * FRAME_S, frames[-1])
        found = []
        for i in range(len(p.id)):
            heading = np.unwrap(np.concatenate((p.heading0[i : i + 1], p.heading[i])))
            found.append(
                {
                    "length": float(p.length[i]),
                    "width": float(p.width[i]),
                    "x": np.interp(at, frames, np.concatenate((p.x0[i : i + 1], p.x[i]))).tolist(),
                    "y": np.interp(at, frames, np.concatenate((p.y0[i : i + 1], p.y[i]))).tolist(),
                    "heading": wrap_angle(np.interp(at, frames, heading)).tolist(),
                }
            )
        return found

    def _driven(self, ego: Stamped[Ego]) -> Plan:
        if self._rows is None:
            return Plan(mode="safe_stop", reason="the peer has found no trajectory yet", planner="peer")
        rows, late = self._rows, (ego.capture_ns - self._found_ns) * 1e-9
        begin = min(late, float(rows["t"][-1]))
        if late > HELD_S + 1e-6:
            tail = _braked(rows, begin, 0.0, max(ego.value.speed, 0.0))
            return Plan(
                mode="safe_stop", reason="the peer finds no trajectory", planner="peer", valid_for=0.0, tail=tail
            )
        end = max(begin, min(begin + VALID_S, float(rows["t"][-1])))
        times = np.append(np.arange(begin, end - 1e-6, 0.05), end)
        profile = Trajectory(t=times - late, **{k: np.interp(times, rows["t"], rows[k]) for k in COLUMNS if k != "t"})
        tail = _braked(rows, end, end - late, float(profile.speed[-1]))
        return Plan(
            mode="drive", reason="the peer's trajectory", planner="peer", valid_for=end - late, profile=profile,
            tail=tail, desired_speed=float(max(rows["speed"][-1], 0.0)),
        )  # fmt: skip


def peer(name: str, tree: config.Tree) -> PeerDriver:
    """The peer of a name.

    Raises:
        ConfigError: its Python is not there, or lacks its packages.
    """
    return PeerDriver([python(), str(Path(__file__).with_name(SCRIPTS[name]))], tree)


def check(name: str) -> None:
    """Whether a peer can be used here, before hours are spent.

    Raises:
        ConfigError: it cannot, and what to do.
    """
    command = (python(), str(Path(__file__).with_name(SCRIPTS[name])))
    try:
        _running(command, 120.0).ask({"do": "plan"})  # answers that it was not started
    except PeerError as e:
        raise config.ConfigError(f"--planner {name}: {e}; {INSTALL}") from None


_processes: dict[tuple[str, ...], Process] = {}


def _running(command: tuple[str, ...], patience_s: float) -> Process:
    found = _processes.get(command)
    if found is None or not found.alive:
        found = _processes[command] = Process(list(command), patience_s)
    return found


@atexit.register
def _end() -> None:
    for process in _processes.values():
        process.close()


def _prolonged(line: F64) -> F64:
    first, last = line[0] - line[1], line[-1] - line[-2]
    return np.vstack(
        (line[0] + AROUND_M * first / np.hypot(*first), line, line[-1] + AROUND_M * last / np.hypot(*last))
    )


def _closed(map: Map | None, closures: Closures) -> list[Any]:
    """Lines that must not be crossed now."""
    shut = set(closures.ids)
    if map is None or not shut:
        return []
    lines = [o.points.tolist() for o in map.obstacles if o.id in shut]
    return lines + [[k.left[0].tolist(), k.right[0].tolist()] for k in map.lanes if k.id in shut]


def _trajectory(answer: Line) -> dict[str, F64]:
    """The columns of an answer.

    Raises:
        PeerError: one is missing, of another length, not finite, or times do not increase from 0.
    """
    try:
        rows = {k: np.asarray(answer[k], dtype=np.float64) for k in COLUMNS}
    except (KeyError, ValueError, TypeError):
        raise PeerError("the peer's answer is no trajectory") from None
    t = rows["t"]
    good = t.ndim == 1 and len(t) >= 2 and abs(t[0]) < 1e-9 and bool((np.diff(t) > 0).all())
    if not good or not all(v.shape == t.shape and np.isfinite(v).all() for v in rows.values()):
        raise PeerError("the peer's trajectory cannot be driven: lengths, times or numbers are wrong")
    rows["heading"] = np.unwrap(rows["heading"])
    rows["speed"] = np.maximum(rows["speed"], 0.0)
    rows["curvature"] = np.clip(rows["curvature"], -0.5, 0.5)
    rows["acceleration"] = np.clip(rows["acceleration"], -12.0, 12.0)
    return rows


def _braked(rows: dict[str, F64], begin: float, t0: float, speed: float) -> Trajectory:
    """A stop along a trajectory from its place at `begin` [s], straight on where it ends; times count from `t0` [s]."""
    s = np.concatenate(([0.0], np.cumsum(np.hypot(np.diff(rows["x"]), np.diff(rows["y"])))))
    t = np.arange(max(math.ceil(speed / BRAKE / FRAME_S), 2) + 1) * FRAME_S
    v = np.maximum(speed - BRAKE * t, 0.0)
    at = np.interp(begin, rows["t"], s) + np.concatenate(([0.0], np.cumsum(0.5 * (v[1:] + v[:-1]) * FRAME_S)))
    moved = np.concatenate(([True], np.diff(s) > 1e-6))
    heading = np.interp(at, s[moved], rows["heading"][moved])
    over = np.maximum(at - s[-1], 0.0)
    return Trajectory(
        t=np.asarray(t0 + t, dtype=np.float64),
        x=np.interp(at, s[moved], rows["x"][moved]) + over * np.cos(heading),
        y=np.interp(at, s[moved], rows["y"][moved]) + over * np.sin(heading),
        heading=heading,
        curvature=np.where(over > 0.0, 0.0, np.interp(at, s[moved], rows["curvature"][moved])),
        speed=v,
        acceleration=np.where(v > 0.0, -BRAKE, 0.0),
    )
