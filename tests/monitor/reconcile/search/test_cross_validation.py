"""Tests that a step is kept if the fit of one half of the recording is valid for the other half."""

import numpy as np
import pytest

from monitor.noise.effects import (
    AngleRandomWalk,
    BiasStep,
    CrossAxis,
    ExponentiallyCorrelated,
    Narrowband,
    NoiseStep,
    Outliers,
    RateRamp,
    Resolution,
    Sinusoidal,
    TemperatureBias,
)
from monitor.reconcile.diagnostics.null_distribution import NullDistribution
from monitor.reconcile.diagnostics.whiteness_tests import find_peak_gains_and_frequencies
from monitor.reconcile.likelihood.hypothesis_fit import fit_with_fewest_changes, fit_with_model_sizes
from monitor.reconcile.search.cross_validation import cross_validate
from monitor.reconcile.search.sample_repair import repair_axis_again
from tests.monitor.reconcile.axes import (
    WALK,
    WHITE,
    N,
    axes,
    axis,
    correlated,
    draw_resonance,
    make_temperature,
    time_s,
    walk,
    white,
    whiten,
)

n = 24_000
MODEL = (WHITE, WALK)
NULL = NullDistribution(7.0, 15.0)
HALF = time_s(n) < 120.0


def draw_noise(seed=0):
    rng = np.random.default_rng(seed)
    return white(n, rng) + walk(n, rng)


def validate_step(one, effect, diagnostic, model=MODEL):
    before, after = fit_with_model_sizes(one, model), fit_with_fewest_changes(one, (effect,), model)
    return cross_validate(before, after, after.effects[-1], diagnostic, NULL)


LINE = 3e-4 * np.sin(2 * np.pi * 17.3 * time_s(n))
RINGING = draw_resonance(n, np.random.default_rng(1), 5e-4, 17.3, 1.0)
SLOW = correlated(n, np.random.default_rng(2), 5e-4, 0.3)
OTHER = correlated(n, np.random.default_rng(3), 1e-2, 1.0)
REAL = {
    "line": (LINE, Sinusoidal(amplitude=1.0, frequency=17.3, phase=0.0), "lines"),
    "resonance": (RINGING, Narrowband(sigma=1e-4, frequency=17.3, bandwidth=1.0), "psd"),
    "correlated": (SLOW, ExponentiallyCorrelated(sigma=1e-4, correlation_time=0.3), "psd"),
    "slope": (1e-5 * time_s(n), RateRamp(R=1.0), "level"),
    "temperature": (
        2e-4 * (make_temperature(n) - 25.0),
        TemperatureBias(coefficient=1.0, reference=25.0),
        "temperature",
    ),
    "leak": (0.05 * OTHER, CrossAxis(source="gx", coefficient=1.0), "other_axes"),
}


def test_drift_of_one_half_does_not_outweigh_the_effect():
    """The random walk that is fitted to the half with the drift is far too large for the other half."""
    drift = np.where(HALF, 0.02 * np.exp(-time_s(n) / 20.0), 0.0)
    one = axis(draw_noise(4) + RINGING + drift, MODEL)
    found = validate_step(one, Narrowband(sigma=1e-4, frequency=17.3, bandwidth=1.0), "psd")
    assert found.reason == ""
    assert found.kept


@pytest.mark.parametrize("name", REAL)
def test_effect_of_both_halves_is_kept(name):
    hidden, effect, diagnostic = REAL[name]
    one = axes({"gx": OTHER, "gz": draw_noise() + hidden}, {"gx": (), "gz": MODEL}, make_temperature(n))["gz"]
    found = validate_step(one, effect, diagnostic)
    assert found.reason == ""
    assert found.kept
    assert found.after < 0.7 * found.before
    assert found.before**2 / 2.0 > 20.0


BY_CHANCE = {
    "resonance": (RINGING, Narrowband(sigma=1e-4, frequency=17.3, bandwidth=1.0), "psd"),
    "correlated": (SLOW, ExponentiallyCorrelated(sigma=1e-4, correlation_time=0.3), "psd"),
    "leak": (0.05 * OTHER * np.where(HALF, 1.0, -0.6), CrossAxis(source="gx", coefficient=1.0), "other_axes"),
    "temperature": (
        4e-4 * (make_temperature(n) - 25.0) * np.where(HALF, 1.0, -0.6),
        TemperatureBias(coefficient=1.0, reference=25.0),
        "temperature",
    ),
}


