"""The four modules on which everything rests when things go wrong, and the tests that hold each of them."""

from __future__ import annotations

from pathlib import Path

ROOT = Path(__file__).parents[2]

MODULES: dict[str, tuple[str, ...]] = {
    "common/codec.py": (
        "tests/contract/test_codec.py",
        "tests/contract/test_codec_says.py",
        "tests/contract/test_half_floats.py",
    ),
    "common/health.py": ("tests/contract/test_health.py",),
    "services/planner/safe_stop.py": ("tests/planner/test_safe_stop.py", "tests/planner/test_planner_inputs.py"),
    "services/planner/validator.py": (
        "tests/planner/test_validator_bounds.py",
        "tests/planner/test_planner_validator.py",
    ),
}
"""Module → its tests, which need nothing but the module's own extra and run in seconds."""
