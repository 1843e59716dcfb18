import numpy as np

from monitor.reconcile.recording_checks.median_block_spectrum import compute_robust_spectrum


def test_factor_of_the_samples_scales_all_bands():
    y = np.random.default_rng(0).standard_normal(20_000)
    one, two = compute_robust_spectrum(y, 100.0), compute_robust_spectrum(np.pi * y + 7.0, 100.0)
    np.testing.assert_allclose(two.log_power - one.log_power, 2.0 * np.log(np.pi), atol=1e-9)


def test_error_is_the_scatter_between_recordings():
    rng = np.random.default_rng(1)
    many = [compute_robust_spectrum(rng.standard_normal(16_000), 100.0) for _ in range(200)]
    scatter = np.std([one.log_power for one in many], axis=0)
    told = np.mean([one.error for one in many], axis=0)
    assert 0.8 < np.median(told / scatter) < 1.25


def test_knock_and_a_hole_change_little():
    y = np.random.default_rng(2).standard_normal(20_000)
    changed = y.copy()
    changed[5000:5050] += 100.0
    changed[9000:9600] = np.nan
    one, two = compute_robust_spectrum(y, 100.0), compute_robust_spectrum(changed, 100.0)
    assert np.abs(two.log_power - one.log_power).max() < 5.0 * one.error.max()


def test_too_few_samples_or_no_noise_give_no_spectrum():
    assert compute_robust_spectrum(np.full(20_000, np.nan), 100.0) is None
    assert compute_robust_spectrum(np.ones(20_000), 100.0) is None
