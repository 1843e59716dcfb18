"""Tests of the overlapping Hadamard variance against published values, allantools, direct sums and simulation."""

import allantools
import numpy as np
import pytest
from allantools.ci import edf_greenhall
from hypothesis import given, settings
from hypothesis import strategies as st

from monitor.estimation.allan.hadamard import compute_hadamard_curve, hadamard_estimator_moments, hadamard_variance
from monitor.estimation.allan.squared_difference_moments import phase_autocovariance
from monitor.estimation.allan.total import total_estimator_moments, total_variance
from monitor.noise.effects import AngleRandomWalk, BiasInstability, RateRandomWalk
from tests.support.allan_references import (
    columns,
    mean_square_of_contrasts_with_gaps,
    nist_1000,
    variance_within_clusters_with_gaps,
)
from tests.support.noise_series import draw_next_samples


def test_nist_sp_1065_values_are_reproduced():
    found, terms, _ = hadamard_variance(nist_1000()[:, None], np.array([1, 10, 100]))
    assert np.sqrt(found[:, 0]) == pytest.approx([2.943883e-01, 9.581083e-02, 3.237638e-02], abs=5e-8)
    assert terms.ravel().tolist() == [998, 971, 701]


@pytest.mark.parametrize("rate_hz", [1.0, 100.0])
@pytest.mark.parametrize("kind", ["float", "int"])
def test_deviations_equal_allantools(kind, rate_hz):
    rng = np.random.default_rng(7)
    y = 1e2 * rng.standard_normal(900) + np.cumsum(rng.standard_normal(900))
    y = np.rint(y).astype(np.int64) if kind == "int" else y
    factors = np.array([1, 2, 3, 7, 50, 200, 299])
    found, _, _ = hadamard_variance(y[:, None], factors)
    _, expected, _, _ = allantools.ohdev(y, rate=rate_hz, data_type="freq", taus=factors / rate_hz)
    assert np.sqrt(found[:, 0]) == pytest.approx(expected, rel=1e-10)


@settings(max_examples=60, deadline=None)
@given(
    n=st.integers(1, 60),
    m=st.integers(1, 20),
    holes=st.sets(st.integers(0, 59), max_size=12),
    offset=st.sampled_from([0.0, 9.81, -300.0]),
    drift=st.sampled_from([0.0, 0.01]),
    scale=st.sampled_from([1e-4, 1.0, 1e3]),
    seed=st.integers(0, 99),
)
def test_variance_is_the_corrected_mean_over_three_clusters(n, m, holes, offset, drift, scale, seed):
    rate = np.random.default_rng(seed).standard_normal(n) + drift * np.arange(n)
    rate[[h for h in holes if h < n]] = np.nan
    found, terms, excess = (one[0, 0] for one in hadamard_variance((offset + scale * rate)[:, None], np.array([m])))
    clusters = [np.arange(k, k + 3 * m).reshape(3, m) for k in range(n + 1 - 3 * m)]
    raw, count, share = mean_square_of_contrasts_with_gaps(rate, clusters, (1.0, -2.0, 1.0))
    assert terms == count
    expected = share / 6.0 * variance_within_clusters_with_gaps(rate, m) if share else 0.0
    error = 1e-11 * (1.0 + (offset / scale) ** 2 * 1e-7)
    assert excess / scale**2 == pytest.approx(expected, rel=1e-7, abs=error, nan_ok=True)
    assert found / scale**2 == pytest.approx(raw / 6.0 - expected, rel=1e-7, abs=error, nan_ok=True)


def test_large_linear_drift_has_no_effect():
    rng = np.random.default_rng(1)
    noise = rng.standard_normal((600, 1))
    factors = np.array([1, 8, 64, 200])
    np.testing.assert_allclose(
        hadamard_variance(noise + 0.5 * np.arange(600)[:, None], factors)[0],
        hadamard_variance(noise, factors)[0],
        rtol=1e-8,
    )
    assert hadamard_estimator_moments(2000, 64).mean[4] == 0.0


def test_white_noise_gives_the_allan_variance():
    hadamard, allan = hadamard_estimator_moments(10_000, 100), total_estimator_moments(10_000, 100).allan
    assert hadamard.mean[:4] / allan[:4] == pytest.approx([10.0 / 9.0, 1.0, 0.8113, 0.5], abs=1e-4)


@pytest.mark.parametrize(("n", "m"), [(60, 1), (60, 7), (61, 20), (300, 90), (900, 10)])
def test_moments_equal_sums_over_all_pairs_of_terms(n, m):
    starts = np.arange(n + 1 - 3 * m)
    rows = np.zeros((starts.size, n + 1))
    for p, weight in enumerate((-1.0, 3.0, -3.0, 1.0)):
        rows[starts, starts + p * m] = weight
    lags = phase_autocovariance(np.subtract.outer(np.arange(n + 1.0), np.arange(n + 1.0)))
    noise = np.stack([rows @ g @ rows.T for g in lags])
    moments = hadamard_estimator_moments(n, m)
    np.testing.assert_allclose(moments.mean[:4], noise[:, 0, 0] / (6 * m * m), rtol=1e-9)
    exact = 2.0 * np.einsum("aij,bij->ab", noise, noise) / (6.0 * m * m * starts.size) ** 2
    scale = np.sqrt(np.outer(exact.diagonal(), exact.diagonal()))
    assert (np.abs(moments.covariance[:4, :4] - exact) < 1e-5 * scale).all()


def test_degrees_of_freedom_agree_with_greenhall_and_riley():
    for m in (32, 125, 333):
        moments = hadamard_estimator_moments(1000, m)
        edf = 2.0 * moments.mean[1:4] ** 2 / moments.covariance.diagonal()[1:4]
        formula = [edf_greenhall(alpha, 3, m, 1001, overlapping=True, modified=False) for alpha in (0, -1, -2)]
        assert edf == pytest.approx(formula, rel=2e-3)


