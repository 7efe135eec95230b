"""What each method sees, frame by frame, of an episode in which nobody reacts.

Observations come at 10 Hz and hold nothing of the future. The predictive field is asked through the real cores: a
`Predictor` with the histories seen so far, a `RiskField` with its prediction; then the ego's footprint moves along its
own path at its own speed, and what it meets in the published slices is recorded.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from common import config
from common.config import Tree
from common.geometry import Polyline
from common.messages import F32, F64, FRAME_S, Ego, Map, Objects, Prediction, Stamped
from common.risk import RiskParameters
from evaluation.hazards.episode import HISTORY_S
from evaluation.hazards.footprint import footprint, met
from evaluation.hazards.named import Case
from evaluation.hazards.published import wttc
from evaluation.hazards.ttc import ttc_2d, ttc_lane
from services.predictor.core import Predictor
from services.predictor.settings import PredictorSettings
from services.riskfield.core import RiskField
from services.riskfield.settings import RiskfieldSettings

SLICE_S = 0.5
REACH_S = 4.0
"""The field is read so far ahead [s]; what lies farther has no weight in any alarm (`alarms.faded`)."""
SLACK = 5
"""The ego is looked for in slice j up to so many frames before and after t_j."""


class Course(Protocol):
    """Where the ego goes if nobody reacts."""

    def ego_poses(self, t: F64) -> tuple[F64, F64, F64]:
        """Centre and heading at times [s]."""


@dataclass(frozen=True)
class Seen:
    """What the methods see in F frames."""

    t: F64
    """Time of each frame [s], [F]."""
    field: F32
    """Largest M_j under the footprint at t_j + m · 0.1 s, m = −SLACK … SLACK, [F, slices, 2 SLACK + 1]."""
    current: F32
    """Largest M_0 under the footprint at t_j: the field of the moment, frozen, [F, slices]."""
    ttc_lane: F64
    """[F] [s]."""
    ttc_2d: F64
    wttc: F64


ALERT: Tree = {
    "policy": "map-first",
    "kinematic": {"turn_sure": 0.35, "turn_rate_min": 0.2, "braking_sure_mps2": 2.0},
    "map": {"swerve_scale": 1000.0, "heading_tolerance": 0.25, "branch_s": 0.1, "body_yaw": 1.0},
}
"""An alarm's predictor: position and yaw alone say which lane, whoever points elsewhere is on none, and strong turns
and braking are believed at once; chosen on tuning seeds, see docs/hazards.md."""


def alert_predictor() -> PredictorSettings:
    """The predictor's settings with `ALERT`."""
    return config.section({"predictor": ALERT}, "predictor", PredictorSettings)


def _over(base: Tree, told: Tree) -> Tree:
    """What is told, over a base; section by section."""
    both = {**base, **told}
    return {k: {**base[k], **told[k]} if isinstance(base.get(k), dict) and k in told else v for k, v in both.items()}


@dataclass(frozen=True)
class Cores:
    """How the two services are configured."""

    predictor: PredictorSettings = field(default_factory=alert_predictor)
    risk: RiskParameters = field(default_factory=RiskParameters)

    @staticmethod
    def of(tree: Tree) -> Cores:
        """From the configuration, over `ALERT`."""
        predictor = config.section(
            {"predictor": _over(ALERT, tree.get("predictor", {}))}, "predictor", PredictorSettings
        )
        return Cores(predictor, config.section(tree, "risk", RiskParameters))

    def new_predictor(self) -> Predictor:
        """A predictor without any history; with the network where the policy wants one."""
        if self.predictor.policy in ("map-first", "kinematic"):
            return Predictor(self.predictor, self.risk)
        from services.predictor.learned import load_learned

        return Predictor(self.predictor, self.risk, load_learned(self.predictor, self.risk)[0])


class FieldWatcher:
    """The predictive field and the field of the moment, with one history."""

    def __init__(self, speed: float, *, curved: bool, cores: Cores) -> None:
        self._predictor = cores.new_predictor()
        ahead = float(np.ceil((speed * (REACH_S + SLACK * FRAME_S) + 6.0) / 10.0) * 10.0)
        settings = RiskfieldSettings(
            ahead=ahead,
            ahead_most=ahead,
            behind=20.0,
            width=60.0 if curved else 16.0,
            slices=round(REACH_S / SLICE_S) + 1,
            slice_s=SLICE_S,
            device="cpu",
        )
        self._field = RiskField(settings, cores.risk, "cpu")

    def observe(self, objects: Objects, t: float, map: Map | None) -> Stamped[Prediction]:
        """Take in what is seen at t [s]."""
        capture = round((t + 1000.0) * 1e9)
        return Stamped(self._predictor.step(Stamped(objects, capture, capture), None, map), capture, capture)

    def read(self, prediction: Stamped[Prediction], ego: Ego, course: Course, t: float) -> tuple[F64, F64]:
        """Largest risk under the footprint: `field` and `current` of one frame."""
        risk = self._field.step(prediction, Stamped(ego, prediction.capture_ns, prediction.capture_ns), None, None)
        body = footprint(ego.length, ego.width)
        starts = np.asarray(risk.slice_times)
        slack = FRAME_S * np.arange(-SLACK, SLACK + 1)
        ahead = np.maximum(starts[:, None] + slack, 0.0)  # nobody is met in the past
        x, y, heading = course.ego_poses(t + ahead)
        ahead_risk = met(risk, np.arange(len(starts))[:, None], x, y, heading, body)
        return ahead_risk, met(risk, 0, *course.ego_poses(t + starts), body)


def watch(case: Case, cores: Cores) -> Seen:
    """All methods on one episode: frames from 0 until the event, or to the end."""
    e = case.episode
    end = e.duration_s if case.truth.event_s is None else case.truth.event_s
    curved = float(np.ptp(e.path.tangents[:, 1])) > 1e-6
    watcher = FieldWatcher(e.speed, curved=curved, cores=cores)
    for k in range(-round(HISTORY_S / FRAME_S), 0):
        watcher.observe(e.objects(k), k * FRAME_S, None)  # a history needs no map
    rows = []
    for k in range(int(np.floor(end / FRAME_S + 1e-9)) + 1):
        t = k * FRAME_S
        objects, ego = e.objects(k), e.ego(t)
        risks = watcher.read(watcher.observe(objects, t, e.map), ego, e, t)
        s = e.s0 + e.speed * t
        rows.append((t, *risks, times_to_collision(ego, s, e.speed, e.path, objects)))
    return stacked(rows)


def times_to_collision(ego: Ego, s: float, speed: float, path: Polyline, objects: Objects) -> tuple[float, ...]:
    """`ttc_lane`, `ttc_2d`, `wttc` of one moment [s]."""
    return ttc_lane(ego, s, speed, path, objects), ttc_2d(ego, s, speed, path, objects), wttc(ego, objects)


def stacked(rows: Iterable[tuple[float, F64, F64, tuple[float, ...]]]) -> Seen:
    """One `Seen` of many frames."""
    t, predictive, current, times = zip(*rows, strict=True)
    return Seen(
        np.array(t),
        np.stack(predictive).astype(np.float32),
        np.stack(current).astype(np.float32),
        *np.array(times).reshape(len(t), -1).T,
    )
