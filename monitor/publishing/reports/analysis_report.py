"""Report of one analysis as a self-contained HTML page, for ``imu-monitor analyze --plot FILE.html``.

The page needs no network. It contains the Allan plot of each kind of sensor, the table of coefficients with intervals,
facts about the recording, notes, and the dynamic Allan deviation if it was computed. Heat maps are images inside the
SVG, so that the page stays below one megabyte.
"""

from pathlib import Path
from typing import Any, Final

from drivers.data_types import AXES
from drivers.errors import ConfigError
from monitor.common.units import COEFFICIENT_NAMES, KIND_NAMES, Kind, axes_of, format_duration, format_number
from monitor.estimation.analysis import RecordingAnalysis
from monitor.estimation.estimate import Estimate
from monitor.estimation.fit.coefficient_values import SYMBOLS, Status
from monitor.publishing.coefficient_cells import (
    TEMPERATURE_MARK,
    TEMPERATURE_MEANS,
    format_coefficient,
    mark_temperature_axis,
)
from monitor.publishing.plots.allan_figure import LEGEND_TEXT, draw_allan_panel
from monitor.publishing.plots.analysis_plot import AnalysisPlotData, is_k_or_r, measured_kinds
from monitor.publishing.plots.dynamic_figure import draw_dynamic_panels, height_inches
from monitor.publishing.plots.style import axis_colour, create_figure, figure_style, svg_element
from monitor.publishing.reports.html_page import render_template

ALLAN_INCHES: Final = (7.2, 5.2)
STATUS_TEXTS: Final = {Status.UPPER_BOUND: "(upper bound)", Status.UNESTIMATED: "(too few data)"}


def write_html_report(drawn: AnalysisPlotData, path: Path, title: str = "") -> None:
    """Write the page to a file.

    Parameters
    ----------
    drawn
        Analysis of the recording.
    path
        File to write.
    title
        Title of the page.

    Raises
    ------
    ConfigError
        If matplotlib or Jinja2 is missing, or if the file cannot be written.
    """
    page = render_page(drawn, title)
    try:
        path.write_text(page, "utf-8")
    except OSError as error:
        raise ConfigError(f"cannot write the report {path}: {error}") from error


def render_page(drawn: AnalysisPlotData, title: str = "") -> str:
    """Return the page as text. The parameters and errors are those of ``write_html_report``."""
    analysis = drawn.analysis
    return render_template(
        "report.html.j2",
        title=title or "Recording",
        facts=recording_facts(analysis),
        notes=analysis.notes,
        parts=[_part(drawn, kind) for kind in measured_kinds(analysis.estimate)],
        axis_colour=axis_colour,
        mark_axis=lambda axis: mark_temperature_axis(axis, analysis.axes_of_temperature),
        format_cell=lambda letter, axis: format_cell(analysis.estimate, letter, axis),
        temperature=f"{TEMPERATURE_MARK} {TEMPERATURE_MEANS}." if analysis.axes_of_temperature else "",
        legend=LEGEND_TEXT,
        window="" if drawn.dynamic is None else format_duration(drawn.dynamic.window_s),
    )


def recording_facts(analysis: RecordingAnalysis) -> tuple[tuple[str, str], ...]:
    """Return names and values that describe the recording."""
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


def format_cell(estimate: Estimate, letter: str, axis: str) -> tuple[str, str]:
    """Return the value of a coefficient with its unit, and its interval or the reason for a missing interval.

    Parameters
    ----------
    estimate
        The estimate.
    letter
        Coefficient.
    axis
        Name of the axis.
    """
    status = Status(int(estimate.coefficients.status[SYMBOLS.index(letter), AXES.index(axis)]))
    text = format_coefficient(estimate.coefficients, letter, axis)
    value = text.value if status == Status.UNESTIMATED else f"{text.value} {text.unit}"
    if is_k_or_r(estimate, letter, axis):
        return value, "(upper bound; K or R)"
    return value, STATUS_TEXTS.get(status, text.interval)


def _part(drawn: AnalysisPlotData, kind: Kind) -> dict[str, Any]:
    """Return the values for the template for one kind of sensor."""
    name, heat_maps = KIND_NAMES[kind], ""
    with figure_style():
        figure = create_figure(*ALLAN_INCHES)
        draw_allan_panel(figure.subplots(), drawn.analysis.estimate, kind, drawn.others)
        allan = svg_element(figure, f"{name}: Allan deviation over averaging time")
        if drawn.dynamic is not None:
            figure = create_figure(ALLAN_INCHES[0], height_inches(drawn.dynamic, kind))
            draw_dynamic_panels(figure, drawn.dynamic, kind, drawn.marks)
            heat_maps = svg_element(figure, f"{name}: Allan deviation and coefficients over time")
    texts = {"name": name, "axes": axes_of(kind), "coefficients": COEFFICIENT_NAMES[kind]}
    return texts | {"allan": allan, "dynamic": heat_maps}
