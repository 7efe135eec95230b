"""The typed messages: unit, frame and shape of every field.

Frames: `map` frame is x east, y north [m]; headings counter-clockwise from x [rad], the heading of the
body (its yaw), not of its motion. Poses are of the rectangle's centre, the ego's too. Masses in kg; 0 means
unknown. Arrays are one per field (structure of arrays); sizes named by a letter agree within one message.
Bodies are plain: ids, numbers and arrays; who sent it and how old it is stands in the header.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from enum import IntEnum
from typing import Annotated, Any, Generic, Literal, TypeVar

import numpy as np
import numpy.typing as npt
from msgspec import Meta, Struct

F64 = npt.NDArray[np.float64]
F32 = npt.NDArray[np.float32]
I64 = npt.NDArray[np.int64]
U8 = npt.NDArray[np.uint8]

HISTORY_FRAMES = 30
"""History used by the prediction, frames of 0.1 s."""
PREDICTION_FRAMES = 60
"""Predicted frames of 0.1 s."""
FRAME_S = 0.1
"""Length of one frame [s]."""
MAX_OBJECTS = 1024
BLOCK = 4
"""Side of a block of `dominant` [cells]."""
NO_SLOT = 255
"""`dominant` of a block in which no source has a share."""

XY_LIMIT = 1e8  # m; UTM coordinates fit
SPEED_LIMIT = 150.0  # m/s


@dataclass(frozen=True)
class Array:
    """Shape, type and range of an array field, checked by the codec.

    `dtypes` are NumPy's names, little-endian; `shape` holds numbers or letters; a letter is bound by the first array
    that uses it. Every array must be finite.
    """

    dtypes: tuple[str, ...]
    shape: tuple[int | str, ...]
    low: float = -np.inf
    high: float = np.inf
    least: int = 0
    """Smallest allowed length of the first dimension."""


class ObjectClass(IntEnum):
    """What kind of traffic participant an object is."""

    UNKNOWN = 0
    CAR = 1
    TRUCK = 2
    BUS = 3
    MOTORCYCLE = 4
    BICYCLE = 5
    PEDESTRIAN = 6


class Method(IntEnum):
    """What made an object's prediction."""

    CONSTANT_VELOCITY = 0
    CTRA = 1
    MAP_BASED = 2
    LSTM = 3


class Message(Struct, frozen=True, kw_only=True, forbid_unknown_fields=False):
    """Base of every body on the bus. A newer minor version may add fields with defaults; unknown ones are skipped."""

    def problem(self) -> str:
        """What types and ranges alone cannot tell is wrong with this message; empty: nothing."""
        return ""


Finite = Annotated[float, Meta(ge=-1e12, le=1e12)]
Position = Annotated[float, Meta(ge=-XY_LIMIT, le=XY_LIMIT)]
Angle = Annotated[float, Meta(ge=-100.0, le=100.0)]
Speed = Annotated[float, Meta(ge=-SPEED_LIMIT, le=SPEED_LIMIT)]
Length = Annotated[float, Meta(gt=0.0, le=100.0)]
NonNegative = Annotated[float, Meta(ge=0.0, le=1e12)]
Name = Annotated[str, Meta(max_length=64)]
Text = Annotated[str, Meta(max_length=1000)]
Id = Annotated[int, Meta(ge=-(2**62), le=2**62)]
Ids = Annotated[list[Id], Meta(max_length=4096)]


class Ego(Message, frozen=True, kw_only=True):
    """State of our own vehicle, `map` frame."""

    x: Position  # centre [m]
    y: Position  # centre [m]
    heading: Angle  # body yaw [rad]
    vx: Speed  # velocity of the centre [m/s]
    vy: Speed
    acceleration: Annotated[float, Meta(ge=-50.0, le=50.0)]  # along the heading [m/s²]
    yaw_rate: Annotated[float, Meta(ge=-20.0, le=20.0)]  # [rad/s]
    length: Length  # [m]
    width: Length  # [m]
    wheelbase: Length  # [m]; axles lie symmetrically about the centre

    @property
    def speed(self) -> float:
        """Signed speed along the heading [m/s]."""
        return float(self.vx * np.cos(self.heading) + self.vy * np.sin(self.heading))


