"""Random repetition of samples."""

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from drivers.data_types import Floats
from monitor.noise.effect import RunningTransform, Transform, parameter_field
from monitor.noise.spectrum import Spectrum


@dataclass(frozen=True, slots=True)
class RandomSampleHold(Transform):
    """Random repetition of samples. Each sample repeats the previous output with probability h.

    On average, the output equals the input after the filter G = (1 − h)/(1 − h/z). The remainder is noise with a
    correlation that decays as hⁿ. The power spectral density is S_out(f) = |G|² S + V τ0 (1 − h²)/|1 − h/z|², where V
    is the mean square of (1 − |G|²) S. The formula is exact for all inputs with stationary increments.

    >>> from monitor.noise.spectrum import white_noise_spectrum
    >>> held = RandomSampleHold(fraction=0.5).transform_spectrum(white_noise_spectrum(1.0, 0.01))
    >>> print(f"{held.avar(np.array([0.01]))[0]:.3f}")  # 1 − h for white noise
    0.500
    """

    fraction: float = parameter_field("1", maximum=0.999)

    description: ClassVar[str] = "Some samples repeat the previous value."

    def transform_spectrum(self, spectrum: Spectrum) -> Spectrum:
        """Return the spectrum after the repetition of samples."""
        h, tau0_s = self.fraction, spectrum.tau0_s

        def squared_denominator(f_hz: Floats) -> Floats:
            return np.asarray((1.0 - h) ** 2 + 4.0 * h * np.sin(np.pi * f_hz * tau0_s) ** 2)  # |1 − h/z|²

        def squared_response(f_hz: Floats) -> Floats:
            return (1.0 - h) ** 2 / squared_denominator(f_hz)

        lowest = 1e-7 / tau0_s
        # 1 − |G|² = 4h sin²(πfτ0)/|1 − h/z|² avoids cancellation at low frequencies.
        lost = (
            spectrum.mean_square(lowest, lambda f: 4.0 * h * np.sin(np.pi * f * tau0_s) ** 2 / squared_denominator(f))
            + spectrum.slope**2 * tau0_s**2 * h / (1.0 - h) ** 2
        )
        rest = Spectrum(lambda f: lost * tau0_s * (1.0 - h**2) / squared_denominator(f), None, tau0_s)
        return spectrum.filtered_by(squared_response, narrow_peaks=((0.0, (1.0 - h) / (2.0 * np.pi * tau0_s)),)) + rest

    def start_transform(self, rate_hz: float, rng: np.random.Generator) -> RunningTransform:
        """Start the repetition of samples. The first sample is never a repetition."""
        repetition = _SampleRepetition(self.fraction, rng)
        return RunningTransform(repetition.transform_in_place, repetition.drawn_random_values)


class _SampleRepetition:
    def __init__(self, fraction: float, rng: np.random.Generator) -> None:
        self._fraction = fraction
        self._rng = rng
        self._last = np.nan
        self._repeat_count = 0

    def transform_in_place(self, values: Floats) -> None:
        repeats = self._rng.random(values.size) < self._fraction
        if np.isnan(self._last):
            repeats[0] = False
        candidates = np.concatenate([[self._last], values])
        sources = np.where(repeats, 0, np.arange(1, candidates.size))
        values[:] = candidates[np.maximum.accumulate(sources)]
        self._last = float(values[-1])
        self._repeat_count += int(repeats.sum())

    def drawn_random_values(self) -> dict[str, Any]:
        return {"count": self._repeat_count}
