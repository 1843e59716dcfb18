"""Figures of the ``reconcile`` reports as SVG elements.

A diagnostic figure shows the measurement, the model expectation, and the band that contains 95 % of recordings
simulated from the model. A gap chart shows the difference between measurement and model (gap), divided by the threshold
of each diagnostic. An interval chart shows one parameter in several recordings.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from math import isfinite
from typing import Final

import numpy as np

from drivers.data_types import Floats
from monitor.common.unit_formatting import DEVIATION_UNITS, sensor_kind
from monitor.publishing.plots import style
from monitor.publishing.plots.svg_panel import TICK_TEXT_SIZE, SvgPanel, render_svg, text_width
from monitor.publishing.reports.reconcile_sentences import (
    diagnostic_name,
    displayed_unit,
    format_range,
    gap_to_threshold_ratio,
    readable_name,
)
from monitor.reconcile.result import DiagnosticGap, DiagnosticPlotData, Location, ParameterInterval

POINTS_PER_INCH: Final = 72.0
MARGINS: Final = (41.76, 10.8, 21.6, 31.68)  # left, right, top and bottom margins for the labels of a panel, points
DASHED: Final = "3.7 1.6"  # lengths of dashes and gaps, points
DOTTED: Final = "1.6 2.6"
BAND_COLOUR: Final = "#cfd5dd"
RANGE_TEXT_COLOUR: Final = "#8a5a00"
ABOVE_THRESHOLD_COLOUR: Final = "#b3261e"
BELOW_THRESHOLD_COLOUR: Final = "#1b7f4d"
MAX_MARKERS: Final = 60  # largest number of points that are drawn with markers
MARGIN_SHARE: Final = 0.06  # margin above and below the curves, as a share of the height of the curves
MAX_BAND_SHARE: Final = 0.35  # a band extends a panel by at most this share of the height of the curves
LOWEST_SHARE: Final = 0.02  # share of the points that may lie below a logarithmic panel
MIN_RANGE_SHARE: Final = 0.08  # a range narrower than this share of the width has a detail plot
DETAIL_WIDTHS: Final = 4.0  # a detail plot extends by this multiple of the range's width to either side
MIN_DETAIL_SHARE: Final = 0.01  # smallest extension of a detail plot, as a share of the width of the whole plot
MIN_DETAIL_POINTS: Final = 8
ROW_INCHES: Final = 0.21  # height of one row of a gap chart or an interval chart
ROWS_WIDTH_INCHES: Final = 5.6
ALLAN_INCHES: Final = (5.6, 3.5)  # size of an Allan deviation before and after the search
MARK_SHARE: Final = 0.1  # height of the labels above the curves, as a share of the height of the curves
MAX_NAME_LENGTH: Final = 32
MIN_GAP_RATIO: Final = 0.05  # a smaller ratio of gap to threshold is drawn at this value


@dataclass(frozen=True, slots=True)
class DiagnosticPlot:
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
    """
    plots = [
        to_displayed_units(title, view, axis, where if i == 0 else None) for i, (title, view) in enumerate(model_panels)
    ]
    left, right, top, bottom = MARGINS
    share, limits = POINTS_PER_INCH * width / len(plots), common_y_limits(plots)
    size = share - left - right, POINTS_PER_INCH * height - top - bottom
    panels = [
        _draw_panel(
            (i * share + left, top, *size), plot, "" if i else plots[0].y_label, style.axis_colour(axis), limits
        )
        for i, plot in enumerate(plots)
    ]
    description = f"{axis}: {plots[0].y_label} over {plots[0].x_label}"
    return render_svg(POINTS_PER_INCH * width, POINTS_PER_INCH * height, panels, description)


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


