"""Results of the drift compensation of a recording, as a table for the terminal and as JSON."""

from typing import Any, Final

import numpy as np
from rich.console import Console
from rich.padding import Padding

from monitor.common.unit_formatting import (
    DEFAULT_UNITS,
    Unit,
    UnitSystem,
    format_count,
    format_duration,
    format_number,
)
from monitor.drift.compensation.arma import ArmaModel
from monitor.drift.compensation.compensation_score import (
    SPANS_S,
    AxisCompensation,
    DriftCompensationResult,
    RateQualityAtRest,
)
from monitor.publishing.messages.message import encode_json
from monitor.publishing.terminal.tables import plain_table, print_line, print_notes

SCHEMA: Final = "imu-monitor/compensate/1"
ARMA_COEFFICIENT_NAMES: Final = ("phi1", "phi2", "theta1")
"""JSON keys of the coefficients φ₁, φ₂ and θ₁ of the ARMA model."""


def print_compensation(result: DriftCompensationResult, console: Console, units: UnitSystem = DEFAULT_UNITS) -> None:
    """Print the drift models and errors of a compensated recording.

    Parameters
    ----------
    result : DriftCompensationResult
        Results of the drift compensation.
    console : Console
        Terminal or file that receives the text.
    units : UnitSystem, optional
        Units of the rates.
    """
    learning, evaluated = (format_duration(one) for one in (result.learning_rest_s, result.evaluated_rest_s))
    console.print(
        f"{result.recording}: {result.samples} samples at {result.rate_hz:g} Hz, method {result.method}; evaluated on "
        f"{evaluated} at rest, after {learning} of learning",
        highlight=False,
    )
    unit, spans = units.deviation("gyro"), (f"{span / 60.0:.0f} min" for span in SPANS_S)
    rows = plain_table("axis", wrapped_headers=("drift", f"rms, {unit.name}", "worst minute", *spans))
    for axis, one in result.axes.items():
        pairs = [
            (one.uncompensated.rms, one.compensated.rms),
            (one.uncompensated.worst_minute, one.compensated.worst_minute),
        ]
        pairs += list(zip(one.uncompensated.drift, one.compensated.drift, strict=True))
        rows.add_row(axis, "—" if one.model is None else one.model.name, *(_format_pair(*pair, unit) for pair in pairs))
    console.print(Padding(rows, (1, 0)))
    console.print(
        "Values before → after compensation, at rest. 1 min, 10 min, 60 min: rms of the mean rate over this time.",
        style="dim",
    )
    for axis, one in result.axes.items():
        if one.steps or one.rejected_intervals:
            print_line(f"{axis}: {_describe_exceptions(one, result.interval_s)}", console)
    print_notes(result.notes, console)


def encode_compensation(result: DriftCompensationResult) -> bytes:
    """Encode the results of a drift compensation as JSON, in SI units."""
    whole = {
        "schema": SCHEMA,
        "recording": result.recording,
        "out": str(result.out),
        "method": result.method,
        "rate": result.rate_hz,
        "samples": result.samples,
        "interval": result.interval_s,
        "learned": result.learning_rest_s,
        "judged": result.evaluated_rest_s,
        "axes": {axis: _axis(at, one, result) for at, (axis, one) in enumerate(result.axes.items())},
        "notes": list(result.notes),
    }
    return encode_json(whole)


def _axis(at: int, one: AxisCompensation, result: DriftCompensationResult) -> dict[str, Any]:
    each = result.intervals
    return {
        "model": None if one.model is None else _model(one.model),
        "before": _rest(one.uncompensated),
        "after": _rest(one.compensated),
        "left_out": one.rejected_intervals,
        "steps": one.steps,
        "intervals": {
            "end": [i.end / result.rate_hz for i in each],
            "bias": np.array([i.mean[at] for i in each]),
            "expected": np.array([i.expected[at] for i in each]),
            "error": np.array([i.known[at] for i in each]),
            "innovation": np.array([i.innovation[at] for i in each]),
        },
    }


def _model(model: ArmaModel) -> dict[str, Any]:
    values = (*model.phi, model.theta)
    return {
        "order": list(model.order),
        **{
            name: {"value": value, "lo": lo, "hi": hi}
            for name, value, lo, hi in zip(ARMA_COEFFICIENT_NAMES, values, model.lo, model.hi, strict=True)
            if np.isfinite(lo)
        },
        "variance": model.variance,
        "white": model.white_variance,
        "mean": model.mean,
    }


def _rest(one: RateQualityAtRest) -> dict[str, Any]:
    return {
        "deviation": one.rms,
        "worst_minute": one.worst_minute,
        "drift": {f"{span:g}": x for span, x in zip(SPANS_S, one.drift, strict=True)},
        "allan": {"tau": one.tau_s, "deviation": one.allan},
    }


def _format_pair(before: float, after: float, unit: Unit) -> str:
    if not (np.isfinite(before) and np.isfinite(after)):
        return "—"
    return f"{format_number(unit.factor * before, 2)} → {format_number(unit.factor * after, 2)}"


def _describe_exceptions(one: AxisCompensation, interval_s: float) -> str:
    parts = []
    if one.rejected_intervals:
        count = format_count(one.rejected_intervals, "interval")
        parts.append(f"{count} of {interval_s:g} s rejected, because drift does not explain the mean or the scatter")
    if one.steps:
        parts.append(f"{format_count(one.steps, 'step')} of the bias")
    return "; ".join(parts)
