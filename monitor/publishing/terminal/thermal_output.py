"""Results of thermal model fits and predictions, as tables for the terminal and as JSON."""

import math
from typing import Any, Final

import numpy as np
from rich.console import Console
from rich.padding import Padding

from monitor.common.unit_formatting import (
    DEFAULT_UNITS,
    UnitSystem,
    format_axis_value,
    format_duration,
    format_number,
    sensor_kind,
)
from monitor.drift.thermal.interval_means import IntervalMeans
from monitor.drift.thermal.temperature_removal import SLOW_LETTERS, TemperatureRemovalComparison
from monitor.drift.thermal.thermal_fit import ThermalFit
from monitor.drift.thermal.thermal_results import ThermalFitReport, ThermalPredictionErrors, ThermalPredictionReport
from monitor.publishing.coefficient_cells import format_coefficient
from monitor.publishing.messages.message import encode_json
from monitor.publishing.terminal.tables import plain_table, print_line, print_notes

FIT_SCHEMA: Final = "imu-monitor/thermal-fit/1"
PREDICT_SCHEMA: Final = "imu-monitor/thermal-predict/1"
LEGEND: Final = (
    "constant: no dependence on temperature is significant beside the slow noise of the axis, or the dependence "
    "explains nothing. leaves: rms of the means minus the model."
)
ONE_WAY: Final = "temperature only rose or only fell, so neither a time lag nor hysteresis can be determined"
DRIFT_WITH_TIME: Final = "temperature only rose or only fell, so a drift with time would look the same"


def print_thermal_fit(report: ThermalFitReport, console: Console, units: UnitSystem = DEFAULT_UNITS) -> None:
    """Print the thermal models of all axes and the errors of their fits.

    Parameters
    ----------
    report
        Results of the thermal model fit.
    console
        Console that receives the output.
    units
        Units of the bias.
    """
    console.print(_summary_line(report.recording, report.interval_s, report.means), highlight=False)
    if report.fits:
        rows = plain_table("axis", "model", "per °C", "95 % interval", "explains", "leaves")
        for axis, one in report.fits.items():
            rows.add_row(axis, *_fit_row(axis, one, units))
        console.print(Padding(rows, (1, 0)))
        console.print(LEGEND, style="dim", highlight=False)
    one_way = [axis for axis, one in report.fits.items() if not one.temperature_rose_and_fell]
    notes = (*report.notes, *notes_on_lags_and_hysteresis(report), *([ONE_WAY] if one_way else []))
    _print_notes(report.refused, notes, console)


def print_thermal_prediction(
    report: ThermalPredictionReport, console: Console, units: UnitSystem = DEFAULT_UNITS
) -> None:
    """Print the predictions of thermal models for a recording and the prediction errors.

    Parameters
    ----------
    report
        Results of the thermal prediction.
    console
        Console that receives the output.
    units
        Units of the bias.
    """
    console.print(_summary_line(report.recording, report.interval_s, report.means), highlight=False)
    if report.judged:
        rows = plain_table(
            "axis", wrapped_headers=("rms alone", "multi-step", "offset out", "one-step", "offset", "within 95 %")
        )
        for axis, one in report.judged.items():
            each = (one.rms_about_mean, one.rms, one.rms_without_offset, one.rms_one_step, one.offset)
            rows.add_row(axis, *(_format_deviation(axis, x, units) for x in each), f"{100.0 * one.coverage:.0f} %")
        console.print(Padding(rows, (1, 0)))
    _print_notes(report.refused, report.notes, console)


def notes_on_temperature_dependence(removal: TemperatureRemovalComparison) -> list[str]:
    """Return a note for each axis on which temperature explains much of the variance of means, of K or of R."""
    notes = []
    for axis, one in removal.dependences.items():
        fallen = [
            f"{letter} falls from {before.value} to {after.value} {after.unit} ({100.0 * share:.0f} % of its variance)"
            for letter in SLOW_LETTERS
            if removal.coefficient_decreased_significantly(letter, axis)
            and (share := removal.variance_share_of_temperature(letter, axis)) is not None
            for before, after in [
                (
                    format_coefficient(removal.before, letter, axis),
                    format_coefficient(removal.coefficients, letter, axis),
                )
            ]
        ]
        without = f"without temperature ({removal.models.get(axis, '')}), {' and '.join(fallen)}" if fallen else ""
        if one.explains_most_variance:
            share_text = f"{math.floor(100.0 * one.share):d} %"
            notes.append(
                f"{axis} follows its temperature: {one.form} explains {share_text} of the variance of means of "
                f"{format_duration(one.interval_s)}, so Q N B K R describe temperature as well as noise"
                f"{'; ' + without if without else ''}; imu-monitor thermal fit models it"
                f"{'' if not one.one_way else f' ({DRIFT_WITH_TIME})'}"
            )
        elif without:
            notes.append(f"{axis} follows its temperature in part: {without}")
    return notes


