"""Plots of bias and temperature: over time and against each other, one row per axis.

matplotlib is imported when a plot is requested, and draws without a display.
"""

from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from drivers.errors import ConfigError
from drivers.quantities import HOUR_S
from drivers.sample import AXES, Floats
from monitor.common.units import DEVIATION_UNITS, sensor_kind
from monitor.drift.thermal.interval_means import IntervalMeans
from monitor.drift.thermal.thermal_model import Prediction, predict
from monitor.drift.thermal.thermal_study import ThermalFitReport, ThermalPredictionReport
from monitor.publishing.plots.allan_figure import COLOURS, GREY
from monitor.publishing.plots.analysis_plot import DPI, MISSING
from monitor.publishing.rerun.panels import format_duration

if TYPE_CHECKING:
    from matplotlib.axes import Axes

ROW_INCHES: Final = (11.0, 2.6)


def study_plot(study: ThermalFitReport, path: Path) -> None:
    """Write a plot of interval means and the fitted thermal models.

    Parameters
    ----------
    study
        The fitted models.
    path
        File to write; its suffix selects the format.

    Raises
    ------
    ConfigError
        matplotlib is missing or the file cannot be written.
    """
    rows = [
        (
            axis,
            study.means[axis],
            predict(one.model, study.means[axis].temperature_c, began=True),
            one.model.shape.name,
        )
        for axis, one in study.fits.items()
    ]
    _draw(rows, f"{study.recording}: bias and temperature, means of {format_duration(study.interval_s)}", path)


def outlook_plot(outlook: ThermalPredictionReport, path: Path) -> None:
    """Write a plot of interval means and the predictions of models of another recording, with the offset removed.

    Parameters
    ----------
    outlook
        The predictions.
    path
        File to write; its suffix selects the format.

    Raises
    ------
    ConfigError
        matplotlib is missing or the file cannot be written.
    """
    rows = []
    for axis, one in outlook.judged.items():
        band = Prediction(*(each + one.offset for each in (one.multi_step.bias, one.multi_step.lo, one.multi_step.hi)))
        rows.append((axis, outlook.means[axis], band, "multi-step, offset out"))
    _draw(rows, f"{outlook.recording}: expected from temperature, means of {format_duration(outlook.interval_s)}", path)


def _draw(rows: list[tuple[str, IntervalMeans, Prediction, str]], title: str, path: Path) -> None:
    """Write the plot; raise ConfigError if matplotlib is missing or the file cannot be written."""
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    except ImportError as error:
        raise ConfigError(MISSING) from error
    figure = Figure(figsize=(ROW_INCHES[0], 0.6 + ROW_INCHES[1] * len(rows)), dpi=DPI, layout="constrained")
    FigureCanvasAgg(figure)
    panels: Any = figure.subplots(len(rows), 2, squeeze=False, width_ratios=[2.4, 1.0])
    for (over_time, against), (axis, means, model, name) in zip(panels, rows, strict=True):
        unit, colour = DEVIATION_UNITS[sensor_kind(axis)], COLOURS[AXES.index(axis) % 3]
        hours = (np.arange(means.bias.size) + 0.5) * means.interval_s / HOUR_S
        middle = float(np.nanmean(means.bias))
        bias, expected, lo, hi, bars = (
            unit.factor * each
            for each in (means.bias - middle, model.bias - middle, model.lo - middle, model.hi - middle, means.error)
        )
        over_time.fill_between(hours, lo, hi, color=colour, alpha=0.15, lw=0, label="95 %")
        over_time.errorbar(hours, bias, bars, fmt=".", ms=4, color=GREY, lw=0.8, label="means")
        over_time.plot(hours, expected, color=colour, lw=1.4, label=name)
        over_time.set_ylabel(f"{axis} less its mean, {unit.name}")
        over_time.legend(loc="best", fontsize=7.5, frameon=False)
        _draw_against_temperature(against, means.temperature_c, bias, expected, colour)
    panels[-1, 0].set_xlabel("time, h")
    panels[-1, 1].set_xlabel("temperature, °C")
    figure.suptitle(title, fontsize=12)
    try:
        figure.savefig(path)
    except (OSError, ValueError) as error:
        raise ConfigError(f"cannot write the plot {path}: {error}") from error


def _draw_against_temperature(
    panel: "Axes", temperature_c: Floats, bias: Floats, expected: Floats, colour: str
) -> None:
    """Draw bias and prediction against temperature."""
    panel.plot(temperature_c, bias, ".", ms=4, color=GREY)
    panel.plot(temperature_c, expected, color=colour, lw=1.2)