def test_intervals_have_the_stated_coverage():
    n, runs, rate_hz = 512, 3000, 200.0
    rng = np.random.default_rng(22)
    theta = np.array([0.0, 1.0, 0.02, 1e-3, 0.0])
    sources = AngleRandomWalk(N=1.0), BiasInstability(B=0.02**0.5), RateRandomWalk(K=1e-3**0.5)
    values = sum(
        np.stack([draw_next_samples(s.start_series(rate_hz, rng), n) for _ in range(runs)], axis=1) for s in sources
    )
    factors = np.array([4, 16, 64, 128, 170])
    curve = compute_hadamard_curve(values, rate_hz, np.repeat(theta[:, None], runs, axis=1), factors)
    white = 1.0 / curve.tau_s  # white noise makes all but a ten-thousandth of the variance
    np.testing.assert_allclose(curve.variance.mean(axis=1), white, rtol=0.1)
    covered = (curve.lo**2 <= white[:, None]) & (white[:, None] <= curve.hi**2)
    assert (covered.mean(axis=1) > 0.94).all()
    assert (covered.mean(axis=1) < 0.982).all()


def test_gaps_reduce_degrees_of_freedom_and_unknown_noise_gives_no_intervals():
    values = np.random.default_rng(3).standard_normal((400, 2))
    whole = compute_hadamard_curve(values, 1.0, np.array([[0.0], [1.0], [0.0], [0.0], [0.0]]) * [1.0, np.nan])
    assert whole.factors.tolist() == [1, 2, 4, 8, 16, 32, 64, 128]
    assert np.isfinite(whole.variance).all()
    assert np.isfinite(whole.hi[:, 0]).all()
    assert np.isnan(whole.hi[:, 1]).all()
    values[100:150, 0] = np.nan
    shorter = compute_hadamard_curve(values, 1.0, np.array([[0.0], [1.0], [0.0], [0.0], [0.0]]) * [1.0, 1.0])
    np.testing.assert_allclose((shorter.edf / whole.edf)[:2, 0], (shorter.terms / whole.terms)[:2, 0])
    assert shorter.terms[0, 0] == whole.terms[0, 0] - 52
    assert shorter.terms[7, 0] == whole.terms[7, 0]  # 61 % of the samples of a cluster are present
    assert (shorter.edf < whole.edf)[:7, 0].all()


@pytest.mark.parametrize("loss", ["random", "bursts"])
@pytest.mark.parametrize("noise", ["white", "flicker", "random walk"])
@pytest.mark.parametrize(("statistic", "longest"), [(hadamard_variance, 170), (total_variance, 511)])
def test_missing_samples_cause_no_bias(statistic, longest, noise, loss):
    """The bias is below 4 standard errors of its mean, or below a tenth of the standard deviation of one record."""
    rng, n, records = np.random.default_rng(3), 512, 600
    white = rng.standard_normal((n, records))
    flicker = np.fft.rfft(rng.standard_normal((8 * n, records)), axis=0)
    flicker[1:] /= np.sqrt(np.arange(1.0, len(flicker)))[:, None]
    flicker[0] = 0.0
    y = {"white": white, "flicker": np.fft.irfft(flicker, axis=0)[:n], "random walk": np.cumsum(white, axis=0)}[noise]
    present = rng.random(y.shape) >= 0.05
    if loss == "bursts":
        present[:] = True
        for axis in range(records):
            for begin in rng.integers(0, n, 3):
                present[begin : begin + 10, axis] = False
    factors = np.append(2 ** np.arange(longest.bit_length()), longest)
    complete, _, nothing = statistic(y, factors)
    assert not nothing.any()
    found, _, _ = statistic(np.where(present, y, np.nan), factors)
    change = found - complete
    error = np.nanstd(change, axis=1) / records**0.5
    assert (np.abs(np.nanmean(change, axis=1)) < np.maximum(4.0 * error, 0.1 * complete.std(axis=1))).all()


def test_no_cluster_contains_a_pause():
    values, factors = np.random.default_rng(5).standard_normal((300, 1)), np.array([1, 8, 50])
    values[150] = np.nan
    for statistic, clusters in ((hadamard_variance, 3), (total_variance, 2)):
        _, usual, excess = statistic(values, factors)
        found, terms, nothing = statistic(values, factors, np.array([150]))
        assert excess[1:].all()
        assert (usual - terms)[1:, 0].tolist() == [clusters * 8, clusters * 50]
        assert not nothing.any()
        assert np.isfinite(found).all()


# --- published results on real data


@pytest.mark.data
@pytest.mark.parametrize(("data", "table"), [("phase-dat", "ohdev"), ("pink", "ohdev"), ("ocxo", "ohdev-octave-ci")])
def test_stable32_values_are_reproduced(reference, data, table):
    if data == "phase-dat":
        y, within = np.diff(columns(reference / "phase-dat.csv", "x")[0]), 5e-5
    elif data == "pink":
        y, within = columns(reference / "pink-frequency.csv", "y")[0], 5e-5
    else:
        y, within = columns(reference / "ocxo-frequency.csv.gz", "y")[0] / 1e7 - 1.0, 1.5e-3
    m, dev, n = columns(reference / f"{data}-stable32-{table}.csv", "m", "dev", "n")
    found, terms, _ = hadamard_variance(y[:, None], m.astype(np.int64))
    assert np.sqrt(found[:, 0]) == pytest.approx(dev, rel=within)
    assert terms.ravel().tolist() == n.astype(int).tolist()
