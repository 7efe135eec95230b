"""Traffic that makes room: everybody follows his record to the letter until somebody is in his way.

Each road user has a clock along his own record. As long as nobody is in his strip it runs with the world's; where the
ego, or one whom the ego has delayed, is in the way, he brakes by the improved IDM and his clock runs slower; afterwards
he drives on with his delay, never faster than he was recorded. Stuck behind somebody who stands or creeps, one on a
road with a neighbouring lane of the same direction changes into it if MOBIL allows.
Walkers stop only for a body that stands in their way: whether they are seen in time is the ego's task.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from common.geometry import Polyline, rectangle_corners, wrap_angle
from common.messages import F64, FRAME_S, MAX_OBJECTS, Closures, Ego, Lane, ObjectClass, Objects
from evaluation.planning import corridor
from evaluation.planning.car_following import Following, LaneChange, improved_idm, mobil
from evaluation.planning.traffic import Kind, Replay, Traffic
from rig.world import Scenario, Track

DRIVERS = {
    ObjectClass.TRUCK: Following(headway=1.2, accel=0.8, brake=2.0),
    ObjectClass.BUS: Following(headway=1.2, accel=0.9, brake=2.0),
    ObjectClass.BICYCLE: Following(headway=0.8, gap=1.0, accel=0.8, brake=1.5),
    ObjectClass.MOTORCYCLE: Following(headway=0.9, gap=1.5, accel=2.0, brake=2.5),
}
"""By class; the others drive as `Following(headway=1.0)`."""
CAR = Following(headway=1.0)
HARDEST = 7.0
"""What brakes can do [m/s²]."""
WALKERS = (ObjectClass.PEDESTRIAN, ObjectClass.UNKNOWN)
NEAR_M = 90.0
"""Who is farther from the ego and from everybody delayed does not look."""
STUCK_S = 2.0
"""Held up so long, one looks for another lane."""
CHANGE_S = 3.5
"""Duration of a lane change."""


def traffic(scenario: Scenario, kind: Kind, recorded_s: float = math.inf) -> Traffic:
    """The others of a scenario, as asked for; what lies beyond `recorded_s` of it was made up [s]."""
    return Reactive(scenario, recorded_s) if kind == "reactive" else Replay(scenario)


@dataclass
class _User:
    """One road user with his own clock."""

    track: Track
    s: F64  # arc length at each row of the record [m]
    velocity: F64  # recorded [k, 2]
    recorded: float = math.inf  # the last row that was recorded; what comes after it was made up
    row: float = 0.0  # where on the record he is, in frames
    speed: float = 0.0
    delayed: bool = False
    held_s: float = 0.0
    side: float = 0.0  # offset to the left of the recorded path [m]
    side_from: float = 0.0
    side_to: float = 0.0
    side_t: float = CHANGE_S
    _ahead: tuple[int, Polyline] | None = field(default=None, repr=False)

    @staticmethod
    def of(track: Track, recorded_s: float = math.inf) -> _User:
        step = np.hypot(np.diff(track.x), np.diff(track.y))
        recorded = recorded_s / FRAME_S - track.frame0
        return _User(track, np.concatenate(([0.0], np.cumsum(step))), track.velocity, recorded)

    def at(self, row: float) -> tuple[float, float, float, float]:
        """x, y, heading, s at a row of the record."""
        k, last = self.track, len(self.track.x) - 1
        i = min(max(math.floor(row), 0), last)
        j, w = min(i + 1, last), min(max(row - i, 0.0), 1.0)
        heading = k.heading[i] + w * float(wrap_angle(k.heading[j] - k.heading[i]))
        return (
            float(k.x[i] + w * (k.x[j] - k.x[i])),
            float(k.y[i] + w * (k.y[j] - k.y[i])),
            float(heading),
            float(self.s[i] + w * (self.s[j] - self.s[i])),
        )

    def pose(self) -> tuple[float, float, float]:
        """Where he is now."""
        x, y, heading, _ = self.at(self.row)
        rate = 0.0
        if self.side_t < CHANGE_S and self.speed > 0.5:
            u = self.side_t / CHANGE_S
            rate = (self.side_to - self.side_from) * 30.0 * u * u * (1.0 - u) ** 2 / CHANGE_S
        turned = heading + math.atan2(rate, max(self.speed, 1.0))
        return x - self.side * math.sin(heading), y + self.side * math.cos(heading), turned

    def way(self) -> tuple[Polyline, float]:
        """The path he is going to take, straight on beyond the record, and how far along it he is."""
        i = math.floor(self.row)
        if self._ahead is None or i >= self._ahead[0] + 10 or self.side_t < CHANGE_S:
            k = self.track
            points = [np.array(self.at(max(self.row - 3.0, 0.0))[:2])]
            for r in range(i, min(i + 90, len(k.x))):
                p = np.array((k.x[r], k.y[r]))
                if np.hypot(*(p - points[-1])) > 0.7:
                    points.append(p)
            heading = self.at(min(self.row + 90.0, len(k.x) - 1.0))[2]
            ahead = np.array([math.cos(heading), math.sin(heading)])
            points += [points[-1] + 20.0 * ahead, points[-1] + 60.0 * ahead]
            line = Polyline.of(np.array(points), tolerance=0.05)
            if abs(self.side_to) > 1e-6:
                t = np.vstack((line.tangents, line.tangents[-1:]))
                line = Polyline.of(line.points + self.side_to * np.stack((-t[:, 1], t[:, 0]), axis=-1), tolerance=0.05)
            self._ahead = (i, line)
        line = self._ahead[1]
        x, y, _ = self.pose()
        return line, float(line.project(np.array([x, y]))[0])


class Reactive:
    """The others of one drive, advanced in steps of 0.1 s."""

    def __init__(self, scenario: Scenario, recorded_s: float = math.inf) -> None:
        self._scenario = scenario
        tracks = [k for k in scenario.tracks if k.last >= 1]
        self._users = [_User.of(k, recorded_s) for k in tracks]
        self._lanes = _lanes(scenario)
        self._centres = {lane.id: centre for lane, centre in self._lanes}
        self._frame = 0
        for u in self._users:
            u.row = float(max(-u.track.frame0, 0))
            u.speed = float(np.hypot(*u.velocity[min(round(u.row), len(u.velocity) - 1)]))
        self._past = self._positions()
        self._now = self._positions()
        self._before = {id: (x, y) for id, (x, y, _, _) in self._now.items()}
        self._fresh: dict[int, tuple[float, float]] = {}

    # --- what there is to see ---

    def _present(self, u: _User, frame: int) -> bool:
        """One is there from his first recorded frame on, until his record ends for him."""
        return frame >= u.track.first_seen and u.row <= len(u.track.x) - 1 + 1e-9

    def _positions(self) -> dict[int, tuple[float, float, float, float]]:
        return {u.track.id: (*u.pose(), u.row) for u in self._users if self._present(u, self._frame)}

    def objects_at(self, t: float) -> Objects:
        """Who is where: at whole frames exactly, straight in between; velocities are backward differences."""
        if t < 1e-9:
            return self._scenario.objects_at(t)
        w = min(max(t / FRAME_S - (self._frame - 1), 0.0), 1.0)
        w = 1.0 if w > 1.0 - 1e-6 else 0.0 if w < 1e-6 else w
        rows = []
        for u in self._users:
            i = u.track.id
            new, old = self._now.get(i), self._past.get(i)
            if (old is None and w < 1.0) or (new is None and w > 0.0):
                continue
            a, b = old or new, new or old
            assert a is not None
            assert b is not None
            v0, v1 = self._velocity_before(i), self._velocity(i)
            rows.append(
                (
                    i, u.track.cls, a[0] + w * (b[0] - a[0]), a[1] + w * (b[1] - a[1]),
                    a[2] + w * float(wrap_angle(b[2] - a[2])), v0[0] + w * (v1[0] - v0[0]), v0[1] + w * (v1[1] - v0[1]),
                    u.track.length, u.track.width, u.track.mass,
                )
            )  # fmt: skip
        rows = rows[:MAX_OBJECTS]
        c = np.array(rows, dtype=np.float64).reshape(-1, 10).T
        return Objects(
            id=c[0].astype(np.int64), cls=c[1].astype(np.uint8), x=c[2].copy(), y=c[3].copy(),
            heading=np.asarray(wrap_angle(c[4])), vx=c[5].copy(), vy=c[6].copy(),
            length=c[7].copy(), width=c[8].copy(), mass=c[9].copy(),
        )  # fmt: skip

    def closures_at(self, t: float) -> Closures:
        """Lights do not react."""
        return self._scenario.closures_at(t)

    def _velocity(self, i: int) -> tuple[float, float]:
        if i in self._past and i in self._now:
            a, b = self._past[i], self._now[i]
            return (b[0] - a[0]) / FRAME_S, (b[1] - a[1]) / FRAME_S
        return self._fresh.get(i, (0.0, 0.0))

    def _velocity_before(self, i: int) -> tuple[float, float]:
        if i in self._before and i in self._past:
            a, b = self._before[i], self._past[i]
            return (b[0] - a[0]) / FRAME_S, (b[1] - a[1]) / FRAME_S
        return self._fresh.get(i, (0.0, 0.0))

    # --- how they move ---

    def advance(self, t: float, ego: Ego) -> None:
        """Bring everybody to the first whole frame after `t`, looking at the ego where it is."""
        while self._frame * FRAME_S <= t + 1e-9:
            self._step(ego)

    def _step(self, ego: Ego) -> None:
        users = [u for u in self._users if self._present(u, self._frame)]
        self._before = {i: (p[0], p[1]) for i, p in self._past.items()} if self._frame else self._rows_before()
        self._past = self._positions()
        for u in users:
            u.delayed = u.delayed or u.row > u.recorded  # whom no record tells where the others are must look
        looking = self._who_looks(users, ego)
        plans = {u.track.id: self._acceleration(u, users, ego) for u in looking}
        for u in self._users:
            if u.track.frame0 > self._frame:
                continue  # not yet there
            if not u.delayed and u.track.id not in plans:
                u.row = float(self._frame + 1 - u.track.frame0)
                u.speed = float(np.hypot(*u.velocity[min(round(u.row), len(u.velocity) - 1)]))
            else:
                self._move(u, plans.get(u.track.id, math.inf))
        self._frame += 1
        self._now = self._positions()
        for u in self._users:
            i = u.track.id
            if i in self._now and i not in self._past:
                row = min(max(round(u.row), 0), len(u.velocity) - 1)
                v = u.velocity[row]
                self._fresh[i] = (float(v[0]), float(v[1]))

    def _rows_before(self) -> dict[int, tuple[float, float]]:
        """Where everybody was a frame before the run began, as recorded or going by his first velocity."""
        found = {}
        now = self._scenario.objects_at(0.0)
        for k in range(len(now.id)):
            found[int(now.id[k])] = (
                float(now.x[k] - now.vx[k] * FRAME_S),
                float(now.y[k] - now.vy[k] * FRAME_S),
            )
        return found

    def _who_looks(self, users: list[_User], ego: Ego) -> list[_User]:
        causes = [(ego.x, ego.y), *[u.pose()[:2] for u in users if u.delayed]]
        found = []
        for u in users:
            x, y, _ = u.pose()
            if u.delayed or any(math.hypot(x - cx, y - cy) < NEAR_M for cx, cy in causes):
                found.append(u)
        return found

    def _acceleration(self, u: _User, users: list[_User], ego: Ego) -> float:
        """What he wants because of those who are not where his record had them; infinite: nothing [m/s²]."""
        if u.speed < 0.05 and not u.delayed and self._recorded(u) < 0.05:
            return math.inf  # stands anyway
        others = [o for o in users if o is not u and (o.delayed or u.delayed)]
        boxes = [(ego.x, ego.y, ego.heading, ego.length, ego.width)]
        speeds = [(ego.vx, ego.vy)]
        for o in others:
            x, y, heading = o.pose()
            boxes.append((x, y, heading, o.track.length, o.track.width))
            speeds.append((o.speed * math.cos(heading), o.speed * math.sin(heading)))
        x, y, _ = u.pose()
        near = [i for i, b in enumerate(boxes) if math.hypot(b[0] - x, b[1] - y) < 20.0 + 5.0 * max(u.speed, 2.0)]
        if not near:
            return math.inf
        corners = rectangle_corners(*np.array([boxes[i] for i in near]).T)
        velocity = np.array([speeds[i] for i in near])
        line, s = u.way()
        half = u.track.length / 2
        if u.track.cls in WALKERS:
            standing = np.hypot(*velocity.T) < 0.5
            lead = corridor.leader(line, s, half, u.track.width / 2, corners[standing], velocity[standing], 3.0)
            return -HARDEST if lead.gap < 0.6 else math.inf
        lead = corridor.leader(line, s, half, u.track.width / 2, corners, velocity, 15.0 + 5.0 * u.speed)
        if lead.index < 0:
            return math.inf
        p = DRIVERS.get(u.track.cls, CAR)
        v0 = max(self._recorded(u), 1.0)
        a = max(improved_idm(p, u.speed, max(v0, u.speed), max(lead.gap, 0.02), u.speed - lead.speed), -HARDEST)
        if u.held_s > STUCK_S and lead.speed < 0.5 * self._wish(u):
            self._change_lane(u, a, users, ego)
        return a

    def _recorded(self, u: _User) -> float:
        """Speed that the record goes on with [m/s]."""
        row = min(u.row + 1.0, len(u.s) - 1.0)
        return max(0.0, (self.s_at(u, row) - self.s_at(u, u.row)) / FRAME_S)

    @staticmethod
    def _wish(u: _User) -> float:
        """Highest speed of the next 5 s of the record [m/s]."""
        i = math.floor(u.row)
        v = u.velocity[i : i + 50]
        return float(np.hypot(*v.T).max()) if len(v) else 0.0

    @staticmethod
    def s_at(u: _User, row: float) -> float:
        """Arc length of the record at a row [m]."""
        i = min(max(math.floor(row), 0), len(u.s) - 1)
        j = min(i + 1, len(u.s) - 1)
        return float(u.s[i] + min(max(row - i, 0.0), 1.0) * (u.s[j] - u.s[i]))

    def _move(self, u: _User, a: float) -> None:
        """One frame on: as recorded if nothing holds him up, otherwise as his acceleration allows."""
        last = len(u.s) - 1.0
        here = self.s_at(u, u.row)
        target = min(u.row + 1.0, last)
        step = self.s_at(u, target) - here
        wanted = step / FRAME_S
        p = DRIVERS.get(u.track.cls, CAR)
        if u.track.cls in WALKERS:
            u.delayed = u.delayed or math.isfinite(a)
            if math.isfinite(a):
                u.speed, u.held_s = 0.0, u.held_s + FRAME_S
                return
            u.row, u.speed = u.row + 1.0, wanted
            return
        limit = u.speed + min(a, p.accel if u.delayed else math.inf) * FRAME_S
        after = max(0.0, min(wanted, limit))
        if after >= wanted - 1e-6:
            u.row = u.row + 1.0
            u.speed = wanted if target > u.row - 1.0 else u.speed
            u.held_s = 0.0
        else:
            u.delayed = True
            go = 0.5 * (min(u.speed, wanted + 2.0) + after) * FRAME_S
            go = min(go, step)
            u.held_s += FRAME_S
            u.row = self._row_at(u, here + go)
            u.speed = after
        if u.side_t < CHANGE_S:
            u.side_t = min(u.side_t + FRAME_S * min(1.0, u.speed / 2.0), CHANGE_S)
            f = u.side_t / CHANGE_S
            u.side = u.side_from + (u.side_to - u.side_from) * f**3 * (10.0 - 15.0 * f + 6.0 * f * f)

    @staticmethod
    def _row_at(u: _User, s: float) -> float:
        """The row at which the record has driven `s`, at most one frame on."""
        lo, hi = u.row, min(u.row + 1.0, len(u.s) - 1.0)
        a, b = Reactive.s_at(u, lo), Reactive.s_at(u, hi)
        return lo if b - a < 1e-9 else lo + (hi - lo) * min(max((s - a) / (b - a), 0.0), 1.0)

    # --- another lane ---

    def _change_lane(self, u: _User, a: float, users: list[_User], ego: Ego) -> None:
        if u.side_t < CHANGE_S or abs(u.side_to) > 1e-6:
            return
        x, y, heading = u.pose()
        for side in (1.0, -1.0):
            width = self._neighbour(x, y, heading, side)
            if width is None:
                continue
            before, gap_behind, follower = self._new_place(u, side * width, users, ego)
            p = DRIVERS.get(u.track.cls, CAR)
            own = improved_idm(p, u.speed, max(self._wish(u), 1.0), max(before[0], 0.02), u.speed - before[1])
            rear = (0.0, improved_idm(CAR, follower, max(follower, 1.0), max(gap_behind, 0.02), follower - u.speed))
            if mobil(LaneChange(), (a, max(own, -HARDEST)), rear if math.isfinite(gap_behind) else (0.0, 0.0)):
                u.side_from, u.side_to, u.side_t = u.side, u.side + side * width, 0.0
                u._ahead = None
                return

    def _new_place(
        self, u: _User, offset: float, users: list[_User], ego: Ego
    ) -> tuple[tuple[float, float], float, float]:
        """Gap and speed of the leader there; gap to and speed of the follower there."""
        x, y, heading = u.pose()
        c, s = math.cos(heading), math.sin(heading)
        front, rear = (math.inf, 0.0), (math.inf, 0.0)
        bodies = [(ego.x, ego.y, ego.length, ego.speed)]
        bodies += [(*o.pose()[:2], o.track.length, o.speed) for o in users if o is not u]
        for ox, oy, length, speed in bodies:
            along, beside = c * (ox - x) + s * (oy - y), -s * (ox - x) + c * (oy - y)
            if abs(beside - offset) > 1.75:
                continue
            gap = abs(along) - (length + u.track.length) / 2
            if along >= 0 and gap < front[0]:
                front = (gap, speed)
            elif along < 0 and gap < rear[0]:
                rear = (gap, speed)
        return front, rear[0], rear[1]

    def _neighbour(self, x: float, y: float, heading: float, side: float) -> float | None:
        """Distance to the next lane's centre on this side, if there is one that runs the same way [m]."""
        for lane, centre in self._lanes:
            near = np.hypot(*(lane.centre - (x, y)).T).min()
            if near > 6.0:
                continue
            s, d = centre.project(np.array([x, y]))
            if abs(float(d)) > 1.5 or not 0.0 <= float(s) <= centre.length:
                continue
            if abs(float(wrap_angle(float(centre.heading(s)) - heading))) > 0.4:
                continue
            other = lane.left_neighbour if side > 0 else lane.right_neighbour
            same = lane.left_same_direction if side > 0 else lane.right_same_direction
            if other is not None and same:
                beside = self._centres.get(other)
                return None if beside is None else abs(float(beside.project(np.array([x, y]))[1]))
        return None


def _lanes(scenario: Scenario) -> list[tuple[Lane, Polyline]]:
    return [] if scenario.map is None else [(k, Polyline.of(k.centre)) for k in scenario.map.lanes]
