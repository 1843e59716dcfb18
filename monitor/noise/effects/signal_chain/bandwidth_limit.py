"""Low-pass filter of the sensor, and the white noise that is added after the filter."""

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from math import floor, pi, sin
from typing import ClassVar, Final

import numpy as np

from drivers.data_types import Floats
from monitor.common.compiled import compiled
from monitor.noise.effect import RunningTransform, Transform, choice_field, parameter_field
from monitor.noise.spectrum import Spectrum, white_noise_spectrum

FILTER_KINDS: Final = ("butterworth", "iir", "fir")
"""Kinds of low-pass filters. The first kind is the default."""
LENGTH_ITERATIONS: Final = 60
"""Number of bisections for the length of a moving average."""
MAX_CACHED_LENGTHS: Final = 4096


@dataclass(frozen=True, slots=True)
class BandwidthLimit(Transform):
    """Digital low-pass filter of order n with half power at the cutoff frequency f_c, followed by white noise.

    The power responses are |H|² = 1/(1 + (tan(πfτ0)/tan(πf_cτ0))^(2n)) of a Butterworth filter (Butterworth, "On the
    theory of filter amplifiers", 1930), |H|² = (a²/(a² + 4(1 − a) sin²(πfτ0)))ⁿ of n exponential averages y ← y + a(x −
    y), and |H|² = |D(f)|^(2n) of n moving averages (Oppenheim & Schafer, "Discrete-Time Signal Processing"). The
    smoothing factor a and the length of the moving averages follow from the cutoff frequency. A decimator averages its
    samples in the same way. The filter starts in the steady state for the first sample, so gravity causes no transient.

    >>> from monitor.noise.spectrum import white_noise_spectrum
    >>> filtered = BandwidthLimit(cutoff=10.0, order=2).transform_spectrum(white_noise_spectrum(1.0, 0.01))
    >>> print(f"{filtered.density(np.array([10.0]))[0]:.6g}")
    0.005
    """

    cutoff: float = parameter_field("Hz", positive=True, below_nyquist=True)
    order: int | None = parameter_field("1", positive=True, whole_number=True, maximum=8, optional=True)
    floor: float | None = parameter_field("rad/√s", "m/s/√s", optional=True)
    kind: str | None = choice_field(*FILTER_KINDS)

    precedes_leaks: ClassVar[bool] = True  # the measurements of other axes are already filtered
    description: ClassVar[str] = "The low-pass filter of the sensor attenuates fast motion and high-frequency noise."

    @property
    def stages(self) -> int:
        """Order of the filter, 1 if the order is absent."""
        return int(self.order or 1)

    def transform_spectrum(self, spectrum: Spectrum) -> Spectrum:
        """Return the filtered spectrum plus the white noise that is added after the filter."""
        filtered = spectrum.filtered_by(self._squared_response(spectrum.tau0_s))
        if not self.floor:
            return filtered
        return filtered + white_noise_spectrum(self.floor**2 / spectrum.tau0_s, spectrum.tau0_s)

    def _squared_response(self, tau0_s: float) -> Callable[[Floats], Floats]:
        """Return the squared magnitude response as a function of frequency in Hz."""
        cycles, n = self.cutoff * tau0_s, self.stages
        if self.kind == "iir":
            a = smoothing_factor(n, cycles)
            return lambda f_hz: np.asarray((1.0 + 4.0 * (1.0 - a) * (np.sin(pi * f_hz * tau0_s) / a) ** 2) ** -n)
        if self.kind == "fir":
            length = moving_average_length(n, cycles)
            return lambda f_hz: np.asarray(moving_average_power(length, f_hz * tau0_s) ** n)

        def butterworth(f_hz: Floats) -> Floats:
            # At half the sample rate, the power of the tangent overflows to infinity, and the response is zero.
            with np.errstate(over="ignore"):
                return np.asarray(1.0 / (1.0 + (np.tan(pi * f_hz * tau0_s) / np.tan(pi * cycles)) ** (2 * n)))

        return butterworth

    def start_transform(self, rate_hz: float, rng: np.random.Generator) -> RunningTransform:
        """Start the filter in the steady state for the first sample."""
        noise = (self.floor or 0.0) * rate_hz**0.5
        if self.kind == "fir":
            length = moving_average_length(self.stages, self.cutoff / rate_hz)
            return RunningTransform(_MovingAverages(self.stages, length, noise, rng).transform_in_place)
        sections = butterworth_sections(self.stages, self.cutoff, rate_hz)
        if self.kind == "iir":
            a = smoothing_factor(self.stages, self.cutoff / rate_hz)
            sections = np.array([[a, 0.0, 0.0, a - 1.0, 0.0]] * self.stages)
        return RunningTransform(_RecursiveFilter(sections, noise, rng).transform_in_place)


