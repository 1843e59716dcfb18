"""Copy of the samples in a sliding window, and a ring buffer of temperatures.

The sliding window stores the running sum of the samples (phase) as integers. Each sample therefore has a rounding error
of one unit of phase. For a window of one hour at 100 Hz, the rounding error is 1e-11 rad/s or m/s².

The detection of quantization steps and repeated values requires the exact output of the sensor. The output is restored
as follows.

- If all samples are close to float32 numbers, they are rounded to float32.
- If the values of an axis form narrow groups, each group is replaced by a single value. If possible, the values of all
  groups are placed on a regular grid.
- Otherwise, the rounding error is masked by uniform random numbers.

Missing samples and samples that were discarded from the window are NaN.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from drivers.data_types import AXES, Floats, Ints
from monitor.estimation.allan.window import AllanWindow

MAX_GROUP_UNITS: Final = 2.0
"""Maximum distance between neighbouring values in a group, in units of phase."""
MIN_GROUP_DISTANCE_UNITS: Final = 16.0
"""Minimum distance between neighbouring groups of values, in units of phase."""
MIN_FLOAT32_EVIDENCE: Final = 20
"""Minimum number of samples that are needed to detect float32 values."""
MAX_GRID_DIVISOR: Final = 6
"""Maximum number of grid steps between the two closest groups of values."""


@dataclass(frozen=True, slots=True)
class WindowSnapshot:
    """Copy of the phase in a sliding window."""

    phase: Ints  # [n + 1, 6 or more] integer phase modulo 2⁶⁴, oldest first
    missing: NDArray[np.int32]  # [n + 1, 6 or more] running count of missing samples
    unit: Floats  # [6] value of one integer unit of phase in rad/s and m/s²
    rate_hz: float

    def __len__(self) -> int:
        return len(self.phase) - 1

    def restore_samples(self) -> Floats:
        """Return the samples [n, 6] in rad/s and m/s², where NaN means missing. Every call returns the same values."""
        columns, rng = [], np.random.default_rng(0)
        for axis in range(len(AXES)):
            units = np.diff(self.phase[:, axis]).astype(np.float64)
            units[np.diff(self.missing[:, axis]) > 0] = np.nan
            columns.append(_restore(units, float(self.unit[axis]), rng))
        return np.column_stack(columns)


def copy_window(window: AllanWindow, rate_hz: float) -> WindowSnapshot:
    """Return a copy of the samples in a sliding window.

    Parameters
    ----------
    window : AllanWindow
        Sliding window to copy.
    rate_hz : float
        Sample rate in Hz.
    """
    phase, missing, first, unit = window.view_phase_ring()
    end = first + window.samples_in_window + 1
    # The samples may wrap around the end of the ring buffer.
    rows = [slice(first, min(end, len(phase))), slice(0, max(end - len(phase), 0))]
    return WindowSnapshot(
        np.concatenate([phase[one] for one in rows]), np.concatenate([missing[one] for one in rows]), unit, rate_hz
    )


def _restore(units: Floats, unit: float, rng: np.random.Generator) -> Floats:
    """Restore the values [n] of one axis in SI units from integer units of phase.

    >>> rounded = np.array([1000.0, 1001.0, 7.0, np.nan, 999.0])
    >>> _restore(rounded, 1e-6, np.random.default_rng(1)).round(9).tolist()
    [0.001, 0.001, 7e-06, nan, 0.001]
    """
    single = (units * unit).astype(np.float32)
    apart = np.abs(single.astype(np.float64) - units * unit)
    telling = np.spacing(np.abs(single)) > MIN_GROUP_DISTANCE_UNITS * unit
    if np.count_nonzero(telling) >= MIN_FLOAT32_EVIDENCE and not (apart > MAX_GROUP_UNITS * unit).any():
        return single.astype(np.float64)
    return _merge_groups(units, rng) * unit


def _merge_groups(units: Floats, rng: np.random.Generator) -> Floats:
    """Replace each group of close values by a single value. Without groups, add random numbers from −½ to ½ unit."""
    known = np.flatnonzero(~np.isnan(units))
    order = known[np.argsort(units[known], kind="stable")]
    ordered = units[order]
    apart = np.diff(ordered, prepend=-np.inf)
    result = units.copy()
    if (apart[apart > MAX_GROUP_UNITS] > MIN_GROUP_DISTANCE_UNITS).all():
        level = np.cumsum(apart > MAX_GROUP_UNITS) - 1
        result[order] = _snap_to_grid(np.bincount(level, ordered) / np.bincount(level))[level]
    else:
        result[known] += rng.random(known.size) - 0.5
    return result


def _snap_to_grid(levels: Floats) -> Floats:
    """Round values to a regular grid, or return them unchanged if no grid fits within the rounding error.

    >>> _snap_to_grid(np.array([1e5, 3.000001e5, 6.0e5])).round(3).tolist()
    [100000.039, 300000.034, 600000.026]
    """
    if levels.size < 2:
        return levels
    shortest = float(np.diff(levels).min())
    for parts in range(1, MAX_GRID_DIVISOR + 1):
        count = np.rint((levels - levels[0]) * (parts / shortest))
        step, first = np.polynomial.polynomial.polyfit(count, levels, 1)[::-1]
        even = first + step * count
        if np.abs(even - levels).max() <= MAX_GROUP_UNITS:
            return np.asarray(even)
    return levels


class TemperatureRing:
    """Ring buffer of the newest temperatures of a device. Each temperature takes 4 bytes.

    Parameters
    ----------
    length : int
        Number of temperatures to keep.

    >>> newest = TemperatureRing(3)
    >>> newest.push_temperatures(0, np.array([20.0, 21.0]))
    >>> newest.push_temperatures(1, np.array([22.0]))
    >>> newest.newest_temperatures(3).tolist()
    [21.0, nan, 22.0]
    """

    def __init__(self, length: int) -> None:
        self._ring = np.full(length, np.nan, np.float32)
        self._next = 0

    def push_temperatures(self, missing_before: int, temperature_c: Floats) -> None:
        """Append missing values, followed by temperatures.

        Parameters
        ----------
        missing_before : int
            Number of missing values before ``temperature_c``.
        temperature_c : ndarray of float64, shape (n,)
            Temperatures in °C.
        """
        if missing_before:
            self._write(np.full(min(missing_before, self._ring.size), np.nan))
        self._write(temperature_c[-self._ring.size :])

    def newest_temperatures(self, n: int) -> Floats:
        """Return the newest n temperatures in °C, oldest first; NaN means not measured."""
        return self._ring[(self._next - np.arange(n, 0, -1)) % self._ring.size].astype(np.float64)

    def _write(self, temperature_c: Floats) -> None:
        before = min(self._ring.size - self._next, len(temperature_c))
        self._ring[self._next : self._next + before] = temperature_c[:before]
        self._ring[: len(temperature_c) - before] = temperature_c[before:]
        self._next = (self._next + len(temperature_c)) % self._ring.size
