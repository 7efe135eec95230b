"""The riskfield as a process: prediction (with ego, map, closures) in, risk out."""

from __future__ import annotations

from common import config, topics
from common.config import ConfigError
from common.health import Health
from common.risk import RiskParameters
from common.service import FatalError, Idle, Inputs, Output, Service, Step, main
from services.riskfield.core import RiskField
from services.riskfield.settings import RiskfieldSettings


def build(tree: config.Tree, health: Health) -> Step:
    """Wire the core to the loop; compiles the kernels."""
    settings = config.section(tree, "riskfield", RiskfieldSettings)
    health.say("starting", "compiling kernels")
    try:
        core = RiskField(settings, config.section(tree, "risk", RiskParameters), settings.device)
    except RuntimeError as e:  # no such device here
        raise ConfigError(str(e)) from None
    try:
        core.warm_up()
    except RuntimeError as e:
        raise FatalError(f"the kernels do not run on {core.device}: {e}") from e
    health.detail["device"] = core.device

    used: tuple[str, int] | None = None

    def step(inputs: Inputs) -> Output | Idle:
        nonlocal used
        prediction = inputs.fresh(topics.PREDICTION)
        ego, world = inputs.fresh(topics.EGO), inputs.latest(topics.MAP)
        closures = inputs.latest(topics.CLOSURES)
        if prediction is None:
            return Idle("no fresh prediction: is the predictor running and are objects published?")
        if ego is None:
            return Idle("no fresh ego: is the vehicle publishing it?")
        if world is None:  # unknown is not "no barriers"
            return Idle("no map yet (topic `map`; to drive without one, publish an empty map)")
        renewed = (prediction.boot, prediction.seq) != used
        # predictor silent: the last prediction's field, shifted in time, until it is too old to be fresh
        t_offset = 0.0 if renewed else prediction.age_s(inputs.now_ns)
        try:
            risk = core.step(prediction, ego, world.value, None if closures is None else closures.value, t_offset)
        except RuntimeError as e:
            if core.device != "cpu":
                raise FatalError(f"the GPU failed: {e}") from e
            raise
        used = (prediction.boot, prediction.seq)  # not before: a step that failed has used nothing
        return Output(
            risk, prediction.capture_ns, prediction.cause, prediction.received_ns if renewed else inputs.now_ns,
            *(("ready", "running") if renewed else ("degraded", "predictor silent: old prediction shifted in time")),
        )  # fmt: skip

    return step


SERVICE = Service(
    name="riskfield",
    subscribes=(topics.PREDICTION, topics.EGO, topics.MAP, topics.CLOSURES),
    publishes=topics.RISK,
    trigger=topics.PREDICTION,
    sends_aside=True,
    period_s=0.1,
    grace_s=0.02,  # a prediction that is merely late by jitter is waited for
    build=build,
)

if __name__ == "__main__":
    raise SystemExit(main(SERVICE))
