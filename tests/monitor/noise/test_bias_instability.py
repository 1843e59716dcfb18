"""Tests of the 1/f noise filter against the 1/f spectrum."""

import allantools
import numpy as np
import pytest

from monitor.noise.effects.ieee952 import bias_instability
from monitor.noise.effects.ieee952.bias_instability import BiasInstability
from tests.support.noise_series import draw_next_samples
from tests.support.recordings import recordings


def compute_squared_response(frequency: np.ndarray) -> np.ndarray:
    """Return the squared response of the filter at frequencies in units of the sample rate."""
    gain = (bias_instability.RESPONSE_CONSTANT / (2.0 * np.pi)) ** 0.5
    direct, poles, residues = bias_instability._partial_fractions(gain)
    z = np.exp(-2j * np.pi * frequency)[:, None]
    return np.abs(direct + (residues / (1.0 - poles * z)).sum(1)) ** 2


def test_filter_is_one_over_f_within_a_thousandth_over_eight_decades():
    frequency = np.concatenate([np.geomspace(1e-8, 0.5, 4000), 0.5 - np.geomspace(1e-7, 0.1, 500)])
    assert np.abs(compute_squared_response(frequency) * 2.0 * np.pi * frequency - 1.0).max() < 1e-3


def test_first_sample_is_as_noisy_as_later_ones():
    # A filter that started at zero would be near zero first and then move away.
    def deviation_after(skip: int) -> float:
        rng = np.random.default_rng(2)
        series = [BiasInstability(B=1.0).start_series(1.0, rng) for _ in range(3000)]
        return float(np.std([draw_next_samples(noise, skip + 1)[-1] for noise in series]))

    # The bound is two standard deviations of 3000 values each, 1.8 % of their ratio.
    assert deviation_after(0) == pytest.approx(deviation_after(2000), rel=0.08)


def test_sampled_allan_variance_joins_the_continuous_one():
    tau = np.array([1.0, 127.0, 128.0, 129.0, 1e6])
    avar = BiasInstability(B=1.0).avar(tau, 1.0)
    # For m = 1 the value is Cin(π)/π, the integral of sin²u/u (Abramowitz & Stegun 5.2.2).
    assert avar[0] == pytest.approx(1.6483 / np.pi, rel=1e-4)
    np.testing.assert_allclose(avar[1:], 2.0 * np.log(2.0) / np.pi, rtol=2e-4)


@pytest.mark.data
def test_published_pink_noise_has_the_stated_shape():
    file = recordings() / "reference" / "pink-frequency.csv"
    rate = np.loadtxt(file, delimiter=",", skiprows=1)[:, 1]
    # 10 000 samples determine σ to 1 % at m = 1 and 5 % at m = 64. Beyond 100 samples the published noise is no
    # longer 1/f: its curve falls to a third at m = 1000.
    factors = 2 ** np.arange(7)
    deviation = allantools.oadev(rate, rate=1.0, data_type="freq", taus=factors)[1]
    ratio = deviation / np.sqrt(BiasInstability(B=1.0).avar(factors * 1.0, 1.0))
    np.testing.assert_allclose(ratio / ratio.mean(), 1.0, atol=0.05)
