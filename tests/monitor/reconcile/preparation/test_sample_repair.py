"""Tests that filled samples have the level, drift, white variance and spectrum of the recording."""

import numpy as np
import pytest
from scipy import signal

from monitor.reconcile.preparation.sample_repair import fill_missing_samples, restore_clipped_samples

N = 200_000


def rng(seed=0):
    return np.random.default_rng(seed)


def test_good_samples_and_the_input_are_not_changed():
    y = rng().standard_normal(5_000)
    y[3] = np.nan
    before = y.copy()
    mask = rng(1).random(5_000) < 0.05
    new = fill_missing_samples(y, mask, rng(2))
    assert np.array_equal(y, before, equal_nan=True)
    kept = ~mask & np.isfinite(y)
    assert np.array_equal(new[kept], y[kept])
    assert np.isfinite(new).all()
    assert not np.array_equal(new[mask], y[mask])


def test_same_seed_gives_the_same_samples():
    y, mask = rng().standard_normal(5_000), rng(1).random(5_000) < 0.05
    assert np.array_equal(fill_missing_samples(y, mask, rng(2)), fill_missing_samples(y, mask, rng(2)))
    assert not np.array_equal(fill_missing_samples(y, mask, rng(2)), fill_missing_samples(y, mask, rng(3)))


def test_spectrum_is_unbiased():
    """With one percent of missing samples, the mean of each wide frequency band changes by less than 0.1 %."""
    apart = []
    for seed in range(6):
        y = rng(seed).standard_normal(N)
        new = fill_missing_samples(
            np.where(rng(seed + 50).random(N) < 0.01, 99.0, y), np.asarray(rng(seed + 50).random(N) < 0.01), rng(seed)
        )
        power, truth = (np.abs(np.fft.rfft(x))[200:] ** 2 for x in (new, y))
        apart.append([power[part].sum() / truth[part].sum() - 1.0 for part in (slice(0, 30_000), slice(30_000, None))])
    assert np.abs(np.mean(apart, axis=0)).max() < 1e-3


def test_white_variance_and_differences_are_kept():
    y = rng().standard_normal(N)
    mask = rng(1).random(N) < 0.4
    new = fill_missing_samples(y, mask, rng(2))
    assert new[mask].var() == pytest.approx(1.0, abs=0.02)
    assert np.diff(new).var() == pytest.approx(2.0, abs=0.04)


@pytest.mark.parametrize("drift", [1e-3, 0.05])
def test_drift_continues_through_short_gaps(drift):
    walk = np.cumsum(drift * rng().standard_normal(N)) + 9.81
    mask = np.zeros(N, dtype=bool)
    for at in range(500, N - 500, 1000):
        mask[at : at + 30] = True
    new = fill_missing_samples(walk + 0.3 * rng(1).standard_normal(N), mask, rng(2))
    left = (new - walk)[mask]
    assert abs(left.mean()) < 0.03
    assert left.std() == pytest.approx(0.3, rel=0.45 if drift > 0.01 else 0.05)


def test_long_gap_is_bridged_between_its_ends():
    level = np.where(np.arange(N) < 120_000, 0.0, 10.0)
    mask = np.zeros(N, dtype=bool)
    mask[100_000:140_000] = True
    new = fill_missing_samples(level + 0.1 * rng().standard_normal(N), mask, rng(2))
    means = new[100_000:140_000].reshape(40, 1000).mean(axis=1)
    assert means == pytest.approx(np.linspace(0.125, 9.875, 40), abs=0.05)
    assert np.diff(new[100_000:140_000]).std() == pytest.approx(0.1 * 2.0**0.5, rel=0.05)


def test_bridge_has_the_random_walk_of_the_recording():
    spreads = []
    for seed in range(12):
        walk = np.cumsum(0.02 * rng(seed).standard_normal(N))
        mask = np.zeros(N, dtype=bool)
        mask[100_000:104_000] = True
        new = fill_missing_samples(walk + rng(seed + 50).standard_normal(N), mask, rng(seed))
        middle = new[101_500:102_500].mean()
        spreads.append(middle - 0.5 * (walk[100_000] + walk[104_000]))
    assert np.std(spreads) == pytest.approx(0.02 * 1000.0**0.5, rel=0.6)  # √(L/4) of the walk in the middle


