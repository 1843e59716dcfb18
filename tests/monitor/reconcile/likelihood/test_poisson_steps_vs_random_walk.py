"""Tests of the likelihood of Poisson steps, a sum over all sets of blocks with jumps. Its limit is a random walk."""

from itertools import product

import numpy as np
import pytest
from scipy.special import logsumexp

from monitor.reconcile.likelihood import poisson_steps_vs_random_walk
from monitor.reconcile.likelihood.event_process_likelihood import (
    BackgroundNoise,
    build_state_space_noise,
    kalman_log_likelihood,
)
from monitor.reconcile.likelihood.poisson_steps_vs_random_walk import compare_poisson_with_random_walk
from tests.monitor.reconcile.event_noise import BLOCK_S, HOUR, TAU0_S, N, dense, jumps, walk, white

RATE, HEIGHT = 0.05, 2.0  # of the short series, beside white noise of density one
BLOCKS = 11


def sum_over_all_sets_of_jumps(means, covariance):
    """Return the log-likelihood as a sum over all sets of blocks with Gaussian jumps."""
    chance = 1.0 - np.exp(-RATE * BLOCK_S)
    variance = RATE * BLOCK_S * HEIGHT**2 / chance
    terms = []
    after = np.tri(means.size)  # level in row k after a jump in column j
    shapes = []
    for j in range(means.size):
        seen = after[:, j].copy()
        shape = np.outer(seen, seen)
        shape[j, :] *= 0.5
        shape[:, j] *= 0.5
        shape[j, j] = 1.0 / 3.0
        shapes.append(variance * shape)
    for some in product((0, 1), repeat=means.size):
        total = covariance + sum((s * shape for s, shape in zip(some, shapes, strict=True)), 0.0)
        k = sum(some)
        logs = np.linalg.slogdet(2.0 * np.pi * total)[1] + means @ np.linalg.solve(total, means)
        terms.append(k * np.log(chance) + (means.size - k) * np.log(1.0 - chance) - 0.5 * logs)
    return logsumexp(terms)


def likelihood(means, rest, rate, height, start):
    around = build_state_space_noise(rest, means, BLOCK_S)._replace(level_variance=start)
    return poisson_steps_vs_random_walk._log_likelihood(means, around, rate * BLOCK_S, height)


@pytest.mark.parametrize("rest", [BackgroundNoise(1.0), BackgroundNoise(1.0, walk=0.02, correlated=((1.0, 30.0),))])
def test_likelihood_nearly_equals_the_sum_over_all_sets_of_jumps(rest):
    off = []
    for seed in range(4):
        rng = np.random.default_rng(seed)
        covariance = dense(rest, BLOCKS, start=4.0)
        level = HEIGHT * np.cumsum(rng.standard_normal(BLOCKS) * np.sqrt(rng.poisson(RATE * BLOCK_S, BLOCKS)))
        means = np.linalg.cholesky(covariance) @ rng.standard_normal(BLOCKS) + level
        off.append(likelihood(means, rest, RATE, HEIGHT, 4.0) - sum_over_all_sets_of_jumps(means, covariance))
    assert np.abs(off).max() < 0.1


def test_many_small_jumps_are_a_random_walk():
    K = 0.1
    rng = np.random.default_rng(0)
    means = np.linalg.cholesky(dense(BackgroundNoise(1.0, walk=K * K), 300)) @ rng.standard_normal(300)
    around = build_state_space_noise(BackgroundNoise(1.0, walk=K * K), means, BLOCK_S)._replace(level_variance=9.0)
    gaussian = kalman_log_likelihood(means, around)
    often = 20.0 / BLOCK_S
    assert likelihood(means, BackgroundNoise(1.0), often, K / often**0.5, 9.0) == pytest.approx(gaussian, abs=1e-4)


@pytest.mark.parametrize(
    "rest",
    [
        BackgroundNoise(N * N),
        BackgroundNoise(N * N, walk=(1e-6) ** 2),
        BackgroundNoise(N * N, correlated=((2e-5, 50.0),)),
    ],
)
def test_jumps_are_distinguished_from_a_random_walk(rest):
    for seed in range(2):
        rng = np.random.default_rng(seed)
        around = white(HOUR, rng) + walk(HOUR, rest.walk**0.5, rng)
        assert (
            compare_poisson_with_random_walk(around + jumps(HOUR, 0.005, 2e-4, rng), TAU0_S, rest, 1.4e-5).gain > 10.0
        )
        assert abs(compare_poisson_with_random_walk(around + walk(HOUR, 1.4e-5, rng), TAU0_S, rest, 1.4e-5).gain) < 3.0


@pytest.mark.long
def test_intervals_contain_the_parameters_and_jumps_are_counted():
    inside, counted = [], []
    for seed in range(8):
        rng = np.random.default_rng(seed)
        found = compare_poisson_with_random_walk(
            white(HOUR, rng) + jumps(HOUR, 0.01, 3e-4, rng), TAU0_S, BackgroundNoise(N * N), 2e-5
        )
        for name, true in (("rate", 0.01), ("height", 3e-4)):
            inside.append(found.parameters[name].lo < true < found.parameters[name].hi)
            assert found.parameters[name].hi / found.parameters[name].lo < 5.0
        counted.append(found.events)
    assert np.mean(inside) > 0.8
    assert np.mean(counted) == pytest.approx(36.0, rel=0.2)


def test_known_walk_is_not_counted_twice():
    rng = np.random.default_rng(4)
    y = white(HOUR, rng) + walk(HOUR, 1e-5, rng) + jumps(HOUR, 0.005, 4e-4, rng)
    found = compare_poisson_with_random_walk(y, TAU0_S, BackgroundNoise(N * N, walk=1e-10), 3e-5)
    assert found.gain > 10.0
    assert found.parameters["height"].lo < 4e-4 < found.parameters["height"].hi
