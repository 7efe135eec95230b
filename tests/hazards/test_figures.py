"""The figures: each is drawn from the real cores, into a file; colours read without colour vision."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from evaluation.figures import scenes
from evaluation.figures.draw import FIGURES
from evaluation.figures.style import risk_colours


def test_more_risk_is_always_darker():
    rgb = np.asarray(risk_colours()(np.linspace(0.0, 1.0, 64)))[:, :3]
    luminance = rgb @ [0.2126, 0.7152, 0.0722]
    assert np.all(np.diff(luminance) < 0.0)


@pytest.mark.parametrize("name", list(FIGURES))
def test_every_figure_is_drawn_with_axes_in_metres_and_a_unit_for_risk(name: str, tmp_path: Path):
    figure = FIGURES[name]()
    labels = {a.get_xlabel() for a in figure.axes} | {a.get_ylabel() for a in figure.axes}
    assert "x [m]" in labels and "y [m]" in labels
    assert any(r"E_\mathrm{max}" in label for label in labels)
    figure.savefig(tmp_path / "figure.png", dpi=60)
    assert (tmp_path / "figure.png").stat().st_size > 10_000


def test_the_turning_car_s_field_bends_with_its_path():
    """On the predicted path, half way round, there is more risk than straight ahead of the car at that distance."""
    scene = scenes.turning()
    p, g = scene.prediction, scene.risk.grid

    def at(x: float, y: float) -> float:
        return float(scene.risk.volume[0][int((x - g.x) / g.h), int((y - g.y) / g.h)])

    on_path = at(float(p.x[0, 12]), float(p.y[0, 12]))
    s = np.hypot(p.x[0, 12] - p.x0[0], p.y[0, 12] - p.y0[0])
    ahead = at(float(p.x0[0] + s * np.cos(p.heading0[0])), float(p.y0[0] + s * np.sin(p.heading0[0])))
    assert on_path > ahead + 0.1


def test_an_unknown_figure_is_refused_with_the_known_ones(tmp_path: Path):
    from common.config import ConfigError
    from evaluation.figures import command

    with pytest.raises(ConfigError, match="turning_object"):
        command.write(tmp_path, ["nonsense"])
