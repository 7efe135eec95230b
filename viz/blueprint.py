"""What a viewer shows when it opens a recording: stored in the recording itself."""

from __future__ import annotations

import rerun as rr
import rerun.blueprint as rrb
from rerun.blueprint.encodings import TextLogColumn, TextLogColumnKind
from rerun.encodings import TensorDimensionIndexSelection, TensorDimensionSelection

from viz.colours import GROUND
from viz.plots import SERVICES

EGO = "world/ego"
"""Every spatial view is drawn in the ego's frame: it drives to the right, and left of it is up."""

WHO = ["+ plan", *(f"+ {service}" for service in SERVICES)]
"""Whose states and words are shown: each stands under its own name."""
COLUMNS = [
    TextLogColumn(kind=TextLogColumnKind.EntityPath, visible=True),
    TextLogColumn(kind=TextLogColumnKind.Body, visible=True),
]

WINDOW_S = 20.0


def blueprint() -> rrb.Blueprint:
    """The one layout: where things are on the left, what they mean along time on the right."""
    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Vertical(
                bird(
                    "Now, from above · the ego drives to the right",
                    ["+ world/**", "- world/map/virtual_line"],
                    (48.0, -4.0),
                    56.0,
                ),
                rrb.Horizontal(
                    rrb.Tabs(
                        bird(
                            "The slice that decided · everyone where predicted",
                            ["+ slice/**", "+ world/map/**", "+ world/plan/profile", "- world/map/virtual_line"],
                            (34.0, 0.0),
                            50.0,
                        ),
                        slices(),
                        active_tab=0,
                    ),
                    stack(),
                    column_shares=[1, 1],
                ),
                rrb.Horizontal(
                    rrb.StateTimelineView(origin="/", contents=WHO, name="Mode of the plan, health of the services"),
                    rrb.TextLogView(
                        origin="/",
                        contents=WHO,
                        name="Log: what changed, and why",
                        columns=rrb.TextLogColumns(timeline_columns=["frame"], text_log_columns=COLUMNS),
                    ),
                    column_shares=[1, 1],
                ),
                row_shares=[10, 8, 5],
            ),
            rrb.Vertical(
                rrb.Tabs(
                    rrb.TextDocumentView(origin="why", name="Why"),
                    rrb.TextDocumentView(origin="health", name="Health"),
                    rrb.TextDocumentView(origin="about", name="About"),
                    active_tab=0,
                ),
                series("plot/speed", "Speed [m/s]"),
                series("plot/acceleration", "Acceleration, comfort's bounds [m/s²]", False),
                series("plot/jerk", "Jerk, comfort's bounds [m/s³]", False),
                series("plot/max_risk", "Highest risk on the path: yellow now, blue in 6 s [E_max]", False),
                series("plot/latency", "Latency, deadline [ms]"),
                row_shares=[10, 5, 4, 4, 4, 5],
            ),
            column_shares=[5, 2],
        ),
        rrb.TimePanel(state="collapsed", timeline="frame"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.BlueprintPanel(state="collapsed"),
        auto_layout=False,
        auto_views=False,
    )


def bird(name: str, contents: list[str], centre: tuple[float, float], height: float) -> rrb.Spatial3DView:
    """A view from straight above, in the ego's frame; `height` [m] sets how much is seen."""
    return rrb.Spatial3DView(
        origin=EGO,
        contents=contents,
        name=name,
        background=rrb.Background(color=GROUND, kind="SolidColor"),
        line_grid=False,
        eye_controls=rrb.EyeControls3D(
            kind=rrb.Eye3DKind.Orbital,
            position=(centre[0], centre[1], height),
            look_target=(centre[0], centre[1], 0.0),
            eye_up=(0.0, 1.0, 0.0),
        ),
    )


def stack() -> rrb.Spatial3DView:
    """The slices one above the other, seen from behind and from the right."""
    return rrb.Spatial3DView(
        origin=EGO,
        contents=[
            "+ stack/**",
            "+ world/map/**",
            "+ world/ego/body",
            "- world/map/virtual_line",
        ],
        name="Time stack · up is later · what moves",
        background=rrb.Background(color=GROUND, kind="SolidColor"),
        line_grid=False,
        eye_controls=rrb.EyeControls3D(
            kind=rrb.Eye3DKind.Orbital,
            position=(-40.0, -48.0, 44.0),
            look_target=(30.0, 2.0, 15.0),
            eye_up=(0.0, 0.0, 1.0),
        ),
    )


def slices() -> rrb.TensorView:
    """Any slice of the volume with its own numbers: a slider chooses which."""
    return rrb.TensorView(
        origin="risk/exact",
        name="Any slice, exact · forward is right",
        slice_selection=rrb.TensorSliceSelection(
            width=TensorDimensionSelection(dimension=0, invert=False),
            height=TensorDimensionSelection(dimension=2, invert=True),
            indices=[TensorDimensionIndexSelection(dimension=1, index=0)],
            slider=[1],
        ),
        scalar_mapping=rrb.TensorScalarMapping(colormap=rr.components.Colormap.Inferno, mag_filter="Nearest"),
        view_fit="FillKeepAspectRatio",
    )


def series(origin: str, name: str, legend: bool = True) -> rrb.TimeSeriesView:
    """Curves of the last seconds, up to the time shown."""
    return rrb.TimeSeriesView(
        origin=origin,
        name=name,
        plot_legend=rrb.PlotLegend(corner=rrb.Corner2D.LeftTop, visible=legend),
        time_ranges=rr.VisibleTimeRange(
            "t",
            start=rr.TimeRangeBoundary.cursor_relative(seconds=-WINDOW_S),
            end=rr.TimeRangeBoundary.cursor_relative(),
        ),
    )
