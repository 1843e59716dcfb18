"""Tests of the fit of one axis: estimated sizes equal the simulated ones, and spectra equal those of the model."""

from dataclasses import replace

import numpy as np
import pytest

from monitor.noise.effects import (
    AngleRandomWalk,
    BandwidthLimit,
    BiasInstability,
    CrossAxis,
    ExponentiallyCorrelated,
    Narrowband,
    NoiseStep,
    QuantizationNoise,
    RateRamp,
    RateRandomWalk,
    Resolution,
    Saturation,
    ScaleFactor,
    Sinusoidal,
    TemperatureBias,
)
from monitor.noise.model import NoiseModel
from monitor.reconcile.likelihood.axis_fit import RegressorCache
from monitor.reconcile.likelihood.hypothesis_fit import fit_with_model_sizes
from monitor.reconcile.preparation.cosine_bins import build_frequency_bins, cosine_transform
from tests.monitor.reconcile.axes import (
    RATE_HZ,
    TERMS,
    WALK,
    WHITE,
    K,
    N,
    axes,
    axis,
    correlated,
    make_temperature,
    time_s,
    walk,
    white,
)

n = 20_000
COMPANY = {
    "classic": (QuantizationNoise(Q=2e-7), *TERMS),
    "correlated": (*TERMS, ExponentiallyCorrelated(sigma=5e-4, correlation_time=0.3)),
    "resonance": (WHITE, Narrowband(sigma=5e-4, frequency=17.0, bandwidth=1.5)),
    "scaled": (*TERMS, ScaleFactor(factor=1.7)),
    "coarse": (WHITE, Resolution(step=5e-4)),
    "clipped far out": (WHITE, Saturation(limit=1.0)),
    "filtered": (*TERMS, BandwidthLimit(cutoff=12.0, order=2)),
    "filtered before noise": (*TERMS, BandwidthLimit(cutoff=12.0, order=2, kind="iir", floor=3e-5)),
    "scaled and filtered": (WHITE, ScaleFactor(factor=0.5), BandwidthLimit(cutoff=30.0, order=1)),
}


@pytest.mark.parametrize("name", COMPANY)
def test_spectrum_equals_that_of_the_model(name):
    effects = COMPANY[name]
    y = NoiseModel({"gz": effects}).simulate(n, RATE_HZ, 3)[:, 2].copy()
    one = axis(y, effects)
    found = fit_with_model_sizes(one, effects)
    expected = NoiseModel({"gz": effects}).two_sided_psd("gz", one.bins.f_hz, 1.0 / RATE_HZ)
    # a little white noise behind a filter is fitted too
    np.testing.assert_allclose(found.fit.whittle.variance / RATE_HZ, expected, rtol=0.02, atol=3e-5 * expected.max())
    assert found.effects == effects


def test_sizes_are_estimated_with_their_errors():
    off = []
    for seed in range(40):
        rng = np.random.default_rng(seed)
        y = white(n, rng) + walk(n, rng, 1e-4) + 2e-5 * time_s(n)
        found = axis(y).fit((AngleRandomWalk(N=1.0), RateRandomWalk(K=1.0), RateRamp(R=1.0)))
        noise, random_walk, _ = found.effects
        off.append(
            [(noise.N - N) / found.size_standard_error(0), (random_walk.K - 1e-4) / found.size_standard_error(1)]
        )
        off[-1].append((found.whittle.beta[0] - 2e-5) / found.size_standard_error(2))
    # 40 standardised errors scatter by 11 %, their mean by 16 %
    assert np.std(off, axis=0) == pytest.approx(1.0, abs=0.35)
    assert np.abs(np.mean(off, axis=0)).max() < 0.55


@pytest.mark.parametrize("chain", [(BandwidthLimit(cutoff=10.0, order=2),), (ScaleFactor(factor=1.4),)])
def test_amplitude_of_a_line_is_that_before_filter_and_scale_factor(chain):
    line = Sinusoidal(amplitude=1e-3, frequency=12.0)
    y = NoiseModel({"gz": (WHITE, line, *chain)}).simulate(n, RATE_HZ, 3)[:, 2].copy()
    found = axis(y, (WHITE, *chain)).fit((WHITE, Sinusoidal(amplitude=1.0, frequency=12.0), *chain))
    assert found.effects[1].amplitude == pytest.approx(1e-3, abs=4.0 * found.size_standard_error(1))
    assert found.size_standard_error(1) < 2e-5


