"""Slow random variation of the white noise variance."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from drivers.data_types import Floats
from monitor.noise.effect import RunningGain, WhiteNoiseGain, parameter_field
from monitor.noise.effects.ieee952.exponentially_correlated import add_recursion


@dataclass(frozen=True, slots=True)
class WanderingVariance(WhiteNoiseGain):
    """Random variation of the white noise variance: N² becomes N² exp(x(t) − s²/2).

    The logarithm x of the variance is first-order Gauss–Markov noise with the standard deviation s and a correlation
    time. This is the log-normal model of stochastic volatility (Taylor, "Modelling Financial Time Series", 1986). The
    mean variance is N², so Allan variance and spectrum are unchanged on average.

    >>> rng = np.random.default_rng(0)
    >>> gain = WanderingVariance(deviation=0.5, correlation_time=2.0).start_gain(1.0, rng).compute_gain(0, 100_000)
    >>> print(f"{np.mean(gain**2):.2f} {np.std(np.log(gain**2)):.2f}")
    1.00 0.50
    """

    deviation: float = parameter_field("1", maximum=3.0)
    correlation_time: float = parameter_field("s", positive=True)

    description: ClassVar[str] = "The variance of the white noise varies randomly."

    def start_gain(self, rate_hz: float, rng: np.random.Generator) -> RunningGain:
        """Start a gain whose variance is in its stationary state."""
        step = 1.0 / (self.correlation_time * rate_hz)
        decay, drive = float(np.exp(-step)), self.deviation * float(np.sqrt(-np.expm1(-2.0 * step)))
        state = self.deviation * float(rng.standard_normal())

        def compute_gain(first: int, n: int) -> Floats:
            nonlocal state
            log_variance = np.full(n, -0.5 * self.deviation**2)
            state = add_recursion(log_variance, rng.standard_normal(n), decay, drive, state)
            return np.asarray(np.exp(0.5 * log_variance))

        return RunningGain(compute_gain)
