"""Risk volumes made for tests."""

import numpy as np

from common.messages import Grid, Risk


class Growing:
    """A field whose every slice differs."""

    def step(self, prediction, ego, map, closures, t_offset) -> Risk:
        volume = np.arange(3, dtype=np.float32)[:, None, None] * np.ones((1, 8, 8), dtype=np.float32)
        return Risk(
            grid=Grid(x=0.0, y=0.0, heading=0.0, rows=8, columns=8, h=0.25),
            slice_times=[0.0, 0.5, 1.0],
            slots=[],
            volume=volume,
            dominant=np.zeros((3, 2, 2), dtype=np.uint8),
        )
