"""The figures of whole drives; each takes a run in simulated time (half a minute to a few minutes of computing)."""

from __future__ import annotations

from evaluation.figures.run_overtaking import overtaking
from evaluation.figures.run_truck import truck

RUN_FIGURES = {"run_overtaking": overtaking, "run_truck": truck}
"""Every figure of a run by the name of its file."""
