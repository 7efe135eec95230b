"""The account: the numbers behind the picture, kept as they were so that a recording can be reviewed without the bus.

What is drawn is rounded, thinned out and placed for the eye. Beside it, under `/account`, every message leaves what a
review needs, in the `map` frame and in SI units; a row's time is that of its content, as for what is drawn.

- `ego`: `state`: x, y, heading, vx, vy, acceleration, yaw_rate; `ego/size`: length, width, wheelbase.
- `objects`: id, cls, x, y, heading, vx, vy, length, width, an entry for each object.
- `prediction`: id, method, and dx, dy: where each will be after each of `HORIZONS_S`, from where it was at the row's
  time, horizons of one object side by side.
- `plan`: `said`: a `Said` as JSON; `numbers`: when it arrived (time of the recording) [s], the planner's work [ms], the
  highest risk on its path (NaN: unknown).
- `status/SERVICE`: `said`: a `Status` as JSON.
- `scale`: e_max, full_scale, slice_times of the volume.

`/account` itself holds `schema` and `version` (major, minor). A reader refuses another major version.
"""

from __future__ import annotations

import msgspec
import numpy as np
import rerun as rr

from common.messages import FRAME_S, Decision, Ego, Objects, Plan, Prediction, Risk, Stamped, Status
from viz.canvas import Canvas

SCHEMA = "forefield.account"
VERSION = (1, 0)
ROOT = "account"
HORIZONS_S = (1.0, 2.0, 3.0, 4.0, 5.0, 6.0)
"""How far ahead predictions are kept [s]."""
_FRAMES = np.array([round(h / FRAME_S) - 1 for h in HORIZONS_S])


class Said(msgspec.Struct, frozen=True, kw_only=True):
    """What a plan says in words and single numbers."""

    mode: str
    reason: str
    planner: str
    desired_speed: float
    """[m/s]"""
    decision: Decision | None = None

    @staticmethod
    def of(plan: Plan) -> Said:
        """The part of a plan that is neither path nor candidates."""
        return Said(
            mode=plan.mode,
            reason=plan.reason,
            planner=plan.planner,
            desired_speed=plan.desired_speed,
            decision=plan.decision,
        )


def _values(kind: str, **fields: object) -> rr.DynamicArchetype:
    # each kind has its own columns, because Rerun remembers one type for each name
    return rr.DynamicArchetype(kind, components=fields)


def log_version(canvas: Canvas) -> None:
    """Say what stands under `/account`, once."""
    canvas.log(ROOT, _values("Account", schema=SCHEMA, version=np.array(VERSION, dtype=np.int64)), static=True)


def log_ego(canvas: Canvas, ego: Ego) -> None:
    """Keep the ego's state."""
    state = (ego.x, ego.y, ego.heading, ego.vx, ego.vy, ego.acceleration, ego.yaw_rate)
    canvas.log(f"{ROOT}/ego", _values("Ego", state=np.array(state, dtype=np.float64)))


def log_ego_size(canvas: Canvas, ego: Ego) -> None:
    """Keep the ego's size."""
    canvas.log(f"{ROOT}/ego/size", _values("Size", length=ego.length, width=ego.width, wheelbase=ego.wheelbase))


def log_objects(canvas: Canvas, objects: Objects) -> None:
    """Keep everyone's class, place, motion and size."""

    def f32(values: np.ndarray) -> np.ndarray:
        return values.astype(np.float32)

    canvas.log(
        f"{ROOT}/objects",
        _values(
            "Objects",
            id=objects.id,
            cls=objects.cls,
            x=objects.x,
            y=objects.y,
            heading=f32(objects.heading),
            vx=f32(objects.vx),
            vy=f32(objects.vy),
            length=f32(objects.length),
            width=f32(objects.width),
        ),
    )


def log_prediction(canvas: Canvas, prediction: Prediction) -> None:
    """Keep where everyone is predicted to be after each horizon."""
    dx = prediction.x[:, _FRAMES] - prediction.x0[:, None]
    dy = prediction.y[:, _FRAMES] - prediction.y0[:, None]
    canvas.log(
        f"{ROOT}/prediction",
        _values(
            "Prediction",
            id=prediction.id,
            method=prediction.method,
            dx=dx.astype(np.float32).ravel(),
            dy=dy.astype(np.float32).ravel(),
        ),
    )


def log_scale(canvas: Canvas, risk: Risk, full_scale: float) -> None:
    """Keep what the drawn levels stand for; `full_scale` is the brightest, in the volume's own units."""
    canvas.log(
        f"{ROOT}/scale",
        _values("Scale", e_max=float(risk.e_max), full_scale=float(full_scale), slice_times=np.array(risk.slice_times)),
    )


def log_plan(canvas: Canvas, stamped: Stamped[Plan], received_s: float) -> None:
    """Keep what a plan says, and when it came."""
    plan = stamped.value
    slices = plan.slice_risk
    highest = float(np.max(slices.risk)) if slices is not None and len(slices.risk) else float("nan")
    canvas.log(
        f"{ROOT}/plan",
        _values(
            "Plan",
            said=msgspec.json.encode(Said.of(plan)).decode(),
            numbers=np.array((received_s, stamped.work_ns * 1e-6, highest)),
        ),
    )


def log_status(canvas: Canvas, status: Status) -> None:
    """Keep what a service says about itself."""
    path = f"{ROOT}/status/{rr.escape_entity_path_part(status.service)}"
    canvas.log(path, _values("Status", said=msgspec.json.encode(status).decode()))
