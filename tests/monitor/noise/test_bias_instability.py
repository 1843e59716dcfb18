"""The 1/f filter against 1/f itself."""

import numpy as np
import pytest

from monitor.noise.effects import bias_instability
from monitor.noise.effects.bias_instability import BiasInstability


def response(frequency: np.ndarray) -> np.ndarray:
    """Squared response of the running filter at frequencies in units of the sample rate."""
    flicker = bias_instability._Flicker(1.0, np.random.default_rng(0))
    z = np.exp(-2j * np.pi * frequency)[:, None]
    return np.abs(flicker._direct + (flicker._residues / (1.0 - flicker._poles * z)).sum(1)) ** 2


def test_filter_is_one_over_f_within_a_thousandth_over_eight_decades():
    frequency = np.concatenate([np.geomspace(1e-8, 0.5, 4000), 0.5 - np.geomspace(1e-7, 0.1, 500)])
    assert np.abs(response(frequency) * 2.0 * np.pi * frequency - 1.0).max() < 1e-3


def test_first_seconds_are_as_noisy_as_later_ones():
    # started at zero instead of its stationary state, the first clusters of 256 would lack a third of σ²
    def cluster_variance(skip: int) -> float:
        rng = np.random.default_rng(2)
        total = 0.0
        for _ in range(3000):
            series = bias_instability._Flicker(1.0, rng)
            series.draw(skip)
            first, second = series.draw(512).reshape(2, 256).mean(1)
            total += 0.5 * (second - first) ** 2
        return total / 3000

    # χ² of 3000 degrees of freedom: 2.6 %
    expected = 2.0 * np.log(2.0) / np.pi
    assert cluster_variance(0) == pytest.approx(expected, rel=0.1)
    assert cluster_variance(2000) == pytest.approx(expected, rel=0.1)


def test_sampled_allan_variance_joins_the_continuous_one():
    tau = np.array([1.0, 127.0, 128.0, 129.0, 1e6])
    avar = BiasInstability(B=1.0).avar(tau, 1.0)
    # m = 1: Cin(π)/π, the integral of sin²u/u, Abramowitz & Stegun 5.2.2
    assert avar[0] == pytest.approx(1.6483 / np.pi, rel=1e-4)
    np.testing.assert_allclose(avar[1:], 2.0 * np.log(2.0) / np.pi, rtol=2e-4)
