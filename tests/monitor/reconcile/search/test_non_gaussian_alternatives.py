"""Tests that the simulated effect is identified when two effects have equal spectra."""

import numpy as np
import pytest

from monitor.noise.effects import (
    BiasInstability,
    BiasStep,
    ExponentiallyCorrelated,
    PoissonSteps,
    RandomTelegraph,
    RateRandomWalk,
)
from monitor.reconcile.likelihood.hypothesis_fit import fit_with_fewest_changes
from monitor.reconcile.search.non_gaussian_alternatives import (
    build_background_noise,
    compare_poisson_with_added_noise,
    fit_poisson_alternative,
    fit_telegraph_alternative,
)
from tests.monitor.reconcile.axes import RATE_HZ, WALK, WHITE, axis, correlated, time_s, walk, white

n = 60_000
MODEL = (WHITE, WALK)


def draw_noise(rng):
    return white(n, rng) + walk(n, rng)


def draw_telegraph(rng, amplitude, dwell_s):
    flips = np.cumsum(rng.poisson(1.0 / (RATE_HZ * dwell_s), n))
    return 0.5 * amplitude * (1.0 - 2.0 * (flips % 2))


def draw_poisson_steps(rng, rate, height):
    count = rng.poisson(rate / RATE_HZ, n)
    return height * np.cumsum(np.sqrt(count) * rng.standard_normal(n))


def find_noise(y):
    """Return the result of a search that has found correlated noise."""
    one = axis(y)
    effects = (*MODEL, ExponentiallyCorrelated(sigma=3e-4, correlation_time=5.0))
    return fit_with_fewest_changes(one, effects[2:], effects[:2])


@pytest.mark.parametrize("seed", [0, 1])
def test_telegraph_signal_is_no_correlated_noise(seed):
    rng = np.random.default_rng(seed)
    state = find_noise(draw_noise(rng) + draw_telegraph(rng, 6e-4, 10.0))
    twin = fit_telegraph_alternative(state, 2)
    assert twin.gain > 5.0
    effect = twin.added[-1]
    assert isinstance(effect, RandomTelegraph)
    assert not any(isinstance(one, ExponentiallyCorrelated) for one in twin.added)
    assert effect.amplitude == pytest.approx(6e-4, rel=0.1)
    assert effect.dwell_time == pytest.approx(10.0, rel=0.5)
    assert 40 < twin.event_count < 90  # 60 are expected
    bounds = twin.intervals["amplitude"]
    assert bounds.lo < effect.amplitude < bounds.hi


@pytest.mark.parametrize("seed", [0, 1])
def test_correlated_noise_is_no_telegraph_signal(seed):
    rng = np.random.default_rng(seed)
    state = find_noise(draw_noise(rng) + correlated(n, rng, 3e-4, 5.0))
    assert fit_telegraph_alternative(state, 2).gain < -5.0


def test_without_white_noise_no_alternative_is_tested():
    rng = np.random.default_rng(2)
    one = axis(draw_noise(rng) + correlated(n, rng, 3e-4, 5.0))
    state = fit_with_fewest_changes(one, (ExponentiallyCorrelated(sigma=3e-4, correlation_time=5.0),), (WALK,))
    assert fit_telegraph_alternative(state, 1) is None


@pytest.mark.parametrize("seed", range(3))
def test_poisson_steps_are_no_random_walk(seed):
    rng = np.random.default_rng(seed)
    y = draw_noise(rng) + draw_poisson_steps(rng, 0.05, 5e-4)
    one = axis(y)
    state = fit_with_fewest_changes(one, (), MODEL)
    assert 1 in state.fit.fitted_noise  # a stronger walk stands in for the steps
    twin = fit_poisson_alternative(state)
    assert twin.gain > 5.0
    effect = twin.added[-1]
    assert isinstance(effect, PoissonSteps)
    assert WALK not in twin.added  # the model has it, and keeps its size
    assert effect.rate == pytest.approx(0.05, rel=0.7)
    assert effect.height == pytest.approx(5e-4, rel=0.5)
    assert 12 < twin.event_count < 60  # 30 are expected, some too small to see


@pytest.mark.parametrize("seed", range(3))
def test_random_walk_is_no_poisson_steps(seed):
    rng = np.random.default_rng(seed)
    one = axis(draw_noise(rng) + walk(n, rng, 1e-4))
    state = fit_with_fewest_changes(one, (), MODEL)
    assert state.effects[1].K > 10 * WALK.K
    assert fit_poisson_alternative(state).gain < 0.0


def test_missing_random_walk_is_compared_with_poisson_steps():
    rng = np.random.default_rng(5)
    y = white(n, rng) + walk(n, rng, 1e-4)
    one = axis(y)
    state = fit_with_fewest_changes(one, (RateRandomWalk(K=1e-5),), (WHITE,))
    assert fit_poisson_alternative(state).gain < 0.0
    stepped = axis(white(n, rng) + draw_poisson_steps(rng, 0.05, 5e-4))
    twin = fit_poisson_alternative(fit_with_fewest_changes(stepped, (RateRandomWalk(K=1e-5),), (WHITE,)))
    assert twin.gain > 5.0
    assert not any(isinstance(effect, RateRandomWalk) for effect in twin.added)


def test_remaining_noise_has_the_spectrum_of_its_effects():
    effects = (
        WHITE,
        RateRandomWalk(K=2e-3),
        PoissonSteps(rate=0.2, height=3e-3),
        RandomTelegraph(amplitude=0.2, dwell_time=8.0),
        ExponentiallyCorrelated(sigma=0.1, correlation_time=20.0),
        BiasInstability(B=1e-2),
    )
    f_hz = np.geomspace(1e-3, 0.3, 20)  # far below the rate
    for some in (effects, effects[:3]):
        rest = build_background_noise(some)
        turn = 2.0 * np.pi * f_hz
        density = rest.white + rest.walk / turn**2 + rest.flicker / turn
        density += sum(2.0 * s**2 * t / (1.0 + (turn * t) ** 2) for s, t in rest.correlated)
        expected = sum(one.two_sided_psd(f_hz, 1.0 / RATE_HZ) for one in some)
        np.testing.assert_allclose(density, expected, rtol=2e-3)


def test_true_model_is_not_tested():
    one = axis(draw_noise(np.random.default_rng(6)))
    assert fit_poisson_alternative(fit_with_fewest_changes(one, (), MODEL)) is None
    step = draw_noise(np.random.default_rng(7)) + 5e-4 * (time_s(n) > 200.0)
    stepped = axis(step)
    state = fit_with_fewest_changes(stepped, (BiasStep(time=200.0, height=1.0),), MODEL)
    assert fit_poisson_alternative(state).gain < 0.0  # one step is a step


def test_jumps_are_distinguished_from_correlated_noise_that_contains_them():
    rng = np.random.default_rng(3)
    stepped = compare_poisson_with_added_noise(find_noise(draw_noise(rng) + draw_poisson_steps(rng, 0.05, 6e-4)))
    assert stepped.gain > 5.0
    assert isinstance(stepped.added[-1], PoissonSteps)
    assert not any(isinstance(one, ExponentiallyCorrelated) for one in stepped.added)
    smooth = compare_poisson_with_added_noise(find_noise(draw_noise(rng) + correlated(n, rng, 3e-4, 5.0)))
    assert smooth is None or smooth.gain < 0.0
    assert compare_poisson_with_added_noise(fit_with_fewest_changes(axis(draw_noise(rng)), (), MODEL)) is None
