"""The planner sees `ego`, `map`, `route` and `risk`, and nothing of the other services."""

from __future__ import annotations

import ast
from pathlib import Path

import services.planner

FILES = sorted(Path(services.planner.__file__).parent.glob("*.py"))


def imported(path: Path) -> set[str]:
    names: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names |= {a.name for a in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            names.add(node.module or "")
    return names


def test_the_planner_imports_no_other_service():
    assert len(FILES) > 10
    for path in FILES:
        for name in imported(path):
            top = name.split(".")[0]
            assert top not in {"viz", "rig", "evaluation", "torch", "zenoh", "scipy"}, f"{path.name}: {name}"
            assert top != "services" or name.startswith("services.planner"), f"{path.name}: {name}"


def test_the_planner_never_names_objects_or_predictions():
    for path in FILES:
        words = {
            node.attr if isinstance(node, ast.Attribute) else node.id
            for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
            if isinstance(node, ast.Attribute | ast.Name)
        }
        assert not words & {"OBJECTS", "PREDICTION", "Objects", "Prediction"}, path.name


def test_the_core_knows_neither_bus_nor_clock():
    for path in FILES:
        if path.name == "__main__.py":
            continue
        assert not imported(path) & {"common.bus", "common.service", "common.clock", "time"}, path.name
