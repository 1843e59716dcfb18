"""Tests of the total variance against published values, allantools, direct sums and simulation."""

import csv

import allantools
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from monitor.estimation.allan import squared_difference_moments as moments_module
from monitor.estimation.allan.batch import octave_cluster_sizes, overlapping_avar
from monitor.estimation.allan.total import MIN_SHARE, compute_total_curve, total_estimator_moments, total_variance
from monitor.noise.effects import AngleRandomWalk, BiasInstability, QuantizationNoise, RateRandomWalk
from tests.support.allan_references import (
    mean_square_of_contrasts_with_gaps,
    nist_1000,
    variance_within_clusters_with_gaps,
)
from tests.support.noise_series import draw_next_samples


def compute_difference_weights(n, m):
    """Return the weights [n - 1, n + 1] of all terms on the phase, following the definition of x*."""
    rows = np.zeros((n - 1, n + 1))
    for i in range(1, n):
        for place, weight in ((i - m, 1.0), (i, -2.0), (i + m, 1.0)):
            if place < 0:
                rows[i - 1, [0, -place]] += (2.0 * weight, -weight)
            elif place > n:
                rows[i - 1, [n, 2 * n - place]] += (2.0 * weight, -weight)
            else:
                rows[i - 1, place] += weight
    return rows


def test_nist_sp_1065_values_are_reproduced():
    found, terms, _ = total_variance(nist_1000()[:, None], np.array([1, 10, 100]))
    assert np.sqrt(found[:, 0]) == pytest.approx([2.922319e-01, 9.134743e-02, 3.406530e-02], abs=5e-8)
    assert terms.ravel().tolist() == [999, 999, 999]


@pytest.mark.parametrize("rate_hz", [1.0, 100.0])
@pytest.mark.parametrize("kind", ["float", "int", "float32"])
def test_deviations_equal_allantools_up_to_the_longest_cluster(kind, rate_hz):
    rng = np.random.default_rng(5)
    y = 1e2 * rng.standard_normal(700) + np.cumsum(rng.standard_normal(700))
    y = {"float": y, "int": np.rint(y).astype(np.int64), "float32": y.astype(np.float32)}[kind]
    factors = np.array([1, 2, 3, 7, 100, 349, 350, 351, 352, 500, 698, 699])
    found, _, _ = total_variance(y[:, None], factors)
    _, expected, _, _ = allantools.totdev(
        y.astype(float) if kind == "float32" else y, rate=rate_hz, data_type="freq", taus=factors / rate_hz
    )
    assert np.sqrt(found[:, 0]) == pytest.approx(expected, rel=1e-10)


@settings(max_examples=60, deadline=None)
@given(
    n=st.integers(2, 60),
    m=st.integers(1, 59),
    holes=st.sets(st.integers(0, 59), max_size=12),
    offset=st.sampled_from([0.0, 9.81, -300.0]),
    scale=st.sampled_from([1e-4, 1.0, 1e3]),
    seed=st.integers(0, 99),
)
def test_variance_is_the_corrected_mean_over_the_reflected_rate(n, m, holes, offset, scale, seed):
    rate = np.random.default_rng(seed).standard_normal(n)
    rate[[h for h in holes if h < n]] = np.nan
    found, terms, excess = (one[0, 0] for one in total_variance((offset + scale * rate)[:, None], np.array([m])))
    forward = np.arange(n)
    extended = np.concatenate([forward[::-1], forward, forward[::-1]])
    clusters = [(extended[n + i - m : n + i], extended[n + i : n + i + m]) for i in range(1, n)] if m < n else []
    raw, count, share = mean_square_of_contrasts_with_gaps(rate, clusters, (-1.0, 1.0))
    assert terms == count
    expected = 0.5 * share * variance_within_clusters_with_gaps(rate, m) if share else 0.0
    error = 1e-12 * (1.0 + (offset / scale) ** 2 * 1e-6)
    assert excess / scale**2 == pytest.approx(expected, rel=1e-8, abs=error, nan_ok=True)
    assert found / scale**2 == pytest.approx(0.5 * raw - expected, rel=1e-8, abs=error, nan_ok=True)


