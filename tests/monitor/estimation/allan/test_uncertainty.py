"""Tests of covariances of Allan variances against direct sums, Greenhall and Riley, and simulation."""

import allantools
import numpy as np
import pytest
from allantools.ci import edf_greenhall
from scipy.stats import chi2

from monitor.estimation.allan.batch import overlapping_avar
from monitor.estimation.allan.uncertainty import (
    PAIRS,
    TABLE_STEP,
    CovarianceTablesByAxis,
    covariance_table,
    deviation_intervals,
)
from monitor.noise.effects import AngleRandomWalk, BiasInstability, QuantizationNoise, RateRandomWalk
from tests.support.noise_series import draw_next_samples


def sum_covariances_directly(n: int, first: int, second: int) -> np.ndarray:
    """Return C^ab of two cluster sizes for all pairs a ≤ b, summed over all pairs of terms."""

    def phase(t):
        t = np.abs(t).astype(float)
        logarithm = np.log(np.maximum(t, 1.0))
        return np.array([t == 0.0, -t / 2.0, t**2 * logarithm / (2.0 * np.pi), (t**3 - t) / 12.0])

    centres = [np.arange(m, n + 1 - m) for m in (first, second)]
    lags, pairs = np.unique(np.subtract.outer(*centres), return_counts=True)
    weights = {-1: 1.0, 0: -2.0, 1: 1.0}
    r = sum(weights[p] * weights[s] * phase(lags + p * first + s * second) for p in (-1, 0, 1) for s in (-1, 0, 1)) / (
        first * second
    )
    return np.array([(pairs * r[a] * r[b]).sum() for a, b in PAIRS]) / (2.0 * centres[0].size * centres[1].size)


@pytest.mark.long
@pytest.mark.parametrize("n", [64, 501, 900])
def test_covariance_table_equals_the_direct_sum(n):
    factors = np.array([1, 2, 3, 4, 7, 8, 30, 32, 100, 128, 250, 400])
    factors = factors[2 * factors < n + 1]
    covariance = covariance_table(n, factors).covariance
    for i, first in enumerate(factors):
        for j, second in enumerate(factors):
            expected = sum_covariances_directly(n, first, second)
            # Sampled 1/f noise ends at half the rate, so its second differences are smaller at the shortest τ.
            flicker = np.sqrt(np.prod(BiasInstability(B=1.0).avar(np.array([first, second], float), 1.0)))
            share = flicker / (2.0 * np.log(2.0) / np.pi)
            expected *= np.array([share ** ((a == 2) + (b == 2)) for a, b in PAIRS])
            own = dict(zip(PAIRS, expected, strict=True))
            scale = np.array([np.sqrt(own[a, a] * own[b, b]) for a, b in PAIRS])
            assert (np.abs(covariance[i, j] - expected) <= 2e-6 * scale).all()


@pytest.mark.parametrize(
    ("source", "alpha"), [(AngleRandomWalk(N=1.0), 0), (BiasInstability(B=1.0), -1), (RateRandomWalk(K=1.0), -2)]
)
def test_degrees_of_freedom_agree_with_greenhall_and_riley(source, alpha):
    factors = 2 ** np.arange(5, 12)
    t = covariance_table(20_000, factors)
    a = 1 - alpha
    own = t.covariance[:, :, PAIRS.index((a, a))].diagonal()
    edf = 2.0 * source.avar(factors * 1.0, 1.0) ** 2 / own
    formula = [edf_greenhall(alpha, 2, int(m), 20_001, overlapping=True, modified=False) for m in factors]
    np.testing.assert_allclose(edf, formula, rtol=0.05)


@pytest.mark.parametrize(
    ("source", "pair"),
    [
        (QuantizationNoise(Q=1.0), (0, 0)),
        (AngleRandomWalk(N=1.0), (1, 1)),
        (BiasInstability(B=1.0), (2, 2)),
        (RateRandomWalk(K=1.0), (3, 3)),
    ],
)
def test_covariance_agrees_with_simulated_curves(source, pair):
    n, factors, runs = 512, np.array([1, 4, 16, 64, 128]), 3000
    t = covariance_table(n, factors)
    rng = np.random.default_rng(11)
    records = np.stack([draw_next_samples(source.start_series(1.0, rng), n) for _ in range(runs)], axis=1)
    measured = np.cov(overlapping_avar(records, factors)[0])
    stated = t.covariance[:, :, PAIRS.index(pair)]
    # A sample covariance of 3000 curves scatters by 3–5 % of the product of both standard deviations.
    deviation = np.sqrt(stated.diagonal())
    error = np.abs(measured - stated) / np.outer(deviation, deviation)
    assert error.max() < 0.25
    assert np.median(error) < 0.05


def test_interval_follows_the_chi_square_distribution():
    lo, hi = deviation_intervals(np.array([4.0, np.nan]), np.array([7.3, 5.0]), 0.9)
    assert lo[0] == pytest.approx(np.sqrt(7.3 * 4.0 / chi2.ppf(0.95, 7.3)))
    assert hi[0] == pytest.approx(np.sqrt(7.3 * 4.0 / chi2.ppf(0.05, 7.3)))
    assert np.isnan([lo[1], hi[1]]).all()
    expected = allantools.confidence_interval(2.0, 7.3, ci=0.9)
    np.testing.assert_allclose([lo[0], hi[0]], expected)


def test_very_few_degrees_of_freedom_give_no_upper_bound():
    lo, hi = deviation_intervals(np.array([0.0, 1.0, np.nan, 0.0]), np.array([1e-3, 1e-3, 1e-3, 10.0]))
    np.testing.assert_array_equal(lo[[0, 2, 3]], [0.0, np.nan, 0.0])
    np.testing.assert_array_equal(hi, [np.inf, np.inf, np.nan, 0.0])


def test_cluster_longer_than_half_the_window_has_no_covariance():
    t = covariance_table(100, np.array([1, 50, 51]))
    assert t.terms.tolist() == [99, 1, -1]
    assert np.isfinite(t.covariance[:2, :2]).all()
    assert np.isnan(t.covariance[2]).all()


def test_covariance_tables_are_renewed_with_growing_windows():
    tables = CovarianceTablesByAxis(np.array([1, 2, 4]), capacity=10_000)
    tables_by_length = [tables.table_of_axis(0, n, n) for n in range(8, 10_001)]
    lengths = sorted({t.n for t in tables_by_length})
    assert len(lengths) < np.log(10_000 / 8) / np.log(TABLE_STEP) + 12
    assert all(t.n <= n < TABLE_STEP * t.n + 1 for n, t in zip(range(8, 10_001), tables_by_length, strict=True))
    assert tables.table_of_axis(0, 10_000, 10_000).n == 10_000
    assert tables.table_of_axis(0, 10_000, 10_000) is tables.table_of_axis(0, 10_000, 10_000)
    assert tables.table_of_axis(0, 50, 50).n == 50
