"""Random steps of the bias."""

from dataclasses import dataclass
from itertools import pairwise
from typing import ClassVar

import numpy as np

from drivers.data_types import Floats
from monitor.noise.effect import RunningSource, SampleBlockContext, Source, parameter_field
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

    def start_series(self, rate_hz: float, rng: np.random.Generator) -> RunningSource:
        """Start a series at zero."""
        gap, level = 1.0 / (self.rate / rate_hz) if self.rate > 0.0 else np.inf, 0.0
        events = RandomEvents(
            lambda n: rng.exponential(gap, n), lambda n: self.height * rng.standard_normal(n), rate_hz
        )

        def add_steps(values: Floats, block: SampleBlockContext) -> None:
            nonlocal level
            when, heights = events.take_block_events(block.first, values.size)
            edges = [0, *when.tolist(), values.size]
            for jump, (begin, end) in zip([0.0, *heights.tolist()], pairwise(edges), strict=True):
                level += jump
                values[begin:end] += level

        return RunningSource(add_steps, lambda: events.drawn_random_values("heights"))