def to_displayed_units(title: str, view: DiagnosticPlotData, axis: str, where: Location | None) -> DiagnosticPlot:
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
    """
    x_unit, y_unit = (
        displayed_unit(unit, float(np.abs(line[np.isfinite(line)]).max(initial=0.0)))
        for unit, line in ((view.x_unit, view.x), (view.y_unit, view.measured))
    )
    if view.x_name == "averaging time" and view.y_unit in ("rad/s", "m/s²"):
        y_unit = DEVIATION_UNITS[sensor_kind(axis)]  # as in all Allan plots
    x_name, factor = x_unit.name, x_unit.factor
    if view.x_name == "time" and not view.log:
        x_name, seconds = style.select_time_unit(float(np.ptp(view.x)))
        factor = 1.0 / seconds
    mark = None if where is None else range_on_x_axis(view, where)
    measured, expected, lo, hi = (line * y_unit.factor for line in (view.measured, view.expected, view.lo, view.hi))
    return DiagnosticPlot(
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
        mark_label="" if where is None else format_range(where, axis),
    )


def common_y_limits(plots: Sequence[DiagnosticPlot]) -> tuple[float, float]:
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


def _draw_panel(
    box: tuple[float, float, float, float],
    plot: DiagnosticPlot,
    y_label: str,
    colour: str,
    limits: tuple[float, float],
) -> SvgPanel:
    x = plot.x[np.isfinite(plot.x) & ((plot.x > 0) | (not plot.log))]
    ends = (float(x.min()), float(x.max())) if np.ptp(x) > 0 else (0.5, 1.5)
    panel = SvgPanel(box, ends, limits, (plot.log, plot.log))
    panel.draw_axes(plot.x_label)
    if plot.mark is not None:
        panel.mark_range(*plot.mark, style.ORANGE)
        panel.write_titles(y_label, style.GREY, plot.mark_label, RANGE_TEXT_COLOUR, bold=True)
    else:
        panel.write_titles(y_label, style.GREY, plot.title, style.DARK)
    # A lower end of zero is drawn below the panel, because zero has no logarithm.
    lo, hi = (np.fmax(line, 0.1 * limits[0]) if plot.log else line for line in (plot.lo, plot.hi))
    panel.fill_band(plot.x, lo, np.where(np.isfinite(plot.hi), hi, np.nan), BAND_COLOUR)
    panel.draw_line(plot.x, plot.measured, colour, 1.1, markers=plot.x.size <= MAX_MARKERS)
    panel.draw_line(plot.x, plot.expected, style.DARK, 1.0, dashes=DASHED)
    return panel


def allan_before_and_after_svg(
    before: DiagnosticPlotData, after: DiagnosticPlotData, axis: str, marks: Mapping[float, str]
) -> str:
    """Draw the measured Allan deviation, and the Allan deviation of the model before and after the search.

    The result is an SVG element. If the search replaced samples, such as outliers, their share of the measured Allan
    variance is added to the extended model.

    Parameters
    ----------
    before
        Allan deviation with the model under test.
    after
        Allan deviation with the extended model.
    axis
        Name of the axis.
    marks
        Averaging time [s] and label of each mark.
    """
    replaced = np.fmax(before.measured**2 - after.measured**2, 0.0)
    curves = {name: np.sqrt(getattr(after, name) ** 2 + replaced) for name in ("measured", "expected", "lo", "hi")}
    first, last = (to_displayed_units("", view, axis, None) for view in (before, replace(after, **curves)))
    low, high = common_y_limits([first, last])
    x_limits = float(first.x.min()) / 1.15, float(first.x.max()) * 1.15
    width, height = (POINTS_PER_INCH * side for side in ALLAN_INCHES)
    left, right, top, bottom = MARGINS
    box = left, top, width - left - right, height - top - bottom
    panel = SvgPanel(box, x_limits, (low, high * (high / low) ** MARK_SHARE), (True, True))
    panel.draw_axes(first.x_label)
    panel.fill_band(last.x, np.fmax(last.lo, 0.1 * low), last.hi, BAND_COLOUR)
    for tau_s, label in marks.items():
        panel.mark_position(tau_s, label, style.ORANGE, RANGE_TEXT_COLOUR)
    panel.draw_line(first.x, first.measured, style.axis_colour(axis), 1.4, markers=True)
    panel.draw_line(first.x, first.expected, style.GREY, 1.6, dashes=DOTTED)
    panel.draw_line(last.x, last.expected, style.DARK, 1.2, dashes=DASHED)
    panel.write_titles(f"{axis}: {first.y_label}", style.GREY, "", style.DARK)
    panel.draw_legend([
        ("measured", style.axis_colour(axis), ""),
        ("model before", style.GREY, DOTTED),
        ("model after", style.DARK, DASHED),
    ])  # fmt: skip
    return render_svg(width, height, [panel], f"{axis}: Allan deviation before and after the search")


def gap_chart_svg(before: Sequence[DiagnosticGap], after: Sequence[DiagnosticGap] = ()) -> str:
    """Draw the gap of each diagnostic divided by the threshold, and return the chart as an SVG element.

    Parameters
    ----------
    before
        Gaps with one model.
    after
        Gaps with the next model. Empty if there is only one model.
    """
    later = {score.diagnostic: score for score in after}
    rows = []
    for score in before:
        scores = [score] + ([later[score.diagnostic]] if score.diagnostic in later else [])
        rows.append([(max(gap_to_threshold_ratio(one), MIN_GAP_RATIO), one.is_significant) for one in scores])
    largest = max((ratio for row in rows for ratio, _ in row), default=1.0)
    names = [diagnostic_name(score.diagnostic) for score in before]
    limits = 0.8 * MIN_GAP_RATIO, max(20.0, 1.3 * largest)
    panel = _create_row_panel(names, "gap over threshold", limits, log=True)
    panel.draw_line(np.array([1.0, 1.0]), np.array([-1.0, len(names)]), style.DARK, 1.2)
    for y, row in enumerate(rows):
        panel.draw_line(np.array([ratio for ratio, _ in row]), np.full(len(row), float(y)), style.GREY, 1.4)
        for at, (ratio, significant) in enumerate(row):
            colour = ABOVE_THRESHOLD_COLOUR if significant else BELOW_THRESHOLD_COLOUR
            panel.draw_disc(ratio, y, colour, hollow=at < len(row) - 1)
    if after:
        panel.write_titles("", style.GREY, "○ before   ● after", style.GREY)
    return _render_rows(panel, "gap over threshold of each diagnostic")


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
    drawn = [
        (y, *(factor * part for part in (one.value, one.lo, one.hi)))
        for y, (_, one) in enumerate(intervals)
        if not (isinstance(one.value, str) or one.lo is None or one.hi is None or not isfinite(one.hi - one.lo))
    ]
    ends = [end for row in drawn for end in row[1:]] or [0.0, 1.0]
    margin = MARGIN_SHARE * (max(ends) - min(ends)) or abs(ends[0]) or 1.0
    limits = min(ends) - margin, max(ends) + margin
    panel = _create_row_panel([name for name, _ in intervals], x_label, limits, log=False)
    for y, value, lo, hi in drawn:
        row_colour = style.DARK if y == len(intervals) - 1 else colour
        panel.draw_line(np.array([min(lo, value), max(hi, value)]), np.array([y, y]), row_colour, 1.8)
        panel.draw_disc(value, y, row_colour)
    return _render_rows(panel, f"{x_label}, of each recording")


def _create_row_panel(names: Sequence[str], x_label: str, limits: tuple[float, float], log: bool) -> SvgPanel:
    """Create a panel with a named row for each integer along y, beginning at the top."""
    short = [name if len(name) <= MAX_NAME_LENGTH else f"{name[: MAX_NAME_LENGTH - 1]}…" for name in names]
    _, right, top, _ = MARGINS
    left = max(text_width(name, TICK_TEXT_SIZE) for name in short) + right
    box = left, top, POINTS_PER_INCH * ROWS_WIDTH_INCHES - left - right, POINTS_PER_INCH * ROW_INCHES * len(names)
    panel = SvgPanel(box, limits, (len(names) - 0.4, -0.6), (log, False))
    panel.draw_axes(x_label, list(enumerate(short)))
    return panel


def _render_rows(panel: SvgPanel, description: str) -> str:
    return render_svg(POINTS_PER_INCH * ROWS_WIDTH_INCHES, panel.bottom + MARGINS[3], [panel], description)