def test_columns_are_independent_and_the_input_is_not_modified():
    values = np.random.default_rng(0).standard_normal((80, 3))
    values[:, 1], values[10, 2], values[11, 2] = np.nan, np.inf, -np.inf
    before = values.copy()
    found, terms, _ = total_variance(values, np.array([1, 5, 79]))
    assert np.array_equal(values, before, equal_nan=True)
    assert np.isnan(found[:, 1]).all()
    assert terms[:, 0].tolist() == [79, 79, 79]
    for k in range(3):
        alone, _, _ = total_variance(values[:, [k]], np.array([1, 5, 79]))
        np.testing.assert_allclose(found[:, [k]], alone, rtol=1e-12)


# --- properties of the estimator


def test_bias_is_the_published_one_up_to_half_the_recording():
    for share, m in ((8, 12_500), (4, 25_000), (2, 50_000)):
        moments = total_estimator_moments(100_000, m)
        loss = (1.0 - moments.mean / moments.allan) * share
        assert loss[:4] == pytest.approx([-4.0 / 3.0, 0.0, 0.481, 0.750], abs=1e-3)


@pytest.mark.parametrize(("n", "m"), [(40, 1), (40, 7), (41, 20), (40, 29), (41, 40), (300, 37), (301, 290)])
def test_moments_equal_sums_over_all_pairs_of_terms(n, m):
    rows = compute_difference_weights(n, m)
    lags = moments_module.phase_autocovariance(np.subtract.outer(np.arange(n + 1.0), np.arange(n + 1.0)))
    noise = np.stack([rows @ g @ rows.T for g in lags])
    ramp = rows @ (0.5 * np.arange(n + 1.0) ** 2)
    mean = np.append(noise.diagonal(axis1=1, axis2=2).mean(axis=1), np.mean(ramp**2)) / (2 * m * m)
    moments = total_estimator_moments(n, m)
    np.testing.assert_allclose(moments.mean, mean, rtol=1e-7)
    theta = np.array([3.0, 1.0, 0.3, 1.0 / n**2, 1.0 / n**3])
    combined = np.tensordot(theta[:4], noise, 1)
    variance = (2 * (combined**2).sum() + 4 * theta[4] * ramp @ combined @ ramp) / (2 * m * m * (n - 1)) ** 2
    assert theta @ moments.covariance @ theta == pytest.approx(variance, rel=1e-9 if n <= 256 else 0.02)


@pytest.mark.parametrize("m", [3, 33, 80, 150, 350, 600, 699])
def test_moments_on_the_coarse_grid_are_accurate_to_five_percent(m):
    n = 700
    rows = compute_difference_weights(n, m)
    lags = moments_module.phase_autocovariance(np.subtract.outer(np.arange(n + 1.0), np.arange(n + 1.0)))
    exact = [2.0 * ((rows @ g @ rows.T) ** 2).sum() / (2 * m * m * (n - 1.0)) ** 2 for g in lags]
    np.testing.assert_allclose(total_estimator_moments(n, m).covariance.diagonal()[:4], exact, rtol=0.05)