def test_fixed_sizes_of_deterministic_effects_are_kept():
    rng = np.random.default_rng(1)
    t, warm = time_s(n), make_temperature(n)
    y = white(n, rng) + 2e-4 * np.sin(2.0 * np.pi * 7.3 * t + 0.8) + 1e-4 * (warm - 25.0) - 2e-6 * t
    effects = (
        WHITE,
        Sinusoidal(amplitude=3e-4, frequency=7.3),
        TemperatureBias(coefficient=1.5e-4, quadratic=1e-6, reference=25.0),
        RateRamp(R=3e-6),
    )
    one = axis(y, temperature_c=warm)
    free, fixed = one.fit(effects), one.fit(effects, frozenset({1, 2, 3}))
    assert fixed.effects[1].amplitude == 3e-4
    assert fixed.effects[1].phase == pytest.approx(0.8, abs=0.05)
    assert fixed.effects[2:] == effects[2:]
    assert fixed.whittle.beta[-1] == -3e-6
    # the white noise of the fixed fit contains the remainder of all three effects
    rest = y + 3e-6 * t - 3e-4 * np.sin(2.0 * np.pi * 7.3 * t + fixed.effects[1].phase)
    rest -= 1.5e-4 * (warm - 25.0) + 1e-6 * (warm - 25.0) ** 2
    assert fixed.whittle.residual.sum() == pytest.approx(np.sum((rest - rest.mean()) ** 2), rel=1e-3)
    assert fixed.log_likelihood < free.log_likelihood - 50.0
    only_line = one.fit(effects, frozenset({1}))
    assert only_line.effects[2].coefficient == pytest.approx(1e-4, abs=4.0 * only_line.size_standard_error(2))
    assert only_line.size_standard_error(1) == 0.0


def test_regressors_and_noise_are_fitted_together():
    rng = np.random.default_rng(1)
    t, warm = time_s(n), make_temperature(n)
    gx = correlated(n, rng, 1e-2, 2.0)
    line = 2e-4 * np.sin(2.0 * np.pi * 7.3 * t + 0.8)
    gz = white(n, rng) + line + 1e-4 * (warm - 25.0) - 0.03 * gx + 4.0
    one = axes({"gx": gx, "gz": gz}, temperature_c=warm)["gz"]
    effects = (
        WHITE,
        Sinusoidal(amplitude=1.0, frequency=7.3, phase=0.0),
        TemperatureBias(coefficient=1.0, reference=25.0),
        CrossAxis(source="gx", coefficient=1.0),
    )
    found = one.fit(effects)
    noise, fitted_line, bias, leak = found.effects
    errors = [found.size_standard_error(at) for at in range(4)]
    assert pytest.approx(N, abs=4 * errors[0]) == noise.N
    assert fitted_line.amplitude == pytest.approx(2e-4, abs=4 * errors[1])
    assert fitted_line.phase == pytest.approx(0.8, abs=4 * errors[1] / 2e-4)
    assert bias.coefficient == pytest.approx(1e-4, abs=4 * errors[2])
    assert leak.coefficient == pytest.approx(-0.03, abs=4 * errors[3])
    assert errors[1] == pytest.approx(N * RATE_HZ**0.5 * np.sqrt(2.0 / n), rel=0.05)
    clean = cosine_transform(gz - line - 1e-4 * (warm - 25.0) + 0.03 * gx)
    assert np.std(found.cosine_transform_without_deterministic_effects() - clean) < 0.03 * np.std(clean)


def test_fixed_size_stays_and_reduces_the_likelihood():
    rng = np.random.default_rng(2)
    one = axis(white(n, rng) + walk(n, rng, 1e-4))
    wrong = (AngleRandomWalk(N=1.1 * N), RateRandomWalk(K=1e-4))
    held, free = one.fit(wrong, frozenset({0})), one.fit(wrong)
    assert held.effects[0].N == 1.1 * N
    assert np.isnan(held.size_standard_error(0))
    assert held.fitted_noise == (1,)
    # n ln(1.1) − n/2 (1 − 1/1.21), each within a few nats
    assert free.log_likelihood - held.log_likelihood == pytest.approx(n * (np.log(1.1) - 0.5 * (1 - 1 / 1.21)), rel=0.3)