@pytest.mark.parametrize("hole", [slice(0, 6_000), slice(500, 6_500), slice(60_000, 66_000), slice(94_000, 100_000)])
def test_long_gap_continues_the_spectrum_at_all_frequencies(hole):
    sos = signal.butter(2, 0.1, output="sos")
    y = signal.sosfilt(sos, rng().standard_normal(100_000)) + 1e-3 * rng(1).standard_normal(100_000)
    mask = np.zeros(y.size, dtype=bool)
    mask[hole] = True
    _, filled = signal.welch(fill_missing_samples(y, mask, rng(2))[hole], nperseg=256)
    _, truth = signal.welch(y, nperseg=256)
    bands = np.array_split(filled[1:] / truth[1:], 8)
    assert [band.mean() for band in bands] == pytest.approx(np.ones(8), abs=0.25)


def test_long_gaps_close_together_are_not_filled_periodically():
    y = rng().standard_normal(20_000)
    mask = np.zeros(y.size, dtype=bool)
    mask[5_000:8_000] = mask[8_005:11_000] = True
    filled = fill_missing_samples(y, mask, rng(1))[5_000:11_000]
    power = np.abs(np.fft.rfft(filled - filled.mean())) ** 2 / filled.size
    assert power.max() < 20.0
    assert filled.std() == pytest.approx(1.0, abs=0.05)


def test_gaps_at_the_ends_have_the_adjacent_level():
    y = 5.0 + 0.1 * rng().standard_normal(2_000)
    mask = np.zeros(2_000, dtype=bool)
    mask[:300] = mask[-300:] = True
    new = fill_missing_samples(y, mask, rng(1))
    assert new[:300].mean() == pytest.approx(5.0, abs=0.05)
    assert new[-300:].std() == pytest.approx(0.1, rel=0.2)


def test_at_least_one_good_sample_is_needed():
    assert fill_missing_samples(np.array([np.nan, 2.0, np.nan]), np.zeros(3, dtype=bool), rng()).tolist() == [
        2.0,
        2.0,
        2.0,
    ]
    with pytest.raises(ValueError, match="contains no good sample"):
        fill_missing_samples(np.full(5, np.nan), np.zeros(5, dtype=bool), rng())
    assert fill_missing_samples(np.arange(3.0), np.zeros(3, dtype=bool), rng()).tolist() == [0.0, 1.0, 2.0]


@pytest.mark.parametrize("limit", [1.0, 2.0, 3.5])
@pytest.mark.parametrize("mean", [0.0, 0.6])
def test_clipped_samples_get_their_distribution_back(limit, mean):
    x = mean + rng().standard_normal(N)
    new = restore_clipped_samples(np.clip(x, -limit, limit), limit, 1.0, rng(1))
    inside = np.abs(x) < limit
    assert np.array_equal(new[inside], x[inside])
    assert (np.abs(new[~inside]) >= limit).all()
    assert np.array_equal(np.sign(new[~inside]), np.sign(x[~inside]))
    assert new.mean() == pytest.approx(mean, abs=0.01)
    assert new.std() == pytest.approx(1.0, abs=0.01)
    assert np.quantile(new, 0.999) == pytest.approx(mean + 3.09, abs=0.15)


def test_level_beyond_the_limit_is_found_and_missing_samples_stay():
    x = 2.3 + rng().standard_normal(N)
    y = np.minimum(x, 2.0)
    y[::1000] = np.nan
    new = restore_clipped_samples(y, 2.0, 1.0, rng(1))
    assert np.isnan(new[::1000]).all()
    assert np.nanmean(new) == pytest.approx(2.3, abs=0.1)


def test_samples_without_clipping_are_not_changed():
    y = rng().standard_normal(1_000)
    assert np.array_equal(restore_clipped_samples(y, 10.0, 1.0, rng(1)), y)