@pytest.mark.parametrize(("share", "stated"), [(8, (12.0, 9.14, 7.08)), (4, (6.0, 4.46, 3.36)), (2, (3.0, 2.12, 1.5))])
def test_degrees_of_freedom_agree_with_howe(share, stated):
    moments = total_estimator_moments(64_000, 64_000 // share)
    edf = 2.0 * moments.mean[1:4] ** 2 / moments.covariance.diagonal()[1:4]
    assert edf == pytest.approx(stated, rel=0.02)


def test_pure_ramp_gives_its_allan_variance():
    n, slope = 600, 0.01
    theta = np.array([[0.0], [0.0], [0.0], [0.0], [slope**2]])
    curve = compute_total_curve(slope * np.arange(n)[:, None], 1.0, theta)
    np.testing.assert_allclose(curve.variance[:, 0], 0.5 * slope**2 * curve.factors**2, rtol=1e-9)
    assert np.isnan(curve.edf).all()  # a ramp has no random variation


@pytest.mark.parametrize("rate_hz", [1.0, 200.0])
def test_intervals_have_the_stated_coverage_up_to_half_the_recording(rate_hz):
    """χ² covers 97 % at T/2 with few degrees of freedom; 3000 recordings determine the coverage to 0.4 %."""
    n, runs = 512, 3000
    rng = np.random.default_rng(21)
    theta = np.array([1e-4, 1.0, 0.02, 1e-3, 0.0])
    sources = (
        QuantizationNoise(Q=1e-2),
        AngleRandomWalk(N=1.0),
        BiasInstability(B=0.02**0.5),
        RateRandomWalk(K=1e-3**0.5),
    )
    values = sum(
        np.stack([draw_next_samples(s.start_series(rate_hz, rng), n) for _ in range(runs)], axis=1) for s in sources
    )
    factors = np.array([64, 128, 256, 384])
    curve = compute_total_curve(values, rate_hz, np.repeat(theta[:, None], runs, axis=1), factors)
    truth = sum(s.avar(factors / rate_hz, 1.0 / rate_hz) for s in sources)
    np.testing.assert_allclose(curve.variance.mean(axis=1), truth, rtol=0.1)
    covered = (curve.lo**2 <= truth[:, None]) & (truth[:, None] <= curve.hi**2)
    assert (covered[:3].mean(axis=1) > 0.944).all()
    assert (covered[:3].mean(axis=1) < 0.981).all()
    assert np.isnan(curve.lo[3]).all()
    assert np.isnan(curve.hi[3]).all()


def test_shortest_cluster_equals_the_allan_variance_and_the_grid_ends_below_the_length():
    values = np.random.default_rng(2).standard_normal((300, 6))
    curve = compute_total_curve(values, 50.0, np.tile([[0.0], [0.02], [0.0], [0.0], [0.0]], 6))
    assert curve.factors.tolist() == [1, 2, 4, 8, 16, 32, 64, 128, 256]
    np.testing.assert_allclose(curve.tau_s, curve.factors / 50.0)
    np.testing.assert_allclose(curve.variance[0], overlapping_avar(values, np.array([1]))[0][0], rtol=1e-12)
    assert octave_cluster_sizes(256)[-1] == 256
    assert octave_cluster_sizes(255)[-1] == 128


def test_unknown_noise_or_too_few_terms_give_no_curve():
    values = np.random.default_rng(3).standard_normal((400, 2))
    values[100:280, 1] = np.nan
    theta = np.array([[0.0, 0.0], [np.nan, 1.0], [0.0, 0.0], [0.0, 0.0], [0.0, 0.0]])
    curve = compute_total_curve(values, 1.0, theta)
    assert np.isnan(curve.variance[:, 0]).all()
    assert np.isnan(curve.hi[:, 0]).all()
    enough = curve.terms[:, 1] >= MIN_SHARE * 399
    assert enough.any()
    assert not enough.all()
    assert np.array_equal(np.isfinite(curve.variance[:, 1]), enough)


# --- published results on real data


@pytest.mark.data
def test_stable32_values_of_phase_dat_are_reproduced(reference):
    with (reference / "phase-dat.csv").open() as stream:
        x = np.array([float(row["x"]) for row in csv.DictReader(stream)])
    with (reference / "phase-dat-stable32-totdev.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    factors = np.array([int(float(row["m"])) for row in rows])
    found, _, _ = total_variance(np.diff(x)[:, None], factors)
    assert np.sqrt(found[:, 0]) == pytest.approx([float(row["dev"]) for row in rows], rel=5e-5)
