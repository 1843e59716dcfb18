"""Tests of the likelihood of a telegraph signal, a sum over all paths, against Gaussian noise of equal spectrum."""

from itertools import product

import numpy as np
import pytest
from scipy.special import logsumexp
from scipy.stats import norm

from monitor.reconcile.likelihood import telegraph_vs_correlated_noise
from monitor.reconcile.likelihood.event_process_likelihood import (
    BackgroundNoise,
    build_state_space_noise,
    compute_block_means,
)
from monitor.reconcile.likelihood.telegraph_vs_correlated_noise import compare_telegraph_with_correlated_noise
from tests.monitor.reconcile.event_noise import BLOCK_S, HOUR, TAU0_S, N, dense, two_levels, walk, wandering, white

A, DWELL = 3.0, 20.0  # of the short series, beside white noise of density one


def list_block_cases():
    """Return (probability, mean from the upper level, variance, True if the level at the end differs) of a block."""
    q = BLOCK_S / DWELL
    none, even, odd = np.exp(-q), 0.5 * (1.0 + np.exp(-2.0 * q)), 0.5 * (1.0 - np.exp(-2.0 * q))
    return [(none, A / 2.0, 0.0, False), (even - none, A / 6.0, A**2 / 18.0, False), (odd, 0.0, A**2 / 12.0, True)]


def sum_over_all_paths(means, covariance):
    """Return the log-likelihood as a sum over all paths. Each path has a Gaussian distribution."""
    terms = []
    for first in (1.0, -1.0):
        for path in product(list_block_cases(), repeat=means.size):
            sign, chance, level, extra = first, 0.5, [], []
            for probability, mean, variance, ends_other in path:
                chance *= probability
                level.append(sign * mean)
                extra.append(variance)
                sign = -sign if ends_other else sign
            terms.append((chance, level, extra))
    chances, levels, extras = (np.array(column) for column in zip(*terms, strict=True))
    covariances = covariance + extras[:, :, None] * np.eye(means.size)
    left = means - levels
    squares = np.einsum("pi,pi->p", left, np.linalg.solve(covariances, left[:, :, None])[:, :, 0])
    logs = np.linalg.slogdet(2.0 * np.pi * covariances)[1]
    return logsumexp(np.log(chances) - 0.5 * (squares + logs))


def draw_means(rest, m, seed, start=0.0):
    rng = np.random.default_rng(seed)
    gaussian = np.linalg.cholesky(dense(rest, m, start)) @ rng.standard_normal(m)
    flips = rng.poisson(BLOCK_S / DWELL, m)
    return gaussian + 0.5 * A * (1.0 - 2.0 * (np.cumsum(flips) % 2))


def likelihood(means, rest, start):
    around = build_state_space_noise(rest, means, BLOCK_S)._replace(level_variance=start)
    return telegraph_vs_correlated_noise._log_likelihood(means, around, A, BLOCK_S / DWELL)


@pytest.mark.parametrize("seed", range(3))
def test_likelihood_equals_the_sum_over_all_paths_in_white_noise(seed):
    means = draw_means(BackgroundNoise(1.0), 7, seed)
    assert likelihood(means, BackgroundNoise(1.0), 0.0) == pytest.approx(
        sum_over_all_paths(means, dense(BackgroundNoise(1.0), 7)), abs=1e-9
    )


def test_likelihood_equals_the_forward_algorithm_in_white_noise():
    means = draw_means(BackgroundNoise(1.0), 300, 1)
    share, total = np.array([0.5, 0.5]), 0.0
    for z in means:
        new = np.zeros(2)
        for level, sign in enumerate((1.0, -1.0)):
            for probability, mean, variance, ends_other in list_block_cases():
                density = norm.pdf(z, sign * mean, np.sqrt(1.0 / BLOCK_S + variance))
                new[1 - level if ends_other else level] += share[level] * probability * density
        total += np.log(new.sum())
        share = new / new.sum()
    assert likelihood(means, BackgroundNoise(1.0), 0.0) == pytest.approx(total, abs=1e-8)


@pytest.mark.parametrize("rest", [BackgroundNoise(1.0, walk=0.02), BackgroundNoise(1.0, correlated=((1.0, 30.0),))])
def test_merging_paths_changes_the_likelihood_little(rest):
    off = []
    for seed in range(5):
        means = draw_means(rest, 7, seed, start=4.0)
        off.append(likelihood(means, rest, 4.0) - sum_over_all_paths(means, dense(rest, 7, start=4.0)))
    assert np.abs(off).max() < 0.35
    assert abs(np.mean(off)) < 0.15


