"""Plots of the bias and the temperature over time, and of the bias against the temperature."""

from pathlib import Path
from typing import Final

import numpy as np

from monitor.common.unit_formatting import DEFAULT_UNITS, UnitSystem, format_duration, sensor_kind
from monitor.drift.thermal.interval_means import IntervalMeans
from monitor.drift.thermal.thermal_model import ThermalPrediction, predict_interval_means
from monitor.drift.thermal.thermal_results import ThermalFitReport, ThermalPredictionReport
from monitor.publishing.plots import style

ROW_INCHES: Final = (11.0, 2.6)


def save_thermal_fit_plot(report: ThermalFitReport, path: Path, units: UnitSystem = DEFAULT_UNITS) -> None:
    """Write a plot of the mean bias in each interval and of the fitted thermal models to a file.

    Parameters
    ----------
    report
        Results of the thermal model fit.
    path
        File to write. The suffix selects the format.
    units
        Units of the bias.

    Raises
    ------
    ConfigError
        If matplotlib is not installed or the file cannot be written.
    """
    rows = [
        (
            axis,
            report.means[axis],
            predict_interval_means(one.model, report.means[axis].temperature_c, starts_with_fit=True),
            one.model.shape.name,
        )
        for axis, one in report.fits.items()
    ]
    title = f"{report.recording}: bias and temperature, means of {format_duration(report.interval_s)}"
    _save_plot(rows, title, path, units)


def save_thermal_prediction_plot(
    report: ThermalPredictionReport, path: Path, units: UnitSystem = DEFAULT_UNITS
) -> None:
    """Write a plot of the mean bias in each interval and of the thermal predictions, without their offset, to a file.

    Parameters
    ----------
    report
        Results of the thermal prediction.
    path
        File to write. The suffix selects the format.
    units
        Units of the bias.

    Raises
    ------
    ConfigError
        If matplotlib is not installed or the file cannot be written.
    """
    rows = []
    for axis, one in report.judged.items():
        predicted = (bound + one.offset for bound in (one.multi_step.bias, one.multi_step.lo, one.multi_step.hi))
        rows.append((axis, report.means[axis], ThermalPrediction(*predicted), "multi-step prediction, offset removed"))
    duration = format_duration(report.interval_s)
    _save_plot(rows, f"{report.recording}: bias predicted from temperature, means of {duration}", path, units)


def _save_plot(
    rows: list[tuple[str, IntervalMeans, ThermalPrediction, str]], title: str, path: Path, units: UnitSystem
) -> None:
    with style.figure_style():
        figure = style.create_figure(ROW_INCHES[0], 0.6 + ROW_INCHES[1] * len(rows))
        panels = figure.subplots(len(rows), 2, squeeze=False, sharex="col", sharey="row", width_ratios=[2.4, 1.0])
        for (over_time, against_temperature), (axis, means, model, name) in zip(panels, rows, strict=True):
            unit, colour = units.deviation(sensor_kind(axis)), style.axis_colour(axis)
            hours = np.asarray((np.arange(means.bias.size) + 0.5) * means.interval_s / 3600.0, np.float64)
            centre = float(np.nanmean(means.bias))
            bias, predicted, lo, hi = (
                unit.factor * (part - centre) for part in (means.bias, model.bias, model.lo, model.hi)
            )
            style.draw_band(over_time, hours, lo, hi, colour, label="95 %")
            over_time.errorbar(
                hours, bias, unit.factor * means.error, fmt=".", markersize=4, color=style.GREY, lw=0.8, label="means"
            )
            over_time.plot(hours, predicted, color=colour, label=name)
            over_time.set_ylabel(f"{axis} minus its mean, {unit.name}")
            style.draw_legend_above(over_time, 3, fontsize=7.5)
            against_temperature.plot(means.temperature_c, bias, ".", markersize=4, color=style.GREY)
            against_temperature.plot(means.temperature_c, predicted, color=colour, lw=1.2)
        panels[-1, 0].set_xlabel("time, h")
        panels[-1, 1].set_xlabel("temperature, °C")
        figure.suptitle(title)
        style.save_figure(figure, path)
