"""Random telegraph noise (popcorn noise)."""

from dataclasses import dataclass
from itertools import pairwise
from typing import ClassVar

import numpy as np

from drivers.data_types import Floats
from monitor.noise.effect import RunningSource, SampleBlockContext, Source, parameter_field
from monitor.noise.gauss_markov_avar_and_spectrum import gauss_markov_spectrum
from monitor.noise.random_events import RandomEvents
from monitor.noise.spectrum import Spectrum


@dataclass(frozen=True, slots=True)
class RandomTelegraph(Source):
    """Random switching between the two levels ±a/2, with exponentially distributed dwell times of mean T.

    The autocovariance is (a²/4) exp(−2|t|/T) (Machlup, "Noise in semiconductors: spectrum of a two-parameter random
    signal", 1954). The spectrum equals the spectrum of exponentially correlated noise with σ = a/2 and T_c = T/2.

    >>> popcorn = RandomTelegraph(amplitude=2.0, dwell_time=20.0)
    >>> print(f"{popcorn.avar(np.array([18.9]), 1e-3)[0]:.3f}")
    0.381
    """

    amplitude: float = parameter_field("rad/s", "m/s²")
    dwell_time: float = parameter_field("s", positive=True)

    description: ClassVar[str] = "The bias jumps between two levels at random times (popcorn noise)."

    @property
    def events_hz(self) -> float:
        """Mean number of level changes per second."""
        return 1.0 / self.dwell_time

    def spectrum(self, tau0_s: float) -> Spectrum:
        """Return the spectrum of exponentially correlated noise with σ = a/2 and T_c = T/2."""
        return gauss_markov_spectrum(0.5 * self.amplitude, 2.0 / self.dwell_time, tau0_s)

    def start_series(self, rate_hz: float, rng: np.random.Generator) -> RunningSource:
        """Start a series that begins at one of the two levels, chosen at random."""
        first_level = 0.5 * self.amplitude if rng.random() < 0.5 else -0.5 * self.amplitude
        flips = RandomEvents(lambda n: rng.exponential(self.dwell_time * rate_hz, n), np.zeros, rate_hz)
        level = first_level

        def add_levels(values: Floats, block: SampleBlockContext) -> None:
            nonlocal level
            when, _ = flips.take_block_events(block.first, values.size)
            edges = [0, *when.tolist(), values.size]
            for begin, end in pairwise(edges):
                values[begin:end] += level
                level = -level
            level = -level  # undo the level change at the end of the block

        return RunningSource(add_levels, lambda: {"first_level": first_level, **flips.drawn_random_values()})
