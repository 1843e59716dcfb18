"""Tests of the spectrum of an axis: Allan variance integrals, filters, held samples and clock errors."""

import numpy as np
import pytest
from scipy.signal import butter, freqz

from monitor.noise.effect import Source
from monitor.noise.effects import (
    AngleRandomWalk,
    BandwidthLimit,
    BiasInstability,
    BiasStep,
    ConstantBias,
    CrossAxis,
    ExponentiallyCorrelated,
    GSensitivity,
    Narrowband,
    NoiseStep,
    QuantizationNoise,
    RandomSampleHold,
    RateRamp,
    RateRandomWalk,
    Resolution,
    SampleRateError,
    Saturation,
    ScaleFactor,
    Sinusoidal,
    WanderingLine,
)
from monitor.noise.model import NoiseModel
from monitor.noise.spectrum import allan_variance_of_density

TAU0_S = 0.01
FACTORS = np.array([1, 2, 3, 5, 8, 17, 64, 129, 1000, 31_623, 1_000_000])

SOURCES = (
    AngleRandomWalk(N=2.0),
    QuantizationNoise(Q=2.0),
    BiasInstability(B=2.0),
    RateRandomWalk(K=2.0),
    ExponentiallyCorrelated(sigma=2.0, correlation_time=0.02),
    ExponentiallyCorrelated(sigma=2.0, correlation_time=500.0),
    Narrowband(sigma=2.0, frequency=17.3, bandwidth=0.01),
    Narrowband(sigma=2.0, frequency=0.02, bandwidth=0.005),
    Narrowband(sigma=2.0, frequency=49.0, bandwidth=3.0),
)


@pytest.mark.parametrize("source", SOURCES, ids=lambda s: s.name)
def test_integral_over_the_spectrum_equals_the_closed_form(source):
    spectrum = source.spectrum(TAU0_S)
    tau = FACTORS * TAU0_S
    found = allan_variance_of_density(spectrum.density, tau, TAU0_S, spectrum.peaks)
    np.testing.assert_allclose(found, source.avar(tau, TAU0_S), rtol=1e-3)


@pytest.mark.parametrize(("deviation", "time_s"), [(0.05, 0.3), (0.9, 0.1), (0.9, 2.0), (0.3, 50.0)])
def test_wandering_line_has_the_autocovariance_of_kubo(deviation, time_s):
    lag = np.arange(400_000) * TAU0_S
    index = (2.0 * np.pi * deviation * time_s) ** 2
    r = 2.0 * np.cos(2.0 * np.pi * 17.3 * lag) * np.exp(-index * (np.expm1(-lag / time_s) + lag / time_s))
    line = WanderingLine(amplitude=2.0, frequency=17.3, frequency_deviation=deviation, correlation_time=time_s)
    factors = np.array([1, 2, 3, 7, 30, 500, 8000])
    np.testing.assert_allclose(
        line.avar(factors * TAU0_S, TAU0_S), compute_avar_from_autocovariance(r, factors), rtol=1e-3
    )
    f = 17.3 + np.array([-10.0, -2.0, -0.5, 0.0, 0.1, 1.5, 30.0])
    expected = [TAU0_S * (2.0 * r @ np.cos(2.0 * np.pi * one * lag) - r[0]) for one in f]
    np.testing.assert_allclose(line.two_sided_psd(f, TAU0_S), expected, rtol=5e-3, atol=1e-7)


def compute_avar_from_autocovariance(autocovariance: np.ndarray, factors: np.ndarray) -> np.ndarray:
    """Return (4 V(m) − V(2m))/2m², where V(m) is the variance of a sum of m samples."""
    r = autocovariance

    def variance_of_sum(m: int) -> float:
        k = np.arange(1, m)
        return float(m * r[0] + 2.0 * ((m - k) * r[k]).sum())

    return np.array([(4.0 * variance_of_sum(m) - variance_of_sum(2 * m)) / (2.0 * m**2) for m in factors])


@pytest.mark.parametrize("order", [1, 2, 5])
@pytest.mark.parametrize("cutoff", [0.7, 12.0, 48.0])
def test_low_passed_white_noise_has_the_stated_avar_and_psd(order, cutoff):
    # The autocovariance of the impulse response is computed from SciPy's coefficients.
    b, a = butter(order, cutoff, fs=1.0 / TAU0_S)
    _, h = freqz(b, a, worN=1 << 16, whole=True)
    r = np.fft.ifft(np.abs(h) ** 2).real * 9.0 / TAU0_S
    factors = np.array([1, 2, 3, 7, 30, 500, 8000])
    model = NoiseModel({"gx": (BandwidthLimit(cutoff=cutoff, order=order), AngleRandomWalk(N=3.0))})
    found = model.avar("gx", factors * TAU0_S, TAU0_S)
    np.testing.assert_allclose(found, compute_avar_from_autocovariance(r, factors), rtol=1e-3)
    assert model.two_sided_psd("gx", np.array([cutoff]), TAU0_S)[0] == pytest.approx(4.5)


def test_line_is_filtered_and_slope_is_not():
    line, slope = Sinusoidal(amplitude=2.0, frequency=17.3), RateRamp(R=1e-3)
    tau = np.array([0.01, 0.02, 3.0, 200.0])
    bare = NoiseModel({"gx": (line,)}).avar("gx", tau, TAU0_S)
    limited = NoiseModel({"gx": (line, slope, ConstantBias(value=3.0), BandwidthLimit(cutoff=17.3, order=3))})
    np.testing.assert_allclose(limited.avar("gx", tau, TAU0_S), 0.5 * bare + 0.5e-6 * tau**2)


