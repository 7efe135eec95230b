"""What a reader of a recording is told beside the picture: what is what, in which units, and the configuration."""

from __future__ import annotations

import json
from typing import Any

from viz.settings import VizSettings


def about(scenario: str, configuration: dict[str, Any], settings: VizSettings) -> str:
    """The page `about` of a recording, as Markdown."""
    return "\n".join(
        (
            f"# {scenario or 'Live'}",
            "",
            "**Bird's-eye view**: the ego drives to the right; left on the picture is left of the ego (up).",
            "The heatmap is the risk M now, in units of E_max, black 0 to pale yellow "
            f"{settings.full_scale:g} E_max and above, the same scale in every frame. Off the road the field stays at "
            "the height of its edge; that plateau, wherever what stands still reaches the top of the scale, is drawn "
            "dark: the bright line along the kerb is its rim, the land behind it is no safer.",
            "",
            "Thin blue lines: candidate paths, brighter where the desired speed is higher. Wide green: the path "
            "chosen. Pink: the stopping tail. Red dot: the cell that decided the speed, with its source and risk.",
            "",
            "**Risk on the path**: one curve a slice, yellow now, blue the last.",
            "",
            "**Time stack**: the slices of the next seconds one above the other, "
            f"{settings.lift:g} m per second; the chosen path climbs through them. Only what moves is shown: where the "
            "largest share stands still, the slices are clear. `risk/exact` holds the volume with its own numbers.",
            "",
            "**Units**: m, s, m/s, m/s², ms. Timelines: `frame` counts messages of objects, `t` is seconds of the run.",
            "",
            "## Configuration",
            "```json",
            json.dumps(configuration, indent=2, sort_keys=True),
            "```",
        )
    )
