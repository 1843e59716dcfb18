"""Tests that filled and repaired samples have the level, drift, variance and spectrum of the recording."""

import numpy as np
import pytest
from scipy import signal

from drivers.data_types import AXES
from monitor.noise.effects import (
    AngleRandomWalk,
    BandwidthLimit,
    Outliers,
    QuantizationNoise,
    RandomSampleHold,
    Resolution,
    Saturation,
    Sinusoidal,
)
from monitor.reconcile.preparation.cosine_bins import cosine_transform
from monitor.reconcile.preparation.value_artifacts import ValueArtifacts
from monitor.reconcile.search.sample_repair import (
    _may_leak,
    _repair_samples,
    fill_missing_samples,
    repair_axis_again,
    restore_clipped_samples,
)
from tests.monitor.reconcile.axes import RATE_HZ, WHITE, N, axes, axis, correlated, time_s, white

SAMPLES = 200_000
n = 12_000
SIGMA = N * RATE_HZ**0.5
RNG = 7


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
        y = rng(seed).standard_normal(SAMPLES)
        new = fill_missing_samples(
            np.where(rng(seed + 50).random(SAMPLES) < 0.01, 99.0, y),
            np.asarray(rng(seed + 50).random(SAMPLES) < 0.01),
            rng(seed),
        )
        power, truth = (np.abs(np.fft.rfft(x))[200:] ** 2 for x in (new, y))
        apart.append([power[part].sum() / truth[part].sum() - 1.0 for part in (slice(0, 30_000), slice(30_000, None))])
    assert np.abs(np.mean(apart, axis=0)).max() < 1e-3


def test_white_variance_and_differences_are_kept():
    y = rng().standard_normal(SAMPLES)
    mask = rng(1).random(SAMPLES) < 0.4
    new = fill_missing_samples(y, mask, rng(2))
    assert new[mask].var() == pytest.approx(1.0, abs=0.02)
    assert np.diff(new).var() == pytest.approx(2.0, abs=0.04)


@pytest.mark.parametrize("drift", [1e-3, 0.05])
def test_drift_continues_through_short_gaps(drift):
    walk = np.cumsum(drift * rng().standard_normal(SAMPLES)) + 9.81
    mask = np.zeros(SAMPLES, dtype=bool)
    for at in range(500, SAMPLES - 500, 1000):
        mask[at : at + 30] = True
    new = fill_missing_samples(walk + 0.3 * rng(1).standard_normal(SAMPLES), mask, rng(2))
    left = (new - walk)[mask]
    assert abs(left.mean()) < 0.03
    assert left.std() == pytest.approx(0.3, rel=0.45 if drift > 0.01 else 0.05)


def test_long_gap_is_bridged_between_its_ends():
    level = np.where(np.arange(SAMPLES) < 120_000, 0.0, 10.0)
    mask = np.zeros(SAMPLES, dtype=bool)
    mask[100_000:140_000] = True
    new = fill_missing_samples(level + 0.1 * rng().standard_normal(SAMPLES), mask, rng(2))
    means = new[100_000:140_000].reshape(40, 1000).mean(axis=1)
    assert means == pytest.approx(np.linspace(0.125, 9.875, 40), abs=0.05)
    assert np.diff(new[100_000:140_000]).std() == pytest.approx(0.1 * 2.0**0.5, rel=0.05)


def test_bridge_has_the_random_walk_of_the_recording():
    spreads = []
    for seed in range(12):
        walk = np.cumsum(0.02 * rng(seed).standard_normal(SAMPLES))
        mask = np.zeros(SAMPLES, dtype=bool)
        mask[100_000:104_000] = True
        new = fill_missing_samples(walk + rng(seed + 50).standard_normal(SAMPLES), mask, rng(seed))
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
    x = mean + rng().standard_normal(SAMPLES)
    new = restore_clipped_samples(np.clip(x, -limit, limit), limit, 1.0, rng(1))
    inside = np.abs(x) < limit
    assert np.array_equal(new[inside], x[inside])
    assert (np.abs(new[~inside]) >= limit).all()
    assert np.array_equal(np.sign(new[~inside]), np.sign(x[~inside]))
    assert new.mean() == pytest.approx(mean, abs=0.01)
    assert new.std() == pytest.approx(1.0, abs=0.01)
    assert np.quantile(new, 0.999) == pytest.approx(mean + 3.09, abs=0.15)


