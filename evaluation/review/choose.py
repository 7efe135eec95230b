"""Which moment shows an intervention: the first drawing at which the plan gives the very reason that explains it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from common.messages import F64
from evaluation.review.drive import Drive
from evaluation.review.recording import Recording, Spoken
from rig.interventions import Intervention

SAME_S = 1e-4
EARLIER_S = 0.3
"""A plan drawn this long before its reason took hold shows it too [s]."""


@dataclass(frozen=True)
class Shown:
    """The moment of an intervention: time of the recording [s], and the plan drawn there."""

    t: float
    plan: Spoken | None


def shown(recording: Recording, drive: Drive, intervention: Intervention, drawn: F64) -> Shown:
    """Choose among the times at which plans were drawn [s]; where none fits, when the reason took hold."""
    since, until = intervention.since + drive.began, intervention.until + drive.began
    of = {round(p.t / SAME_S): p for p in recording.plans}
    for t in drawn[(drawn >= since - EARLIER_S) & (drawn <= until)]:
        plan = of.get(round(float(t) / SAME_S))
        if plan is not None and _gives(plan, intervention):
            return Shown(float(t), plan)
    k = int(np.clip(np.searchsorted(drive.states.t, intervention.since), 0, len(drive.states.t) - 1))
    in_force = drive.in_force[k]
    return Shown(since if in_force is None else in_force.t, in_force)


def _gives(plan: Spoken, intervention: Intervention) -> bool:
    decision, why = plan.said.decision, intervention.reason
    told = (None, None) if decision is None else (decision.source_id, decision.term)
    return (plan.said.mode, *told) == (why.mode, why.source_id, why.term)
