"""Views of the Rerun viewer that several panels use. Importing this module imports Rerun."""

from collections.abc import Mapping, Sequence
from typing import Any, Final

import rerun as rr
import rerun.blueprint as rrb

TIMELINE: Final = "sample_time"
RAW_SAMPLES_S: Final = 30.0
"""Time range of raw samples in view, up to the cursor [s]."""
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
    """Return a view of time series up to the cursor.

    Parameters
    ----------
    origin
        Path of the entity.
    name
        Title of the view.
    contents
        Entities to show, without the sign of inclusion.
    last_s
        Time range before the cursor [s]; None shows everything from the beginning.
    legend
        True to show a legend.
    styles
        Styles of entities that differ from those of other views, by path.
    """
    return rrb.TimeSeriesView(
        origin=origin,
        contents=[f"+ {one}" for one in contents],
        name=name,
        plot_legend=rrb.PlotLegend(rrb.Corner2D.LeftTop) if legend else rrb.PlotLegend(visible=False),
        overrides=styles,
        axis_x=_until_cursor() if last_s is None else _before_cursor(last_s),
    )


def temperature_view(device: str) -> rrb.TimeSeriesView:
    """Return the view of the temperature of a device."""
    return time_series_view(f"/{device}/temperature", "Temperature, °C")


def _before_cursor(seconds: float) -> rrb.TimeAxis:
    """Return a time axis of the last seconds, with space on the right for a tick label at the cursor."""
    first, last = (rr.TimeRangeBoundary.cursor_relative(seconds=s) for s in (-seconds, HALF_LABEL_SHARE * seconds))
    return rrb.TimeAxis(view_range=rr.TimeRange(first, last))


def _until_cursor() -> rrb.TimeAxis:
    """Return a time axis from the beginning to the cursor."""
    now = rr.TimeRangeBoundary.cursor_relative()
    return rrb.TimeAxis(view_range=rr.TimeRange(rr.TimeRangeBoundary.infinite(), now))
