"""Check for an obvious error in the units of a recording.

The accelerometers of a sensor at rest measure gravity, in whatever unit. The white noise of a gyroscope at rest is at
most about 0.2 °/s/√Hz, also for consumer sensors at a low sample rate. The check only names the unit that would fit,
and changes no values.
"""

from math import sqrt
from typing import Final

import numpy as np

from drivers.data_types import Floats
from drivers.impossible_units import MAX_SPREAD_AT_REST, are_integers, find_acceleration_unit
from drivers.units import DEGREE, G0, angular_rate_factor

GYRO_UNITS: Final = ("rad/s", "deg/s", "mrad/s", "mdps")
MAX_SAMPLES: Final = 1 << 14
"""Number of samples that are checked."""
MIN_SAMPLES: Final = 100
MAX_NOISE_AT_REST: Final = 0.4 * DEGREE
"""Largest noise density of a gyroscope at rest, rad/s/√Hz."""
MAX_NOISE_ALONE: Final = 1.0 * DEGREE
"""Largest noise density of gyroscopes, rad/s/√Hz, if no accelerometer shows whether the sensor is at rest."""
MAX_RATE_RAD_S: Final = 4000.0 * DEGREE
"""Median angular rate beyond the full scale of MEMS gyroscopes, rad/s."""
MAD_TO_SIGMA: Final = 1.4826
"""Ratio of the standard deviation to the median absolute deviation of a normal distribution."""


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
        if at_rest and (unit := find_acceleration_unit(some[:, 3:], median, accel_unit)):
            notes.append(
                f"The accelerometers measure {median:.4g} m/s² at rest, expected {G0:.4g} m/s². Their numbers, read in "
                f"{accel_unit}, would fit the unit {unit} (--accel-unit {unit})."
            )
    limit = MAX_NOISE_AT_REST if at_rest else MAX_NOISE_ALONE if not force.size else np.inf
    if note := _check_gyros(values[:MAX_SAMPLES, :3], rate_hz, limit, gyro_unit):
        notes.append(note)
    return notes


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
        f"{limit / DEGREE:.2g} °/s/√Hz{_suggest_counts(numbers) if are_integers(numbers) else fits}."
    )


def _suggest_counts(numbers: Floats) -> str:
    if not are_integers(numbers):
        return ""
    return ". Their numbers are integers and may be raw counts (such as --gyro-unit deg/s/131 for 131 LSB/(°/s))"


def _noise_of_differences(column: Floats) -> float:
    """Return the standard deviation of white noise from the differences of consecutive samples."""
    return _median_deviation(np.diff(column)) / sqrt(2.0)


def _median_deviation(values: Floats) -> float:
    """Return the standard deviation of normally distributed values from their median absolute deviation."""
    finite = values[np.isfinite(values)]
    return float(MAD_TO_SIGMA * np.median(np.abs(finite - np.median(finite)))) if finite.size else 0.0
