"""Tests of power-law noise against the classic terms, fractional integration and the stated Allan variance."""

import numpy as np
import pytest
from scipy.special import gamma, gammaln

from monitor.noise.effects import AngleRandomWalk, BandwidthLimit, BiasInstability, PowerLaw, RateRandomWalk
from monitor.noise.effects.disturbances import power_law
from tests.support.noise_series import draw_next_samples

RATE_HZ = 100.0


@pytest.mark.parametrize("d", [0.02, 0.25, 0.5, 0.75, 0.97])
def test_impulse_response_is_that_of_fractional_integration(d: float) -> None:
    decay, weights, direct, walk = power_law._fractional_filter(1.0, d)
    k = np.concatenate([np.arange(20.0), np.geomspace(20.0, 1e7, 60).round()])
    powers = np.exp(k[:, None] * np.log(1.0 - decay))
    found = powers @ weights + direct * (k == 0) + walk
    expected = np.exp(gammaln(k + d) - gammaln(k + 1.0)) / gamma(d)
    np.testing.assert_allclose(found, expected, rtol=5e-3)


@pytest.mark.parametrize(
    ("exponent", "classic"),
    [
        (0.0, AngleRandomWalk(N=1.0)),
        (1.0, BiasInstability(B=(2.0 * np.pi) ** 0.5)),
        (2.0, RateRandomWalk(K=2.0 * np.pi)),
    ],
)
def test_integer_exponents_are_the_classic_terms(exponent: float, classic) -> None:
    f_hz, tau_s = np.geomspace(1e-3, 1.0, 20), np.array([2.56, 30.0, 1000.0])
    noise = PowerLaw(density=1.0, exponent=exponent)
    np.testing.assert_allclose(noise.two_sided_psd(f_hz, 0.01), classic.two_sided_psd(f_hz, 0.01), rtol=3e-4)
    np.testing.assert_allclose(noise.avar(tau_s, 0.01), classic.avar(tau_s, 0.01), rtol=1e-3)


@pytest.mark.parametrize("exponent", [0.5, 1.5, 2.5, 2.9])
def test_allan_variance_is_a_power_of_tau(exponent: float) -> None:
    """The relation is σ²(τ) ∝ τ^(α−1), even if most of the variance comes from below the integration grid."""
    tau_s = np.array([10.0, 100.0, 1000.0])
    avar = PowerLaw(density=1.0, exponent=exponent).avar(tau_s, 0.01)
    np.testing.assert_allclose(avar[1:] / avar[:-1], 10.0 ** (exponent - 1.0), rtol=5e-3)


@pytest.mark.parametrize("exponent", [0.4, 1.0, 1.5, 1.9, 2.4])
def test_allan_variance_is_the_same_at_the_start_and_later(exponent: float) -> None:
    """The test uses cluster times of one sample and of one second."""
    rng = np.random.default_rng(3)
    runs = np.stack(
        [
            draw_next_samples(PowerLaw(density=1.0, exponent=exponent).start_series(RATE_HZ, rng), 2050)
            for _ in range(1500)
        ]
    )
    stated = PowerLaw(density=1.0, exponent=exponent).avar(np.array([0.01, 1.0]), 0.01)
    for begin in (0, 1800):
        part = runs[:, begin : begin + 200]
        second = np.diff(part[:, :2], axis=1)[:, 0] / 2.0**0.5
        assert np.mean(second**2) == pytest.approx(stated[0], rel=0.15)
        halves = (part[:, 100:].mean(axis=1) - part[:, :100].mean(axis=1)) / 2.0**0.5
        assert np.mean(halves**2) == pytest.approx(stated[1], rel=0.15)


def test_filter_does_not_change_the_variance_at_long_times() -> None:
    spectrum = PowerLaw(density=1.0, exponent=2.6).spectrum(0.01)
    filtered = BandwidthLimit(cutoff=20.0, order=2).transform_spectrum(spectrum)
    assert filtered.avar(np.array([100.0]))[0] == pytest.approx(spectrum.avar(np.array([100.0]))[0], rel=1e-3)
