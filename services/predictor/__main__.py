"""The predictor as a process: objects (with ego and map) in, prediction out."""

from __future__ import annotations

import logging

from common import config, topics
from common.health import Health
from common.messages import State
from common.risk import RiskParameters
from common.service import Idle, Inputs, Output, Service, Step, main
from services.predictor.core import Predictor
from services.predictor.learned import load_learned
from services.predictor.settings import PredictorSettings

log = logging.getLogger("forefield")


def build(tree: config.Tree, health: Health) -> Step:
    """Wire the core to the loop."""
    settings = config.section(tree, "predictor", PredictorSettings)
    risk = config.section(tree, "risk", RiskParameters)
    learned, said = load_learned(settings, risk)
    core = Predictor(settings, risk, learned)
    health.detail.update(core.detail)
    if said:
        health.detail["network"] = said
        log.warning("%s", said)
    state: State = "ready" if learned is not None or not said else "degraded"
    reason = "running" if state == "ready" else f"running without the network: {said}"

    def step(inputs: Inputs) -> Output | Idle:
        objects = inputs.fresh(topics.OBJECTS)
        if objects is None:
            return Idle("no fresh objects: is the vehicle publishing them?")
        if topics.OBJECTS.suffix not in inputs.new:
            return Idle(reason, state)
        world = inputs.latest(topics.MAP)
        prediction = core.step(objects, inputs.fresh(topics.EGO), None if world is None else world.value)
        health.detail.update(core.detail)
        return Output(prediction, objects.capture_ns, objects.descent(), objects.received_ns, state, reason)

    return step


SERVICE = Service(
    name="predictor",
    subscribes=(topics.OBJECTS, topics.EGO, topics.MAP),  # `route` may be heard, and is of no use here
    publishes=topics.PREDICTION,
    trigger=topics.OBJECTS,
    period_s=0.2,
    build=build,
)

if __name__ == "__main__":
    raise SystemExit(main(SERVICE))
