"""Tests of the gains of single diagnostics against least squares, periodograms and explicit sums."""

import numpy as np
import pytest
from scipy.optimize import minimize_scalar
from scipy.signal import periodogram

from monitor.noise.effects import (
    AngleRandomWalk,
    BiasCurve,
    NoiseStep,
    RateRamp,
    RateRandomWalk,
    Resolution,
    Sinusoidal,
    TurnOnTransient,
)
from monitor.reconcile.diagnostics import whiteness_tests
from monitor.reconcile.diagnostics.whiteness_tests import (
    _regressor_gain,
    compute_level_step_gains,
    find_peak_gains_and_frequencies,
    fitted_variance_gain_nats,
)
from monitor.reconcile.likelihood.whitening import compute_periodogram, relative_noise_std_over_time
from monitor.reconcile.preparation.cosine_bins import cosine_transform
from tests.monitor.reconcile.axes import RATE_HZ, WHITE, N, axes, axis, correlated, time_s, walk, white, whiten

n = 4800
MODEL = (WHITE, RateRandomWalk(K=1e-4))

CURVE = (BiasCurve(slope=1.0, curvature=1.0), 1)  # regressor t²


def draw_axis(seed=0, size=n):
    rng = np.random.default_rng(seed)
    return white(size, rng) + walk(size, rng, 1e-4)


def least_squares_gain(view, columns):
    """Return ½ (|w|² − min |w − X b|²) of the whitened coefficients."""
    x = np.stack([column * view.weights for column in columns], axis=1)
    left = view.coefficients - x @ np.linalg.lstsq(x, view.coefficients, rcond=None)[0]
    return 0.5 * float(view.coefficients @ view.coefficients - left @ left)


@pytest.mark.parametrize("model", [(WHITE,), MODEL], ids=["white", "with a walk"])
def test_gain_of_a_step_at_each_time_equals_least_squares(model):
    y = draw_axis() + 3e-3 * (np.arange(n) >= 1700)
    view = whiten(axis(y), model)
    gains, times_s, _ = compute_level_step_gains(view)
    for at in (0, 1, 700, int(np.argmax(gains)), gains.size - 2, gains.size - 1):
        step = cosine_transform(np.where(np.arange(n) >= round(times_s[at] * RATE_HZ), 1.0, 0.0))
        assert gains[at] == pytest.approx(least_squares_gain(view, [step]), rel=1e-6, abs=1e-9)
    assert times_s[np.argmax(gains)] == pytest.approx(17.0, abs=0.05)


def test_gains_in_a_long_recording_equal_least_squares():
    """In long recordings, steps are weighted on a coarse grid, and smooth regressors are shortened."""
    size = 2 * whiteness_tests.MAX_STEP_GRID + 4321
    y = draw_axis(9, size) + 3e-3 * (np.arange(size) >= 17_000)
    view = whiten(axis(y), MODEL)
    gains, times_s, places = compute_level_step_gains(view)
    for at in (0, 1, 700, 33_333, int(np.argmax(gains)), gains.size - 1):
        step = cosine_transform(np.where(np.arange(size) >= round(times_s[at] * RATE_HZ), 1.0, 0.0))
        assert gains[at] == pytest.approx(least_squares_gain(view, [step]), rel=1e-4, abs=1e-6)
    assert 1.0 < places < size
    t = time_s(size)
    transient = TurnOnTransient(amplitude=1.0, time_constant=0.05 * t[-1])
    for regressor, series in (
        ((RateRamp(R=1.0), 0), t),
        (CURVE, t**2),
        ((transient, 0), np.exp(-t / (0.05 * t[-1]))),
    ):
        exact = least_squares_gain(view, [cosine_transform(series)])
        assert _regressor_gain(view, [regressor]) == pytest.approx(
            exact, rel=1e-4, abs=0.01
        )  # nats, of a threshold of about 12


