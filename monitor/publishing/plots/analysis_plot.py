"""Plot of the analysis of a recording, for ``imu-monitor analyze --plot FILE.png``.

The figure shows Allan plots, tables of coefficients, and Allan deviations over time. Gyroscopes and accelerometers have
separate columns.
"""

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np

from drivers.data_types import AXES
from monitor.common.unit_formatting import DEFAULT_UNITS, KINDS, Kind, UnitSystem, axes_of, format_duration
from monitor.estimation.allan.dynamic_allan import DynamicAllan
from monitor.estimation.analysis import RecordingAnalysis
from monitor.estimation.estimate import Estimate
from monitor.estimation.fit.coefficients_with_intervals import SYMBOLS, Status
from monitor.publishing.coefficient_cells import (
    TEMPERATURE_MARK,
    TEMPERATURE_MEANS,
    format_coefficient,
    mark_temperature_axis,
)
from monitor.publishing.messages.results import measured_axes
from monitor.publishing.plots.allan_figure import LEGEND_TEXT, AdditionalDeviation, draw_allan_panel
from monitor.publishing.plots.dynamic_figure import ChangeMark, draw_dynamic_panels, dynamic_figure_height_inches
from monitor.publishing.plots.style import COLOURS, GREY, create_figure, figure_style, save_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

INCHES: Final = (7.2, 7.6)  # width and height of one Allan plot with table
CURVES_RATIO: Final = 3.6  # height of the Allan plot
ROW_RATIO: Final = 1.75 / 6.0  # height of a row of the table, relative to the Allan plot; the first row names the axes
COLUMNS: Final = (0.0, 0.46, 0.65, 0.84)  # left edges of the table columns, as shares of the table width
TABLE_LEGEND: Final = (
    "small print: 95 % interval;  ≤ one-sided 95 % bound;  — too few data;  K or R: the data do not show which"
)


@dataclass(frozen=True, slots=True)
class AnalysisPlotData:
    """Analysis results of one recording that the plot and the HTML report show."""

    analysis: RecordingAnalysis
    others: Sequence[AdditionalDeviation] = ()  # total and Hadamard deviations
    dynamic: DynamicAllan | None = None
    marks: Sequence[ChangeMark] = ()  # changes that are marked in the plots over time
    units: UnitSystem = DEFAULT_UNITS


def save_analysis_plot(plot_data: AnalysisPlotData, path: Path, title: str = "") -> None:
    """Write the analysis plot to a file.

    Parameters
    ----------
    plot_data
        Analysis of the recording.
    path
        File to write. The suffix selects the format.
    title
        Title of the figure.

    Raises
    ------
    ConfigError
        If matplotlib is not installed or the file cannot be written.
    """
    analysis = plot_data.analysis
    with figure_style():
        figure = draw_analysis_figure(
            analysis.estimate, analysis.axes_of_temperature, plot_data.others, plot_data.dynamic, plot_data.marks,
            plot_data.units, title,
        )  # fmt: skip
        save_figure(figure, path)