@pytest.mark.long
def test_unknown_initial_level_is_an_average_over_levels():
    """The result is accurate to one nat, even if the first dwell of 200 blocks may be in the lower level."""
    rest = BackgroundNoise(1.0)
    for seed, still in ((0, 0), (1, 0), (2, 200)):
        rng = np.random.default_rng(seed)
        means = np.concatenate(
            [draw_means(rest, 400, seed), np.full(still, 0.5 * A) + rng.standard_normal(still) / 3**0.5]
        )
        means = means[::-1] - means.mean()
        start = 100.0 * means.var()
        levels = np.linspace(-4.0, 4.0, 801)
        each = [likelihood(means - level, rest, 0.0) + norm.logpdf(level, 0.0, start**0.5) for level in levels]
        assert likelihood(means, rest, start) == pytest.approx(logsumexp(each) + np.log(levels[1] - levels[0]), abs=1.0)


def compare_processes(y, rest=None, sigma=2e-4, time_s=10.0):
    return compare_telegraph_with_correlated_noise(
        y, TAU0_S, BackgroundNoise(N * N) if rest is None else rest, sigma, time_s
    )


@pytest.mark.parametrize("time_s", [3.0, 10.0, 60.0])
@pytest.mark.parametrize("K", [0.0, 3e-6])
def test_simulated_process_is_recognized(time_s, K):
    for seed in range(2):
        rng = np.random.default_rng(seed)
        around = white(HOUR, rng) + walk(HOUR, K, rng)
        rest = BackgroundNoise(N * N, walk=K**2)
        assert compare_processes(around + two_levels(HOUR, 4e-4, 2.0 * time_s, rng), rest, 2e-4, time_s).gain > 20.0
        assert compare_processes(around + wandering(HOUR, 2e-4, time_s, rng), rest, 2e-4, time_s).gain < -20.0


def test_intervals_contain_the_parameters_and_switches_are_counted():
    inside, counted = [], []
    for seed in range(12):
        rng = np.random.default_rng(seed)
        level = two_levels(HOUR, 4e-4, 20.0, rng)
        found = compare_processes(white(HOUR, rng) + level, sigma=2.6e-4, time_s=7.0)
        for name, true in (("amplitude", 4e-4), ("dwell_time", 20.0)):
            bounds = found.parameters[name]
            inside.append(bounds.lo < true < bounds.hi)
            assert bounds.hi / bounds.lo < 1.7
        counted.append(found.events / np.count_nonzero(np.diff(level)))
    assert np.mean(inside) > 0.8
    assert np.mean(counted) == pytest.approx(1.0, abs=0.03)


def test_result_does_not_depend_on_offset_and_unit():
    rng = np.random.default_rng(0)
    y = white(HOUR, rng) + two_levels(HOUR, 3e-4, 20.0, rng)
    plain = compare_processes(y)
    assert compare_processes(y + 9.81).gain == pytest.approx(plain.gain, abs=1e-3)
    scaled = compare_processes(1e3 * y, BackgroundNoise(1e6 * N * N), 0.2)
    assert scaled.gain == pytest.approx(plain.gain, abs=1e-3)
    assert scaled.parameters["amplitude"].value == pytest.approx(1e3 * plain.parameters["amplitude"].value, rel=1e-6)


def test_distant_start_gives_the_same_levels():
    rng = np.random.default_rng(5)
    y = white(HOUR, rng) + two_levels(HOUR, 3e-4, 1200.0, rng)
    for factor in (0.6, 1.0, 1.7):
        found = compare_processes(y, sigma=1.5e-4 * factor, time_s=600.0)
        assert found.parameters["amplitude"].value == pytest.approx(3e-4, rel=0.05)


def test_blocks_follow_the_correlation_time():
    means, block_s = compute_block_means(
        np.random.default_rng(0).standard_normal(HOUR),
        TAU0_S,
        telegraph_vs_correlated_noise._choose_block_length_s(3600.0, TAU0_S, 8.0, 4.0),
    )
    assert (means.size, block_s) == (3600, pytest.approx(1.0))
    assert telegraph_vs_correlated_noise._choose_block_length_s(3600.0, TAU0_S, 5000.0, 100.0) == pytest.approx(18.0)
    assert telegraph_vs_correlated_noise._choose_block_length_s(3600.0, TAU0_S, 64.0, 2.0) == pytest.approx(2.0)
    assert telegraph_vs_correlated_noise._choose_block_length_s(3600.0, TAU0_S, 64.0, 1e-3) == pytest.approx(
        20 * TAU0_S
    )