class Objects(Message, frozen=True, kw_only=True):
    """What the vehicle perceives around it now, `map` frame; never the ego itself. n may be 0: that is a statement."""

    id: Annotated[I64, Array(("<i8",), ("n",))]
    cls: Annotated[U8, Array(("|u1",), ("n",), 0, 6)]  # ObjectClass
    x: Annotated[F64, Array(("<f8",), ("n",), -XY_LIMIT, XY_LIMIT)]  # centre [m]
    y: Annotated[F64, Array(("<f8",), ("n",), -XY_LIMIT, XY_LIMIT)]
    heading: Annotated[F64, Array(("<f8",), ("n",), -100, 100)]  # [rad]
    vx: Annotated[F64, Array(("<f8",), ("n",), -SPEED_LIMIT, SPEED_LIMIT)]  # [m/s]
    vy: Annotated[F64, Array(("<f8",), ("n",), -SPEED_LIMIT, SPEED_LIMIT)]
    length: Annotated[F64, Array(("<f8",), ("n",), 0.05, 100)]  # [m]
    width: Annotated[F64, Array(("<f8",), ("n",), 0.05, 100)]  # [m]
    mass: Annotated[F64, Array(("<f8",), ("n",), 0, 1e6)]  # [kg]; 0: unknown

    def problem(self) -> str:
        """Ids must differ and there may be at most MAX_OBJECTS of them."""
        return _id_problem(self.id)


def _id_problem(ids: I64) -> str:
    if len(ids) > MAX_OBJECTS:
        return f"{len(ids)} objects, at most {MAX_OBJECTS}"
    return "" if len(np.unique(ids)) == len(ids) else "the same id twice"


BoundaryType = Literal["unknown", "virtual", "dashed", "solid", "kerb", "barrier", "road_edge"]
"""`unknown`, `dashed`, `solid` are lane lines; `virtual` is nothing; `kerb`, `barrier`, `road_edge` are barriers."""


class Lane(Struct, frozen=True, kw_only=True):
    """One lane; its three lines run in its driving direction, `map` frame."""

    id: Id
    centre: Annotated[F64, Array(("<f8",), ("c", 2), -XY_LIMIT, XY_LIMIT, 2)]  # [m], at least 2 points
    left: Annotated[F64, Array(("<f8",), ("l", 2), -XY_LIMIT, XY_LIMIT, 2)]
    right: Annotated[F64, Array(("<f8",), ("r", 2), -XY_LIMIT, XY_LIMIT, 2)]
    left_type: BoundaryType = "unknown"
    right_type: BoundaryType = "unknown"
    speed_limit: Annotated[float, Meta(ge=0.0, le=SPEED_LIMIT)] = 0.0  # [m/s]; 0: unknown
    successors: Ids = []
    left_neighbour: Id | None = None
    left_same_direction: bool = True
    right_neighbour: Id | None = None
    right_same_direction: bool = True


class Obstacle(Struct, frozen=True, kw_only=True):
    """A static line that is not a lane boundary: barrier, kerb or stop line, `map` frame."""

    id: Id
    kind: Literal["barrier", "kerb", "stop_line"]
    points: Annotated[F64, Array(("<f8",), ("p", 2), -XY_LIMIT, XY_LIMIT, 2)]  # [m], at least 2 points
    width: Annotated[float, Meta(ge=0.0, le=100.0)] = 0.2  # [m]


class Map(Message, frozen=True, kw_only=True):
    """Lanes and static obstacles. A stop line counts only while it stands in `closures`."""

    lanes: Annotated[list[Lane], Meta(max_length=20000)] = []
    obstacles: Annotated[list[Obstacle], Meta(max_length=20000)] = []


class Goal(Struct, frozen=True, kw_only=True):
    """Where the drive ends: reached when the ego's centre is within `radius` of it, `map` frame."""

    x: Position
    y: Position
    radius: Annotated[float, Meta(gt=0.0, le=1e4)]  # [m]
    stop: bool = False  # True: come to rest there; False: drive through


class Route(Message, frozen=True, kw_only=True):
    """Where to go: always a reference line and a goal; lane ids where known."""

    reference: Annotated[
        F64, Array(("<f8",), ("n", 2), -XY_LIMIT, XY_LIMIT, 2)
    ]  # [m], at least 2 points, in driving order
    goal: Goal
    lane_ids: Ids = []
    speed_limit: Annotated[float, Meta(ge=0.0, le=SPEED_LIMIT)] = 0.0  # highest wanted speed [m/s]; 0: the map's
    lane_width: Annotated[float, Meta(ge=0.0, le=50.0)] = 3.5  # [m], where no map tells


class Closures(Message, frozen=True, kw_only=True):
    """Ids of stop lines and lanes that are closed now (red light, barrier down)."""

    ids: Ids = []


