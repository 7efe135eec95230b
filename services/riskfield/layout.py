"""Rows of float32 that the packing writes and the kernels read; all in the grid's frame, metres and seconds."""

from __future__ import annotations

from common.messages import HISTORY_FRAMES, PREDICTION_FRAMES

OBJECT_FIELDS = (
    "x", "y", "cos", "sin", "inverse_cos", "inverse_sin", "half_length", "half_width",
    "A", "A_e", "radius", "near", "near_x", "q0", "f0", "f1", "f2", "f3",
    "M2", "inverse_L", "reach", "sign", "s0", "half", "inverse_l", "width", "inverse_w2", "low", "high",
    "first", "last",
)  # fmt: skip
"""One object in one slice: its pose and half sides; the potential's A, A / E_max and radius (0: it does not reach the
grid), and for the two levels how far the exact values reach, along x too, and the smooth core (see `packing`);
½ M_v u² / K0, 1 / L, |u| t, sgn u, arc length of the centre, l / 2, 1 / l, w, 1 / w²; between which x the kinetic term
may lie, and the first and last segment of its path that it needs. An inverse of 0 stands for infinity."""
SEGMENT_FIELDS = (
    "x", "y", "tx", "ty", "inverse_tx", "inverse_ty", "s", "low", "high", "before_x", "before_y", "turn", "before_most",
    "next_x", "next_y", "next_0", "next_most", "x_low", "x_high", "bent",
)  # fmt: skip
"""One straight piece of one object's path: anchor, tangent, arc length at the anchor, from where to where it counts
along itself; the tangents of its neighbours and how much of them may count; its extent along x; whether a neighbour
turns at all."""
LINE_FIELDS = (
    "x", "y", "tx", "ty", "length", "next_x", "next_y", "half_width", "k_s", "flat", "side", "depth", "kind", "index",
    "x_low", "x_high", "along_low", "along_high", "beside_low", "beside_high",
)  # fmt: skip
"""One segment of one static line."""
CPU_RUN, CPU_GROUP = 512, 16
"""Longest run of cells and most slices for one task on the CPU; CUDA takes one block of one slice."""
MOST_VERTICES = HISTORY_FRAMES + PREDICTION_FRAMES + 3
"""Of one path: all frames, the current state, and a metre beyond both ends."""
FAR = 1.0e4
"""How far a path's ends go on straight [m]."""
STRAIGHT = 1.0e-7
"""Neighbouring segments that turn by less are one [rad]."""
FAR_STEP = 1.0
"""Distance of the nodes of the far field, at most [m]."""
