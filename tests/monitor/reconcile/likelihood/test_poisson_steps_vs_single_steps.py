"""Tests that single steps are found by least squares, and that many steps are attributed to a Poisson process."""

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from monitor.reconcile.likelihood import poisson_steps_vs_single_steps
from monitor.reconcile.likelihood.event_process_likelihood import (
    BackgroundNoise,
    build_state_space_noise,
    compute_block_means,
)
from monitor.reconcile.likelihood.poisson_steps_vs_single_steps import compare_poisson_with_single_steps
from tests.monitor.reconcile.event_noise import BLOCK_S, HOUR, TAU0_S, N, dense, jumps, white

REST = BackgroundNoise(1.0, walk=0.01, correlated=((1.0, 30.0),))
M = 60


@pytest.fixture
def noisy_step():
    """Return block means of noise with a step, and their covariance."""
    covariance = dense(REST, M, start=50.0)
    means = np.linalg.cholesky(covariance) @ np.random.default_rng(0).standard_normal(M)
    return means + 3.0 * (np.arange(M) >= 40), covariance


def test_gain_of_each_shock_equals_a_regression(noisy_step):
    means, covariance = noisy_step
    around = build_state_space_noise(REST, means, BLOCK_S)._replace(level_variance=50.0)
    known = 40
    free = np.zeros(M)
    free[known] = 1e4
    covariance += 1e4 * np.outer(np.arange(M) >= known, np.arange(M) >= known)
    scores = poisson_steps_vs_single_steps._shock_statistics(means, around, free)
    for k in (3, 17, 39, 55):
        step = (np.arange(M) >= k).astype(float)
        solved = np.linalg.solve(covariance, np.column_stack([step, means]))
        assert scores[k] == pytest.approx((step @ solved[:, 1]) ** 2 / (step @ solved[:, 0]), rel=1e-6)


def test_whitened_regressors_give_the_dense_likelihood(noisy_step):
    means, covariance = noisy_step
    around = build_state_space_noise(REST, means, BLOCK_S)._replace(level_variance=50.0)
    columns = np.column_stack([means, np.arange(M) >= 20.0])
    logs = poisson_steps_vs_single_steps._whiten(columns, around)
    assert -0.5 * (logs + columns[:, 0] @ columns[:, 0]) == pytest.approx(
        multivariate_normal.logpdf(means, cov=covariance)
    )
    step = (np.arange(M) >= 20).astype(float)
    assert columns[:, 0] @ columns[:, 1] == pytest.approx(step @ np.linalg.solve(covariance, means))


def draw_steps(times, heights, rng):
    t = TAU0_S * np.arange(HOUR)
    return white(HOUR, rng) + sum(height * (t >= time) for time, height in zip(times, heights, strict=True))


def test_times_of_steps_are_found():
    times, heights = (700.3, 1801.7, 2950.1), (4e-4, -3e-4, 5e-4)
    y = draw_steps(times, heights, np.random.default_rng(0))
    means, block_s = compute_block_means(y, TAU0_S, 5.0)
    noise = build_state_space_noise(BackgroundNoise(N * N), means, block_s)
    assert poisson_steps_vs_single_steps._fit_single_steps(means, noise, 5).times * block_s == pytest.approx(
        times, abs=3.0
    )
    found = compare_poisson_with_single_steps(y, TAU0_S, BackgroundNoise(N * N), 1e-5)
    assert found.single_steps == 3
    assert found.gain < 2.0


def test_noise_has_no_step():
    contest = compare_poisson_with_single_steps(
        white(HOUR, np.random.default_rng(1)), TAU0_S, BackgroundNoise(N * N), 2e-6
    )
    assert contest.single_steps == 0
    assert abs(contest.gain) < 2.0


def test_number_of_steps_is_limited():
    y = draw_steps((500.0, 1500.0, 2500.0), (4e-4, 4e-4, 4e-4), np.random.default_rng(2))
    assert (
        compare_poisson_with_single_steps(y, TAU0_S, BackgroundNoise(N * N), 1e-5, max_single_steps=2).single_steps == 2
    )


def test_one_step_is_no_poisson_process():
    for seed in range(3):
        y = draw_steps((1234.5,), (3e-4,), np.random.default_rng(seed))
        assert compare_poisson_with_single_steps(y, TAU0_S, BackgroundNoise(N * N), 5e-6).gain < 2.0


def test_many_steps_are_a_poisson_process():
    rng = np.random.default_rng(0)
    y = white(HOUR, rng) + jumps(HOUR, 0.005, 4e-4, rng)
    assert compare_poisson_with_single_steps(y, TAU0_S, BackgroundNoise(N * N), 2.8e-5).gain > 20.0


def test_steps_in_adjacent_blocks_stay_separate():
    """For a rise over two adjacent blocks, the refined times must not coincide, or the heights would be unknown."""
    means = np.where(np.arange(M) < 30, 0.0, np.where(np.arange(M) < 31, 20.0, 60.0)) - 29.0
    means = means + 0.1 * np.random.default_rng(0).standard_normal(M)
    found = poisson_steps_vs_single_steps._fit_single_steps(
        means, build_state_space_noise(BackgroundNoise(0.03), means, BLOCK_S), 2
    )
    assert found.times.size == 2
    assert found.times[1] - found.times[0] >= 1.0
