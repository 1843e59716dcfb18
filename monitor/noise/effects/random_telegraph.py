"""Random telegraph noise (popcorn noise)."""

from dataclasses import dataclass
from itertools import pairwise
from typing import Any, ClassVar

import numpy as np

from drivers.sample import Floats
from monitor.noise import gauss_markov
from monitor.noise.effect import NoiseSeries, SampleBlockContext, Source, check_event_rate, parameter
from monitor.noise.random_events import RandomEvents


@dataclass(frozen=True, slots=True)
class RandomTelegraph(Source):
    """Random switching between two levels ±a/2, with exponential dwell times of mean T: switches at the rate λ = 1/T.

    The autocovariance is (a²/4) exp(−2λ|t|) (Machlup, "Noise in semiconductors: spectrum of a two-parameter random
    signal", 1954). The second moments equal those of exponentially correlated noise with σ = a/2 and T_c = T/2.

    >>> popcorn = RandomTelegraph(amplitude=2.0, dwell_time=20.0)
    >>> print(f"{popcorn.avar(np.array([18.9]), 1e-3)[0]:.3f}")
    0.381
    """

    amplitude: float = parameter("rad/s", "m/s²")
    dwell_time: float = parameter("s", "s", positive=True)

    name: ClassVar[str] = "random_telegraph"
    description: ClassVar[str] = "The bias jumps between two levels at random times, like popcorn."

    def avar(self, tau_s: Floats, tau0_s: float) -> Floats:
        """Return the Allan variance of exponentially correlated noise with σ = a/2, T_c = T/2."""
        return gauss_markov.avar(0.5 * self.amplitude, 2.0 / self.dwell_time, tau_s, tau0_s)

    def psd(self, f_hz: Floats, tau0_s: float) -> Floats:
        """Return the spectrum of exponentially correlated noise with σ = a/2, T_c = T/2."""
        return gauss_markov.psd(0.5 * self.amplitude, 2.0 / self.dwell_time, f_hz, tau0_s)

    def check_rate(self, rate_hz: float) -> None:
        """Raise ConfigError if the switches are too frequent for a simulation."""
        check_event_rate(self, 1.0 / self.dwell_time, rate_hz)

    def start(self, rate_hz: float, rng: np.random.Generator) -> "_TwoLevels":
        """Return a stationary series.

        It starts at a random level. The remaining first dwell time has the same distribution as a whole one.
        """
        return _TwoLevels(0.5 * self.amplitude, self.dwell_time * rate_hz, rate_hz, rng)


class _TwoLevels(NoiseSeries):
    """Series that switches between two levels."""

    def __init__(self, level: float, dwell: float, rate_hz: float, rng: np.random.Generator) -> None:
        self._level = level if rng.random() < 0.5 else -level
        self._first_level = self._level
        self._flips = RandomEvents(lambda n: rng.exponential(dwell, n), np.zeros, rate_hz)

    def add(self, values: Floats, block: SampleBlockContext) -> None:
        when, _ = self._flips.take(block.first, values.size)
        edges = [0, *when.tolist(), values.size]
        for begin, end in pairwise(edges):
            values[begin:end] += self._level
            self._level = -self._level
        self._level = -self._level  # The loop also switches at the end of a block, which is no event.

    def truth(self) -> dict[str, Any]:
        return {"first_level": self._first_level, **self._flips.truth()}
