"""The smallest vehicle that Forefield can drive. Copy it and put your own vehicle in the place of `Body`.

It publishes `map` and `route` once (latched: whoever comes later gets them too), `ego` at 50 Hz and `objects` at 10 Hz,
and drives the newest `plan`: its profile until `valid_for`, then its stopping tail, and nothing else. Units, frames and
ranges stand in `common/messages.py`. It needs `pip install forefield` without any extra.

    forefield services                        # in one terminal, or docker compose with compose.vehicle.yaml
    python docs/examples/vehicle.py           # in another

Where the router is, the vehicle's name and its certificates come from FOREFIELD_CONFIG or variables such as
FOREFIELD__BUS__CONNECT='["tcp/10.0.0.2:7447"]', FOREFIELD__VEHICLE=van7, FOREFIELD__BUS__TLS__CA=….
"""

from __future__ import annotations

import argparse
import math
import time

import numpy as np

from common import config, topics
from common.bus import BusSettings, open_bus
from common.messages import Ego, Goal, Lane, Map, ObjectClass, Objects, Plan, Route, Stamped

PERIOD_S = 0.02  # ego at 50 Hz
OBJECTS_EVERY = 5  # objects at 10 Hz
LENGTH, WIDTH, WHEELBASE = 4.5, 1.8, 2.7  # m


class Body:
    """Your vehicle: its state comes from your localisation, `drive` goes to your speed and steering controllers."""

    def __init__(self) -> None:
        self.x = self.y = self.heading = self.speed = self.acceleration = self.curvature = 0.0  # of the rear axle

    def drive(self, speed: float, acceleration: float, curvature: float) -> None:
        """Follow the plan for one period: its acceleration, and 2 m/s² for each m/s that the speed is off."""
        wanted = min(max(acceleration + 2.0 * (speed - self.speed), -8.0), 3.0)
        before = self.speed
        self.speed = max(self.speed + wanted * PERIOD_S, 0.0)
        self.acceleration = (self.speed - before) / PERIOD_S
        self.curvature = curvature
        self.heading += self.speed * curvature * PERIOD_S
        self.x += self.speed * math.cos(self.heading) * PERIOD_S
        self.y += self.speed * math.sin(self.heading) * PERIOD_S

    def ego(self) -> Ego:
        """The state as Forefield wants it: poses are of the rectangle's centre."""
        c, s = math.cos(self.heading), math.sin(self.heading)
        yaw_rate = self.speed * self.curvature
        sideways = yaw_rate * WHEELBASE / 2
        return Ego(
            x=self.x + c * WHEELBASE / 2, y=self.y + s * WHEELBASE / 2, heading=self.heading,
            vx=c * self.speed - s * sideways, vy=s * self.speed + c * sideways,
            acceleration=self.acceleration, yaw_rate=yaw_rate, length=LENGTH, width=WIDTH, wheelbase=WHEELBASE,
        )  # fmt: skip


def perceived(t: float) -> Objects:
    """What your perception sees: here a car 60 m ahead at 5 m/s. Nothing seen is an empty list, never silence."""
    one = {name: np.array([value]) for name, value in (
        ("id", 1), ("x", 60.0 + 5.0 * t), ("y", 0.0), ("heading", 0.0), ("vx", 5.0), ("vy", 0.0),
        ("length", 4.6), ("width", 1.9), ("mass", 0.0),  # 0: unknown
    )}  # fmt: skip
    return Objects(cls=np.array([ObjectClass.CAR], np.uint8), **one)


def road() -> tuple[Map, Route]:
    """Your map and route: here one straight lane of 500 m."""
    x = np.linspace(-50.0, 450.0, 101)
    line = [np.column_stack((x, np.full_like(x, y))) for y in (0.0, 1.75, -1.75)]
    lane = Lane(
        id=1, centre=line[0], left=line[1], right=line[2], left_type="road_edge", right_type="road_edge",
        speed_limit=13.9,
    )  # fmt: skip
    return Map(lanes=[lane]), Route(reference=line[0], goal=Goal(x=400.0, y=0.0, radius=5.0, stop=True), lane_ids=[1])


def wanted(plan: Stamped[Plan] | None, now_ns: int) -> tuple[float, float, float]:
    """Speed [m/s], acceleration [m/s²] and curvature [1/m] to drive now.

    The profile until `valid_for`, then the tail, which ends at rest; then stand. This is the whole of what a vehicle
    owes to safety here: nothing newer arrived, so nothing newer is driven.
    """
    if plan is None:
        return 0.0, 0.0, 0.0
    t = plan.age_s(now_ns)
    part = plan.value.profile if t < plan.value.valid_for else plan.value.tail
    if part is None or t > part.t[-1]:
        return 0.0, 0.0, 0.0
    speed, acceleration, curvature = (np.interp(t, part.t, c) for c in (part.speed, part.acceleration, part.curvature))
    return float(speed), float(acceleration), float(curvature)


def main() -> None:
    """Publish and drive until stopped, or so far."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("--metres", type=float, default=math.inf, help="stop after so far")
    metres = parser.parse_args().metres
    tree = config.load()
    with open_bus(config.section(tree, "bus", BusSettings), config.vehicle(tree), "vehicle") as bus:
        bus.liveliness("vehicle")  # says that the vehicle is there: no replay takes its place
        ego, objects = bus.publisher(topics.EGO), bus.publisher(topics.OBJECTS)
        plans = bus.inbox(topics.PLAN)
        latched = bus.publisher(topics.MAP), bus.publisher(topics.ROUTE)  # kept: they serve whoever comes later
        for publisher, message in zip(latched, road(), strict=True):
            publisher.put(message, capture_ns=time.monotonic_ns())

        body, mode = Body(), ""
        began = time.monotonic_ns()
        k = 0
        while body.x < metres:
            due_ns = began + round(k * PERIOD_S * 1e9)
            while (left_ns := due_ns - time.monotonic_ns()) > 0:
                bus.wait(left_ns * 1e-9)
                plans.take()  # checked and counted; `plans.latest` is the newest good one
            # what is published says when it was true, on the monotonic clock of this machine
            ego.put(body.ego(), capture_ns=due_ns)
            if k % OBJECTS_EVERY == 0:
                objects.put(perceived(k * PERIOD_S), capture_ns=due_ns)
            body.drive(*wanted(plans.latest, time.monotonic_ns()))
            if plans.latest is not None and plans.latest.value.mode != mode:
                mode = plans.latest.value.mode
                print(f"{k * PERIOD_S:6.2f} s  {body.x:6.1f} m  {mode}: {plans.latest.value.reason}", flush=True)
            k += 1
        print(f"drove {body.x:.1f} m, {body.speed:.1f} m/s", flush=True)


if __name__ == "__main__":
    main()
