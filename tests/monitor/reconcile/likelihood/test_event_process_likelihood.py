"""Tests of the covariance of block means and of the width of a likelihood maximum."""

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from monitor.reconcile.likelihood.event_process_likelihood import (
    MAX_LOG_PARAMETER_RANGE,
    BackgroundNoise,
    _flicker_processes,
    build_state_space_noise,
    compute_block_means,
    correlated_noise_of_block_means,
    fit_event_process,
    kalman_log_likelihood,
    log_interval,
    maximise_over_log_parameters,
)
from tests.monitor.reconcile.event_noise import BLOCK_S, dense


@pytest.mark.parametrize(
    "rest",
    [
        BackgroundNoise(1.0),
        BackgroundNoise(1.0, walk=0.02),
        BackgroundNoise(1.0, walk=0.02, correlated=((0.7, 20.0), (0.4, 1.0), (2.0, 9000.0))),
        BackgroundNoise(1e-3, correlated=((0.7, 20.0),)),
    ],
)
def test_filter_equals_the_dense_gaussian_likelihood(rest):
    covariance = dense(rest, 300, start=5.0)
    means = np.linalg.cholesky(covariance) @ np.random.default_rng(0).standard_normal(300)
    around = build_state_space_noise(rest, means, BLOCK_S)._replace(level_variance=5.0)
    found = kalman_log_likelihood(means, around)
    assert found == pytest.approx(multivariate_normal.logpdf(means, cov=covariance), abs=1e-6)


def test_slow_process_equals_a_random_walk_in_a_block():
    for block_s in (0.0999, 0.1001):  # either side of where a series takes over
        row, own = correlated_noise_of_block_means(1.0, 10.0, block_s)
        walk = 2.0 / 10.0 * block_s
        assert row[2:] == pytest.approx((walk, 0.5 * walk), rel=0.02)
        assert own == pytest.approx(walk / 3.0, rel=0.02)
    assert correlated_noise_of_block_means(1.0, 10.0, 0.0999)[1] / 0.0999 == pytest.approx(
        correlated_noise_of_block_means(1.0, 10.0, 0.1001)[1] / 0.1001, rel=1e-4
    )


def test_flicker_is_one_over_f_below_the_white_noise():
    rest, span_s = BackgroundNoise(2.25e-8, flicker=9e-10), 3600.0
    f = np.geomspace(1.0 / span_s, rest.flicker / (2.0 * np.pi * rest.white), 50)
    summed = sum(2.0 * s * s * t / (1.0 + (2.0 * np.pi * f * t) ** 2) for s, t in _flicker_processes(rest, 1.0, span_s))
    assert summed == pytest.approx(rest.flicker / (2.0 * np.pi * f), rel=0.25)
    inside = f > 4.0 / span_s
    assert summed[inside] == pytest.approx(rest.flicker / (2.0 * np.pi * f[inside]), rel=0.12)
    assert _flicker_processes(BackgroundNoise(1.0), 1.0, span_s) == []


def test_maximum_has_the_width_of_the_likelihood():
    target, inverse = np.log([3e-4, 20.0]), np.array([[25.0, -6.0], [-6.0, 4.0]])

    def likelihood(a, b):
        x = np.log([a, b]) - target
        return 7.0 - 0.5 * x @ inverse @ x

    height, at = maximise_over_log_parameters(likelihood, (5e-4, 9.0))
    assert height == pytest.approx(7.0, abs=0.02)
    assert at == pytest.approx(target, abs=0.05)
    found = fit_event_process(lambda a, b, odds: likelihood(a, b) + 12.0 * np.log(odds), {"a": 5e-4, "b": 9.0})
    assert found.log_likelihood == height
    assert found.events == pytest.approx(12.0, rel=1e-3)
    for k, name in enumerate(("a", "b")):
        bounds = found.parameters[name]
        assert bounds.value == pytest.approx(np.exp(at[k]))
        assert bounds.hi / bounds.value == pytest.approx(np.exp(1.96 * np.linalg.inv(inverse)[k, k] ** 0.5), rel=1e-4)
        assert bounds.lo * bounds.hi == pytest.approx(bounds.value**2)


def test_without_a_maximum_there_is_no_interval():
    flat = fit_event_process(lambda a, b, _odds: -0.0 * a * b, {"a": 1.0, "b": 1.0})
    assert flat.parameters["a"].lo is None
    assert log_interval(1.0, MAX_LOG_PARAMETER_RANGE).hi is None


def test_search_stays_near_its_start():
    _, (at,) = maximise_over_log_parameters(np.log, (2.0,))
    assert 2.0 < np.exp(at) <= 60.0 * (1.0 + 1e-9)


def test_block_means_are_means_of_their_samples():
    y = np.random.default_rng(0).standard_normal(1003) + 5.0
    means, block_s = compute_block_means(y, 0.01, 0.1)
    assert block_s == pytest.approx(0.1)
    assert means + y[:1000].mean() == pytest.approx([y[10 * k : 10 * k + 10].mean() for k in range(100)])
    noise = build_state_space_noise(BackgroundNoise(1.0), means, block_s)
    assert noise.level_variance == pytest.approx(100.0 * means.var())
