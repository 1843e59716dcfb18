"""Rerun views that several panels and reports use. Importing this module imports Rerun."""

from collections.abc import Mapping, Sequence
from typing import Any, Final

import rerun as rr
import rerun.blueprint as rrb

TIMELINE: Final = "sample_time"
RAW_SAMPLES_S: Final = 30.0
"""Duration of the samples that a view shows [s]."""
HALF_LABEL_SHARE: Final = 0.08
"""Width of half a tick label, as a share of the width of the plot."""


def time_series_view(
    origin: str,
    name: str,
    contents: Sequence[str] = ("$origin",),
    last_s: float | None = None,
    legend: bool = False,
    styles: Mapping[Any, rr.SeriesLines] | None = None,
) -> rrb.TimeSeriesView:
    """Return a view of time series that ends at the time cursor of the viewer.

    Parameters
    ----------
    origin
        Path of the entity that the view shows.
    name
        Title of the view.
    contents
        Paths of the entities to show.
    last_s
        Time range before the cursor [s]. By default, the view begins with the first sample.
    legend
        True to show a legend.
    styles
        Line styles for this view only, by path of the entity.
    """
    return rrb.TimeSeriesView(
        origin=origin,
        contents=[f"+ {one}" for one in contents],
        name=name,
        plot_legend=rrb.PlotLegend(rrb.Corner2D.LeftTop) if legend else rrb.PlotLegend(visible=False),
        overrides=styles,
        axis_x=_until_cursor() if last_s is None else _before_cursor(last_s),
    )


def drawing_view(origin: str, name: str, contents: Any, x_range: Sequence[float], y_range: Sequence[float]) -> rrb.View:
    """Return a view of a two-dimensional drawing in chart units.

    Parameters
    ----------
    origin
        Path of the entity that the view shows.
    name
        Title of the view.
    contents
        Paths of the entities to show.
    x_range, y_range
        Limits of the view in chart units.
    """
    return rrb.Spatial2DView(
        origin=origin,
        contents=contents,
        name=name,
        visual_bounds=rrb.VisualBounds2D(x_range=list(x_range), y_range=list(y_range)),
    )


def collapsed_blueprint(root: rrb.Container, timeline: str) -> rrb.Blueprint:
    """Return a layout with collapsed side panels and the given timeline."""
    return rrb.Blueprint(
        root,
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(state="collapsed", timeline=timeline, play_state="following"),
        auto_views=False,
        auto_layout=False,
    )


def markdown_document(text: str) -> rr.TextDocument:
    """Return a Rerun component with a Markdown text."""
    return rr.TextDocument(text, media_type=rr.MediaType.MARKDOWN)


def temperature_view(device: str) -> rrb.TimeSeriesView:
    """Return a view of the temperature of a device over time."""
    return time_series_view(f"/{device}/temperature", "Temperature, °C")


def _before_cursor(seconds: float) -> rrb.TimeAxis:
    """Return a time axis for the last seconds before the cursor, with space for a tick label at the cursor."""
    first, last = (rr.TimeRangeBoundary.cursor_relative(seconds=s) for s in (-seconds, HALF_LABEL_SHARE * seconds))
    return rrb.TimeAxis(view_range=rr.TimeRange(first, last))


def _until_cursor() -> rrb.TimeAxis:
    now = rr.TimeRangeBoundary.cursor_relative()
    return rrb.TimeAxis(view_range=rr.TimeRange(rr.TimeRangeBoundary.infinite(), now))