def draw_analysis_figure(
    estimate: Estimate,
    axes_of_temperature: Collection[str] = (),
    others: Sequence[AdditionalDeviation] = (),
    dynamic: DynamicAllan | None = None,
    marks: Sequence[ChangeMark] = (),
    units: UnitSystem = DEFAULT_UNITS,
    title: str = "",
) -> "Figure":
    """Draw Allan plots and tables of coefficients, for a whole recording or for a sliding window.

    Parameters
    ----------
    estimate
        Allan deviations and coefficients.
    axes_of_temperature
        Axes to mark, on which temperature explains most of the slow variance.
    others, dynamic, marks, units
        See ``AnalysisPlotData``.
    title
        Title of the figure.

    Raises
    ------
    ConfigError
        If matplotlib is not installed.
    """
    with figure_style():
        kinds = measured_sensor_kinds(estimate)
        table_ratio = ROW_RATIO * (1 + max(len(units.columns(kind)) for kind in kinds))
        heights = [INCHES[1] * (CURVES_RATIO + table_ratio) / (CURVES_RATIO + ROW_RATIO * (1 + len(SYMBOLS)))]
        if dynamic is not None:
            heights.append(max(dynamic_figure_height_inches(dynamic, kind) for kind in kinds))
        figure = create_figure(INCHES[0] * len(kinds), sum(heights))
        parts = figure.subfigures(len(heights), len(kinds), squeeze=False, height_ratios=heights)
        for column, kind in enumerate(kinds):
            curves, table = parts[0, column].subplots(2, 1, height_ratios=[CURVES_RATIO, table_ratio])
            draw_allan_panel(curves, estimate, kind, others, units)
            _draw_table(table, estimate, axes_of_temperature, kind, units)
            if dynamic is not None:
                draw_dynamic_panels(parts[1, column], dynamic, kind, marks, units)
        figure.suptitle("\n".join([*([title] if title else []), describe_recording(estimate)]))
        return figure


def measured_sensor_kinds(estimate: Estimate) -> list[Kind]:
    """Return the kinds of sensor that have measured axes, or gyro and accel if no axis is measured."""
    present = {axis for _, axis in measured_axes(estimate.curve)}
    return [kind for kind in KINDS if set(axes_of(kind)) & present] or list(KINDS)


def describe_recording(estimate: Estimate) -> str:
    """Return one line that states the number of samples, the rate, the duration and the number of missing samples."""
    missing = estimate.curve.n - estimate.samples
    gaps = f", {missing:,} missing" if missing > 0 else ""
    duration = format_duration(estimate.curve.n / estimate.rate_hz)
    return f"{estimate.samples:,} samples at {estimate.rate_hz:.6g} Hz, {duration}{gaps}"


def is_k_r_ambiguous(estimate: Estimate, letter: str, axis: str) -> bool:
    """Return True if a coefficient has only an upper bound because the data cannot distinguish K from R.

    Parameters
    ----------
    estimate
        Estimate of the noise coefficients.
        letter
        Symbol of the coefficient: Q, N, B, K or R.
    axis
        Name of the axis.
    """
    i = AXES.index(axis)
    bounded = estimate.coefficients.status[SYMBOLS.index(letter), i] == Status.UPPER_BOUND
    return letter in ("K", "R") and bool(estimate.k_or_r[i] and bounded)


def _draw_table(
    panel: "Axes", estimate: Estimate, axes_of_temperature: Collection[str], kind: Kind, units: UnitSystem
) -> None:
    panel.axis("off")
    coefficients = units.columns(kind)
    rows = np.linspace(0.97, 0.19, len(coefficients) + 1)
    columns = list(zip(axes_of(kind), COLUMNS[1:], COLOURS, strict=True))
    for axis, x, colour in columns:
        name = mark_temperature_axis(axis, axes_of_temperature)
        panel.text(x, rows[0], name, color=colour, fontweight="bold", va="center")
    for (letter, name, unit), y in zip(coefficients, rows[1:], strict=True):
        panel.text(COLUMNS[0], y, f"{letter}  {name}, {unit.name}", va="center")
        for axis, x, _ in columns:
            cell = format_coefficient(estimate.coefficients, letter, axis, unit=unit)
            panel.text(x, y + 0.02, cell.value, va="center")
            small = "K or R" if is_k_r_ambiguous(estimate, letter, axis) else cell.interval
            panel.text(x, y - 0.05, small, va="center", fontsize=6.5, color=GREY)
    temperature = f";  {TEMPERATURE_MARK} {TEMPERATURE_MEANS}" if axes_of_temperature else ""
    for y, text in ((0.03, TABLE_LEGEND + temperature), (-0.04, LEGEND_TEXT)):
        panel.text(COLUMNS[0], y, text, va="center", fontsize=7.5, color=GREY)
    panel.set(xlim=(0, 1), ylim=(-0.06, 1))