def notes_on_lags_and_hysteresis(report: ThermalFitReport) -> list[str]:
    """Return a note for each lag, and for each axis whose bias differs between heating and cooling."""
    notes = []
    for axis, one in report.fits.items():
        notes += [
            f"{axis} follows its temperature with a lag of {format_duration(constant)} "
            f"(95 % interval {format_duration(lo)} … {format_duration(hi)})"
            for constant, (lo, hi) in zip(one.model.shape.constants_s, one.time_constant_intervals_s, strict=True)
        ]
        loop = one.hysteresis
        if loop is not None and loop.is_significant:
            notes.append(
                f"{axis}: at one temperature the bias differs between heating and cooling by up to "
                f"{format_axis_value(axis, loop.size)} (hysteresis or a lag, p = {loop.p_value:.1g})"
            )
    return notes


def encode_thermal_fit(report: ThermalFitReport) -> bytes:
    """Encode the results of a thermal model fit as JSON, in SI units."""
    axes: dict[str, Any] = {}
    for axis, one in report.fits.items():
        model, loop = one.model, one.hysteresis
        axes[axis] = {
            "model": model.shape.name,
            "reference": model.reference_c,
            "sizes": model.coefficients.tolist(),
            "time_constants": list(model.shape.constants_s),
            "equation": model.equation,
            "sizes_interval": _coefficient_intervals(one),
            "time_constants_interval": one.time_constant_intervals_s,
            "slope": model.mean_bias_slope,
            "slope_interval": one.slope_interval,
            "p_value": one.p_value,
            "hysteresis": loop and (loop.size if loop.is_significant else 0.0),
            "hysteresis_p": loop and loop.p_value,
            "both_directions": one.temperature_rose_and_fell,
            "explained": one.explained,
            "phi": model.phi,
            "rms": one.rms,
            "tests": [{"model": each.shape.name, "p_value": each.p_value} for each in one.tests],
            "temperature": report.means[axis].temperature_c,
            "bias": report.means[axis].bias,
            "error": report.means[axis].error,
        }
    return _json(FIT_SCHEMA, report.recording, report.interval_s, axes, report.refused, report.notes)


def encode_thermal_prediction(report: ThermalPredictionReport) -> bytes:
    """Encode thermal predictions and measured interval means as JSON, in SI units."""
    axes = {axis: _prediction_of_axis(report.means[axis], one) for axis, one in report.judged.items()}
    return _json(PREDICT_SCHEMA, report.recording, report.interval_s, axes, report.refused, report.notes)


def _prediction_of_axis(means: IntervalMeans, one: ThermalPredictionErrors) -> dict[str, Any]:
    return {
        "rms": one.rms,
        "rms_offset_out": one.rms_without_offset,
        "rms_one_step": one.rms_one_step,
        "rms_alone": one.rms_about_mean,
        "offset": one.offset,
        "within": one.coverage,
        "temperature": means.temperature_c,
        "bias": means.bias,
        "multi_step": one.multi_step,
        "one_step": one.one_step,
    }


def _json(
    schema: str, recording: str, interval_s: float, axes: dict[str, Any], refused: Any, notes: tuple[str, ...]
) -> bytes:
    whole = {
        "schema": schema,
        "recording": recording,
        "interval": interval_s,
        "axes": axes,
        "refused": dict(refused),
        "notes": list(notes),
    }
    return encode_json(whole)


def _summary_line(recording: str, interval_s: float, means: Any) -> str:
    first: IntervalMeans = next(iter(means.values()))
    count = first.bias.size
    warmth = first.temperature_c
    span = f"{np.nanmin(warmth):.1f} … {np.nanmax(warmth):.1f} °C" if np.isfinite(warmth).any() else "no temperature"
    return f"{recording}: {count} intervals of {format_duration(interval_s)}, {span}"


def _coefficient_intervals(one: ThermalFit) -> Any:
    """Return the 95 % interval of each coefficient [terms, 2]."""
    sizes = one.model.coefficients
    half = one.half_widths(np.eye(one.model.covariance.shape[0])[: sizes.size])
    return np.stack([sizes - half, sizes + half], axis=1)


def _fit_row(axis: str, one: ThermalFit, units: UnitSystem) -> tuple[str, ...]:
    model, leaves = one.model, _format_deviation(axis, one.rms, units)
    if model.shape.is_constant:
        return (model.shape.name, "—", "—", "—", leaves)
    factor = units.deviation(sensor_kind(axis)).factor
    return (
        model.shape.name,
        _format_deviation(axis, model.mean_bias_slope, units),
        " … ".join(format_number(factor * each) for each in one.slope_interval),
        f"{100.0 * one.explained:z.0f} %",
        leaves,
    )


def _format_deviation(axis: str, si: float, units: UnitSystem) -> str:
    return units.deviation(sensor_kind(axis)).format_si_value(si)


def _print_notes(refused: Any, notes: tuple[str, ...], console: Console) -> None:
    for axis, reason in refused.items():
        print_line(f"{axis}: {reason}", console)
    print_notes(notes, console)
