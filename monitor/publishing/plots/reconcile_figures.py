"""Figures of the ``reconcile`` reports as SVG elements.

A diagnostic figure shows the measurement, the model expectation, and the band that contains 95 % of recordings
simulated from the model. An interval chart shows one parameter in several recordings.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from math import isfinite
from typing import TYPE_CHECKING, Final

import numpy as np

from drivers.data_types import Floats
from monitor.common.unit_formatting import DEFAULT_UNITS, UnitSystem, sensor_kind
from monitor.publishing.plots import style
from monitor.publishing.reports.reconcile_sentences import (
    displayed_unit,
    format_range,
    readable_name,
)
from monitor.reconcile.result import DiagnosticPlotData, Location, ParameterInterval

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

MARGINS_INCHES: Final = (0.58, 0.15, 0.30, 0.44)  # left, right, top and bottom margins for the labels of a panel
BAND_COLOUR: Final = "#cfd5dd"
RANGE_TEXT_COLOUR: Final = "#8a5a00"
ABOVE_THRESHOLD_COLOUR: Final = "#b3261e"
MAX_MARKERS: Final = 60  # largest number of points that are drawn with markers
MARGIN_SHARE: Final = 0.06  # margin above and below the curves, as a share of the height of the curves
MAX_BAND_SHARE: Final = 0.35  # a band extends a panel by at most this share of the height of the curves
LOWEST_SHARE: Final = 0.02  # share of the points that may lie below a logarithmic panel
MIN_RANGE_SHARE: Final = 0.08  # a range narrower than this share of the width has a detail plot
DETAIL_WIDTHS: Final = 4.0  # a detail plot extends by this multiple of the range's width to either side
MIN_DETAIL_SHARE: Final = 0.01  # smallest extension of a detail plot, as a share of the width of the whole plot
MIN_DETAIL_POINTS: Final = 8
ROW_INCHES: Final = 0.21  # height of one row of an interval chart
ROWS_WIDTH_INCHES: Final = 5.6
NAME_CHARACTER_INCHES: Final = 0.08  # width of a character in the name of a row
ALLAN_INCHES: Final = (5.6, 3.5)  # size of an Allan deviation before and after the search
MARK_SHARE: Final = 0.1  # height of the labels above the curves, as a share of the height of the curves
MAX_NAME_LENGTH: Final = 32


@dataclass(frozen=True, slots=True)
class DiagnosticPanelCurves:
    """Curves of one diagnostic panel in displayed units."""

    title: str
    x_label: str
    y_label: str
    log: bool
    x: Floats  # [k]
    measured: Floats  # [k]
    expected: Floats  # [k]
    lo: Floats  # [k]
    hi: Floats  # [k]
    mark: tuple[float, float] | None  # range to mark along x
    mark_label: str


def diagnostic_comparison_svg(
    model_panels: Sequence[tuple[str, DiagnosticPlotData]],
    axis: str,
    width: float,
    height: float,
    where: Location | None = None,
    units: UnitSystem = DEFAULT_UNITS,
) -> str:
    """Draw one diagnostic with a panel for each model, and return the figure as an SVG element.

    Parameters
    ----------
    model_panels
        Title and data of each panel, one for each model.
    axis
        Name of the axis.
    width, height
        Size of the figure [inches].
    where
        Range to mark in the first panel.
    units
        Unit system.
    """
    plots = [
        to_displayed_units(title, view, axis, where if i == 0 else None, units)
        for i, (title, view) in enumerate(model_panels)
    ]
    with style.figure_style():
        return _draw_comparison(*_create_panels(len(plots), width, height), plots, axis)


def _create_panels(count: int, width: float, height: float) -> "tuple[Figure, list[Axes]]":
    """Create a figure with panels side by side."""
    left, right, top, bottom = MARGINS_INCHES
    share = width / count
    size = ((share - left - right) / width, (height - top - bottom) / height)
    figure = style.create_figure(width, height, layout=None)
    return figure, [figure.add_axes(((i * share + left) / width, bottom / height, *size)) for i in range(count)]


def _draw_comparison(
    figure: "Figure", panels: "Sequence[Axes]", plots: Sequence[DiagnosticPanelCurves], axis: str
) -> str:
    limits = common_y_limits(plots)
    for i, (panel, plot) in enumerate(zip(panels, plots, strict=True)):
        _draw_panel(panel, plot if i == 0 else replace(plot, y_label=""), style.axis_colour(axis), limits)
    return style.to_svg_element(figure, f"{axis}: {plots[0].y_label} over {plots[0].x_label}")


def select_diagnostic_view(
    views: Sequence[DiagnosticPlotData], diagnostic_id: str, where: Location
) -> DiagnosticPlotData | None:
    """Return the data of a diagnostic, or of the first diagnostic whose x axis shows the range.

    Parameters
    ----------
    views
        Data of all diagnostics.
    diagnostic_id
        Identifier of the diagnostic.
    where
        Range that the diagnostic found.
    """
    own = [view for view in views if view.diagnostic == diagnostic_id]
    return next(iter(own or [view for view in views if range_on_x_axis(view, where) is not None]), None)


def range_on_x_axis(view: DiagnosticPlotData, where: Location) -> tuple[float, float] | None:
    """Return the range along the x axis of a diagnostic, or None if the x axis shows another quantity.

    Parameters
    ----------
    view
        Data of the diagnostic.
    where
        The range.
    """
    match view.x_name, view.x_unit:
        case _, "Hz":
            return where.frequency
        case (("averaging time" | "lag"), _):
            return where.tau
        case "time", _:
            return where.time
        case _, "°C":
            return where.temperature
        case _, "rad/s" | "m/s²":
            return where.value
    return None


def zoomed_view(view: DiagnosticPlotData, where: Location) -> DiagnosticPlotData | None:
    """Return the diagnostic data near a narrow range, or None if the range is wide enough to be visible.

    Parameters
    ----------
    view
        Data of the diagnostic.
    where
        The range.
    """
    at = range_on_x_axis(view, where)
    if at is None or view.x.size < 2:
        return None
    with np.errstate(divide="ignore", invalid="ignore"):
        x, ends = (np.log10(values) if view.log else values for values in (view.x, np.array(at)))
    valid = x[np.isfinite(x)]
    low, width = float(valid.min()), float(np.ptp(valid))
    share, (a, b) = (x - low) / width, ((ends - low) / width).tolist()
    if not b - a < MIN_RANGE_SHARE:
        return None
    rows = np.abs(share - 0.5 * (a + b)) < max(DETAIL_WIDTHS * (b - a), MIN_DETAIL_SHARE)
    if rows.sum() < MIN_DETAIL_POINTS:
        return None
    lines = {name: getattr(view, name)[rows] for name in ("x", "measured", "expected", "lo", "hi")}
    return replace(view, y_name="detail", **lines)


def to_displayed_units(
    title: str, view: DiagnosticPlotData, axis: str, where: Location | None, units: UnitSystem = DEFAULT_UNITS
) -> DiagnosticPanelCurves:
    """Convert the data of a diagnostic to displayed units.

    Parameters
    ----------
    title
        Title of the panel.
    view
        Data of the diagnostic.
    axis
        Name of the axis.
    where
        Range to mark. The range is ignored if the x axis shows another quantity.
    units
        Unit system.
    """
    x_unit, y_unit = (
        displayed_unit(unit, float(np.abs(line[np.isfinite(line)]).max(initial=0.0)), units)
        for unit, line in ((view.x_unit, view.x), (view.y_unit, view.measured))
    )
    if view.x_name == "averaging time" and view.y_unit in ("rad/s", "m/s²"):
        y_unit = units.deviation(sensor_kind(axis))  # as in all Allan plots
    x_name, factor = x_unit.name, x_unit.factor
    if view.x_name == "time" and not view.log:
        x_name, seconds = style.select_time_unit(float(np.ptp(view.x)))
        factor = 1.0 / seconds
    mark = None if where is None else range_on_x_axis(view, where)
    measured, expected, lo, hi = (line * y_unit.factor for line in (view.measured, view.expected, view.lo, view.hi))
    return DiagnosticPanelCurves(
        title=title,
        x_label=", ".join(part for part in (readable_name(view.x_name), x_name) if part),
        y_label=", ".join(part for part in (readable_name(view.y_name), y_unit.name) if part),
        log=view.log,
        x=view.x * factor,
        measured=measured,
        expected=expected,
        lo=lo,
        hi=hi,
        mark=None if mark is None else (mark[0] * factor, mark[1] * factor),
        mark_label="" if where is None else format_range(where, axis, units),
    )


def common_y_limits(plots: Sequence[DiagnosticPanelCurves]) -> tuple[float, float]:
    """Return common limits of the y axis for all panels."""
    log = plots[0].log
    curves = _finite([line for plot in plots for line in (plot.measured, plot.expected)], log)
    if curves.size == 0:
        return (0.1, 10.0) if log else (-1.0, 1.0)
    low, high = float(curves.min()), float(curves.max())
    if log:  # an almost empty bin of a spectrum is decades below the other bins
        low = float(min(np.quantile(curves, LOWEST_SHARE), *_finite([plot.expected for plot in plots], log), high))
    reach = MAX_BAND_SHARE * (high - low)
    bands = _finite([line for plot in plots for line in (plot.lo, plot.hi)], log).clip(low - reach, high + reach)
    low, high = float(bands.min(initial=low)), float(bands.max(initial=high))
    margin = MARGIN_SHARE * (high - low) or max(abs(high) * MARGIN_SHARE, 1e-12)
    return (10.0 ** (low - margin), 10.0 ** (high + margin)) if log else (low - margin, high + margin)


def _finite(lines: Sequence[Floats], log: bool) -> Floats:
    """Return all finite values, as logarithms for a logarithmic panel."""
    values = np.concatenate(lines)
    values = values[np.isfinite(values) & ((values > 0) | (not log))]
    return np.log10(values) if log else values


def _draw_panel(panel: "Axes", plot: DiagnosticPanelCurves, colour: str, limits: tuple[float, float]) -> None:
    x = plot.x[np.isfinite(plot.x) & ((plot.x > 0) | (not plot.log))]
    left, right = (float(x.min()), float(x.max())) if np.ptp(x) > 0 else (0.5, 1.5)
    scale = "log" if plot.log else "linear"
    panel.set(xscale=scale, yscale=scale, xlim=(left, right), ylim=limits, xlabel=plot.x_label)
    panel.autoscale(False)
    # A lower end of zero is drawn below the panel, because zero has no logarithm.
    lo, hi = (np.fmax(line, 0.1 * limits[0]) if plot.log else line for line in (plot.lo, plot.hi))
    panel.fill_between(plot.x, lo, hi, where=np.isfinite(plot.hi).tolist(), color=BAND_COLOUR, linewidth=0)
    few = plot.x.size <= MAX_MARKERS
    panel.plot(plot.x, plot.measured, color=colour, linewidth=1.1, marker="o" if few else "", markersize=4.5)
    panel.plot(plot.x, plot.expected, "--", color=style.DARK, linewidth=1.0)
    if plot.mark is not None:
        ends = np.clip(plot.mark, left, right).tolist()
        # The outline keeps a very narrow range visible.
        panel.axvspan(*ends, facecolor=style.ORANGE, edgecolor=style.ORANGE, alpha=0.35, linewidth=3)
        panel.set_title(plot.mark_label, loc="right", y=1.0, fontsize=9, color=RANGE_TEXT_COLOUR, fontweight="bold")
    else:
        panel.set_title(plot.title, loc="right", y=1.0, fontsize=9)
    for which in "xy" if plot.log else ():
        style.style_log_axis(panel, which, minor_grid=False)
    if not plot.log:
        panel.xaxis.set_major_formatter(lambda value, _: style.format_tick(value))
        panel.yaxis.set_major_formatter(lambda value, _: style.format_tick(value))
    panel.tick_params(labelsize=8.5)
    panel.set_title(plot.y_label, loc="left", y=1.0, fontsize=9, color=style.GREY)


def allan_before_and_after_svg(
    before: DiagnosticPlotData,
    after: DiagnosticPlotData,
    axis: str,
    marks: Mapping[float, str],
    units: UnitSystem = DEFAULT_UNITS,
) -> str:
    """Draw the measured Allan deviation, and the Allan deviation of the model before and after the search.

    The result is an SVG element.

    Parameters
    ----------
    before, after
        Allan deviations of ``comparable_allan_deviations``.
    axis
        Name of the axis.
    marks
        Averaging time [s] and label of each mark.
    units
        Unit system.
    """
    first, last = (to_displayed_units("", view, axis, None, units) for view in (before, after))
    with style.figure_style():
        figure = style.create_figure(*ALLAN_INCHES)
        panel = figure.subplots()
        low, high = common_y_limits([first, last])
        x_limits = float(first.x.min()) / 1.15, float(first.x.max()) * 1.15
        panel.set(xscale="log", yscale="log", xlim=x_limits, ylim=(low, high * (high / low) ** MARK_SHARE))
        panel.fill_between(last.x, np.fmax(last.lo, 0.1 * low), last.hi, color=BAND_COLOUR, linewidth=0)
        panel.plot(first.x, first.measured, "o-", color=style.axis_colour(axis), markersize=4.5, label="measured")
        panel.plot(first.x, first.expected, ":", color=style.GREY, linewidth=1.6, label="model before")
        panel.plot(last.x, last.expected, "--", color=style.DARK, linewidth=1.2, label="model after")
        for tau_s, label in marks.items():
            panel.axvline(tau_s, color=style.ORANGE, linewidth=1.2, alpha=0.7, zorder=0)
            panel.annotate(
                label, (tau_s, 0.97), xycoords=panel.get_xaxis_transform(), ha="center", va="top",
                color=RANGE_TEXT_COLOUR, fontsize=9, fontweight="bold", bbox=style.LABEL_BOX,
            )  # fmt: skip
        for which in "xy":
            style.style_log_axis(panel, which, minor_grid=False)
        panel.set_xlabel(first.x_label)
        panel.set_title(f"{axis}: {first.y_label}", fontsize=9.5, color=style.GREY)
        style.draw_legend_above(panel, 3)
        return style.to_svg_element(figure, f"{axis}: Allan deviation before and after the search")


def interval_chart_svg(
    intervals: Sequence[tuple[str, ParameterInterval]], x_label: str, factor: float, colour: str
) -> str:
    """Draw parameter values with 95 % intervals, and return the chart as an SVG element.

    Parameters
    ----------
    intervals
        Name and interval of each row. The last row is the pooled value.
    x_label
        Name and unit of the parameter.
    factor
        Factor from the SI unit to the unit of ``x_label``.
    colour
        Colour of the recordings.
    """
    with style.figure_style():
        figure, panel = _create_row_panel([name for name, _ in intervals], x_label)
        for y, (_, one) in enumerate(intervals):
            if isinstance(one.value, str) or one.lo is None or one.hi is None or not isfinite(one.hi - one.lo):
                continue
            pooled = y == len(intervals) - 1
            value, lo, hi = (factor * part for part in (one.value, one.lo, one.hi))
            panel.errorbar(
                value, y, xerr=[[max(value - lo, 0.0)], [max(hi - value, 0.0)]],
                fmt="D" if pooled else "o", color=style.DARK if pooled else colour, elinewidth=1.8, markersize=6,
            )  # fmt: skip
        panel.xaxis.set_major_formatter(lambda value, _: style.format_tick(value))
        return style.to_svg_element(figure, f"{x_label}, of each recording")


def _create_row_panel(names: Sequence[str], x_label: str) -> "tuple[Figure, Axes]":
    height = 0.75 + ROW_INCHES * len(names)
    short = [name if len(name) <= MAX_NAME_LENGTH else f"{name[: MAX_NAME_LENGTH - 1]}…" for name in names]
    left = NAME_CHARACTER_INCHES * max(map(len, short), default=0) + MARGINS_INCHES[1]
    _, right, top, bottom = MARGINS_INCHES
    figure = style.create_figure(ROWS_WIDTH_INCHES, height, layout=None)
    size = (1.0 - (left + right) / ROWS_WIDTH_INCHES, 1.0 - (top + bottom) / height)
    panel = figure.add_axes((left / ROWS_WIDTH_INCHES, bottom / height, *size))
    panel.set_yticks(range(len(names)), short)
    panel.set_ylim(len(names) - 0.4, -0.6)
    panel.set_xlabel(x_label)
    panel.grid(axis="y", color=style.MINOR_GRID_COLOUR)
    return figure, panel