def test_gain_of_a_regressor_equals_least_squares():
    t = time_s(n)
    view = whiten(axis(draw_axis(1) + 1e-4 * t), MODEL)
    columns = [cosine_transform(t), cosine_transform(t**2), cosine_transform(np.sin(t))]
    regressors = [(RateRamp(R=1.0), 0), CURVE, (Sinusoidal(amplitude=1.0, frequency=0.5 / np.pi), 0)]
    assert _regressor_gain(view, regressors[:1]) == pytest.approx(least_squares_gain(view, columns[:1]), rel=1e-6)
    assert _regressor_gain(view, regressors) == pytest.approx(least_squares_gain(view, columns), rel=1e-5)
    assert _regressor_gain(view, [regressors[0], regressors[0]]) == pytest.approx(
        _regressor_gain(view, regressors[:1]), rel=1e-4
    )
    fitted = whiten(axis(draw_axis(1) + 1e-4 * t), (*MODEL, RateRamp(R=1.0)))
    assert _regressor_gain(fitted, regressors[:1]) == pytest.approx(0.0, abs=1e-6)
    assert _regressor_gain(fitted, regressors[2:]) == pytest.approx(least_squares_gain(fitted, columns[2:]), rel=1e-5)


def test_gain_of_power_equals_a_free_variance():
    rng = np.random.default_rng(2)
    for scale, count in ((1.0, 50), (1.6, 50), (0.5, 8), (3.0, 1)):
        w = scale * rng.standard_normal(count)

        def loss(log_v, w=w):
            return 0.5 * float(np.sum(log_v + w**2 * np.exp(-log_v)))

        best = loss(0.0) - minimize_scalar(loss).fun
        assert fitted_variance_gain_nats(np.mean(w**2, keepdims=True), np.array([count]))[0] == pytest.approx(
            best, abs=1e-6
        )
    assert np.isfinite(fitted_variance_gain_nats(np.zeros(1), np.ones(1))).all()


def test_peaks_of_the_periodogram_equal_scipy():
    rng = np.random.default_rng(3)
    w = rng.standard_normal(n) + 0.3 * np.sin(2 * np.pi * 7.3 * time_s(n)) + 0.2 * np.cos(2 * np.pi * 31.0 * time_s(n))
    (first, f1), (second, f2), (third, _) = find_peak_gains_and_frequencies(compute_periodogram(w), RATE_HZ, 3)
    assert (f1, f2) == (pytest.approx(7.3, abs=0.02), pytest.approx(31.0, abs=0.02))
    assert first > second > third
    f, power = periodogram(w, RATE_HZ, detrend=False, scaling="density", nfft=2 * n)
    top = np.argmax(power)
    assert first == pytest.approx(0.5 * power[top] * RATE_HZ, rel=0.02)
    assert f1 == pytest.approx(f[top], abs=RATE_HZ / n)
    # a line A sin in white noise of variance one gains A² n/4, give or take its own scatter
    assert first == pytest.approx(0.3**2 * n / 4, abs=4 * np.sqrt(0.3**2 * n / 2))


def test_autocorrelation_is_the_sum_of_products():
    view = whiten(axis(draw_axis(4) + correlated(n, np.random.default_rng(5), 4e-4, 0.03)), MODEL)
    products = [view.series[:-lag] @ view.series[lag:] / n for lag in range(1, whiteness_tests.MAX_LAG_SAMPLES + 1)]
    found = whiteness_tests.diagnose_autocorrelation(view)
    best = int(np.argmax(np.square(products)))
    assert found.gain == pytest.approx(0.5 * n * products[best] ** 2)
    assert found.where.tau == (pytest.approx((best + 1) / RATE_HZ),) * 2


def test_gain_of_the_spectrum_is_at_least_that_of_every_bin():
    view = whiten(axis(draw_axis(6)), MODEL)
    bins = view.axis.bins
    each = fitted_variance_gain_nats(bins.sum_over_bins(view.coefficients**2) / bins.count, bins.count)
    whole = fitted_variance_gain_nats(np.array([np.mean(view.coefficients**2)]), np.array([n - 1.0]))[0]
    found = whiteness_tests.diagnose_psd(view)
    assert found.gain >= each.max() - 1e-9
    wider = whiteness_tests.diagnose_psd(whiten(axis(1.2 * draw_axis(6)), MODEL))
    assert wider.gain > 0.8 * (whole + n / 2 * (0.44 - np.log(1.44)))
    lo, hi = wider.where.frequency
    assert hi - lo > 10.0


