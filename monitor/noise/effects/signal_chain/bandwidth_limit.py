"""Low-pass filter of the sensor."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from drivers.data_types import Floats
from monitor.common.compiled import compiled
from monitor.noise.effect import RunningTransform, Transform, parameter_field
from monitor.noise.spectrum import Spectrum


@dataclass(frozen=True, slots=True)
class BandwidthLimit(Transform):
    """Digital Butterworth low-pass filter of order n (Butterworth, "On the theory of filter amplifiers", 1930).

    The power response is |H|² = 1/(1 + (tan(πfτ0)/tan(πf_cτ0))^(2n)). The filter starts in the steady state of the
    first sample, so gravity causes no transient.

    >>> from monitor.noise.spectrum import white_noise_spectrum
    >>> filtered = BandwidthLimit(cutoff=10.0, order=2).transform_spectrum(white_noise_spectrum(1.0, 0.01))
    >>> print(f"{filtered.density(np.array([10.0]))[0]:.6g}")
    0.005
    """

    cutoff: float = parameter_field("Hz", positive=True, below_nyquist=True)
    order: int = parameter_field("1", positive=True, whole_number=True, maximum=8)

    description: ClassVar[str] = "The low-pass filter of the sensor attenuates fast motion and high-frequency noise."

    def transform_spectrum(self, spectrum: Spectrum) -> Spectrum:
        """Return the spectrum after the filter."""
        tau0_s = spectrum.tau0_s
        corner = np.tan(np.pi * self.cutoff * tau0_s)

        def squared_response(f_hz: Floats) -> Floats:
            # At half the sample rate, the power of the tangent overflows to infinity, and the response is zero.
            with np.errstate(over="ignore"):
                return np.asarray(1.0 / (1.0 + (np.tan(np.pi * f_hz * tau0_s) / corner) ** (2 * int(self.order))))

        return spectrum.filtered_by(squared_response)

    def start_transform(self, rate_hz: float, rng: np.random.Generator) -> "_LowPass":
        """Start the filter in the steady state of the first sample."""
        return _LowPass(butterworth_sections(int(self.order), self.cutoff, rate_hz))


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


class _LowPass(RunningTransform):
    def __init__(self, sections: Floats) -> None:
        self._sections = sections
        self._state: Floats | None = None

    def transform_in_place(self, values: Floats) -> None:
        if self._state is None:
            b0, _, b2, _, a2 = self._sections.T
            self._state = np.stack([1.0 - b0, b2 - a2], axis=1) * values[0]
        filtered = np.ascontiguousarray(values)
        _filter_sections(filtered, self._sections, self._state)
        values[:] = filtered


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
