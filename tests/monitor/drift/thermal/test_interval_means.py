"""Tests of interval means and their standard errors."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from monitor.drift.thermal.interval_means import BUFFER_ROWS, RunningIntervalMeans, compute_interval_means


def test_standard_error_is_that_of_white_noise():
    y = 9.81 + 1e-3 * np.random.default_rng(1).standard_normal(400_000)
    means = compute_interval_means(y, np.full(y.size, 25.0), 100.0, 10.0)
    assert means.bias.size == 400
    assert np.std(means.bias) == pytest.approx(1e-3 / 1000**0.5, rel=0.1)
    assert np.sqrt(np.mean(means.error**2)) == pytest.approx(1e-3 / 1000**0.5, rel=0.05)


def test_drift_within_an_interval_does_not_increase_its_error():
    y = np.linspace(0.0, 1.0, 1000)
    means = compute_interval_means(y, y, 1.0, 1000.0)
    assert means.error[0] < 0.05


def test_interval_with_too_few_samples_is_missing():
    y = np.ones(100)
    y[:6], y[10:14] = np.nan, np.nan
    means = compute_interval_means(y, np.full(100, 20.0), 1.0, 10.0)
    assert np.isnan(means.bias[0])
    assert means.bias[1:].tolist() == [1.0] * 9
    assert means.both_known.tolist() == [False] + [True] * 9


def test_incomplete_last_interval_is_omitted():
    assert compute_interval_means(np.ones(25), np.ones(25), 1.0, 10.0).bias.size == 2


def test_recording_without_values_has_no_known_interval():
    assert compute_interval_means(np.full(20, np.nan), np.ones(20), 1.0, 10.0).both_known.tolist() == [False, False]


def simulate_recording(seed: int, n: int, missing_share: float) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    values = 9.81 + 1e-3 * rng.standard_normal((n, 6)) + 1e-5 * np.arange(n)[:, None]
    values[rng.random((n, 6)) < missing_share] = np.nan
    temperature_c = 25.0 + 0.01 * rng.standard_normal(n)
    temperature_c[rng.random(n) < 0.5 * missing_share] = np.nan
    return values, temperature_c


@pytest.mark.long
@given(
    length=st.integers(8, 300),
    seed=st.integers(0, 99),
    missing_share=st.sampled_from([0.0, 0.3, 0.55]),
    cuts=st.lists(st.integers(0, 1500), max_size=12),
    hole=st.tuples(st.integers(0, 1500), st.integers(0, 700)),
)
@settings(deadline=None)
def test_running_means_equal_those_of_the_whole_recording(length, seed, missing_share, cuts, hole):
    values, temperature_c = simulate_recording(seed, 1500, missing_share)
    first, lost = hole[0], min(hole[1], 1500 - hole[0])
    values[first : first + lost], temperature_c[first : first + lost] = np.nan, np.nan
    means, found = RunningIntervalMeans(length), []
    edges = sorted({0, 1500, first, first + lost, *cuts} - set(range(first + 1, first + lost)))
    behind = 0
    for lo, hi in pairwise(edges):
        if lost and lo == first:
            behind = lost
        else:
            found += means.add_samples(values[lo:hi], temperature_c[lo:hi], behind)
            behind = 0
    if behind:  # missing samples are reported with the following block
        found += means.add_samples(values[:0], temperature_c[:0], behind)
    assert [interval.end for interval in found] == [length * (k + 1) for k in range(1500 // length)]
    for axis in range(6):
        want = compute_interval_means(values[:, axis], temperature_c, 1.0, float(length))
        np.testing.assert_allclose([interval.bias[axis] for interval in found], want.bias, rtol=1e-12)
        np.testing.assert_allclose([interval.error[axis] for interval in found], want.error, rtol=1e-6)
        np.testing.assert_allclose([interval.temperature_c for interval in found], want.temperature_c, rtol=1e-12)


def test_block_sizes_do_not_change_the_means():
    values, temperature_c = simulate_recording(1, 5 * BUFFER_ROWS, 0.2)
    whole = RunningIntervalMeans(3 * BUFFER_ROWS).add_samples(values, temperature_c, 0)
    means = RunningIntervalMeans(3 * BUFFER_ROWS)
    single = [
        interval
        for k in range(len(values))
        for interval in means.add_samples(values[k : k + 1], temperature_c[k : k + 1], 0)
    ]
    assert len(whole) == len(single) == 1
    assert whole[0].bias.tolist() == single[0].bias.tolist()
    assert whole[0].error.tolist() == single[0].error.tolist()


def test_very_long_gap_is_skipped_at_once():
    means = RunningIntervalMeans(100, longest=5)
    found = means.add_samples(np.ones((30, 6)), np.full(30, 20.0), 10**12)
    assert len(found) == 5
    assert found[-1].end == 10**12
    assert np.isnan(found[-1].bias).all()
    (after,) = means.add_samples(np.ones((70, 6)), np.full(70, 20.0), 0)
    assert (after.end, after.temperature_c) == (10**12 + 100, 20.0)
    assert after.bias.tolist() == pytest.approx([1.0] * 6)
