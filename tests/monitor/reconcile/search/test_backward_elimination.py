"""Tests of backward elimination: unneeded effects are removed, and needed effects stay."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from monitor.noise.effects import (
    AngleRandomWalk,
    ExponentiallyCorrelated,
    Narrowband,
    NoiseStep,
    QuantizationNoise,
    RateRamp,
    ScaleFactor,
    Sinusoidal,
)
from monitor.reconcile.diagnostics.null_distribution import run_diagnostics
from monitor.reconcile.likelihood.effect_roles import effect_size
from monitor.reconcile.likelihood.hypothesis_fit import Hypothesis, fit_with_fewest_changes, fit_with_model_sizes
from monitor.reconcile.likelihood.whitening import whiten_axis
from monitor.reconcile.search.backward_elimination import (
    changed_sizes,
    eliminate_unneeded_effects,
    revert_insignificant_size_changes,
    share_frequency_or_time,
)
from monitor.reconcile.search.cross_validation import accept_without_validation
from monitor.reconcile.search.search import AxisSearchResult, HypothesisDiagnostics, SearchRound
from monitor.reconcile.search.trials import RETUNE, Trial
from tests.monitor.reconcile.axes import STRICT, WALK, WHITE, N, axes, axis, draw_resonance, time_s, walk, white, whiten

n = 30_000
MODEL = (WHITE, WALK)
T = time_s(n)


@cache
def draw_noise(seed=0):
    rng = np.random.default_rng(seed)
    return white(n, rng) + walk(n, rng)


def make_found(hypothesis: Hypothesis) -> AxisSearchResult:
    """Return the result of a search that ended with this hypothesis after one round."""
    reason = accept_without_validation("made by hand")
    done = SearchRound(HypothesisDiagnostics({}, ()), (Trial(RETUNE, None, 10.0),), hypothesis, reason)
    final = HypothesisDiagnostics(run_diagnostics(whiten_axis(hypothesis.fit)), ())
    return AxisSearchResult((done,), hypothesis, final, None)


def eliminate_effects(y, added, model=MODEL) -> Hypothesis:
    one = axis(y, model)
    found = make_found(Hypothesis(model, one.fit((*model, *added), frozenset(range(len(model))))))
    return eliminate_unneeded_effects({"gz": found}, {"gz": STRICT}, fitted_first=False)["gz"].hypothesis


def list_added(hypothesis):
    return [effect.name for effect in hypothesis.added]


def test_effect_that_explains_nothing_is_removed():
    line = Sinusoidal(amplitude=1e-4, frequency=17.3)
    y = draw_noise() + 2e-4 * np.sin(2 * np.pi * 17.3 * T)
    assert list_added(eliminate_effects(y, (line, RateRamp(R=1e-9), Narrowband(1e-6, 8.0, 0.5)))) == ["sinusoidal"]


def test_effect_that_is_needed_stays():
    y = draw_noise() + draw_resonance(n, np.random.default_rng(3), 3e-4, 8.0, 0.5)
    assert list_added(eliminate_effects(y, (Narrowband(1e-4, 8.0, 0.5),))) == ["narrowband"]


def test_factor_that_a_changed_size_cancels_is_removed():
    step = NoiseStep(time=0.5 * n / 100.0, ratio=0.85)
    rng = np.random.default_rng(0)
    one = axis(white(n, rng) * np.where(step.time > T, 1.0, step.ratio) + walk(n, rng), (*MODEL, step))
    before = fit_with_fewest_changes(one, (step, ScaleFactor(factor=0.92)), MODEL)
    assert changed_sizes(before) == [0]  # N is larger, because the factor makes it too small
    found = eliminate_unneeded_effects({"gz": make_found(before)}, {"gz": STRICT}, fitted_first=False)["gz"].hypothesis
    assert list_added(found) == ["noise_step"]
    assert changed_sizes(found) == []


def test_factor_of_all_sizes_is_not_replaced_by_changed_sizes():
    found = eliminate_effects(1.25 * draw_noise(), (ScaleFactor(factor=1.25),))
    assert list_added(found) == ["scale_factor"]
    assert changed_sizes(found) == []


def test_two_peaks_of_one_resonance_become_one_resonance():
    y = draw_noise() + draw_resonance(n, np.random.default_rng(3), 3e-4, 8.0, 1.5)
    found = eliminate_effects(y, (Narrowband(2e-4, 7.7, 0.6), Narrowband(2e-4, 8.3, 0.6)))
    (hump,) = found.added
    assert isinstance(hump, Narrowband)
    assert hump.frequency == pytest.approx(8.0, abs=0.2)
    assert hump.bandwidth == pytest.approx(1.5, rel=0.4)


def test_two_distant_resonances_stay():
    rng = np.random.default_rng(3)
    y = draw_noise() + draw_resonance(n, rng, 3e-4, 8.0, 0.2) + draw_resonance(n, rng, 3e-4, 10.0, 0.2)
    assert (
        list_added(eliminate_effects(y, (Narrowband(2e-4, 8.0, 0.2), Narrowband(2e-4, 10.0, 0.2))))
        == ["narrowband"] * 2
    )


def test_size_that_did_not_change_keeps_its_old_value():
    one = axis(draw_noise(), MODEL)
    free = Hypothesis(MODEL, one.fit(MODEL))
    assert changed_sizes(free) == [0, 1]
    assert revert_insignificant_size_changes(free).effects == MODEL


def test_only_the_changed_one_of_two_sizes_is_retuned():
    rng = np.random.default_rng(5)
    one = axis(1.1 * white(n, rng) + walk(n, rng), MODEL)
    found = revert_insignificant_size_changes(Hypothesis(MODEL, one.fit(MODEL)))
    assert changed_sizes(found) == [0]
    assert effect_size(found.effects[0]) == pytest.approx(1.1 * N, rel=0.02)


def test_term_compatible_with_zero_is_removed():
    model = (*MODEL, QuantizationNoise(Q=3e-6))
    rng = np.random.default_rng(6)
    one = axis(white(n, rng) + walk(n, rng), model)
    almost = (*MODEL, QuantizationNoise(Q=1e-8))
    found = revert_insignificant_size_changes(Hypothesis(model, one.fit(almost, frozenset({0, 1, 2}))))
    assert changed_sizes(found) == [2]
    assert effect_size(found.effects[2]) == 0.0


def test_equal_ratios_of_sizes_become_one_scale_factor_of_a_triad():
    model = (WHITE, WALK)
    values = {name: 1.3 * draw_noise(seed) for seed, name in enumerate(("gx", "gy", "gz"))}
    found = {
        name: make_found(Hypothesis(model, one.fit(model, frozenset({1})))) for name, one in axes(values, model).items()
    }
    simple = eliminate_unneeded_effects(found, dict.fromkeys(found, STRICT), fitted_first=False)
    factors = {one.hypothesis.added for one in simple.values()}
    ((factor,),) = factors
    assert isinstance(factor, ScaleFactor)
    assert factor.factor == pytest.approx(1.3, rel=0.01)
    assert not any(changed_sizes(one.hypothesis) for one in simple.values())
    unchanged = eliminate_unneeded_effects(found, dict.fromkeys(found, STRICT), fitted_first=True)
    assert [one.hypothesis.added for one in unchanged.values()] == [()] * 3


def test_sizes_with_different_ratios_stay_separate():
    values = {name: factor * draw_noise(2) for name, factor in (("gx", 1.2), ("gy", 1.3), ("gz", 1.4))}
    found = {
        name: make_found(Hypothesis(MODEL, one.fit(MODEL, frozenset({1})))) for name, one in axes(values, MODEL).items()
    }
    simple = eliminate_unneeded_effects(found, dict.fromkeys(found, STRICT), fitted_first=False)
    assert [one.hypothesis.added for one in simple.values()] == [()] * 3


def test_weak_line_stays_if_another_axis_has_it():
    y = draw_noise() + 4.4e-5 * np.sin(2 * np.pi * 17.3 * T)
    loud = draw_noise(1) + 1e-3 * np.sin(2 * np.pi * 17.3 * T)
    line = Sinusoidal(amplitude=1e-5, frequency=17.3)
    both = axes({"gx": loud, "gz": y}, MODEL)
    found = {name: make_found(fit_with_fewest_changes(one, (line,), MODEL)) for name, one in both.items()}
    null = dict.fromkeys(found, STRICT)
    gain = found["gz"].hypothesis.fit.log_likelihood - fit_with_model_sizes(both["gz"], MODEL).fit.log_likelihood
    assert 5.0 < gain < 23.0
    together = eliminate_unneeded_effects(found, null, fitted_first=False)
    alone = eliminate_unneeded_effects({"gz": found["gz"]}, null, fitted_first=False)
    assert (list_added(together["gz"].hypothesis), list_added(alone["gz"].hypothesis)) == (["sinusoidal"], [])


def test_simplification_that_a_diagnostic_contradicts_is_undone():
    y = draw_noise() + 5.2e-5 * np.sin(2 * np.pi * 17.3 * T)
    one = axis(y, MODEL)
    found = make_found(fit_with_fewest_changes(one, (Sinusoidal(amplitude=1e-5, frequency=17.3),), MODEL))
    with_line, without = found.final.findings["lines"].gain, run_diagnostics(whiten(one, MODEL))["lines"].gain
    assert without > with_line
    strict = {**STRICT, "lines": replace(STRICT["lines"], threshold=0.5 * (with_line + without))}
    (kept,) = eliminate_unneeded_effects({"gz": found}, {"gz": strict}, fitted_first=False).values()
    assert kept is found


def test_line_and_a_resonance_at_one_frequency_have_one_cause():
    line = Sinusoidal(amplitude=1.0, frequency=17.3)
    assert share_frequency_or_time(line, Narrowband(1.0, 17.31, 0.1))
    assert not share_frequency_or_time(line, Sinusoidal(amplitude=1.0, frequency=18.3))
    assert not share_frequency_or_time(AngleRandomWalk(N=1.0), AngleRandomWalk(N=1.0))
    assert not share_frequency_or_time(line, ExponentiallyCorrelated(sigma=1.0, correlation_time=17.3))
