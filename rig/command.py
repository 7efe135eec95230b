"""The `forefield` command. What it needs beyond the services is in the extra `rig`."""

from __future__ import annotations

import sys

EXTRAS = {
    "typer": "rig",
    "rich": "rig",
    "commonroad": "rig",
    "mcap": "rig",
    "torch": "predictor",
    "warp": "riskfield",
    "rerun": "viz",
}


def main() -> None:
    """Run the command; a missing package is named together with the extra that brings it."""
    try:
        from rig.application import app

        app()
    except ModuleNotFoundError as e:
        package = (e.name or "").partition(".")[0]
        if package not in EXTRAS:
            raise
        print(f"forefield needs {package}: pip install 'forefield[{EXTRAS[package]}]'", file=sys.stderr)
        raise SystemExit(2) from None


if __name__ == "__main__":
    main()