def test_regressors_of_any_size_leave_the_noise_unchanged():
    rng = np.random.default_rng(3)
    one = axis(white(n, rng) + 3e-5 * time_s(n))
    found = one.fit((WHITE, RateRamp(R=1.0)), frozenset({0}))
    same = found.with_regressor_sizes(found.whittle.beta)
    assert same.log_likelihood == pytest.approx(found.log_likelihood, abs=1e-6)
    error = found.size_standard_error(1)
    for shift in (-2.0, 1.0, 3.0):  # standard errors: a parabola
        moved = found.with_regressor_sizes(found.whittle.beta + shift * error)
        assert found.log_likelihood - moved.log_likelihood == pytest.approx(0.5 * shift**2, rel=1e-3)


def test_result_does_not_depend_on_the_unit():
    rng = np.random.default_rng(4)
    y = white(n, rng) + walk(n, rng)
    one, other = axis(y).fit(TERMS), axis(1e4 * y + 9.81).fit(TERMS)
    assert pytest.approx(1e4 * one.effects[0].N, rel=1e-3) == other.effects[0].N
    assert other.log_likelihood == pytest.approx(one.log_likelihood - (n - 1) * np.log(1e4), abs=0.05)


def test_white_noise_is_that_before_its_step():
    rng = np.random.default_rng(5)
    y = white(n, rng) * np.where(time_s(n) < 50.0, 1.0, 3.0)
    found = axis(y).fit((AngleRandomWalk(N=1.0), NoiseStep(time=50.0, ratio=3.0)))
    assert pytest.approx(N, rel=0.03) == found.effects[0].N


def test_bins_of_the_stop_band_are_not_used():
    effects = (WHITE, BandwidthLimit(cutoff=0.8, order=4))
    y = NoiseModel({"gz": effects}).simulate(n, RATE_HZ, 1)[:, 2].copy()
    one = axis(y, effects)
    power = one.bins.sum_over_bins(one.coefficients**2) / one.bins.count
    below = power < 1e-5 * np.median(power)
    assert not one.used_bins[below].any()
    assert one.used_bins[one.bins.f_hz < 1.0].all()
    whole = axis(white(n, np.random.default_rng(0)))
    assert whole.used_bins[whole.bins.count > 4].all()


def test_result_does_not_depend_on_the_bins():
    rng = np.random.default_rng(7)
    one = axis(white(n, rng) + walk(n, rng))
    finer = replace(one, bins=build_frequency_bins(n, RATE_HZ, [(20.0, 0.1)]))
    assert finer.bins.count.size > one.bins.count.size
    np.testing.assert_array_equal(finer.coefficients, one.coefficients)
    assert (finer.name, finer.n, finer.rate_hz) == ("gz", n, RATE_HZ)
    assert pytest.approx(one.fit(TERMS).effects[0].N, rel=1e-3) == finer.fit(TERMS).effects[0].N


def test_regressor_is_computed_once_for_all_sizes():
    made = RegressorCache(n, RATE_HZ, make_temperature(n))
    one = made.regressor_cosine_transforms(Sinusoidal(amplitude=3.0, frequency=5.0, phase=1.0))
    assert made.regressor_cosine_transforms(Sinusoidal(amplitude=0.1, frequency=5.0, phase=2.0)) is one
    assert made.regressor_cosine_transforms(Sinusoidal(amplitude=0.1, frequency=5.1, phase=2.0)) is not one
    sine = np.sin(2.0 * np.pi * 5.0 * time_s(n))
    np.testing.assert_allclose(one[0], cosine_transform(sine), atol=1e-9)
    bias = TemperatureBias(coefficient=4.0, reference=25.0)
    np.testing.assert_allclose(
        made.regressor_cosine_transforms(bias)[0], cosine_transform(make_temperature(n)), atol=1e-9
    )


def test_terms_of_size_zero_stay_small():
    found = axis(white(n, np.random.default_rng(8))).fit((WHITE, BiasInstability(B=1.0), WALK))
    assert found.effects[1].B < 0.3 * N
    assert found.effects[2].K < 20 * K


def test_cache_of_a_part_contains_only_its_samples():
    size = 9000
    whole = RegressorCache(size, RATE_HZ, make_temperature(size))
    first, second = whole.restrict_to_part(slice(0, 4500)), whole.restrict_to_part(slice(4500, 9000))
    assert whole.restrict_to_part(slice(0, 4500)) is first is not second
    effect = TemperatureBias(coefficient=1.0, reference=20.0)
    np.testing.assert_allclose(
        second.regressor_cosine_transforms(effect)[0], cosine_transform(make_temperature(size)[4500:]), atol=1e-9
    )
