"""Tests that outliers are distinguished from other heavy tails and that their scale and fraction are estimated
correctly."""

import numpy as np
import pytest
from scipy.stats import norm, t

from monitor.reconcile.likelihood.outlier_fit import convert_student_to_gaussian, fit_outliers, student_misfit_z

N = 60_000


def draw_noise(seed=0, n=N):
    return np.random.default_rng(seed).standard_normal(n)


def add_outliers(share, scale, seed=0, n=N):
    rng = np.random.default_rng(seed)
    which = rng.random(n) < share
    return np.where(which, scale, 0.0) * rng.standard_normal(n) + rng.standard_normal(n), which


@pytest.mark.parametrize(("share", "scale"), [(1e-3, 10.0), (0.01, 4.0), (0.1, 3.0), (2e-3, 1000.0)])
@pytest.mark.parametrize("unit", [1e-4, 1.0])
def test_fraction_and_scale_of_outliers_are_estimated(share, scale, unit):
    w, which = add_outliers(share, scale)
    found = fit_outliers(unit * w)
    assert found.fraction.value == pytest.approx(share, rel=0.3)
    assert found.scale.value == pytest.approx(scale * unit, rel=0.3)
    assert found.gain > 50.0
    assert found.gain_over_student > 10.0
    assert found.clustering_z < 3.5
    assert found.misfit_z < 3.5
    far = np.abs(w) > 6.0
    assert np.array_equal(found.mask[far], far[far])
    assert found.count == found.mask.sum() <= 1.3 * which.sum()


def test_intervals_contain_the_true_values():
    inside = 0
    for seed in range(40):
        found = fit_outliers(add_outliers(4e-3, 5.0, seed)[0])
        inside += (found.fraction.lo < 4e-3 < found.fraction.hi) + (found.scale.lo < 5.0 < found.scale.hi)
    assert 68 <= inside <= 80  # of 80 at 95 %


def test_gaussian_noise_gains_little():
    gains = [found.gain for found in (fit_outliers(draw_noise(seed)) for seed in range(30)) if found is not None]
    assert len(gains) < 30
    assert max(gains) < 10.0


@pytest.mark.parametrize("freedom", [3, 6, 12])
def test_student_noise_is_no_mixture(freedom):
    found = fit_outliers(np.random.default_rng(0).standard_t(freedom, 4 * N))
    assert found.gain > 100.0
    assert found.gain_over_student < -5.0


@pytest.mark.parametrize("freedom", [3.0, 6.0, 12.0])
@pytest.mark.parametrize("unit", [1e-4, 1.0])
def test_student_distribution_fits_student_noise(freedom, unit):
    w = unit * np.random.default_rng(1).standard_t(freedom, 4 * N)
    found = fit_outliers(w).student
    assert found.nu.value == pytest.approx(freedom, rel=0.1)
    assert found.nu.lo < freedom < found.nu.hi
    assert found.scale == pytest.approx(unit, rel=0.02)
    assert student_misfit_z(w, found) < 3.5


def test_laplacian_noise_fits_neither_a_mixture_nor_student():
    w = np.random.default_rng(0).laplace(size=N)
    found = fit_outliers(w)
    assert found.misfit_z > 5.0
    assert student_misfit_z(w, found.student) > 4.0


def test_student_values_are_mapped_to_gaussian_values_of_the_same_probability():
    probability = np.array([1e-9, 0.02, 0.5, 0.7, 1.0 - 1e-9])
    made = convert_student_to_gaussian(t(5.0, scale=0.6**0.5).ppf(probability), 5.0)
    assert made == pytest.approx(norm.ppf(probability), abs=1e-6)
    assert np.isfinite(convert_student_to_gaussian(np.array([1e200, -1e200]), 1000.0)).all()


def draw_bursts():
    w = draw_noise()
    for at in range(1000, N, 6000):
        w[at : at + 40] *= 4.0
    return w


def draw_decreasing_noise():
    return draw_noise() * np.where(np.arange(N) > 0.8 * N, 1.8, 1.0)


def draw_modulated_noise():
    return draw_noise() * np.exp(0.6 * np.sin(2.0 * np.pi * np.arange(N) / 9000.0))


def draw_telegraph():
    """Return a telegraph signal without its local means."""
    level = 12.0 * (np.cumsum(np.random.default_rng(5).random(N) < 1 / 600.0) % 2)
    x = draw_noise() + level
    return x - np.convolve(x, np.ones(9) / 9.0, mode="same")


@pytest.mark.parametrize("make", [draw_bursts, draw_decreasing_noise, draw_modulated_noise, draw_telegraph])
def test_clustered_deviations_are_no_outliers(make):
    found = fit_outliers(make())
    assert found.gain > 20.0
    assert found.clustering_z > 6.0


def test_light_tails_have_no_outliers():
    for w in (np.random.default_rng(0).random(N) - 0.5, draw_noise() + np.where(draw_noise(1) > 0.0, 2.0, -2.0)):
        found = fit_outliers(w)
        assert found is None or found.gain < 5.0


def test_missing_samples_are_ignored():
    w, _ = add_outliers(0.01, 6.0)
    with_holes = w.copy()
    with_holes[::3] = np.nan
    found = fit_outliers(with_holes)
    assert found.fraction.value == pytest.approx(0.01, rel=0.3)
    assert not found.mask[::3].any()


@pytest.mark.parametrize("w", [np.zeros(500), np.full(500, np.nan), np.arange(5.0)])
def test_uninformative_values_give_no_result(w):
    assert fit_outliers(w) is None
