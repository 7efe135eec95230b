"""The riskfield: a prediction, the ego and the road in; the risk volume M of the next six seconds out."""

from __future__ import annotations

import numpy as np

from common.messages import Closures, Ego, Grid, Map, Prediction, Risk, Slot, Stamped
from common.risk import RiskParameters
from common.risk_sources import StaticLine, dynamic_sources
from services.riskfield.device import FieldDevice, resolve
from services.riskfield.grid import grid_around
from services.riskfield.packing import pack_objects
from services.riskfield.selection import left_out
from services.riskfield.settings import RiskfieldSettings
from services.riskfield.slots import assign_slots, within_bytes
from services.riskfield.static_layer import StaticLayer, pack_lines


class RiskField:
    """Holds the device's buffers and the current map's lines; `step` is otherwise a function of its arguments."""

    def __init__(self, settings: RiskfieldSettings, risk: RiskParameters, device: str = "auto") -> None:
        self.settings = settings
        self.risk = risk
        self.device = resolve(device)
        """`cpu` or `cuda:0`."""
        self._field = FieldDevice(settings, risk, self.device)
        self._map: Map | None = None
        self._layer = StaticLayer(Map(), risk)

    def warm_up(self) -> None:
        """Compile the kernels (seconds when the cache is cold) and run them once on an empty field."""
        grid = Grid(x=0.0, y=0.0, heading=0.0, rows=4, columns=4, h=self.settings.h)
        sources = dynamic_sources(_nobody(), np.zeros(1), (0.0, 0.0), self.risk)
        packed = pack_objects(sources, np.zeros(0, dtype=bool), grid, self.risk)
        self._field.compute(grid, packed, pack_lines((), grid))

    def step(
        self,
        prediction: Stamped[Prediction],
        ego: Stamped[Ego],
        map: Map | None,
        closures: Closures | None,
        t_offset: float = 0.0,
    ) -> Risk:
        """The risk volume around the ego.

        Args:
            prediction: What the objects will do; its capture is time 0.
            ego: Our own vehicle: where the grid lies, and the velocity that u is relative to.
            map: The road, None: unknown, then there are no static sources. The same object again costs nothing.
            closures: Stop lines and lanes closed now.
            t_offset: Slice 0 lies this long after the prediction's capture [s].
        """
        now = ego.value
        t_offset = min(max(t_offset, 0.0), 10.0)
        grid = grid_around(now, self.settings)
        times = [j * self.settings.slice_s for j in range(self.settings.slices)]
        sources = dynamic_sources(prediction.value, np.asarray(times) + t_offset, (now.vx, now.vy), self.risk)
        counts, omitted = left_out(sources, now)
        packed = pack_objects(sources, counts, grid, self.risk, self.settings.accuracy == "fast")
        lines = self._lines(grid, map, closures, now)
        volume, codes = self._field.compute(grid, packed, pack_lines(lines, grid))

        names = [
            Slot(id=int(sources.id[i]), term=term, cls=int(sources.cls[i]))
            for i in packed.kept
            for term in ("potential", "kinetic")
        ]
        names += [Slot(id=line.id, term="static", cls=-1, label=line.label) for line in lines]
        omitted = within_bytes(omitted)
        taken = 9 * len(times) + sum(len(e.reason) + 12 for e in omitted)
        slots, dominant, shared = assign_slots(codes, names, other_bytes=taken)
        return Risk(
            grid=grid,
            slice_times=times,
            t_offset=t_offset,
            slots=slots,
            left_out=omitted + shared,
            e_max=self.risk.e_max,
            volume=volume,
            dominant=dominant,
        )

    def _lines(self, grid: Grid, map: Map | None, closures: Closures | None, ego: Ego) -> tuple[StaticLine, ...]:
        if map is None:
            return ()
        if map is not self._map:
            self._map, self._layer = map, StaticLayer(map, self.risk)
        return self._layer.within(grid, () if closures is None else closures.ids, ego)


def _nobody() -> Prediction:
    none, frames = np.zeros(0), np.zeros((0, 60))
    return Prediction(
        id=np.zeros(0, dtype=np.int64),
        cls=np.zeros(0, dtype=np.uint8),
        x0=none,
        y0=none,
        heading0=none,
        vx0=none,
        vy0=none,
        length=none,
        width=none,
        mass=none,
        x=frames,
        y=frames,
        heading=frames.astype(np.float32),
        speed=frames.astype(np.float32),
        past_x=np.zeros((0, 0)),
        past_y=np.zeros((0, 0)),
        method=np.zeros(0, dtype=np.uint8),
    )
