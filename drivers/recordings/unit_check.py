"""Check for an obvious error in the units of a recording.

The accelerometers of a sensor at rest measure gravity, in whatever unit. The white noise of a gyroscope at rest is at
most about 0.2 °/s/√Hz, also for consumer sensors at a low sample rate. The check only names the unit that would fit,
and changes no values.
"""

from collections.abc import Sequence
from math import log, sqrt
from typing import Final

import numpy as np

from drivers.data_types import Floats
from drivers.recordings.unit_inference import measure_rotation
from drivers.units import DEGREE, G0, acceleration_factor, angular_rate_factor

ACCELERATION_UNITS: Final = ("m/s²", "g", "mg", "mm/s²")
GYRO_UNITS: Final = ("rad/s", "deg/s", "mrad/s", "mdps")
SENSITIVITIES: Final = tuple(2**k for k in range(8, 15))
"""Usual sensitivities of accelerometers with integer output, in LSB/g."""
MAX_SAMPLES: Final = 1 << 14
"""Number of samples that are checked."""
MIN_SAMPLES: Final = 100
MAX_GRAVITY_DISTANCE: Final = log(1.12)
"""Largest logarithmic distance between the measured specific force and gravity.

The errors of bias and scale factor of a MEMS accelerometer may reach 10 %.
"""
MAX_SPREAD_AT_REST: Final = 0.03
"""Largest spread of the specific force of a sensor at rest, relative to its median."""
MAX_NOISE_AT_REST: Final = 0.4 * DEGREE
"""Largest noise density of a gyroscope at rest, rad/s/√Hz."""
MAX_NOISE_ALONE: Final = 1.0 * DEGREE
"""Largest noise density of gyroscopes, rad/s/√Hz, if no accelerometer shows whether the sensor is at rest."""
MAX_RATE_RAD_S: Final = 4000.0 * DEGREE
"""Median angular rate beyond the full scale of MEMS gyroscopes, rad/s."""
MAD_TO_SIGMA: Final = 1.4826
"""Ratio of the standard deviation to the median absolute deviation of a normal distribution."""

MAX_BIAS_RAD_S: Final = 25.0 * DEGREE
"""Bias that no MEMS gyroscope exceeds."""
MAX_CENTRIFUGE_RATE: Final = 5.0
"""Angular rate below which no centrifuge generates 100 g: its radius would be 40 m."""
MAX_STEP_RAD: Final = 2.0
"""Largest rotation between two samples. If the rotation is larger, aliasing may hide the turn of gravity."""
ROTATION_STEPS: Final = 100