def smoothing_factor(order: int, cutoff_cycles: float) -> float:
    """Return the smoothing factor a of a chain of exponential averages y ← y + a(x − y).

    Parameters
    ----------
    order : int
        Number of averages.
    cutoff_cycles : float
        Half-power frequency of the whole chain, as a fraction of the sample rate.

    Examples
    --------
    >>> a = smoothing_factor(2, 0.1)
    >>> print(f"{(a**2 / (a**2 + 4 * (1 - a) * sin(0.1 * pi) ** 2)) ** 2:.6f}")
    0.500000
    """
    gain = 0.5 ** (1.0 / order)
    c = 4.0 * sin(pi * cutoff_cycles) ** 2 * gain / (1.0 - gain)
    return float(2.0 * c / (c + (c * c + 4.0 * c) ** 0.5))


def moving_average_power(length: float, cycles: Floats | float) -> Floats:
    """Return the squared magnitude response of a moving average.

    Parameters
    ----------
    length : float
        Length in samples, at least 1. The fractional part is the weight of the oldest sample.
    cycles : float or ndarray of float64
        Frequency as a fraction of the sample rate.

    Examples
    --------
    >>> print(f"{moving_average_power(2.5, 0.0):.3f} {moving_average_power(2.0, 0.5):.3f}")
    1.000 0.000
    """
    whole = floor(length)
    turn = np.exp(-2j * pi * np.asarray(cycles))
    with np.errstate(invalid="ignore", divide="ignore"):
        total = np.where(turn == 1.0, whole, (1.0 - turn**whole) / (1.0 - turn)) + (length - whole) * turn**whole
    return np.asarray(np.abs(total / length) ** 2)


@lru_cache(MAX_CACHED_LENGTHS)
def moving_average_length(order: int, cutoff_cycles: float) -> float:
    """Return the length in samples of a chain of equal moving averages, by bisection.

    Parameters
    ----------
    order : int
        Number of averages.
    cutoff_cycles : float
        Half-power frequency of the whole chain, as a fraction of the sample rate.

    Examples
    --------
    >>> print(f"{moving_average_length(1, 0.25):.3f}")
    2.000
    """
    gain = 0.5 ** (1.0 / order)
    lo, hi = 1.0, 1.0 + 0.5 / cutoff_cycles  # the continuous moving average has a length of 0.443/f_c
    for _ in range(LENGTH_ITERATIONS):
        middle = 0.5 * (lo + hi)
        lo, hi = (middle, hi) if moving_average_power(middle, cutoff_cycles) > gain else (lo, middle)
    return hi