def test_true_model_makes_an_axis_white():
    squares, fast = [], []
    for seed in range(20):
        view = whiten(axis(draw_axis(seed)), MODEL)
        squares.append(view.coefficients**2)
        fast.append(view.flat_series**2)
    at = np.mean(squares, axis=0)
    for group in np.array_split(at, 12):  # 400 coefficients of 20 runs: scatter 1.6 %
        assert group.mean() == pytest.approx(1.0, abs=0.06)
    assert np.mean(fast) == pytest.approx(1.0, abs=0.03)


def test_fast_series_is_white_for_every_spectrum():
    size = 40_000
    y = draw_axis(7, size) + correlated(size, np.random.default_rng(8), 3e-3, 0.05)
    view = whiten(axis(y), (WHITE,))
    assert np.mean(view.series**2) > 2.0
    assert np.mean(view.flat_series**2) == pytest.approx(1.0, abs=0.05)
    assert whiteness_tests.diagnose_outliers(view).gain < 5.0
    assert whiteness_tests.diagnose_variance_change(view).gain < 15.0


def test_noise_steps_of_a_model_change_the_expected_variance():
    steady = axis(draw_axis())
    course = relative_noise_std_over_time(steady.fit((WHITE, NoiseStep(time=12.0, ratio=3.0))))
    assert np.mean(course**2) == pytest.approx(1.0)
    assert course[1200] / course[1199] == pytest.approx(3.0)
    assert np.unique(course).size == 2
    np.testing.assert_array_equal(relative_noise_std_over_time(steady.fit((WHITE,))), np.ones(n))
    y = white(n, np.random.default_rng(9)) * np.where(time_s(n) < 12.0, 1.0, 3.0)
    effects = (AngleRandomWalk(N=N), NoiseStep(time=12.0, ratio=3.0))
    assert whiteness_tests.diagnose_variance_change(whiten(axis(y), effects)).gain < 15.0
    assert whiteness_tests.diagnose_variance_change(whiten(axis(y), (AngleRandomWalk(N=2.5 * N),))).gain > 300.0


def test_effects_of_the_model_are_no_finding():
    y = 5e-4 * np.rint(white(n, np.random.default_rng(10)) / 5e-4)
    assert whiteness_tests.diagnose_quantization_clipping_repeats(whiten(axis(y), (WHITE,))).gain > 1000.0
    model = (WHITE, Resolution(step=5e-4))
    assert whiteness_tests.diagnose_quantization_clipping_repeats(whiten(axis(y, model), model)).gain < 1.0


def test_location_at_the_ends_of_the_range_is_their_value():
    y = np.clip(white(n, np.random.default_rng(11)), -1.5e-3, 1.5e-3)
    found = whiteness_tests.diagnose_quantization_clipping_repeats(whiten(axis(y), (WHITE,)))
    assert found.gain > 100.0
    lo, hi = found.where.value
    assert lo <= 1.5e-3 * (1 + 1e-9)
    assert hi >= 1.5e-3 * (1 - 1e-9)


def test_without_temperature_and_other_axes_there_is_no_finding():
    view = whiten(axis(draw_axis(12)), MODEL)
    assert whiteness_tests.diagnose_temperature_dependence(view).gain == 0.0
    assert whiteness_tests.diagnose_leaks_from_other_axes(view).gain == 0.0


def test_leaking_axis_is_named():
    rng = np.random.default_rng(13)
    gx, gy = correlated(n, rng, 1e-2, 1.0), correlated(n, rng, 1e-2, 1.0)
    one = axes({"gx": gx, "gy": gy, "gz": draw_axis(14) + 0.03 * gy}, {"gx": (), "gy": (), "gz": MODEL})["gz"]
    view = whiten(one, MODEL)
    found = whiteness_tests.diagnose_leaks_from_other_axes(view)
    assert found.where.source == "gy"
    assert found.gain == pytest.approx(least_squares_gain(view, [cosine_transform(gy)]), rel=1e-6)


def test_fitted_regressors_are_subtracted():
    line = 1e-3 * np.sin(2 * np.pi * 7.3 * time_s(n))
    one = axis(draw_axis(15) + line)
    model = (*MODEL, Sinusoidal(amplitude=1.0, frequency=7.3, phase=0.0))
    view = whiten(one, model)
    assert (
        whiteness_tests.diagnose_spectral_lines(view).gain
        < 20.0
        < whiteness_tests.diagnose_spectral_lines(whiten(one, MODEL)).gain
    )
