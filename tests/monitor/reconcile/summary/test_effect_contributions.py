"""Tests that the parts of the gap are complete and never negative, even for quantized values."""

from dataclasses import replace
from functools import cache
from math import sqrt

import numpy as np
import pytest

from monitor.estimation.allan.batch import cluster_sizes
from monitor.noise.effects import (
    AngleRandomWalk,
    Narrowband,
    NoiseStep,
    Outliers,
    PoissonSteps,
    Resolution,
    Sinusoidal,
)
from monitor.reconcile.likelihood.effect_roles import with_effect_size
from monitor.reconcile.likelihood.hypothesis_fit import Hypothesis, fit_with_model_sizes
from monitor.reconcile.result import DiagnosticGap, Location
from monitor.reconcile.search.backward_elimination import changed_sizes
from monitor.reconcile.search.cross_validation import accept_without_validation
from monitor.reconcile.search.search import AxisSearchResult, HypothesisDiagnostics, SearchRound
from monitor.reconcile.search.trials import Trial
from monitor.reconcile.summary.effect_contributions import (
    decompose_explained_gain,
    find_most_influenced_averaging_times,
    fit_without,
    measure_remaining_gaps,
    value_artifact_gain,
)
from tests.monitor.reconcile.axes import RATE_HZ, WALK, WHITE, N, axis, time_s, walk, white

n = 30_000
MODEL = (WHITE, WALK)
LINE, HUMP = Sinusoidal(amplitude=1e-4, frequency=17.3), Narrowband(sigma=1e-6, frequency=8.0, bandwidth=0.5)
NOTHING = HypothesisDiagnostics({}, ())
WHITE_MODEL = (AngleRandomWalk(N=N),)


@cache
def louder_with_line():
    rng = np.random.default_rng(1)
    y = 1.2 * white(n, rng) + walk(n, rng) + 1.5e-4 * np.sin(2 * np.pi * 17.3 * time_s(n))
    one = axis(y, MODEL)
    return Hypothesis(MODEL, one.fit((*MODEL, LINE, HUMP), frozenset({1})))


def search(hypothesis, *trials):
    rounds = tuple(
        SearchRound(NOTHING, (one,), hypothesis, accept_without_validation("made by hand")) for one in trials
    )
    return AxisSearchResult(rounds, hypothesis, NOTHING, None)


def test_parts_are_not_negative_and_complete():
    hypothesis = louder_with_line()
    gains = decompose_explained_gain(search(hypothesis), fitted_first=False)
    assert set(gains) == {0, 2, 3}
    start = fit_with_model_sizes(hypothesis.axis, MODEL).fit.log_likelihood
    assert sum(gains.values()) == pytest.approx(hypothesis.fit.log_likelihood - start, abs=1e-3)
    assert gains[2] == pytest.approx(1.5e-4**2 * n / (4 * (1.2 * N) ** 2 * 100.0), rel=0.15)  # A²n/(4σ²)
    assert gains[0] == pytest.approx(0.5 * n * (1.2**2 - 1.0 - 2 * np.log(1.2)), rel=0.15)
    assert 0.0 <= gains[3] < 5.0


def test_sizes_of_a_model_of_the_same_recording_have_no_gain():
    gains = decompose_explained_gain(search(louder_with_line()), fitted_first=True)
    assert set(gains) == {2, 3}


def test_removed_effect_has_its_old_size_or_is_left_out():
    hypothesis = louder_with_line()
    without = fit_without(hypothesis, {0, 2, 3})
    assert without.effects[0] == WHITE
    assert len(without.effects) == 2
    free = fit_without(hypothesis, {2})
    assert [type(effect) for effect in free.effects] == [AngleRandomWalk, type(WALK), Narrowband]
    assert free.effects[0] != WHITE
    assert free.effects[1] == WALK


def test_size_that_was_set_to_zero_is_fitted_without_the_effect_that_replaced_it():
    rng = np.random.default_rng(4)
    one, absent = axis(white(n, rng), WHITE_MODEL), with_effect_size(WHITE, 0.0)
    hypothesis = Hypothesis(WHITE_MODEL, one.fit((absent, WHITE), frozenset({0})))
    without = fit_without(hypothesis, {1})
    assert [effect.N for effect in without.effects] == [pytest.approx(N, rel=0.02)]
    assert hypothesis.fit.log_likelihood - without.log_likelihood < 1.0


def test_outliers_have_the_gain_of_their_test():
    hypothesis = louder_with_line()
    with_outliers = Hypothesis(
        MODEL, hypothesis.axis.fit((*MODEL, Outliers(fraction=1e-3, scale=1e-2)), frozenset({0, 1}))
    )
    trial = Trial("outliers", with_outliers.added[0], 200.0)
    gains = decompose_explained_gain(search(with_outliers, trial), fitted_first=True)
    assert gains == {2: pytest.approx(200.0)}