@pytest.mark.parametrize("name", BY_CHANCE)
def test_effect_that_one_half_contradicts_is_not_kept(name):
    hidden, effect, diagnostic = BY_CHANCE[name]
    hidden = hidden * HALF if diagnostic == "psd" else hidden
    one = axes({"gx": OTHER, "gz": draw_noise() + hidden}, {"gx": (), "gz": MODEL}, make_temperature(n))["gz"]
    before, after = fit_with_model_sizes(one, MODEL), fit_with_fewest_changes(one, (effect,), MODEL)
    # on the data that chose it, it is worth its name
    assert after.fit.log_likelihood - before.fit.log_likelihood > 20.0
    found = cross_validate(before, after, effect, diagnostic, NULL)
    assert not found.kept


def test_strongest_line_of_noise_is_not_validated():
    """The strongest line in pure noise gains about twelve nats, which is too little to decide by comparing the halves
    of the recording."""
    one = axis(draw_noise(4))
    view = whiten(one, MODEL)
    gain, f_hz = find_peak_gains_and_frequencies(view.periodogram, one.rate_hz, 1)[0]
    assert gain > 7.0
    found = validate_step(one, Sinusoidal(amplitude=1.0, frequency=f_hz, phase=0.0), "lines")
    assert found.reason or not found.kept
    assert np.isnan(found.before) == bool(found.reason)


def test_changed_size_of_a_known_noise_is_kept():
    one = axis(1.2 * draw_noise(5))
    before = fit_with_model_sizes(one, MODEL)
    after = fit_with_fewest_changes(one, (), MODEL)
    assert after.resized_model_effect_count >= 1
    found = cross_validate(before, after, None, "psd", NULL)
    assert found.kept
    assert found.after < 0.2 * found.before


@pytest.mark.parametrize(
    ("effect", "model"),
    [(NoiseStep(time=60.0, ratio=2.0), (AngleRandomWalk(N=N),)), (BiasStep(time=30.0, height=1.0), MODEL)],
)
def test_single_event_is_not_validated_by_halves(effect, model):
    course = np.where(time_s(n) < 60.0, 1.0, 2.0) if isinstance(effect, NoiseStep) else 1.0
    y = draw_noise(6) * course + 4e-3 * (time_s(n) >= 30.0) * isinstance(effect, BiasStep)
    found = validate_step(axis(y), effect, "variance" if isinstance(effect, NoiseStep) else "level", model)
    assert found.reason
    assert found.kept
    assert np.isnan([found.before, found.after]).all()


def test_effect_too_weak_for_a_half_has_that_reason():
    one = axis(draw_noise(7) + 4e-5 * np.sin(2 * np.pi * 17.3 * time_s(n)))
    found = validate_step(one, Sinusoidal(amplitude=1.0, frequency=17.3, phase=0.0), "lines")
    assert "half" in found.reason


@pytest.mark.parametrize("kind", ["outliers", "resolution"])
def test_outliers_are_tested_in_each_half(kind):
    rng = np.random.default_rng(8)
    y = draw_noise(8)
    if kind == "outliers":
        y = y + (rng.random(n) < 2e-3) * 1e-2 * rng.standard_normal(n)
        effect, diagnostic = Outliers(fraction=2e-3, scale=1e-2), "tails"
    else:
        y = 6e-4 * np.rint(y / 6e-4)
        effect, diagnostic = Resolution(step=6e-4), "values"
    plain = axis(y, MODEL)
    one = repair_axis_again(plain, (*MODEL, effect), rng)
    before = fit_with_fewest_changes(plain, (), MODEL)
    after = fit_with_fewest_changes(one, (effect,), MODEL)
    found = cross_validate(before, after, effect, diagnostic, NULL)
    assert found.kept
    assert found.reason == ""
    assert found.after < 0.5 * found.before