def test_level_beyond_the_limit_is_found_and_missing_samples_stay():
    x = 2.3 + rng().standard_normal(SAMPLES)
    y = np.minimum(x, 2.0)
    y[::1000] = np.nan
    new = restore_clipped_samples(y, 2.0, 1.0, rng(1))
    assert np.isnan(new[::1000]).all()
    assert np.nanmean(new) == pytest.approx(2.3, abs=0.1)


def test_samples_without_clipping_are_not_changed():
    y = rng().standard_normal(1_000)
    assert np.array_equal(restore_clipped_samples(y, 10.0, 1.0, rng(1)), y)


def draw_noise(seed=0):
    return white(n, np.random.default_rng(seed))


@pytest.mark.parametrize("known", [True, False])
@pytest.mark.parametrize("loss", [0.05, 0.1, "bursts"])
@pytest.mark.parametrize("kind", ["low-pass filter", "quantization", "line"])
def test_missing_samples_do_not_change_the_spectrum(kind, loss, known):
    """Draws that ignore the spectrum change the power of a band by 5 to 2300 % in most cases."""
    generator = rng(8)
    drawn = generator.standard_normal(20_000 + 1)
    if kind == "low-pass filter":  # a first-order Butterworth filter
        b, a = signal.butter(1, 15.0, fs=RATE_HZ)
        y = N * RATE_HZ**0.5 * signal.lfilter(b, a, drawn)[1:]
        model = (WHITE, BandwidthLimit(cutoff=15.0, order=1))
    elif kind == "quantization":
        y = 1e-3 * np.diff(drawn) + white(20_000, generator, 3e-5)
        model = (QuantizationNoise(Q=1e-5), AngleRandomWalk(N=3e-5))
    else:
        y = white(20_000, generator) + 1e-3 * np.sin(2.0 * np.pi * 12.3 * time_s(20_000))
        model = (WHITE, Sinusoidal(frequency=12.3, amplitude=1e-3))
    lost = generator.random(20_000) < loss if loss != "bursts" else np.zeros(20_000, bool)
    for begin in generator.integers(0, 20_000, 20_000 // 1000) if loss == "bursts" else ():
        lost[begin : begin + 10] = True
    one = axis(np.where(lost, np.nan, y), model if known else (WHITE,))
    edges = np.array([100, 1000, 5000, 10_000, 14_000, 18_000])
    power, filled = (np.add.reduceat(cosine_transform(x) ** 2, edges) for x in (y, one.repaired))
    np.testing.assert_allclose(filled / power, 1.0, atol=0.05 if known else 0.3)
    np.testing.assert_array_equal(one.repaired[~lost], y[~lost])


def test_gaps_are_filled_from_adjacent_samples():
    y = correlated(n, np.random.default_rng(1), 1e-3, 2.0) + white(n, np.random.default_rng(2), 0.1 * N)
    holed = y.copy()
    lost = np.random.default_rng(3).random(n) < 0.1
    lost[5000:5100] = True
    holed[lost] = np.nan
    one = axis(holed, (WHITE,))
    np.testing.assert_array_equal(one.repaired[~lost], y[~lost])
    assert np.isfinite(one.repaired).all()
    assert np.std(one.repaired[lost] - y[lost]) < 0.5 * np.std(y)
    assert np.isnan(one.raw[lost]).all()


def test_input_is_not_changed():
    y = draw_noise()
    y[::50] = np.nan
    kept = y.copy()
    axes({"gx": y, "gz": draw_noise(1)}, (WHITE, Outliers(fraction=0.01, scale=1e-2), Saturation(limit=1.5e-3)))
    np.testing.assert_array_equal(y, kept)


def test_repeats_are_repaired_if_the_model_has_them():
    y, rng = draw_noise(), np.random.default_rng(4)
    held = rng.random(n) < 0.2
    held[0] = False
    for at in np.flatnonzero(held):
        y[at] = y[at - 1]
    shown = ValueArtifacts(y)
    assert shown.repeats is not None
    assert shown.repeats.fraction.value == pytest.approx(0.2, abs=0.03)
    as_it_is = _repair_samples(y, shown, (WHITE,), np.random.default_rng(RNG))
    np.testing.assert_array_equal(as_it_is, y)
    put_right = _repair_samples(y, shown, (WHITE, RandomSampleHold(fraction=0.2)), np.random.default_rng(RNG))
    assert np.count_nonzero(np.diff(put_right) == 0.0) == 0
    np.testing.assert_array_equal(put_right[~held], y[~held])
    assert np.std(put_right) == pytest.approx(SIGMA, rel=0.03)


def test_clipped_samples_are_drawn_beyond_the_limit():
    y = draw_noise()
    limit = 2.0 * SIGMA
    clipped = np.clip(y, -limit, limit)
    shown = ValueArtifacts(clipped)
    assert shown.clipping is not None
    mended = _repair_samples(clipped, shown, (WHITE, Saturation(limit=limit)), np.random.default_rng(RNG))
    at_limit = np.abs(clipped) >= limit
    np.testing.assert_array_equal(mended[~at_limit], clipped[~at_limit])
    assert np.all(np.abs(mended[at_limit]) >= limit * (1 - 1e-9))
    assert np.all(np.sign(mended[at_limit]) == np.sign(clipped[at_limit]))
    assert np.std(clipped) < 0.97 * SIGMA
    assert np.std(mended) == pytest.approx(SIGMA, rel=0.025)
    np.testing.assert_array_equal(_repair_samples(clipped, shown, (WHITE,), np.random.default_rng(RNG)), clipped)


def test_outliers_are_treated_as_missing_if_the_model_has_them():
    y, rng = draw_noise(), np.random.default_rng(5)
    far = rng.choice(n, 30, replace=False)
    y[far] += 20.0 * SIGMA * rng.choice([-1.0, 1.0], 30)
    plain = axis(y, (WHITE,))
    np.testing.assert_array_equal(plain.repaired, y)
    mended = axis(y, (WHITE, Outliers(fraction=30 / n, scale=20.0 * SIGMA)))
    assert np.abs(mended.repaired[far]).max() < 6.0 * SIGMA
    changed = np.flatnonzero(mended.repaired != y)
    assert set(far) <= set(changed)
    assert changed.size < 40
    np.testing.assert_array_equal(mended.raw, y)


def test_same_generator_gives_the_same_axis():
    y = draw_noise()
    y[::9] = np.nan
    one, other = axis(y, (WHITE,)), axis(y, (WHITE,))
    np.testing.assert_array_equal(one.coefficients, other.coefficients)
    third = axes({"gz": y}, (WHITE,), seed=1)["gz"]
    assert not np.array_equal(one.coefficients, third.coefficients)


def test_repair_for_other_effects_equals_a_new_preparation():
    y = np.clip(draw_noise(), -1.5 * SIGMA, 1.5 * SIGMA)
    model = (WHITE, Saturation(limit=1.5 * SIGMA))
    later = repair_axis_again(axis(y, (WHITE,)), model, np.random.default_rng(0))
    np.testing.assert_allclose(later.coefficients, axis(y, model).coefficients)
    back = repair_axis_again(later, (WHITE,), np.random.default_rng(0))
    np.testing.assert_array_equal(back.repaired, y)


def test_axes_leak_only_into_possible_targets():
    into = {one: {other for other in AXES if _may_leak(other, one)} for one in AXES}
    assert into["gx"] == {"gy", "gz", "ax", "ay", "az"}
    assert into["ay"] == {"ax", "az"}
    every = axes({name: draw_noise(k) for k, name in enumerate(AXES)}, (AngleRandomWalk(N=N),))
    assert {name: set(one.leak_sources) for name, one in every.items()} == into


def test_artifacts_of_values_are_detected():
    y = draw_noise()
    shown = ValueArtifacts(y)
    assert shown.quantization is None
    coarse = ValueArtifacts(4e-4 * np.rint(y / 4e-4))
    assert coarse.quantization is not None
    assert coarse.quantization.step.value == pytest.approx(4e-4)
    # repeats of coarse values are no repeats of samples
    one = axis(4e-4 * np.rint(y / 4e-4), (WHITE, Resolution(step=4e-4)))
    np.testing.assert_array_equal(one.repaired, one.raw)