def test_each_of_two_noise_steps_has_the_gain_of_its_own_test():
    hypothesis = louder_with_line()
    steps = [NoiseStep(ratio=2.0, time=50.0), NoiseStep(ratio=1.5, time=150.0)]
    both = Hypothesis(MODEL, hypothesis.axis.fit((*MODEL, *steps), frozenset({0, 1})))
    trials = [
        Trial("noise_step", replace(one, time=one.time + 1.0), gain)
        for one, gain in zip(steps, (200.0, 30.0), strict=True)
    ]
    gains = decompose_explained_gain(search(both, *trials), fitted_first=True)
    assert gains == {2: pytest.approx(200.0), 3: pytest.approx(30.0)}


def test_power_of_random_jumps_counts_once():
    hypothesis = louder_with_line()
    jumps = Hypothesis(MODEL, hypothesis.axis.fit((*MODEL, PoissonSteps(rate=0.1, height=1e-3)), frozenset({0, 1})))
    trial = Trial("poisson_steps", jumps.added[0], 200.0, gain_over_same_spectrum=30.0)
    spectrum = jumps.fit.log_likelihood - fit_without(jumps, {2}).log_likelihood
    gains = decompose_explained_gain(search(jumps, trial), fitted_first=True)
    assert gains == {2: pytest.approx(max(spectrum, 0.0) + 30.0)}


@pytest.mark.parametrize(("step_to_noise", "share"), [(1.0, 1 / 13), (0.3, 0.0075)])
def test_quantization_counts_with_its_noise(step_to_noise, share):
    sigma = 1e-3
    step = step_to_noise * sigma
    y = step * np.rint(white(n, np.random.default_rng(2)) / step)
    model = (AngleRandomWalk(N=1e-4),)
    one = axis(y, model)
    fit = one.fit((*model, Resolution(step=step)))
    expected = 0.5 * n * (share / (1 - share) + np.log(1 - share))
    assert value_artifact_gain(fit, Resolution) == pytest.approx(expected, rel=0.1)
    assert one.value_artifacts.quantization.gain > 20.0 * value_artifact_gain(fit, Resolution)


def make_gap(diagnostic, gain):
    return DiagnosticGap(diagnostic, Location(), sqrt(2.0 * gain), 2.0, 5.0)


def test_diagnostics_of_one_group_count_once():
    hypothesis = louder_with_line()
    left = (
        make_gap("lines", 40.0),
        make_gap("psd", 60.0),
        make_gap("tails", 30.0),
        make_gap("variance", 20.0),
        make_gap("level", 25.0),
    )
    found = measure_remaining_gaps(search(hypothesis), left)
    assert [(one.group, one.strongest.diagnostic) for one in found] == [
        ("spectrum", "psd"), ("distribution", "tails"), ("level", "level"),
    ]  # fmt: skip
    assert [one.gain_nats for one in found] == [pytest.approx(gain) for gain in (60.0, 30.0, 25.0)]
    assert measure_remaining_gaps(search(hypothesis), ()) == ()


def test_spectrum_that_is_wrong_everywhere_counts_in_every_band():
    rng = np.random.default_rng(3)
    wrong = fit_with_model_sizes(axis(1.2 * (white(n, rng) + walk(n, rng)), MODEL), MODEL)
    (one,) = measure_remaining_gaps(search(wrong), (make_gap("psd", 60.0),))
    assert one.gain_nats == pytest.approx(0.5 * n * (1.2**2 - 1.0 - 2 * np.log(1.2)), rel=0.15)


def averaging_times(y, *added, fixed=frozenset({0})):
    hypothesis = Hypothesis(WHITE_MODEL, axis(y, WHITE_MODEL).fit((*WHITE_MODEL, *added), fixed))
    changed = (*changed_sizes(hypothesis), *range(len(WHITE_MODEL), len(hypothesis.effects)))
    return find_most_influenced_averaging_times(hypothesis, changed)


def test_a_line_is_largest_where_its_allan_variance_stands_out_most():
    f, a = 2.3, 4e-4
    y = white(n, np.random.default_rng(1)) + a * np.sin(2 * np.pi * f * time_s(n))
    found = averaging_times(y, Sinusoidal(amplitude=a, frequency=f))[1]
    tau = 2.0 ** np.arange(12) / RATE_HZ
    x = np.pi * f * tau
    ratio = np.sqrt(1.0 + a**2 * np.sin(x) ** 4 / x**2 * tau / N**2)
    assert found == pytest.approx(tau[np.argmax(ratio)])


def test_a_random_walk_is_largest_at_the_longest_averaging_time():
    rng = np.random.default_rng(1)
    found = averaging_times(white(n, rng) + walk(n, rng), WALK)
    assert list(found) == [1]
    assert found[1] == max(cluster_sizes(n, RATE_HZ)) / RATE_HZ
