"""Writing the figures: `forefield figures --out DIR`."""

from __future__ import annotations

from pathlib import Path

import matplotlib as mpl

from evaluation.figures.draw import FIGURES
from evaluation.figures.run_figures import RUN_FIGURES
from evaluation.figures.style import RC


def write(folder: Path) -> list[Path]:
    """Draw every figure into a folder, which is made if need be; the files written."""
    folder.mkdir(parents=True, exist_ok=True)
    written = []
    with mpl.rc_context(RC):  # type: ignore[arg-type]
        for name, make in {**FIGURES, **RUN_FIGURES}.items():
            path = folder / f"{name}.png"
            make().savefig(path)
            written.append(path)
    return written
