"""The figures of whole drives; each takes a run in simulated time (half a minute to a few minutes of computing)."""

from __future__ import annotations

from evaluation.figures.run_overtaking import overtaking
from evaluation.figures.run_truck import truck
from evaluation.figures.run_turns import u_turn, unprotected_left

RUN_FIGURES = {
    "run_overtaking": overtaking,
    "run_truck": truck,
    "run_u_turn": u_turn,
    "run_unprotected_left": unprotected_left,
}
"""Every figure of a run by the name of its file."""
