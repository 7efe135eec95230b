"""The planner as a process: ego, map, route and risk in, plan out, 20 times a second whatever arrives.

It steps when new risk arrives and 50 ms after its last step otherwise; a step that would fall just before the next risk
waits for it (7 ms at most). When the risk or the ego in use becomes too old it steps at that very moment.
"""

from __future__ import annotations

from common import config, topics
from common.health import Health
from common.service import Idle, Inputs, Output, Service, Step, main
from services.planner.core import Planner
from services.planner.settings import PlannerSettings


def build(tree: config.Tree, health: Health) -> Step:
    """Wire the core to the loop."""
    settings = config.section(tree, "planner", PlannerSettings)
    core = Planner(settings)
    health.say("starting", "compiling kernels")
    core.warm_up()
    health.detail["planner"] = settings.name

    def step(inputs: Inputs) -> Output | Idle:
        ego, risk = inputs.latest(topics.EGO), inputs.latest(topics.RISK)
        plan = core.step(ego, risk, inputs.latest(topics.MAP), inputs.latest(topics.ROUTE), inputs.now_ns)
        health.count(f"mode:{plan.mode}")
        renewed = risk is not None and topics.RISK.suffix in inputs.new
        return Output(
            plan,
            core.capture_ns(ego, inputs.now_ns),
            None if risk is None else risk.cause,
            risk.received_ns if risk is not None and renewed else inputs.now_ns,
            *(("ready", "driving") if plan.mode == "drive" else ("waiting", f"{plan.mode}: {plan.reason}")),
            again_ns=core.expires_ns(ego, risk, inputs.now_ns),
        )

    return step


SERVICE = Service(
    name="planner",
    subscribes=(topics.EGO, topics.MAP, topics.ROUTE, topics.RISK),
    publishes=topics.PLAN,
    trigger=topics.RISK,
    period_s=0.05,
    grace_s=0.007,  # no step is begun just before the next risk arrives
    build=build,
)

if __name__ == "__main__":
    raise SystemExit(main(SERVICE))
