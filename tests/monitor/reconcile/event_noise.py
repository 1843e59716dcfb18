"""Noise of effects with equal spectra, drawn independently of the simulator."""

import numpy as np

N = 1.5e-4
TAU0_S = 0.05
HOUR = 72000
BLOCK_S = 3.0


def dense(rest, m, start=0.0):
    """Return the covariance of block means from integrals of autocovariances, shape [m, m].

    ``start`` is the variance of the initial level.
    """
    k = np.arange(m)
    apart = np.abs(k[:, None] - k)
    covariance = np.full((m, m), start) + rest.white / BLOCK_S * np.eye(m)
    covariance += rest.walk * BLOCK_S * (np.minimum(k[:, None], k) + np.where(apart == 0, 1.0 / 3.0, 0.5))
    for sigma, time_s in rest.correlated:
        x = BLOCK_S / time_s
        within = 2.0 * (x - 1.0 + np.exp(-x)) / x**2
        between = (2.0 * np.sinh(0.5 * x) / x) ** 2 * np.exp(-x * apart)
        covariance += sigma**2 * np.where(apart == 0, within, between)
    return covariance


def white(n, rng):
    return N / TAU0_S**0.5 * rng.standard_normal(n)


def two_levels(n, amplitude, dwell_s, rng):
    """Draw a telegraph signal from the parity of a Poisson count in each sample, with a random initial level."""
    flips = rng.poisson(TAU0_S / dwell_s, n)
    return 0.5 * amplitude * (1.0 - 2.0 * ((rng.integers(2) + np.cumsum(flips)) % 2))


def wandering(n, sigma, time_s, rng):
    """Draw Gauss-Markov noise from the circulant matrix of its autocovariance."""
    lag = np.minimum(np.arange(2 * n), 2 * n - np.arange(2 * n)) * TAU0_S
    power = np.fft.rfft(sigma**2 * np.exp(-lag / time_s)).real.clip(0.0)
    return np.fft.irfft(np.sqrt(power) * np.fft.rfft(rng.standard_normal(2 * n)), 2 * n)[:n]


def walk(n, K, rng):
    return K * TAU0_S**0.5 * np.cumsum(rng.standard_normal(n))


def jumps(n, rate, height, rng):
    """Draw Poisson steps from the number of jumps in each sample."""
    return height * np.cumsum(np.sqrt(rng.poisson(rate * TAU0_S, n)) * rng.standard_normal(n))