class Prediction(Message, frozen=True, kw_only=True):
    """Predicted motion of every object, `map` frame; frame i of the 60 lies (i + 1) · 0.1 s after `capture`.

    The current state stands beside it, so that the riskfield needs no `objects`; `past_*` is the path already driven,
    oldest first, the last one frame before now (extrapolated straight where it was not seen).
    """

    id: Annotated[I64, Array(("<i8",), ("n",))]
    cls: Annotated[U8, Array(("|u1",), ("n",), 0, 6)]  # ObjectClass
    x0: Annotated[F64, Array(("<f8",), ("n",), -XY_LIMIT, XY_LIMIT)]  # current centre [m]
    y0: Annotated[F64, Array(("<f8",), ("n",), -XY_LIMIT, XY_LIMIT)]
    heading0: Annotated[F64, Array(("<f8",), ("n",), -100, 100)]  # [rad]
    vx0: Annotated[F64, Array(("<f8",), ("n",), -SPEED_LIMIT, SPEED_LIMIT)]  # [m/s]
    vy0: Annotated[F64, Array(("<f8",), ("n",), -SPEED_LIMIT, SPEED_LIMIT)]
    length: Annotated[F64, Array(("<f8",), ("n",), 0.05, 100)]  # [m]
    width: Annotated[F64, Array(("<f8",), ("n",), 0.05, 100)]  # [m]
    mass: Annotated[F64, Array(("<f8",), ("n",), 0, 1e6)]  # [kg]; 0: unknown
    x: Annotated[F64, Array(("<f8",), ("n", PREDICTION_FRAMES), -XY_LIMIT, XY_LIMIT)]  # [m]
    y: Annotated[F64, Array(("<f8",), ("n", PREDICTION_FRAMES), -XY_LIMIT, XY_LIMIT)]
    heading: Annotated[F32, Array(("<f4",), ("n", PREDICTION_FRAMES), -100, 100)]  # [rad]
    speed: Annotated[F32, Array(("<f4",), ("n", PREDICTION_FRAMES), 0, SPEED_LIMIT)]  # [m/s]
    past_x: Annotated[F64, Array(("<f8",), ("n", "h"), -XY_LIMIT, XY_LIMIT)]  # [m], frames of 0.1 s
    past_y: Annotated[F64, Array(("<f8",), ("n", "h"), -XY_LIMIT, XY_LIMIT)]
    method: Annotated[U8, Array(("|u1",), ("n",), 0, 3)]  # Method
    sigma: Annotated[F32, Array(("<f4",), ("n", PREDICTION_FRAMES), 0, 100)] | None = None  # spread [m]

    def problem(self) -> str:
        """Ids must differ, there may be at most MAX_OBJECTS of them, and no more past than histories hold."""
        if self.past_x.shape[1] > HISTORY_FRAMES:
            return f"past of {self.past_x.shape[1]} frames, at most {HISTORY_FRAMES}"
        return _id_problem(self.id)


class Grid(Struct, frozen=True, kw_only=True):
    """Where the cells of a volume lie. Cell (i, j)'s centre is ((i + ½) h, (j + ½) h) from the pose, in its frame."""

    x: Position  # outer corner of cell (0, 0), `map` frame [m]
    y: Position
    heading: Angle  # direction in which i grows; j grows to its left [rad]
    rows: Annotated[int, Meta(ge=4, le=8192)]
    columns: Annotated[int, Meta(ge=4, le=8192)]
    h: Annotated[float, Meta(gt=0.0, le=10.0)]  # side of a cell [m]


Term = Literal["potential", "kinetic", "static"]


class Slot(Struct, frozen=True, array_like=True):
    """One source of risk that `dominant` may name. `cls` is an ObjectClass, or −1 for a static line."""

    id: Id
    term: Term
    cls: int
    label: Name = ""  # for static lines: `lane_line`, `barrier`, `kerb`, `stop_line`, `closed_lane`


class LeftOut(Struct, frozen=True, array_like=True):
    """A source that does not count, and why."""

    id: Id
    reason: Name


