"""Random steps of the bias."""

from dataclasses import dataclass
from itertools import pairwise
from typing import Any, ClassVar

import numpy as np

from drivers.data_types import Floats
from monitor.noise.effect import NoiseSeries, SampleBlockContext, Source, parameter_field
from monitor.noise.effects.ieee952.rate_random_walk import RateRandomWalk
from monitor.noise.random_events import RandomEvents
from monitor.noise.spectrum import Spectrum


@dataclass(frozen=True, slots=True)
class PoissonSteps(Source):
    """Compound Poisson process with λ Gaussian steps per second (Cox & Miller, Theory of Stochastic Processes).

    The spectrum equals the spectrum of rate random walk with K² = λh².

    >>> jumps = PoissonSteps(rate=0.01, height=1e-4)
    >>> print(f"{jumps.avar(np.array([300.0]), 0.01)[0]:.6g}")
    1e-08
    """

    rate: float = parameter_field("1/s")
    height: float = parameter_field("rad/s", "m/s²")

    description: ClassVar[str] = "The bias jumps at random times and keeps each new value."

    @property
    def events_hz(self) -> float:
        """Mean number of steps per second."""
        return self.rate

    def spectrum(self, tau0_s: float) -> Spectrum:
        """Return the spectrum of rate random walk with K² = λh²."""
        return RateRandomWalk(K=self.rate**0.5 * self.height).spectrum(tau0_s)

    def start_series(self, rate_hz: float, rng: np.random.Generator) -> "_RandomSteps":
        """Start a series at zero."""
        return _RandomSteps(self.rate / rate_hz, self.height, rate_hz, rng)


class _RandomSteps(NoiseSeries):
    def __init__(self, rate: float, height: float, rate_hz: float, rng: np.random.Generator) -> None:
        gap = 1.0 / rate if rate > 0.0 else np.inf
        self._events = RandomEvents(
            lambda n: rng.exponential(gap, n), lambda n: height * rng.standard_normal(n), rate_hz
        )
        self._level = 0.0

    def add_next_samples(self, values: Floats, block: SampleBlockContext) -> None:
        when, heights = self._events.take_block_events(block.first, values.size)
        edges = [0, *when.tolist(), values.size]
        for jump, (begin, end) in zip([0.0, *heights.tolist()], pairwise(edges), strict=True):
            self._level += jump
            values[begin:end] += self._level

    def drawn_random_values(self) -> dict[str, Any]:
        return self._events.drawn_random_values("heights")
