"""The samples that a live window holds, taken out of it again: for work that wants a recording.

The window keeps phase, not samples, so that no second copy of an hour has to be held: a sample is the difference of two
phases, exact but for the rounding to a unit of phase (1e-11 rad/s and m/s² for an hour at 100 Hz), which the phase
carries on from sample to sample. Whoever asks for levels and repeats must not see those of this rounding, but the
sensor's own, which are a million times larger. So where the values of an axis stand in groups, closer than NEAR units
within and further than FAR apart, each group becomes one value again, and these lie on a grid if they may; where they
do not, they had no steps, and what the rounding took is filled up with as much at random. Where all may have been
float32, they are.

A missing sample comes back as NaN in its place, as does what the window was told to forget.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from drivers.sample import AXES, Floats, Ints
from monitor.estimation.allan.window import AllanWindow

NEAR: Final = 2.0
"""Units of phase: each sample is off by one at most, either way."""
FAR: Final = 16.0
TELLING: Final = 20
DIVISORS: Final = 6


@dataclass(frozen=True, slots=True)
class Held:
    """A copy of what a window held at one moment, quick to make; ``values`` takes its time."""

    phase: Ints  # [n + 1, 6 or more] modulo 2⁶⁴, oldest first
    missing: NDArray[np.int32]  # alike: how many samples were missing up to each
    unit: Floats  # [6] rad/s and m/s² in one unit of phase
    rate_hz: float

    def __len__(self) -> int:
        return len(self.phase) - 1

    def values(self) -> Floats:
        """The samples [n, 6] in rad/s and m/s², the same at every call; NaN = missing."""
        columns, rng = [], np.random.default_rng(0)
        for axis in range(len(AXES)):
            units = np.diff(self.phase[:, axis]).astype(np.float64)
            units[np.diff(self.missing[:, axis]) > 0] = np.nan
            columns.append(_as_given(units, float(self.unit[axis]), rng))
        return np.column_stack(columns)


def held(window: AllanWindow, rate_hz: float) -> Held:
    """What the window holds now."""
    phase, missing, first, unit = window.ring()
    end = first + window.n + 1
    # the ring's end may lie between
    rows = [slice(first, min(end, len(phase))), slice(0, max(end - len(phase), 0))]
    return Held(
        np.concatenate([phase[one] for one in rows]), np.concatenate([missing[one] for one in rows]), unit, rate_hz
    )


def _as_given(units: Floats, unit: float, rng: np.random.Generator) -> Floats:
    """Rounded values [n] as they may have been: equal where a sensor has steps, on no grid where it has none.

    >>> rounded = np.array([1000.0, 1001.0, 7.0, np.nan, 999.0])
    >>> _as_given(rounded, 1e-6, np.random.default_rng(1)).round(9).tolist()
    [0.001, 0.001, 7e-06, nan, 0.001]
    """
    single = (units * unit).astype(np.float32)
    apart = np.abs(single.astype(np.float64) - units * unit)
    telling = np.spacing(np.abs(single)) > FAR * unit  # chance is as near to a float32 in one of four such
    if np.count_nonzero(telling) >= TELLING and not (apart > NEAR * unit).any():
        return single.astype(np.float64)
    return _apart(units, rng) * unit


def _apart(units: Floats, rng: np.random.Generator) -> Floats:
    """Groups as one value each, all else with what the rounding took."""
    known = np.flatnonzero(~np.isnan(units))
    order = known[np.argsort(units[known], kind="stable")]
    ordered = units[order]
    apart = np.diff(ordered, prepend=-np.inf)
    result = units.copy()
    if (apart[apart > NEAR] > FAR).all():
        level = np.cumsum(apart > NEAR) - 1
        result[order] = _even(np.bincount(level, ordered) / np.bincount(level))[level]
    else:
        result[known] += rng.random(known.size) - 0.5
    return result


def _even(levels: Floats) -> Floats:
    """Levels that lie on one grid, but for their rounding, exactly on it; others as they are.

    >>> _even(np.array([1e5, 3.000001e5, 6.0e5])).round(3).tolist()
    [100000.039, 300000.034, 600000.026]
    """
    if levels.size < 2:
        return levels
    shortest = float(np.diff(levels).min())
    for parts in range(1, DIVISORS + 1):  # the shortest way between two levels may be more than a step
        count = np.rint((levels - levels[0]) * (parts / shortest))
        step, first = np.polynomial.polynomial.polyfit(count, levels, 1)[::-1]
        even = first + step * count
        if np.abs(even - levels).max() <= NEAR:
            return np.asarray(even)
    return levels


class Temperatures:
    """The newest temperatures of a device, 4 bytes a sample, beside the window that holds its axes.

    >>> newest = Temperatures(3)
    >>> newest.push(0, np.array([20.0, 21.0]))
    >>> newest.push(1, np.array([22.0]))
    >>> newest.newest(3).tolist()
    [21.0, nan, 22.0]
    """

    def __init__(self, length: int) -> None:
        self._ring = np.full(length, np.nan, np.float32)
        self._next = 0

    def push(self, lost: int, temperature_c: Floats) -> None:
        """So many missing samples, then these [n] in °C."""
        if lost:
            self._write(np.full(min(lost, self._ring.size), np.nan))
        self._write(temperature_c[-self._ring.size :])

    def newest(self, n: int) -> Floats:
        """Of the newest n samples, oldest first; NaN = not measured."""
        return self._ring[(self._next - np.arange(n, 0, -1)) % self._ring.size].astype(np.float64)

    def _write(self, temperature_c: Floats) -> None:
        before = min(self._ring.size - self._next, len(temperature_c))  # the ring's end
        self._ring[self._next : self._next + before] = temperature_c[:before]
        self._ring[: len(temperature_c) - before] = temperature_c[before:]
        self._next = (self._next + len(temperature_c)) % self._ring.size
