"""Tests of the Allan variance and the spectrum of a Gauss-Markov process against sums over its autocovariance."""

from fractions import Fraction
from math import isclose

import numpy as np
import pytest

from monitor.noise.gauss_markov_avar_and_spectrum import gauss_markov_spectrum


def sum_over_autocovariance(n: int, step: complex) -> float:
    """Return −Σ c_k (1 − Re φ^k)/n², where c is the autocorrelation of the ±1 window of 2n samples."""
    window = np.r_[np.full(n, -1.0), np.full(n, 1.0)]
    c = np.correlate(window, window, "full")[2 * n :]
    return float((c * np.expm1(-step * np.arange(1, 2 * n)).real).sum() / n**2)


@pytest.mark.parametrize("decay", [1.0, 1e-3, 1e-6, 0.3 - 2.0j, 1e-4 - 1e-3j, 1e-6 - 1e-4j, 1e-5 - 3.0j])
@pytest.mark.parametrize("n", [1, 2, 3, 10, 300])
def test_avar_agrees_with_the_sum(decay, n):
    found = float(gauss_markov_spectrum(1.0, decay, 1.0).avar(np.array([float(n)]))[0])
    assert isclose(found, sum_over_autocovariance(n, complex(decay)), rel_tol=5e-4)


def test_short_times_give_a_random_walk():
    found = gauss_markov_spectrum(2.0, 1e-9, 1.0).avar(np.array([1.0, 5.0]))
    exact = [float(Fraction(8, 10**9) * n * (1 + Fraction(1, 2 * n * n)) / 3) for n in (1, 5)]
    np.testing.assert_allclose(found, exact, rtol=1e-6)


def test_integral_of_the_spectrum_is_the_variance():
    f = (np.arange(200_000) + 0.5) / 400_000
    for decay in (0.05, 0.05 - 1.3j):
        assert 2.0 * gauss_markov_spectrum(3.0, decay, 1.0).density(f).mean() / 2.0 == pytest.approx(9.0, rel=1e-6)
