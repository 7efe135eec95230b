"""A service as small as can be, to test the loop that every service runs: it answers objects with a prediction.

What it does with a message hangs on the first object's x: −1 raises, −2 breaks its own contract, −3 is fatal, −4 takes
four periods, −5 is answered with 5 too late, and with 6 by who knows that it is late.
"""

from __future__ import annotations

import atexit
import time

import numpy as np

from common import topics
from common.config import Tree
from common.health import Health
from common.service import FatalError, Idle, Inputs, Output, Service, Step, main
from tests import samples

PERIOD_S = 0.05
LATE_NS = 60_000_000


def build(tree: Tree, health: Health) -> Step:
    if tree.get("predictor"):
        raise ValueError("a mistake of ours, not of the configuration")

    atexit.register(time.sleep, 30.0)  # as long as it likes: a service that was asked to end does not wait for it
    ends: dict[int, int] = {}

    def step(inputs: Inputs) -> Output | Idle:
        objects = inputs.fresh(topics.OBJECTS)
        if objects is None:
            return Idle("no fresh objects")
        code = objects.value.x[0]
        if code == -1:
            raise KeyError("as asked")
        if code == -3:
            raise FatalError("as asked")
        if code == -4:
            time.sleep(4 * PERIOD_S)
        if code == -5:
            end = ends.setdefault(objects.seq, inputs.now_ns + LATE_NS)
            early = inputs.now_ns < end
            time.sleep(2e-9 * LATE_NS if early else 0.0)
            late = samples.prediction(x0=np.full(3, 5.0 if early else 6.0))
            return Output(late, objects.capture_ns, None, objects.received_ns, again_ns=end if early else None)
        x0 = np.full(3, np.nan if code == -2 else code)
        prediction = samples.prediction(x0=x0)
        return Output(prediction, objects.capture_ns, objects.descent(), objects.received_ns)

    return step


if __name__ == "__main__":
    raise SystemExit(
        main(Service("predictor", (topics.OBJECTS, topics.MAP), topics.PREDICTION, topics.OBJECTS, PERIOD_S, build))
    )