def describe_impossible_default_units(values: Floats, rate_hz: float, gyro_given: bool, accel_given: bool) -> str:
    """Return why numbers of a live sensor cannot be in rad/s or m/s², or an empty text.

    Only motions that are impossible on Earth are described, so that vehicles, centrifuges and rate tables pass. A
    constant angular rate and a constant specific force are possible together only about a vertical axis. The component
    of the specific force along this axis is then gravity, also in a centrifuge.

    Parameters
    ----------
    values
        [n, 6] float64 in the order of AXES, in rad/s and m/s² if the default units are right.
    rate_hz
        Sample rate in Hz.
    gyro_given, accel_given
        True if the user states the unit of the triad, which is then not examined.
    """
    rates, forces = values[:, :3], values[:, 3:]
    if not np.isfinite(forces).all() or not np.ptp(forces, axis=0).any():
        return ""
    mean = forces.mean(axis=0)
    force = float(np.linalg.norm(mean))
    at_rest = bool((forces.std(axis=0) <= MAX_SPREAD_AT_REST * force).all())
    measures_rates = bool(np.isfinite(rates).all() and np.ptp(rates, axis=0).all())
    if at_rest and not accel_given and (unit := _find_acceleration_unit(forces, force, "m/s²")):
        counts = unit.startswith("g/") and _are_integers(rates) and bool(np.ptp(rates) >= 2.0)
        slow = unit == "mg" and float(np.median(np.linalg.norm(rates, axis=1))) < MAX_CENTRIFUGE_RATE
        if unit == "g" or (measures_rates and (counts or slow)):
            return f'the accelerometer measures {force:.4g} at rest, expected 9.81 m/s²: set accel_unit = "{unit}"'
    if gyro_given or not measures_rates:
        return ""
    turn = measure_rotation(rates[np.newaxis], forces[np.newaxis], max(len(values) // ROTATION_STEPS, 1))
    if turn is not None and abs(log(turn * rate_hz / DEGREE)) < log(1.4):
        return (
            f"gravity turns {1.0 / (turn * rate_hz):.3g} times less than the gyroscope in rad/s: "
            'set gyro_unit = "deg/s"'
        )
    rate = rates.mean(axis=0)
    size = float(np.linalg.norm(rate))
    parts = rates[: len(rates) // 10 * 10].reshape(10, -1, 3).mean(axis=1)
    constant = at_rest and bool((parts.std(axis=0) < 0.2 * size).all()) and abs(log(force / G0)) < MAX_GRAVITY_DISTANCE
    visible = MAX_BIAS_RAD_S < size < MAX_STEP_RAD * rate_hz
    if constant and visible and abs(float(mean @ rate)) < 0.8 * G0 * size:
        fits = '"deg/s/131" or another scale of counts' if _are_integers(rates) else f'"deg/s" (bias {size:.2g} °/s)'
        return f"gravity does not turn, but the gyroscope measures {size:.3g} in rad/s: set gyro_unit = {fits}"
    return ""


def describe_likely_unit_errors(
    values: Floats, rate_hz: float | None, gyro_unit: str = "rad/s", accel_unit: str = "m/s²"
) -> list[str]:
    """Return a note for each triad whose unit is obviously wrong.

    Parameters
    ----------
    values
        [n, 6] float64 in the order of AXES, in rad/s and m/s².
    rate_hz
        Sample rate in Hz. None if unknown.
    gyro_unit
        Unit from which the angular rates were converted.
    accel_unit
        Unit from which the accelerations were converted.
    """
    some = values[:: max(len(values) // MAX_SAMPLES, 1)]
    with np.errstate(invalid="ignore", over="ignore"):  # damaged files contain signaling NaNs and huge numbers
        force = np.linalg.norm(some[:, 3:], axis=1)
    force = force[np.isfinite(force)]
    notes: list[str] = []
    at_rest = False
    if force.size >= MIN_SAMPLES:
        median = float(np.median(force))
        at_rest = _median_deviation(force) <= MAX_SPREAD_AT_REST * median
        if at_rest and (unit := _find_acceleration_unit(some[:, 3:], median, accel_unit)):
            notes.append(
                f"The accelerometers measure {median:.4g} m/s² at rest, expected {G0:.4g} m/s². Their numbers, read in "
                f"{accel_unit}, would fit the unit {unit} (--accel-unit {unit})."
            )
    limit = MAX_NOISE_AT_REST if at_rest else MAX_NOISE_ALONE if not force.size else np.inf
    if note := _check_gyros(values[:MAX_SAMPLES, :3], rate_hz, limit, gyro_unit):
        notes.append(note)
    return notes


def _find_acceleration_unit(values: Floats, force_m_s2: float, unit: str) -> str | None:
    """Return the unit in which the measured values would equal gravity.

    The result is None if the present unit fits, or if no unit fits.
    """
    number = force_m_s2 / acceleration_factor(unit)
    numbers = values[np.isfinite(values)] / acceleration_factor(unit)
    counts = tuple(f"g/{n}" for n in SENSITIVITIES) if _are_integers(numbers) else ()
    distances = {
        one: abs(log(number * acceleration_factor(one) / G0)) for one in (unit, *ACCELERATION_UNITS, *counts) if number
    }
    best = min(distances, key=lambda one: distances[one], default=unit)
    wrong = distances.get(unit, 0.0) > MAX_GRAVITY_DISTANCE
    return best if wrong and distances[best] < MAX_GRAVITY_DISTANCE else None


def _check_gyros(values: Floats, rate_hz: float | None, limit: float, unit: str) -> str:
    """Return a note if even the quietest gyroscope is too noisy or too fast for its unit, or an empty text."""
    measured = [column for column in values.T if np.isfinite(column).sum() >= MIN_SAMPLES]
    if not measured:
        return ""
    numbers = np.concatenate(measured) / angular_rate_factor(unit)
    if min(float(np.nanmedian(np.abs(column))) for column in measured) > MAX_RATE_RAD_S:
        what = f"The gyroscopes measure more than {MAX_RATE_RAD_S / DEGREE:.0f} °/s"
        return f"{what}. Their numbers do not fit the unit {unit}{_suggest_counts(numbers)}."
    if rate_hz is None:
        return ""
    noise = min(map(_noise_of_differences, measured)) * sqrt(2.0 / rate_hz)
    if not noise > limit:
        return ""
    factor = angular_rate_factor(unit)
    smaller = [one for one in GYRO_UNITS if 0.0 < noise * angular_rate_factor(one) / factor <= limit]
    fits = f". Their numbers would fit the unit {smaller[0]} (--gyro-unit {smaller[0]})" if smaller else ""
    return (
        f"Every gyroscope has a noise density above {noise / DEGREE:.2g} °/s/√Hz, expected at most "
        f"{limit / DEGREE:.2g} °/s/√Hz{_suggest_counts(numbers) if _are_integers(numbers) else fits}."
    )


def _suggest_counts(numbers: Floats) -> str:
    if not _are_integers(numbers):
        return ""
    return ". Their numbers are integers and may be raw counts (such as --gyro-unit deg/s/131 for 131 LSB/(°/s))"


def _noise_of_differences(column: Floats) -> float:
    """Return the standard deviation of white noise from the differences of consecutive samples."""
    return _median_deviation(np.diff(column)) / sqrt(2.0)


def _median_deviation(values: Floats) -> float:
    """Return the standard deviation of normally distributed values from their median absolute deviation."""
    finite = values[np.isfinite(values)]
    return float(MAD_TO_SIGMA * np.median(np.abs(finite - np.median(finite)))) if finite.size else 0.0


def _are_integers(numbers: Floats | Sequence[float]) -> bool:
    finite = np.asarray(numbers)[np.isfinite(numbers)]
    return bool(np.all(np.abs(finite - np.rint(finite)) < 1e-6))
