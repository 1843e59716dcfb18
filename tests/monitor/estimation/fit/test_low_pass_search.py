"""Tests of the search for a low-pass filter in the sensor, which must not affect N and its interval."""

import numpy as np
import pytest
from scipy.signal import butter, sosfilt

from drivers.data_types import make_block
from monitor.estimation.allan.batch import overlapping_avar
from monitor.estimation.analysis import analyze
from monitor.estimation.estimator import Estimator
from monitor.estimation.fit.low_pass_search import LowPass, is_visible_in_spectrum, power_spectrum

RATE_HZ = 100.0
ANGLE_RANDOM_WALK = 1.5e-4


def simulate_filtered_noise(order, cutoff_hz, n, seed=1):
    """Return white noise of level N after a digital Butterworth low-pass filter, without the transient."""
    sections = butter(order, cutoff_hz, fs=RATE_HZ, output="sos")
    white = ANGLE_RANDOM_WALK * np.sqrt(RATE_HZ) * np.random.default_rng(seed).standard_normal((n + 5000, 6))
    return sosfilt(sections, white, axis=0)[5000:]


def analyze_values(values):
    return analyze([make_block(np.arange(len(values)) * 10_000_000, values)], RATE_HZ)


def count_intervals_containing_n(found):
    c = found.estimate.coefficients
    return int(((c.lo[1] <= ANGLE_RANDOM_WALK) & (c.hi[1] >= ANGLE_RANDOM_WALK)).sum())


@pytest.mark.parametrize(("order", "cutoff_hz"), [(1, 10.0), (2, 30.0), (4, 5.0)])
def test_column_is_the_allan_variance_of_filtered_noise(order, cutoff_hz):
    factors = np.array([1, 2, 5, 16, 100, 1000])
    values = simulate_filtered_noise(order, cutoff_hz, 400_000)
    measured = overlapping_avar(values, factors)[0].mean(axis=1) / (ANGLE_RANDOM_WALK**2 * RATE_HZ)
    stated = LowPass("digital", order, cutoff_hz / RATE_HZ).filtered_white_noise_avar(factors)
    assert measured[:4] == pytest.approx(stated[:4], rel=0.02)
    assert measured == pytest.approx(stated, rel=0.12)


@pytest.mark.long
@pytest.mark.parametrize("cutoff_hz", [3.0, 20.0])
def test_analogue_filter_equals_a_much_faster_digital_filter(cutoff_hz):
    sections = butter(2, cutoff_hz, fs=20 * RATE_HZ, output="sos")
    fast = sosfilt(sections, np.random.default_rng(2).standard_normal((2_000_000, 6)), axis=0)[20_000:]
    factors = np.array([1, 2, 8, 64])
    measured = overlapping_avar(fast[::20], factors)[0].mean(axis=1)
    stated = LowPass("sampled", 2, cutoff_hz / RATE_HZ).filtered_white_noise_avar(factors)
    assert measured / stated == pytest.approx(np.full(4, (measured / stated).mean()), rel=0.04)


@pytest.mark.long
@pytest.mark.parametrize("order", [1, 2, 3, 4])
@pytest.mark.parametrize("cutoff_hz", [3.0, 10.0, 33.0])
def test_n_is_correct_for_any_bandwidth(order, cutoff_hz):
    found = analyze_values(simulate_filtered_noise(order, cutoff_hz, 360_000, seed=order))
    assert count_intervals_containing_n(found) >= 4
    assert found.estimate.coefficients.value[1] == pytest.approx(ANGLE_RANDOM_WALK, rel=0.03)
    known = np.isfinite(found.bandwidth_hz)
    assert known.sum() >= 4
    # At low noise levels, an order is easily confused with its neighbor at a slightly different cutoff.
    assert found.bandwidth_hz[known] == pytest.approx(cutoff_hz, rel=0.3)


@pytest.mark.long
def test_white_noise_and_lines_have_no_bandwidth():
    white = ANGLE_RANDOM_WALK * 10.0 * np.random.default_rng(4).standard_normal((200_000, 6))
    assert np.isnan(analyze_values(white).bandwidth_hz).all()
    line = white + 2e-3 * np.sin(2.0 * np.pi * 20.3 * np.arange(200_000) / RATE_HZ)[:, None]
    assert np.isnan(analyze_values(line).bandwidth_hz).all()


@pytest.mark.long
def test_live_estimate_finds_the_filter():
    values = simulate_filtered_noise(2, 20.0, 120_000)
    estimator = Estimator(RATE_HZ, 1200.0)
    estimator.add_samples(make_block(np.arange(len(values)) * 10_000_000, values))
    before = estimator.get_estimate()
    for _ in range(6 * 65):  # steps of the searches of six axes
        estimator.step_slow_statistics()
    after = estimator.get_estimate()
    assert np.isnan(before.fitted[0]).any() or (before.fitted[0] != after.fitted[0]).any()
    c = after.coefficients
    assert ((c.lo[1] <= ANGLE_RANDOM_WALK) & (c.hi[1] >= ANGLE_RANDOM_WALK)).sum() >= 5
    assert np.isfinite(after.fitted).all()
    np.testing.assert_allclose(after.fitted[0], after.curve.avar[0], rtol=0.03)


@pytest.mark.long
def test_resonance_is_not_taken_for_a_filter():
    # A strong wide resonance lowers the shortest τ as a low-pass does, but its spectrum does not end.
    rng = np.random.default_rng(3)
    values = ANGLE_RANDOM_WALK * np.sqrt(RATE_HZ) * rng.standard_normal((200_000, 6))
    sections = butter(2, [3.0, 5.0], "bandpass", fs=RATE_HZ, output="sos")
    values += 20.0 * ANGLE_RANDOM_WALK * np.sqrt(RATE_HZ) * sosfilt(sections, rng.standard_normal((200_000, 6)), axis=0)
    found = analyze([make_block(np.arange(len(values)) * 10_000_000, values)], RATE_HZ)
    assert (found.fit.misfit > 1.0).all() or (found.fit.left_out > 0).all()
    assert np.isnan(found.bandwidth_hz).all()


def test_filter_visibility_uses_medians_of_the_spectrum():
    spectrum = power_spectrum(simulate_filtered_noise(2, 20.0, 100_000)[:, 0])
    assert is_visible_in_spectrum(LowPass("digital", 2, 0.2), spectrum)
    assert not is_visible_in_spectrum(LowPass("digital", 2, 0.05), spectrum)
    assert not is_visible_in_spectrum(LowPass("digital", 2, 0.001), spectrum)  # below the lowest bin
    spectrum[700:703] *= 1e6  # a line beyond the cutoff
    assert is_visible_in_spectrum(LowPass("digital", 2, 0.2), spectrum)
    assert power_spectrum(np.zeros(100)).size == 0
    assert not is_visible_in_spectrum(LowPass("digital", 2, 0.2), power_spectrum(np.zeros(100)))


def test_spectrum_ignores_missing_samples():
    values = simulate_filtered_noise(2, 20.0, 100_000)[:, 0]
    absent = np.full(100_000, np.nan)
    assert np.median(power_spectrum(np.concatenate([absent, values])) / power_spectrum(values)) == pytest.approx(
        1.0, rel=0.2
    )
    assert power_spectrum(absent).size == 0
