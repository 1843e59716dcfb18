"""Tests that the cosine transform is orthonormal, that its variance is the spectrum, and that bins are complete."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.signal import lfilter, periodogram

from monitor.reconcile.preparation.cosine_bins import (
    build_frequency_bins,
    cosine_transform,
    inverse_cosine_transform,
    sinusoid_cosine_transforms,
)


def make_transform_matrix(n):
    """Return the matrix of the transform from its definition, shape [n − 1, n]."""
    k, j = np.arange(1, n)[:, None], np.arange(n)
    return np.sqrt(2.0 / n) * np.cos(np.pi * k * (2 * j + 1) / (2 * n))


def test_transform_is_the_cosine_sum_without_the_mean():
    y = np.random.default_rng(0).standard_normal(200) + 7.0
    assert cosine_transform(y) == pytest.approx(make_transform_matrix(200) @ y, abs=1e-12)
    assert np.sum(cosine_transform(y) ** 2) == pytest.approx(np.sum((y - y.mean()) ** 2))
    assert inverse_cosine_transform(cosine_transform(y)) == pytest.approx(y - y.mean(), abs=1e-12)


def test_white_noise_and_random_walk_have_independent_coefficients():
    n, k = 60, np.arange(1, 60)
    d = make_transform_matrix(n)
    np.testing.assert_allclose(d @ d.T, np.eye(n - 1), atol=1e-12)
    steps = np.tril(np.ones((n, n)))
    np.testing.assert_allclose(
        d @ steps @ steps.T @ d.T, np.diag(1.0 / (4.0 * np.sin(0.5 * np.pi * k / n) ** 2)), atol=1e-9
    )


@pytest.mark.parametrize("pole", [0.0, 0.7, -0.5])
def test_variance_of_a_coefficient_is_the_spectrum(pole):
    n, runs, rate_hz = 1024, 400, 50.0
    drawn = lfilter([1.0], [1.0, -pole], np.random.default_rng(3).standard_normal((runs, n + 200)))[:, 200:]
    ours = np.mean([cosine_transform(y) ** 2 for y in drawn], axis=0) / rate_hz
    f, one_sided = periodogram(drawn, rate_hz, detrend="constant")
    peers = one_sided.mean(axis=0)[1:-1] / 2.0
    density = 1.0 / np.abs(1.0 - pole * np.exp(-2j * np.pi * f[1:-1] / rate_hz)) ** 2 / rate_hz
    groups = np.array_split(np.arange(f.size - 2), 8)
    for group in groups:  # 64 ordinates of 400 runs: scatter 0.9 %; ends leak a little
        mine = ours[2 * group[0] + 1 : 2 * group[-1] + 2].mean()
        assert mine == pytest.approx(peers[group].mean(), rel=0.04)
        assert mine == pytest.approx(density[group].mean(), rel=0.04)


@given(
    n=st.integers(2, 60_000),
    rate_hz=st.sampled_from([1.0, 50.0, 100.0, 8000.0]),
    peaks=st.lists(st.tuples(st.floats(0.0, 0.7), st.floats(1e-5, 0.2)), max_size=3),
)
@settings(max_examples=60, deadline=None)
def test_every_coefficient_is_in_one_bin(n, rate_hz, peaks):
    found = build_frequency_bins(n, rate_hz, [(middle * rate_hz, width * rate_hz) for middle, width in peaks])
    assert found.count.min() >= 1
    assert found.first[0] == 0
    np.testing.assert_array_equal(found.first[1:], np.cumsum(found.count)[:-1])
    assert found.count.sum() == n - 1
    f_hz = np.arange(1, n) * 0.5 * rate_hz / n
    last = (found.first + found.count - 1).astype(int)
    assert np.all(found.f_hz >= f_hz[found.first] * (1.0 - 1e-12))
    assert np.all(found.f_hz <= f_hz[last] * (1.0 + 1e-12))


def test_bins_are_narrow_at_steep_spectra():
    n, rate_hz = 360_000, 100.0
    found = build_frequency_bins(n, rate_hz)
    step_hz = 0.5 * rate_hz / n
    width_hz = found.count * step_hz
    assert np.all(found.count[:20] == 1)
    slow, high = found.first > 100, found.f_hz > 0.45 * rate_hz
    assert np.all(width_hz[slow] < 0.1 * found.f_hz[slow])
    assert width_hz.max() <= 0.1 + 2 * step_hz
    assert np.all(width_hz[high] <= 0.1 * (0.5 * rate_hz - found.f_hz[high]) + 2 * step_hz)
    around = build_frequency_bins(n, rate_hz, [(17.3, 0.02)])
    near = np.abs(around.f_hz - 17.3) < 0.02
    assert np.count_nonzero(near) > 10
    assert np.max((around.count * step_hz)[near]) < 0.01


def test_values_are_summed_over_bins_and_expanded_again():
    found = build_frequency_bins(5000, 100.0, [(10.0, 0.5)])
    values = np.random.default_rng(0).standard_normal(4999)
    direct, at = [], 0
    for count in found.count.astype(int):
        direct.append(sum(values[at : at + count]))
        at += count
    assert found.sum_over_bins(values) == pytest.approx(direct)
    each = found.expand_to_coefficients(np.arange(found.count.size, dtype=float))
    assert each.size == 4999
    assert found.sum_over_bins(each) == pytest.approx(np.arange(found.count.size) * found.count)


def test_short_array_is_summed_as_if_padded_with_zeros():
    bins = build_frequency_bins(10_000, 100.0)
    products = np.random.default_rng(0).standard_normal(9999)
    for size in (1, 48, 5000, 9999):
        padded = np.where(np.arange(9999) < size, products, 0.0)
        np.testing.assert_allclose(bins.sum_over_bins(products[:size]), bins.sum_over_bins(padded), atol=1e-9)


@pytest.mark.parametrize("turns", [0.1, 0.4999, 0.5001, 0.6, 0.75, 1.3])
def test_transform_of_a_sinusoid_is_exact_even_beyond_half_the_sample_rate(turns):
    n, first = 1000, 5
    phase = 2.0 * np.pi * turns * np.arange(first, first + n)
    half_sines = np.sin(0.5 * np.pi * np.arange(1, n) / n)
    sine, cosine = sinusoid_cosine_transforms(turns, first, half_sines)
    assert sine == pytest.approx(cosine_transform(np.sin(phase)), abs=1e-8)
    assert cosine == pytest.approx(cosine_transform(np.cos(phase)), abs=1e-8)