class Risk(Message, frozen=True, kw_only=True):
    """The risk volume M. All but `volume` and `dominant` travels in the header; they are the raw body, in this order.

    `volume` is [slice, i, j] in units of E_max; slice j's field holds on [t_j, t_{j+1}), the last one for good.
    `dominant` is the slot of the source with the largest share at the highest cell of each 4 × 4 block.
    """

    grid: Grid
    slice_times: Annotated[list[NonNegative], Meta(min_length=1, max_length=256)]  # from capture + t_offset [s]
    t_offset: Annotated[float, Meta(ge=0.0, le=10.0)] = 0.0  # [s]
    slots: Annotated[list[Slot], Meta(max_length=255)]
    left_out: Annotated[list[LeftOut], Meta(max_length=1024)] = []
    e_max: Annotated[float, Meta(gt=0.0, le=1e6)] = 1.0
    volume: Annotated[npt.NDArray[np.floating[Any]], Array(("<f2", "<f4"), ("s", "i", "j"), 0, 6e4)]
    dominant: Annotated[U8, Array(("|u1",), ("s", "bi", "bj"))]  # ceil(rows / 4), ceil(columns / 4); NO_SLOT: none

    def problem(self) -> str:
        """The arrays must have the grid's shape, and slice times must increase."""
        shape = (len(self.slice_times), self.grid.rows, self.grid.columns)
        blocks = (shape[0], -(-shape[1] // BLOCK), -(-shape[2] // BLOCK))
        if self.volume.shape != shape or self.dominant.shape != blocks:
            return f"volume {self.volume.shape}, dominant {self.dominant.shape}; the grid says {shape}, {blocks}"
        if any(b <= a for a, b in itertools.pairwise(self.slice_times)):
            return "slice times do not increase"
        return ""


class Trajectory(Struct, frozen=True, kw_only=True):
    """A timed path of the rectangle's centre, `map` frame; times count from the plan's `capture`."""

    t: Annotated[F64, Array(("<f8",), ("m",), -10, 1e3)]  # strictly increasing [s]
    x: Annotated[F64, Array(("<f8",), ("m",), -XY_LIMIT, XY_LIMIT)]  # [m]
    y: Annotated[F64, Array(("<f8",), ("m",), -XY_LIMIT, XY_LIMIT)]
    heading: Annotated[F64, Array(("<f8",), ("m",), -100, 100)]  # body yaw [rad]
    curvature: Annotated[F64, Array(("<f8",), ("m",), -10, 10)]  # tan(steer) / wheelbase [1/m]
    speed: Annotated[F64, Array(("<f8",), ("m",), 0, SPEED_LIMIT)]  # of the rear axle, along the heading [m/s]
    acceleration: Annotated[F64, Array(("<f8",), ("m",), -50, 50)]  # [m/s²]


class Candidates(Struct, frozen=True, kw_only=True):
    """Every path that was considered: k paths of p points, `map` frame."""

    x: Annotated[F64, Array(("<f8",), ("k", "p"), -XY_LIMIT, XY_LIMIT)]  # centre [m]
    y: Annotated[F64, Array(("<f8",), ("k", "p"), -XY_LIMIT, XY_LIMIT)]
    desired_speed: Annotated[F64, Array(("<f8",), ("k",), 0, SPEED_LIMIT)]  # S_p [m/s]
    score: Annotated[F64, Array(("<f8",), ("k",), -1e9, 1e9)]


class SliceRisk(Struct, frozen=True, kw_only=True):
    """Highest risk met by the chosen path in each slice, and where."""

    t: Annotated[F64, Array(("<f8",), ("s",), -10, 1e3)]  # start of the slice from the plan's capture [s]
    risk: Annotated[F64, Array(("<f8",), ("s",), 0, 6e4)]
    x: Annotated[F64, Array(("<f8",), ("s",), -XY_LIMIT, XY_LIMIT)]  # the point of the path [m]
    y: Annotated[F64, Array(("<f8",), ("s",), -XY_LIMIT, XY_LIMIT)]


class Decision(Struct, frozen=True, kw_only=True):
    """What decided the speed."""

    sentence: Text
    slice: int | None = None  # index into the volume's slices
    slice_s: Finite | None = None  # its start, from the plan's capture [s]
    cell: tuple[int, int] | None = None  # (i, j)
    x: Position | None = None  # the cell's centre, `map` frame [m]
    y: Position | None = None
    source_id: Id | None = None
    source_cls: int | None = None
    term: Name | None = None  # potential, kinetic, static; or curve, limit, horizon, goal, comfort
    risk: Finite | None = None


class Plan(Message, frozen=True, kw_only=True):
    """What to drive: the profile until `valid_for`, then the tail, and nothing else.

    In `waiting` and in a `safe_stop` for which no ego is known, there is no trajectory: hold the vehicle still.
    """

    mode: Literal["drive", "waiting", "safe_stop"]
    reason: Text
    planner: Name = ""
    valid_for: Annotated[float, Meta(ge=0.0, le=10.0)] = 0.3  # [s] from the plan's capture
    profile: Trajectory | None = None
    tail: Trajectory | None = None  # starts from the profile's state at `valid_for`, ends at v = 0
    desired_speed: Annotated[float, Meta(ge=0.0, le=SPEED_LIMIT)] = 0.0  # S_p of the chosen path [m/s]
    chosen: int = -1  # index into `candidates`
    candidates: Candidates | None = None
    slice_risk: SliceRisk | None = None
    decision: Decision | None = None

    def problem(self) -> str:
        """Times increase; a plan to drive has a profile and a tail that ends at rest."""
        for trajectory in (self.profile, self.tail):
            if trajectory is not None and not np.all(np.diff(trajectory.t) > 0):
                return "times do not increase"
        if self.mode == "drive" and (self.profile is None or self.tail is None):
            return "a drive plan without profile or tail"
        if self.tail is not None and (not len(self.tail.speed) or self.tail.speed[-1] != 0.0):
            return "the tail does not end at rest"
        return ""


class InputHealth(Struct, frozen=True, kw_only=True):
    """How one input of a service is doing."""

    alive: bool  # a message arrived within its time
    rate_ok: bool
    valid: bool  # the last one was accepted
    age_s: Finite | None = None
    rate_hz: NonNegative = 0.0
    received: int = 0
    used: int = 0


State = Literal["starting", "waiting", "ready", "degraded", "stopping"]


class Status(Message, frozen=True, kw_only=True):
    """Health of one service, 2 Hz."""

    service: Name
    state: State
    reason: Text
    uptime_s: NonNegative
    inputs: dict[str, InputHealth] = {}
    counters: dict[str, int] = {}  # `topic:reason` → how often
    work_ms: dict[str, Finite] = {}  # p50, p95, p99, max of the last messages
    detail: dict[str, str] = {}  # what the service adds about itself


class Cause(Struct, frozen=True, array_like=True):
    """Which `objects` message something descends from."""

    boot: Name
    seq: Annotated[int, Meta(ge=0, le=2**62)]


class Used(Struct, frozen=True, array_like=True):
    """A message that a step had before it, as its receiver knew it."""

    topic: Name  # its suffix
    boot: Name
    seq: Annotated[int, Meta(ge=0, le=2**62)]
    capture_ns: Annotated[int, Meta(ge=-(2**62), le=2**62)]  # on the receiver's monotonic clock
    new: bool  # accepted since the step before


class StepInputs(Struct, frozen=True, array_like=True):
    """All that the step which made a message had before it: with the messages named here it can be repeated exactly."""

    now_ns: Annotated[int, Meta(ge=-(2**62), le=2**62)]  # when it began, own monotonic clock
    used: Annotated[list[Used], Meta(max_length=16)]


class Header(Struct, frozen=True, kw_only=True):
    """What stands in the attachment of every message. Times in ns, on the sender's monotonic clock."""

    schema: Name
    version: tuple[Annotated[int, Meta(ge=0, le=65535)], Annotated[int, Meta(ge=0, le=65535)]]
    source: Name
    boot: Annotated[str, Meta(min_length=8, max_length=64)]
    seq: Annotated[int, Meta(ge=0, le=2**62)]
    capture_ns: Annotated[int, Meta(ge=-(2**62), le=2**62)]
    sent_ns: Annotated[int, Meta(ge=-(2**62), le=2**62)]
    age_ns: Annotated[int, Meta(ge=0, le=2**62)]
    work_ns: Annotated[int, Meta(ge=0, le=2**62)] = 0
    cause: Cause | None = None
    step: StepInputs | None = None  # of services: what the message was made from
    body: dict[str, Any] | None = None  # `risk` alone: the fields of the body that are not raw


T_co = TypeVar("T_co", covariant=True)


@dataclass(frozen=True)
class Stamped(Generic[T_co]):
    """A message as its receiver knows it: with its age brought onto the receiver's own clock."""

    value: T_co
    capture_ns: int
    """When the content was true, on the receiver's monotonic clock [ns]."""
    received_ns: int
    """When it arrived, on the receiver's monotonic clock [ns]."""
    cause: Cause | None = None
    source: str = ""
    boot: str = ""
    seq: int = 0
    work_ns: int = 0

    def age_s(self, now_ns: int) -> float:
        """Age of the content [s]."""
        return (now_ns - self.capture_ns) * 1e-9

    def descent(self) -> Cause:
        """The cause of what is made from this message when it is itself the origin (`objects`)."""
        return Cause(self.boot, self.seq)