@pytest.mark.parametrize("source", [AngleRandomWalk(N=1.0), ExponentiallyCorrelated(sigma=1.0, correlation_time=0.05)])
@pytest.mark.parametrize("h", [0.0, 0.1, 0.8])
def test_held_samples_have_the_stated_avar(source: Source, h):
    # The autocovariance is summed over the ages of the two held values.
    n = 1500
    lag = np.arange(n)
    r = 100.0 * (lag == 0) if isinstance(source, AngleRandomWalk) else np.exp(-0.2 * lag)
    age = (1.0 - h) * h ** np.arange(400)

    def held_autocovariance(k: int) -> float:
        newer = np.arange(min(k, age.size))
        pairs = np.abs(k - newer[:, None] + np.arange(age.size)[None, :])
        return float(h**k * r[0] + (age[newer, None] * age[None, :] * r[np.minimum(pairs, n - 1)]).sum())

    expected = np.array([r[0], *(held_autocovariance(k) for k in range(1, 130))])
    factors = np.array([1, 2, 5, 20, 60])
    found = NoiseModel({"gx": (source, RandomSampleHold(fraction=h))}).avar("gx", factors * TAU0_S, TAU0_S)
    np.testing.assert_allclose(found, compute_avar_from_autocovariance(expected, factors), rtol=1e-3)


def test_sample_rate_error_rescales_time_and_frequency():
    axis = (AngleRandomWalk(N=1.0), RateRandomWalk(K=0.1), Sinusoidal(amplitude=1.0, frequency=10.0))
    true = NoiseModel({"gx": axis})
    stated = NoiseModel({"gx": axis, "ay": (SampleRateError(ratio=1.25),)})  # stated on one axis, valid for all
    tau = np.array([0.01, 0.3, 20.0])
    np.testing.assert_allclose(stated.avar("gx", tau, 0.01), true.avar("gx", tau / 1.25, 0.008))
    f = np.array([0.1, 8.0, 40.0])
    np.testing.assert_allclose(stated.two_sided_psd("gx", f, 0.01), 1.25 * true.two_sided_psd("gx", 1.25 * f, 0.008))
    assert stated.spectrum("gx", 0.01).lines == ((8.0, 0.5),)


def test_cross_axis_effects_add_the_variance_of_the_source():
    model = NoiseModel(
        {
            "gx": (AngleRandomWalk(N=1.0), CrossAxis(source="gy", coefficient=0.5), ScaleFactor(factor=3.0)),
            "gy": (AngleRandomWalk(N=2.0), CrossAxis(source="gx", coefficient=0.1), ScaleFactor(factor=5.0)),
            "gz": (GSensitivity(source="az", coefficient=0.1), GSensitivity(source="az", coefficient=0.2)),
            "az": (AngleRandomWalk(N=10.0),),
        }
    )
    tau = np.array([1.0])
    assert model.avar("gx", tau, 0.01)[0] == pytest.approx(9.0 * (1.0 + 0.25 * 25.0 * 4.0))
    assert model.avar("gy", tau, 0.01)[0] == pytest.approx(25.0 * (4.0 + 0.01 * 9.0 * 1.0))
    assert model.avar("gz", tau, 0.01)[0] == pytest.approx(0.09 * 100.0)  # equal series add up as amplitudes


@pytest.mark.parametrize(
    "axis",
    [
        (AngleRandomWalk(N=1.0), NoiseStep(time=1.0, ratio=2.0)),
        (AngleRandomWalk(N=1.0), BiasStep(time=1.0, height=2.0)),
        (AngleRandomWalk(N=1.0), Saturation(limit=30.0)),
        (AngleRandomWalk(N=1.0), ConstantBias(value=95.0), Saturation(limit=100.0)),
        (AngleRandomWalk(N=1.0), Resolution(step=20.0)),
    ],
)
def test_non_stationary_axis_has_no_variance(axis):
    model = NoiseModel({"gx": axis, "gy": (AngleRandomWalk(N=1.0),)})
    assert np.isnan(model.avar("gx", np.array([1.0]), 0.01)).all()
    assert np.isnan(model.two_sided_psd("gx", np.array([1.0]), 0.01)).all()
    assert model.avar("gy", np.array([1.0]), 0.01).tolist() == [1.0]


def test_negligible_saturation_and_resolution_keep_the_variance():
    model = NoiseModel({"gx": (AngleRandomWalk(N=1.0), Saturation(limit=100.0), Resolution(step=1.2))})
    assert model.avar("gx", np.array([2.0]), 0.01)[0] == pytest.approx(0.5 + 0.12 * 0.01 / 2.0)


@pytest.mark.parametrize("width", [0.6, 0.8, 2.0])
def test_rounding_is_white_for_sufficient_noise(width):
    values = NoiseModel({"gx": (AngleRandomWalk(N=width), Resolution(step=1.0))}).simulate(400_000, 1.0, 0)[:, 0]
    # The tolerance is 1.5 %; χ² of 400 000 samples is 0.22 %, and rounding alone adds 10 % at 0.8 steps.
    assert values.var() == pytest.approx(width**2 + 1.0 / 12.0, rel=0.015)


def test_filtered_random_walk_is_unchanged_at_long_times():
    model = NoiseModel({"gx": (RateRandomWalk(K=1.0), BandwidthLimit(cutoff=5.0, order=2))})
    tau = np.array([100.0, 1e4])
    np.testing.assert_allclose(model.avar("gx", tau, 0.01), tau / 3.0, rtol=1e-3)
