"""Writing the figures: `forefield figures --out DIR [--only NAME] [--svg]`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import matplotlib as mpl

from common.config import ConfigError
from evaluation.figures.draw import FIGURES
from evaluation.figures.run_figures import RUN_FIGURES
from evaluation.figures.style import RC


def write(folder: Path, only: Sequence[str] = (), *, svg: bool = False) -> list[Path]:
    """Draw every figure, or some of them, into a folder, which is made if need be; the files written.

    Raises:
        ConfigError: there is no figure of that name.
    """
    figures = {**FIGURES, **RUN_FIGURES}
    for name in only:
        if name not in figures:
            raise ConfigError(f"--only {name}: no such figure; there are {', '.join(figures)}")
    folder.mkdir(parents=True, exist_ok=True)
    written = []
    with mpl.rc_context(RC):  # type: ignore[arg-type]
        for name in only or figures:
            path = folder / f"{name}.{'svg' if svg else 'png'}"
            figures[name]().savefig(path)
            written.append(path)
    return written