def butterworth_sections(order: int, cutoff_hz: float, rate_hz: float) -> Floats:
    """Return the second-order sections of a digital Butterworth low-pass filter with unit gain at f = 0.

    Each pair of poles at angles ±θ from the negative real axis gives a section s² + 2 cos θ s + 1. A filter of odd
    order has an additional section s + 1. The bilinear transform is s = (1 − z⁻¹)/(1 + z⁻¹) / tan(πf_c/f_s).

    Parameters
    ----------
    order : int
        Order of the filter.
    cutoff_hz : float
        Cutoff frequency (half power), Hz.
    rate_hz : float
        Sample rate, Hz.

    Returns
    -------
    ndarray, shape (n, 5)
        Coefficients b0, b1, b2, a1, a2 of each section.

    Examples
    --------
    >>> butterworth_sections(1, 25.0, 100.0).round(9).tolist()
    [[0.5, 0.5, 0.0, -0.0, 0.0]]
    """
    w = np.tan(np.pi * cutoff_hz / rate_hz)
    sections = [[w / (1.0 + w), w / (1.0 + w), 0.0, (w - 1.0) / (w + 1.0), 0.0]] if order % 2 else []
    for pair in range(order // 2):
        damping = 2.0 * np.sin(np.pi * (2 * pair + 1) / (2 * order))
        whole = 1.0 + damping * w + w * w
        gain = w * w / whole
        sections.append([gain, 2.0 * gain, gain, 2.0 * (w * w - 1.0) / whole, (1.0 - damping * w + w * w) / whole])
    return np.array(sections)


class _LowPass(ABC):
    """Filter followed by white noise of a given standard deviation."""

    def __init__(self, noise: float, rng: np.random.Generator) -> None:
        self._noise, self._rng = noise, rng

    def transform_in_place(self, values: Floats) -> None:
        filtered = np.ascontiguousarray(values)
        self._filter(filtered)
        if self._noise:
            filtered += self._noise * self._rng.standard_normal(filtered.size)
        values[:] = filtered

    @abstractmethod
    def _filter(self, values: Floats) -> None:
        """Filter the next samples [n] in place."""


class _RecursiveFilter(_LowPass):
    def __init__(self, sections: Floats, noise: float, rng: np.random.Generator) -> None:
        super().__init__(noise, rng)
        self._sections = sections
        self._state: Floats | None = None

    def _filter(self, values: Floats) -> None:
        if self._state is None:
            b0, _, b2, _, a2 = self._sections.T
            self._state = np.stack([1.0 - b0, b2 - a2], axis=1) * values[0]
        _filter_sections(values, self._sections, self._state)


class _MovingAverages(_LowPass):
    def __init__(self, order: int, length: float, noise: float, rng: np.random.Generator) -> None:
        super().__init__(noise, rng)
        self._length = length
        self._past = np.zeros((order, floor(length) + 1))  # last inputs of each average, relative to the first sample
        self._sums = np.zeros(order)  # of the whole samples
        self._newest = 0
        self._first: float | None = None

    def _filter(self, values: Floats) -> None:
        if self._first is None:
            self._first = float(values[0])
        values -= self._first
        self._newest = _average(values, self._past, self._sums, self._newest, self._length)
        values += self._first


@compiled
def _filter_sections(values: Floats, sections: Floats, state: Floats) -> None:
    """Filter values [n] in place (direct form II transposed). The state [sections, 2] is updated."""
    for i in range(sections.shape[0]):
        b0, b1, b2, a1, a2 = sections[i]
        one, two = state[i]
        for k in range(values.size):
            x = values[k]
            y = b0 * x + one
            one = b1 * x - a1 * y + two
            two = b2 * x - a2 * y
            values[k] = y
        state[i, 0], state[i, 1] = one, two


@compiled
def _average(values: Floats, past: Floats, sums: Floats, newest: int, length: float) -> int:
    """Average values [n] in place. The past inputs [order, m + 1] and the sums [order] are updated."""
    slots = past.shape[1]
    weight = length - (slots - 1)
    for k in range(values.size):
        newest = (newest + 1) % slots
        oldest = (newest + 1) % slots
        x = values[k]
        for i in range(sums.size):
            past[i, newest] = x
            sums[i] += x - past[i, oldest]
            x = (sums[i] + weight * past[i, oldest]) / length
        values[k] = x
    return newest
