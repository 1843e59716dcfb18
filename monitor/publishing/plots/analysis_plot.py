"""Plot of one analysis, for ``imu-monitor analyze --plot FILE.png``.

Gyroscopes and accelerometers are shown side by side: the Allan plot, a table of the coefficients, and the dynamic
curves if they were computed. matplotlib is imported when a plot is requested, and draws without a display.
"""

from collections.abc import Collection, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np

from drivers.errors import ConfigError
from drivers.sample import AXES
from monitor.common.units import COEFFICIENT_NAMES, COEFFICIENT_UNITS, KINDS, Kind, axes_of, format_duration
from monitor.estimation.allan.dynamic_allan import DynamicAllan
from monitor.estimation.estimate import Estimate
from monitor.estimation.fit.coefficients import SYMBOLS, Status
from monitor.publishing.coefficient_cells import (
    TEMPERATURE_MARK,
    TEMPERATURE_MEANS,
    format_coefficient,
    mark_temperature_axis,
)
from monitor.publishing.messages.results import measured_axes
from monitor.publishing.plots.allan_figure import COLOURS, GREY, LEGEND_TEXT, OtherDeviation, allan_panel
from monitor.publishing.plots.dynamic_figure import ChangeMark, dynamic_panels, height_inches

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import SubFigure

INCHES: Final = (7.2, 7.6)  # size of one Allan plot with its table
DPI: Final = 150
MISSING: Final = 'matplotlib is not installed: pip install "imu-monitor[plot]"'
EXPLAINED: Final = (
    "small print: 95 % interval;  ≤ one-sided 95 % bound;  — too few data;  K or R: the data do not tell which"
)


def allan_plot(
    estimate: Estimate,
    path: Path,
    title: str = "",
    others: Sequence[OtherDeviation] = (),
    dynamic: DynamicAllan | None = None,
    marks: Sequence[ChangeMark] = (),
    axes_of_temperature: Collection[str] = (),
) -> None:
    """Write the plot; the suffix of ``path`` selects the format.

    Parameters
    ----------
    estimate
        Estimate of the whole recording.
    path
        File to write.
    title
        Title of the figure.
    others
        Other deviations, such as total and Hadamard deviation.
    dynamic
        Dynamic curves of the same recording, drawn below the table.
    marks
        Changes to mark in the dynamic curves.
    axes_of_temperature
        Axes to mark because temperature explains most of their slow variance.

    Raises
    ------
    ConfigError
        matplotlib is missing or the file cannot be written.
    """
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    except ImportError as error:
        raise ConfigError(MISSING) from error
    kinds = kinds_of(estimate)
    below = max((height_inches(dynamic, kind) for kind in kinds), default=0.0) if dynamic is not None else 0.0
    figure = Figure(figsize=(INCHES[0] * len(kinds), INCHES[1] + below), dpi=DPI, layout="constrained")
    FigureCanvasAgg(figure)
    rows = [INCHES[1]] if dynamic is None else [INCHES[1], below]
    parts = figure.subfigures(len(rows), len(kinds), squeeze=False, height_ratios=rows)
    for column, kind in enumerate(kinds):
        _draw_allan_and_table(parts[0, column], estimate, kind, others, axes_of_temperature)
        if dynamic is not None:
            dynamic_panels(parts[1, column], dynamic, kind, marks)
    figure.suptitle("\n".join([*([title] if title else []), summary(estimate)]), fontsize=12)
    try:
        figure.savefig(path)
    except (OSError, ValueError) as error:
        raise ConfigError(f"cannot write the plot {path}: {error}") from error


def kinds_of(estimate: Estimate) -> list[Kind]:
    """Return the kinds of sensor that are measured; both kinds if none is."""
    present = {axis for _, axis in measured_axes(estimate.curve)}
    return [kind for kind in KINDS if set(axes_of(kind)) & present] or list(KINDS)


def summary(estimate: Estimate) -> str:
    """Return one line with the number of samples, rate, duration and number of missing samples."""
    missing = estimate.curve.n - estimate.samples
    gaps = f", {missing:,} missing" if missing > 0 else ""
    seconds = format_duration(estimate.curve.n / estimate.rate_hz)
    return f"{estimate.samples:,} samples at {estimate.rate_hz:.6g} Hz, {seconds}{gaps}"


def k_or_r(estimate: Estimate, letter: str, axis: str) -> bool:
    """Return True if this coefficient is one of K and R, and the data do not show which of the two is present.

    Parameters
    ----------
    estimate
        The estimate.
    letter
        Coefficient.
    axis
        Name of the axis.
    """
    i, drifts = AXES.index(axis), letter in ("K", "R")
    return (
        drifts
        and bool(estimate.k_or_r[i])
        and estimate.coefficients.status[SYMBOLS.index(letter), i] == Status.UPPER_BOUND
    )


def _draw_allan_and_table(
    part: "SubFigure",
    estimate: Estimate,
    kind: Kind,
    others: Sequence[OtherDeviation],
    axes_of_temperature: Collection[str],
) -> None:
    """Draw the Allan plot and the table of one kind of sensor."""
    curves, table = part.subplots(2, 1, height_ratios=[3.6, 1.75])
    allan_panel(curves, estimate, kind, others)
    _table(table, estimate, kind, axes_of_temperature)


def _table(axes: "Axes", estimate: Estimate, kind: Kind, axes_of_temperature: Collection[str]) -> None:
    """Draw the table of coefficients: the value, and its interval in small print."""
    axes.axis("off")
    columns = (0.0, 0.46, 0.65, 0.84)
    rows = np.linspace(0.97, 0.19, len(SYMBOLS) + 1)
    for axis, x, colour in zip(axes_of(kind), columns[1:], COLOURS, strict=True):
        axes.text(
            x, rows[0], mark_temperature_axis(axis, axes_of_temperature), color=colour, fontweight="bold", va="center"
        )
    for letter, y in zip(SYMBOLS, rows[1:], strict=True):
        unit = COEFFICIENT_UNITS[kind][letter].name
        axes.text(columns[0], y, f"{letter}  {COEFFICIENT_NAMES[kind][letter]}, {unit}", va="center", fontsize=9.5)
        for axis, x in zip(axes_of(kind), columns[1:], strict=True):
            cell = format_coefficient(estimate.coefficients, letter, axis)
            axes.text(x, y + 0.02, cell.value, va="center", fontsize=9.5)
            small = "K or R" if k_or_r(estimate, letter, axis) else cell.interval
            axes.text(x, y - 0.05, small, va="center", fontsize=6.5, color=GREY)
    temperature = f";  {TEMPERATURE_MARK} {TEMPERATURE_MEANS}" if axes_of_temperature else ""
    axes.text(columns[0], 0.03, EXPLAINED + temperature, va="center", fontsize=7.5, color=GREY)
    axes.text(columns[0], -0.04, LEGEND_TEXT, va="center", fontsize=7.5, color=GREY)
    axes.set(xlim=(0, 1), ylim=(-0.06, 1))
