"""Section `[riskfield]`: the grid, the slices and where they are computed."""

from __future__ import annotations

from typing import Annotated, Literal

from msgspec import Meta

from common.config import Settings

Metres = Annotated[float, Meta(gt=0.0, le=1000.0)]


class RiskfieldSettings(Settings, frozen=True, kw_only=True):
    """How the risk volume is laid out; the field's own constants stand in `[risk]`."""

    ahead: Metres = 130.0  # grid ahead of the ego's centre at low speed [m]; it follows the speed when needed
    ahead_most: Metres = 600.0  # and ends here: reaches 1.5 v + v²/3 + 6.5 m up to 144 km/h [m]
    behind: Metres = 30.0  # grid behind the ego's centre [m]
    width: Metres = 40.0  # grid across, half of it on each side [m]
    # side of a cell [m]; above 0.25 a barrier (half-width 0.6 m) can fall below the contact threshold between cells
    h: Annotated[float, Meta(ge=0.05, le=2.0)] = 0.25
    slices: Annotated[int, Meta(ge=1, le=256)] = 13  # number of slices [-]
    slice_s: Annotated[float, Meta(gt=0.0, le=10.0)] = 0.5  # from one slice to the next [s]
    dtype: Literal["float16", "float32"] = "float16"  # of the volume
    # fast: far from a body the potential is interpolated between nodes, to 2e-3 E_max; exact: every cell is computed
    accuracy: Literal["fast", "exact"] = "fast"
    device: Literal["auto", "cpu", "cuda"] = "auto"  # auto: CUDA where there is one
    threads: Annotated[int, Meta(ge=1, le=64)] = 1  # on the CPU, the slices are shared among them [-]
