"""Decaying correlation: closed form and series against sums of the autocovariance in long arithmetic."""

from fractions import Fraction
from math import isclose

import numpy as np
import pytest
from scipy.special import comb

from monitor.noise import correlated


def second_difference(n: int, step: complex) -> float:
    """Σ over the lags of the weights of an Allan variance of n samples, times 1 − Re φ^k: nothing cancels."""
    k = np.arange(1, 2 * n)
    # autocovariance of the ±1 window of 2n samples
    window = np.r_[np.full(n, -1.0), np.full(n, 1.0)]
    weight = np.correlate(window, window, "full")[2 * n :]
    return float((-weight * -np.expm1(-step * k).real).sum() * -1.0 / n**2) * -1.0


@pytest.mark.parametrize("decay", [1.0, 1e-3, 1e-6, 0.3 - 2.0j, 1e-4 - 1e-3j, 1e-6 - 1e-4j, 1e-5 - 3.0j])
@pytest.mark.parametrize("n", [1, 2, 3, 10, 300])
def test_agrees_with_the_sum(decay, n):
    found = float(correlated.avar(1.0, decay, np.array([float(n)]), 1.0)[0])
    assert isclose(found, second_difference(n, complex(decay)), rel_tol=5e-4)


def test_short_times_are_a_random_walk():
    found = correlated.avar(2.0, 1e-9, np.array([1.0, 5.0]), 1.0)
    exact = [float(Fraction(8, 10**9) * n * (1 + Fraction(1, 2 * n * n)) / 3) for n in (1, 5)]
    np.testing.assert_allclose(found, exact, rtol=1e-6)
    assert comb(2, 1) == 2  # two halves of a cluster


def test_spectrum_has_all_the_variance():
    f = (np.arange(200_000) + 0.5) / 400_000
    for decay in (0.05, 0.05 - 1.3j):
        assert 2.0 * correlated.psd(3.0, decay, f, 1.0).mean() / 2.0 == pytest.approx(9.0, rel=1e-6)
