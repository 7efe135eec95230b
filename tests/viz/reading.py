"""Draws into a file, and reads back what stands in it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from rerun.chunk import RrdReader

from tests.viz import synthetic
from viz.blueprint import blueprint
from viz.scene import Scene
from viz.settings import VizSettings
from viz.sinks import recording


def draw(path: Path, give: Callable[[Scene], None], **settings) -> Path:
    """Record what `give` gives to a scene."""
    s = VizSettings(record=str(path), **settings)
    with recording(s, "synthetic", blueprint(), {"planner": {"name": "default"}}) as rec:
        give(Scene(rec, s))
    return path


def record(path: Path, drive: synthetic.Drive, frames: int, **settings) -> Path:
    """Record a made-up drive."""
    heard = list(synthetic.messages(drive, frames))  # made beforehand, because making them takes longer than a drive
    return draw(path, lambda scene: synthetic.give(scene, heard), **settings)


def rows(path: Path, entity: str) -> list[tuple[int | None, dict]]:
    """(frame, components) of each row, in the order of the frames."""
    found = []
    for chunk in RrdReader(path).stream().filter(content=entity):
        batch = chunk.to_record_batch()
        names = [n for n in batch.schema.names if ":" in n or "_at_origin" in n]
        for i in range(batch.num_rows):
            frame = batch.column("frame")[i].as_py() if "frame" in batch.schema.names else None
            found.append((frame, {n.split(":")[-1]: batch.column(n)[i] for n in names}))
    return sorted(found, key=lambda row: -1 if row[0] is None else row[0])


def carrying(path: Path, component: str) -> set:
    """Every value of a component, whatever entity has it."""
    batches = [chunk.to_record_batch() for chunk in RrdReader(path).stream()]
    columns = [b.column(component) for b in batches if component in b.schema.names]
    return {value for column in columns for row in column.to_pylist() if row for value in row}


def origin(path: Path) -> np.ndarray:
    (_, found), = rows(path, "/world")  # fmt: skip
    return np.array([found["map_x_at_origin"].as_py()[0], found["map_y_at_origin"].as_py()[0]])


def heat(found: dict) -> tuple[np.ndarray, np.ndarray]:
    """Levels and centres of the cells as drawn, from what is logged alone: rows from the top, turned at the corner."""
    form = found["format"].as_py()[0]
    image = np.frombuffer(bytes(found["data"].as_py()[0]), np.uint8).reshape(form["height"], form["width"])
    cell = found["cell_size"].as_py()[0]
    corner = np.array(found["translation"].as_py()[0])[:2]
    qx, qy, qz, qw = found["quaternion"].as_py()[0]
    assert abs(qx) + abs(qy) < 1e-9
    angle = 2 * np.arctan2(qz, qw)
    x = (np.arange(form["width"]) + 0.5) * cell
    y = (form["height"] - np.arange(form["height"]) - 0.5) * cell
    x, y = np.meshgrid(x, y)
    c, s = np.cos(angle), np.sin(angle)
    return image, corner + np.stack((c * x - s * y, s * x + c * y), axis=-1)
