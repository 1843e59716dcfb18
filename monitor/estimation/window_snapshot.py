"""Copy of the samples in a live window for analyses of a recording, and a ring buffer of temperatures.

The window stores phase and not samples, because a copy of the samples would need additional memory. A sample is the
difference of two successive values of phase. The rounding error of the difference is one unit of phase. With a window
of an hour at 100 Hz, this is 1e-11 rad/s or m/s². The rounding error of a sample is added to the next sample.

Analyses of quantization steps and repeated values need the original values of the sensor. The original values are
restored by the following rules.

- If all samples are close to float32 numbers, they are rounded to float32.
- If the values of an axis form groups narrower than ``MAX_GROUP_UNITS`` and further apart than
  ``MIN_GROUP_DISTANCE_UNITS``, each group becomes one value again. The values are placed on a regular grid if one fits.
- Otherwise the sensor had no steps, and uniform random numbers replace the rounded part.

Missing samples and samples discarded by the window are NaN.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from drivers.data_types import AXES, Floats, Ints
from monitor.estimation.allan.window import AllanWindow

MAX_GROUP_UNITS: Final = 2.0
"""Maximum distance of neighbours within a group, in units of phase. The rounding error of a sample is at most one unit.
"""
MIN_GROUP_DISTANCE_UNITS: Final = 16.0
"""Minimum distance between groups, in units of phase."""
MIN_FLOAT32_EVIDENCE: Final = 20
"""Minimum number of samples that can distinguish float32 input from other values."""
MAX_GRID_DIVISOR: Final = 6
"""Maximum number of grid steps that are tried for the smallest distance between two levels."""


@dataclass(frozen=True, slots=True)
class WindowSnapshot:
    """Copy of the phase in a window at one moment. The copy is fast, and ``values`` takes longer."""

    phase: Ints  # [n + 1, 6 or more] modulo 2⁶⁴, oldest first
    missing: NDArray[np.int32]  # [n + 1, 6 or more] running count of missing samples
    unit: Floats  # [6] size of one unit of phase in rad/s and m/s²
    rate_hz: float

    def __len__(self) -> int:
        return len(self.phase) - 1

    def values(self) -> Floats:
        """Return the samples [n, 6] in rad/s and m/s², identical at every call; NaN means missing."""
        columns, rng = [], np.random.default_rng(0)
        for axis in range(len(AXES)):
            units = np.diff(self.phase[:, axis]).astype(np.float64)
            units[np.diff(self.missing[:, axis]) > 0] = np.nan
            columns.append(_restore(units, float(self.unit[axis]), rng))
        return np.column_stack(columns)


def copy_window(window: AllanWindow, rate_hz: float) -> WindowSnapshot:
    """Return a copy of the current content of a window.

    Parameters
    ----------
    window : AllanWindow
        Window to copy.
    rate_hz : float
        Sample rate in Hz.
    """
    phase, missing, first, unit = window.view_phase_ring()
    end = first + window.samples_in_window + 1
    # The window may continue at the start of the ring buffer.
    rows = [slice(first, min(end, len(phase))), slice(0, max(end - len(phase), 0))]
    return WindowSnapshot(
        np.concatenate([phase[one] for one in rows]), np.concatenate([missing[one] for one in rows]), unit, rate_hz
    )


def _restore(units: Floats, unit: float, rng: np.random.Generator) -> Floats:
    """Restore the values [n] of one axis from integer units of phase, as described in the module docstring.

    >>> rounded = np.array([1000.0, 1001.0, 7.0, np.nan, 999.0])
    >>> _restore(rounded, 1e-6, np.random.default_rng(1)).round(9).tolist()
    [0.001, 0.001, 7e-06, nan, 0.001]
    """
    single = (units * unit).astype(np.float32)
    apart = np.abs(single.astype(np.float64) - units * unit)
    # By chance, one of four other values is this close to a float32 number.
    telling = np.spacing(np.abs(single)) > MIN_GROUP_DISTANCE_UNITS * unit
    if np.count_nonzero(telling) >= MIN_FLOAT32_EVIDENCE and not (apart > MAX_GROUP_UNITS * unit).any():
        return single.astype(np.float64)
    return _merge_groups(units, rng) * unit


def _merge_groups(units: Floats, rng: np.random.Generator) -> Floats:
    """Replace each group by one value, or add uniform random numbers of one unit if there are no groups."""
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
    """Return the levels on a regular grid if a grid fits within the rounding error, otherwise unchanged.

    >>> _snap_to_grid(np.array([1e5, 3.000001e5, 6.0e5])).round(3).tolist()
    [100000.039, 300000.034, 600000.026]
    """
    if levels.size < 2:
        return levels
    shortest = float(np.diff(levels).min())
    for parts in range(1, MAX_GRID_DIVISOR + 1):  # the smallest distance between two levels may be several steps
        count = np.rint((levels - levels[0]) * (parts / shortest))
        step, first = np.polynomial.polynomial.polyfit(count, levels, 1)[::-1]
        even = first + step * count
        if np.abs(even - levels).max() <= MAX_GROUP_UNITS:
            return np.asarray(even)
    return levels


class TemperatureRing:
    """Ring buffer of the newest temperatures of a device, with 4 bytes per sample.

    Parameters
    ----------
    length : int
        Number of samples to keep.

    >>> newest = TemperatureRing(3)
    >>> newest.push(0, np.array([20.0, 21.0]))
    >>> newest.push(1, np.array([22.0]))
    >>> newest.newest_temperatures(3).tolist()
    [21.0, nan, 22.0]
    """

    def __init__(self, length: int) -> None:
        self._ring = np.full(length, np.nan, np.float32)
        self._next = 0

    def push(self, lost: int, temperature_c: Floats) -> None:
        """Append missing samples, then temperatures.

        Parameters
        ----------
        lost : int
            Number of missing samples before ``temperature_c``.
        temperature_c : ndarray of float64, shape (n,)
            Temperatures in °C.
        """
        if lost:
            self._write(np.full(min(lost, self._ring.size), np.nan))
        self._write(temperature_c[-self._ring.size :])

    def newest_temperatures(self, n: int) -> Floats:
        """Return the temperatures of the newest n samples in °C, oldest first; NaN means not measured."""
        return self._ring[(self._next - np.arange(n, 0, -1)) % self._ring.size].astype(np.float64)

    def _write(self, temperature_c: Floats) -> None:
        """Write temperatures to the ring buffer, and continue at the start after the end."""
        before = min(self._ring.size - self._next, len(temperature_c))  # samples that fit before the end of the ring
        self._ring[self._next : self._next + before] = temperature_c[:before]
        self._ring[: len(temperature_c) - before] = temperature_c[before:]
        self._next = (self._next + len(temperature_c)) % self._ring.size
