"""Units that are impossible for the samples of a sensor on Earth.

The check is meant for live streams, whose configuration states the units or omits them. Only motions that are
impossible on Earth are described, so that vehicles, centrifuges and rate tables pass. A constant angular rate and a
constant specific force are possible together only about a vertical axis. The component of the specific force along this
axis is then gravity, also in a centrifuge. A centrifuge needs an angular rate that grows with its specific force.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import log, sqrt
from typing import Final, Literal

import numpy as np

from drivers.data_types import Floats
from drivers.units import DEGREE, G0, acceleration_factor, angular_rate_factor

ACCELERATION_UNITS: Final = ("m/s²", "g", "mg", "mm/s²")
SENSITIVITIES: Final = tuple(2**k for k in range(8, 15))
"""Usual sensitivities of accelerometers with integer output, in LSB/g."""
MAX_GRAVITY_DISTANCE: Final = log(1.12)
"""Largest logarithmic distance between the measured specific force and gravity.

The errors of bias and scale factor of a MEMS accelerometer may reach 10 %.
"""
STATED_GRAVITY_DISTANCE: Final = log(1.05)
"""The same for the unit that fits better than a unit that the user states."""
MAX_SPREAD_AT_REST: Final = 0.03
"""Largest spread of the specific force of a sensor at rest, relative to its median."""
MAX_BIAS_RAD_S: Final = 25.0 * DEGREE
"""Bias that no MEMS gyroscope exceeds."""
MAX_CENTRIFUGE_RADIUS_M: Final = 40.0
MAX_STEP_RAD: Final = 2.0
"""Largest rotation between two samples. If the rotation is larger, aliasing may hide the turn of gravity."""
ROTATION_STEPS: Final = 100


@dataclass(frozen=True, slots=True)
class ImpossibleUnit:
    """A unit that contradicts the samples."""

    triad: Literal["gyro", "accel"]
    observation: str  # the contradiction
    fits: str  # unit that fits, in quotation marks


def find_impossible_unit(
    values: Floats, rate_hz: float, units: Sequence[str], stated: Sequence[bool]
) -> ImpossibleUnit | None:
    """Return a unit that is impossible for the samples, or None.

    Parameters
    ----------
    values
        [n, 6] float64 in the order of AXES, in rad/s and m/s² if the units are right.
    rate_hz
        Sample rate in Hz.
    units
        Units of the angular rates and of the accelerations from which the values were converted.
    stated
        For both units: True if the user states the unit. A stated unit is doubted only if a sensor without gravity in
        its accelerations, and triads with different axes, could not cause the contradiction either.
    """
    rates, forces = values[:, :3], values[:, 3:]
    if not np.isfinite(forces).all() or not np.ptp(forces, axis=0).any():
        return None
    measures_rates = bool(np.isfinite(rates).all() and np.ptp(rates, axis=0).all())
    counts = rates / angular_rate_factor(units[0])
    has_counts = measures_rates and are_integers(counts) and bool(np.ptp(counts) >= 2.0)
    mean = forces.mean(axis=0)
    force = float(np.linalg.norm(mean))
    at_rest = bool((forces.std(axis=0) <= MAX_SPREAD_AT_REST * force).all())
    sizes = np.linalg.norm(forces, axis=1)
    size = float(sizes.mean())
    unaccelerated = bool(sizes.std() <= MAX_SPREAD_AT_REST * size)
    turn = 0.0  # rotation of gravity, relative to the angular rates
    if measures_rates:
        rows = max(len(values) // ROTATION_STEPS, 1)
        turn = (measure_rotation(rates[np.newaxis], forces[np.newaxis], rows) or 0.0) * rate_hz
    turns_in_rad, turns_in_degrees = (turn > 0.0 and abs(log(turn / unit)) < log(1.4) for unit in (1.0, DEGREE))
    limit = STATED_GRAVITY_DISTANCE if stated[1] else MAX_GRAVITY_DISTANCE
    if unaccelerated and (unit := find_acceleration_unit(forces, size, units[1], limit)):
        factor = acceleration_factor(unit) / acceleration_factor(units[1])
        small = abs(factor / G0 - 1.0) < 1e-6 and (turns_in_rad or turns_in_degrees if stated[1] else at_rest)
        slow = measures_rates and float(np.median(np.linalg.norm(rates, axis=1))) < sqrt(size / MAX_CENTRIFUGE_RADIUS_M)
        large = at_rest and factor < 1.0 and slow and (stated[1] or unit == "mg")
        integers = at_rest and unit.startswith("g/") and has_counts and not stated[1]
        if small or large or integers:
            measured = f"the accelerometer measures {size:.4g} m/s² instead of gravity (9.81 m/s²)"
            return ImpossibleUnit("accel", measured, f'"{unit}"')
    is_gravity = unaccelerated and abs(log(size / G0)) < MAX_GRAVITY_DISTANCE
    if turns_in_degrees and angular_rate_factor(units[0]) == 1.0 and (is_gravity or not stated[0]):
        what = f"gravity turns {1.0 / turn:.3g} times less than the gyroscope in rad/s"
        return ImpossibleUnit("gyro", what, '"deg/s"')
    if not measures_rates:
        return None
    rate = rates.mean(axis=0)
    speed = float(np.linalg.norm(rate))
    parts = rates[: len(rates) // 10 * 10].reshape(10, -1, 3).mean(axis=1)
    constant = at_rest and is_gravity and bool((parts.std(axis=0) < 0.2 * speed).all())
    visible = MAX_BIAS_RAD_S < speed < MAX_STEP_RAD * rate_hz
    doubtful = not stated[0] or (has_counts and angular_rate_factor(units[0]) in (1.0, DEGREE))
    if constant and visible and doubtful and abs(float(mean @ rate)) < 0.8 * G0 * speed:
        number = speed / angular_rate_factor(units[0])
        fits = '"deg/s/131" or another scale of counts' if has_counts else f'"deg/s" (bias {number:.2g} °/s)'
        what = f"gravity does not turn, but the gyroscope measures {number:.3g} in {units[0]}"
        return ImpossibleUnit("gyro", what, fits)
    return None


def find_acceleration_unit(
    values: Floats, force_m_s2: float, unit: str, max_distance: float = MAX_GRAVITY_DISTANCE
) -> str | None:
    """Return the unit in which the measured values would equal gravity.

    The result is None if the present unit fits, or if no unit fits.
    """
    number = force_m_s2 / acceleration_factor(unit)
    numbers = values[np.isfinite(values)] / acceleration_factor(unit)
    counts = tuple(f"g/{n}" for n in SENSITIVITIES) if are_integers(numbers) else ()
    distances = {
        one: abs(log(number * acceleration_factor(one) / G0)) for one in (unit, *ACCELERATION_UNITS, *counts) if number
    }
    best = min(distances, key=lambda one: distances[one], default=unit)
    wrong = distances.get(unit, 0.0) > MAX_GRAVITY_DISTANCE
    return best if wrong and distances[best] < max_distance else None


def measure_rotation(gyro: Floats | None, accel: Floats | None, rows: int = 32) -> float | None:
    """Return the angle in rad per unit of angular rate and sample, or None if the sensor turns too little.

    Gravity is at rest, so its direction in the sensor changes by minus the cross product of angle and direction.
    """
    if gyro is None or accel is None or gyro.shape[2] < 3 or accel.shape[2] < 3 or gyro.shape[1] < 4 * rows:
        return None
    count = gyro.shape[1] // rows
    means = [np.nanmean(x[:, : count * rows].reshape(len(x), count, rows, 3), axis=2) for x in (gyro, accel)]
    rates, up = means[0] - np.nanmedian(means[0], axis=(0, 1)), means[1]
    up = up / np.maximum(np.linalg.norm(up, axis=2, keepdims=True), 1e-30)
    expected = -np.cross(0.5 * (rates[:, 1:] + rates[:, :-1]), 0.5 * (up[:, 1:] + up[:, :-1])) * rows
    changes = np.diff(up, axis=1)
    used = np.isfinite(expected).all(axis=2) & np.isfinite(changes).all(axis=2)
    x, y = expected[used].ravel(), changes[used].ravel()
    if x.size < 10 or not np.any(x) or float(np.sqrt(np.mean(y**2))) < 0.02:
        return None
    correlation = float(x @ y / sqrt((x @ x) * (y @ y)))
    return float(x @ y / (x @ x)) if correlation > 0.7 else None


def are_integers(numbers: Floats | Sequence[float]) -> bool:
    """Return True if all finite numbers are integers."""
    finite = np.asarray(numbers)[np.isfinite(numbers)]
    return bool(np.all(np.abs(finite - np.rint(finite)) < 1e-6))
