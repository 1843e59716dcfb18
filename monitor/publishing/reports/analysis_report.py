"""HTML report on the analysis of a recording, for ``imu-monitor analyze --plot FILE.html``.

The page is self-contained. Heat maps are embedded as raster images, so that the page is smaller than one megabyte.
"""

from pathlib import Path
from typing import Any, Final

from drivers.data_types import AXES
from drivers.errors import ConfigError
from monitor.common.unit_formatting import (
    KIND_NAMES,
    CoefficientColumn,
    Kind,
    axes_of,
    format_duration,
    format_number,
)
from monitor.estimation.analysis import RecordingAnalysis
from monitor.estimation.estimate import Estimate
from monitor.estimation.fit.coefficients_with_intervals import SYMBOLS, Status
from monitor.publishing.coefficient_cells import (
    TEMPERATURE_MARK,
    TEMPERATURE_MEANS,
    format_coefficient,
    mark_temperature_axis,
)
from monitor.publishing.plots.allan_figure import LEGEND_TEXT, draw_allan_panel
from monitor.publishing.plots.analysis_plot import AnalysisPlotData, is_k_r_ambiguous, measured_sensor_kinds
from monitor.publishing.plots.dynamic_figure import draw_dynamic_panels, dynamic_figure_height_inches
from monitor.publishing.plots.style import axis_colour, create_figure, figure_style, to_svg_element
from monitor.publishing.reports.html_page import render_template

ALLAN_INCHES: Final = (7.2, 4.4)
STATUS_TEXTS: Final = {Status.UPPER_BOUND: "(upper bound)", Status.UNESTIMATED: "(too few data)"}


def write_html_report(plot_data: AnalysisPlotData, path: Path, title: str = "") -> None:
    """Write the HTML report of an analysis to a file.

    Parameters
    ----------
    plot_data
        Analysis of the recording.
    path
        HTML file to write.
    title
        Title of the HTML page.

    Raises
    ------
    ConfigError
        If matplotlib or Jinja2 is not installed, or if the file cannot be written.
    """
    page = render_page(plot_data, title)
    try:
        path.write_text(page, "utf-8")
    except OSError as error:
        raise ConfigError(f"cannot write the report {path}: {error}") from error


def render_page(plot_data: AnalysisPlotData, title: str = "") -> str:
    """Return the text of the HTML report. The parameters and exceptions are those of ``write_html_report``."""
    analysis = plot_data.analysis
    return render_template(
        "report.html.j2",
        title=title or "Recording",
        facts=recording_facts(analysis),
        notes=analysis.notes,
        parts=[_part(plot_data, kind) for kind in measured_sensor_kinds(analysis.estimate)],
        axis_colour=axis_colour,
        mark_axis=lambda axis: mark_temperature_axis(axis, analysis.axes_of_temperature),
        format_value_and_interval=lambda column, axis: format_value_and_interval(analysis.estimate, column, axis),
        temperature=f"{TEMPERATURE_MARK} {TEMPERATURE_MEANS}." if analysis.axes_of_temperature else "",
        legend=LEGEND_TEXT,
        window="" if plot_data.dynamic is None else format_duration(plot_data.dynamic.window_s),
    )


def recording_facts(analysis: RecordingAnalysis) -> tuple[tuple[str, str], ...]:
    """Return the names and values of the properties of a recording that the report lists."""
    estimate = analysis.estimate
    missing = max(estimate.curve.n - estimate.samples, 0)
    share = f" ({format_number(100.0 * missing / estimate.curve.n, 2)} %)" if missing else ""
    return (
        ("rate", f"{estimate.rate_hz:.6g} Hz"),
        ("samples", f"{estimate.samples:,}"),
        ("duration", format_duration(analysis.seconds)),
        ("missing samples", f"{missing:,}{share}" if missing else "none"),
        ("averaging times", f"{format_number(estimate.curve.tau_s[0])} … {format_number(estimate.curve.tau_s[-1])} s"),
    )


def format_value_and_interval(estimate: Estimate, column: CoefficientColumn, axis: str) -> tuple[str, str]:
    """Return a noise coefficient, and its 95 % interval or the reason why there is no interval.

    Parameters
    ----------
    estimate
        Estimate of the noise coefficients.
    column
        Coefficient and its unit.
    axis
        Name of the axis.
    """
    letter = column.symbol
    status = Status(int(estimate.coefficients.status[SYMBOLS.index(letter), AXES.index(axis)]))
    text = format_coefficient(estimate.coefficients, letter, axis, unit=column.unit)
    if is_k_r_ambiguous(estimate, letter, axis):
        return text.value, "(upper bound; K or R)"
    return text.value, STATUS_TEXTS.get(status, text.interval)


def _part(plot_data: AnalysisPlotData, kind: Kind) -> dict[str, Any]:
    name, heat_maps = KIND_NAMES[kind], ""
    with figure_style():
        figure = create_figure(*ALLAN_INCHES)
        draw_allan_panel(figure.subplots(), plot_data.analysis.estimate, kind, plot_data.others, plot_data.units)
        allan = to_svg_element(figure, f"{name}: Allan deviation over averaging time")
        if plot_data.dynamic is not None:
            figure = create_figure(ALLAN_INCHES[0], dynamic_figure_height_inches(plot_data.dynamic, kind))
            draw_dynamic_panels(figure, plot_data.dynamic, kind, plot_data.marks, plot_data.units)
            heat_maps = to_svg_element(figure, f"{name}: Allan deviation and coefficients over time")
    texts = {"name": name, "axes": axes_of(kind), "columns": plot_data.units.columns(kind)}
    return texts | {"allan": allan, "dynamic": heat_maps}
