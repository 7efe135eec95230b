"""Section `[viz]`: what is drawn, how often, and where it goes."""

from __future__ import annotations

from typing import Annotated

from msgspec import Meta

from common.config import Settings

Positive = Annotated[float, Meta(gt=0.0)]


class VizSettings(Settings, frozen=True):
    """Section `[viz]`. `record` and `serve` are also options of `python -m viz`."""

    record: str = ""
    """File to write (`.rrd`), or a folder, which then receives pieces that never overwrite each other; empty: none."""
    scenario: str = ""
    """Name stored in the recording; empty: `live`."""
    serve: Annotated[int, Meta(ge=0, le=65535)] = 0
    """Port on which a viewer can watch live; 0: none. The server knows no authentication: it listens on `address`."""
    address: str = "127.0.0.1"
    """Address of that server; anything but loopback shows the drive to everyone who reaches it."""
    server_memory: str = "256MiB"
    """What the server keeps for a viewer that joins late; the oldest is dropped first."""
    rotate_mib: Annotated[float, Meta(ge=0.0)] = 1024.0
    """A piece of this size is finished and the next begun [MiB]; 0: half the budget. A piece is complete by itself."""
    rotate_minutes: Annotated[float, Meta(ge=0.0)] = 15.0
    """So is a piece of this age [min]; 0: any age."""
    budget_mib: Annotated[float, Meta(ge=0.0)] = 20480.0
    """All pieces together take no more; the oldest is removed first [MiB]. An hour takes some 4 GiB. At least twice
    `rotate_mib`, since one finished piece stays while the next is written. 0: no budget."""
    reserve_mib: Annotated[float, Meta(ge=0.0)] = 256.0
    """This much of the disk is left free, whoever fills it [MiB]: the oldest pieces go if that suffices, otherwise
    recording pauses."""
    footer: bool = True
    """Finish the file with an index when it is closed. It costs memory while recording; without it a file still opens,
    and `rerun rrd optimize IN -o OUT` adds it afterwards."""
    flush_s: Positive = 0.75
    """Rows wait this long to share a chunk [s]: smaller files, and as much is lost with a process that is killed."""
    live_flush_s: Positive = 0.2
    """The same for live viewers: the picture is later by as much [s]."""
    heavy_hz: Positive = 10.0
    """Highest rate at which risk, candidates and objects are drawn [Hz]."""
    ego_hz: Positive = 20.0
    """Highest rate at which the ego is drawn [Hz]."""
    exact_hz: Annotated[float, Meta(ge=0.0)] = 1.0
    """Rate at which the volume is stored with its own numbers (float16 tensor) [Hz]; 0: never."""
    stack: bool = True
    """Draw the moving part of all slices as layers lifted by time; else only the first and the one that decided."""
    stack_step: Annotated[int, Meta(ge=1, le=8)] = 2
    """Cells of the volume that one cell of a layer stands for, along each side; their maximum is shown."""
    lift: Positive = 6.0
    """Height that one second of the future takes in the time stack [m/s]."""
    full_scale: Positive = 1.5
    """Risk shown in the brightest colour [E_max]; more is shown alike."""
    trail_s: Annotated[float, Meta(ge=0.0)] = 3.0
    """How much of the driven path is drawn behind objects and ego [s]."""
    labelled: Annotated[int, Meta(ge=0)] = 16
    """How many objects, the nearest first, may carry a label; fewer where they would cover each other."""
    candidate_points: Annotated[int, Meta(ge=2)] = 12
    """Points drawn for each candidate."""
    comfort_accel: Positive = 1.07
    """Comfort's bound drawn beside the acceleration, speeding up [m/s²]; a run takes the planner's own."""
    comfort_brake: Positive = 1.5
    """The same, slowing down [m/s²]."""
    comfort_jerk: Positive = 1.5
    """The same for jerk [m/s³]."""

    def __post_init__(self) -> None:
        """Check what two settings say together.

        Raises:
            ValueError: the budget has no room for two pieces.
        """
        if self.budget_mib and self.budget_mib < 2.0 * self.rotate_mib:
            raise ValueError(
                f"viz.budget_mib is {self.budget_mib:g}, less than two pieces of viz.rotate_mib {self.rotate_mib:g}: "
                f"nothing finished could be kept; raise it to {2.0 * self.rotate_mib:g}, or set "
                f"viz.rotate_mib={self.budget_mib / 2.0:g}"
            )
