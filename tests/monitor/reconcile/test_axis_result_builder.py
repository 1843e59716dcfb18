"""Tests of the result of an axis: it follows the schema of the report and describes the hidden effects."""

import json
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from monitor.noise.effects import Narrowband
from monitor.noise.model import NoiseModel
from monitor.reconcile.axis_result_builder import build_axis_result
from monitor.reconcile.diagnostics.null_distribution import NullDistribution
from monitor.reconcile.diagnostics.whiteness_tests import DIAGNOSTICS
from monitor.reconcile.json_report import encode_report
from monitor.reconcile.result import Reconciliation
from monitor.reconcile.search.search import search_missing_effects
from monitor.reconcile.search.trials import Trial
from tests.monitor.reconcile.axes import (
    RATE_HZ,
    STRICT,
    WALK,
    WHITE,
    N,
    axis,
    check_report,
    correlated,
    time_s,
    walk,
    white,
)

n = 40_000
MODEL = (WHITE, WALK)
T = time_s(n)
LINE = 2e-4 * np.sin(2 * np.pi * 17.3 * T + 0.7)
UNREACHED = dict.fromkeys(DIAGNOSTICS, NullDistribution(1e6, 1e9))
ALWAYS = dict.fromkeys(DIAGNOSTICS, NullDistribution(0.0, 0.0))


def draw_noise(seed=0):
    rng = np.random.default_rng(seed)
    return white(n, rng) + walk(n, rng)


def steep_resonance(size, rng, sigma, frequency_hz, half_width_hz):
    """Noise with the cube of the spectrum of a resonance."""
    spectrum, f = np.fft.rfft(rng.standard_normal(size)), np.fft.rfftfreq(size, 1.0 / RATE_HZ)
    series = np.fft.irfft(spectrum * (1.0 + ((f - frequency_hz) / half_width_hz) ** 2) ** -1.5, size)
    return sigma * series / series.std()


def band_limited(size, rng, sigma, lo_hz, hi_hz):
    """White noise in a frequency band, and nothing elsewhere."""
    spectrum, f = np.fft.rfft(rng.standard_normal(size)), np.fft.rfftfreq(size, 1.0 / RATE_HZ)
    series = np.fft.irfft(np.where((f > lo_hz) & (f < hi_hz), spectrum, 0.0), size)
    return sigma * series / series.std()


def make_hidden_effect(name):
    rng = np.random.default_rng(1)
    return {
        "nothing": draw_noise(),
        "line": draw_noise() + LINE,
        "louder": 1.15 * draw_noise(),
        "outliers": draw_noise() + (rng.random(n) < 1e-3) * 1.5e-2 * rng.standard_normal(n),
        "line and outliers": draw_noise() + LINE + (rng.random(n) < 1e-3) * 1.5e-2 * rng.standard_normal(n),
        "clustered outliers": draw_noise() + np.repeat(rng.random(n // 4) < 1e-3, 4) * 1.5e-2 * rng.standard_normal(n),
        "correlated": draw_noise() + correlated(n, rng, 3e-4, 0.5),
        "band with sharp edges": draw_noise() + band_limited(n, np.random.default_rng(1), 4.7e-4, 5.0, 10.0),
        "steep resonance": draw_noise() + steep_resonance(n, np.random.default_rng(1), 1e-3, 17.0, 2.0),
        "filtered and coarse": 4e-4 * np.rint(draw_noise() / 4e-4),
    }[name]


NAMES = ("nothing", "line", "louder", "outliers", "correlated", "filtered and coarse")


@cache
def search_effect(name):
    return search_missing_effects(axis(make_hidden_effect(name), MODEL), MODEL, STRICT, np.random.default_rng(0))


@cache
def describe_effect(name):
    return build_axis_result(search_effect(name), STRICT, STRICT)


@pytest.mark.long
@pytest.mark.parametrize("name", NAMES)
def test_report_follows_its_schema(name):
    result = describe_effect(name)
    model = NoiseModel({"gz": MODEL}, RATE_HZ)
    whole = Reconciliation(result.verdict, {"gz": result}, model, model, False, RATE_HZ, n, n / RATE_HZ, 1)
    report = json.loads(encode_report(whole))
    check_report(report)
    assert report["verdict"] == ("agrees" if name == "nothing" else "explained")
    assert [score["lens"] for score in report["axes"]["gz"]["scores"]] == list(DIAGNOSTICS)


def test_description_of_a_line_is_complete():
    (step,) = describe_effect("line").steps
    assert (step.kind, step.effect) == ("added", "sinusoidal")
    for name, true in (("frequency", 17.3), ("amplitude", 2e-4), ("phase", 0.7)):
        bounds = step.parameters[name]
        assert bounds.lo < bounds.value < bounds.hi
        assert abs(bounds.value - true) < 4.0 * (bounds.hi - bounds.lo) / 3.92
    assert step.confidence > 0.9
    assert step.before.diagnostic == "lines"
    lo, hi = step.before.where.frequency
    assert lo < 17.3 < hi
    assert step.before.is_significant
    assert not step.after.is_significant
    assert step.after.gap < step.before.gap
    assert step.held_out[0] > step.held_out[1]
    assert "17.3 Hz" in step.because
    assert "sinusoidal" in step.because


def test_changed_size_is_a_retuned_step():
    steps = describe_effect("louder").steps
    assert {step.kind for step in steps} == {"retuned"}
    (of_white,) = (step for step in steps if step.effect == "angle_random_walk")
    bounds = of_white.parameters["N"]
    assert bounds.lo < 1.15 * N < bounds.hi
    assert set(of_white.parameters) == {"N"}
    assert "which the model has" in of_white.because


def test_single_samples_are_counted():
    (step,) = describe_effect("outliers").steps
    assert step.effect == "outliers"
    assert step.before.diagnostic == "tails"
    assert step.parameters["fraction"].lo < 1e-3 < step.parameters["fraction"].hi
    assert step.parameters["scale"].lo < 1.5e-2 < step.parameters["scale"].hi
    assert "detected events" in step.because


def test_misfit_of_clustered_outliers_remains():
    result = describe_effect("clustered outliers")
    assert [step.effect for step in result.steps] == ["outliers"]
    assert search_effect("clustered outliers").final.findings["tails"].gain < STRICT["tails"].threshold
    assert [gap.diagnostic for gap in result.left_over] == ["tails"]
    assert result.verdict == "partly_explained"
    (rest,) = result.remaining
    assert 0.0 < rest.gain_nats < 0.1 * result.steps[0].gain_nats
    assert describe_effect("outliers").verdict == "explained"


def test_runners_up_are_other_effects_and_never_certain():
    (step,) = describe_effect("correlated").steps
    assert step.effect == "exponentially_correlated"
    bounds = step.parameters["correlation_time"]
    assert bounds.lo < 0.5 < bounds.hi
    chances = [one.confidence for one in step.runners_up]
    assert chances == sorted(chances, reverse=True)
    assert sum(chances) + step.confidence <= 1.0 + 1e-9


@pytest.mark.parametrize(("rival_score", "confidence"), [(0.0, 0.5), (-3.0, 0.95)])
def test_rival_of_another_group_reduces_the_confidence(rival_score, confidence):
    search = search_effect("line")
    (done,) = search.rounds
    rival = Trial("narrowband", None, done.trials[0].score + rival_score - 20.0, slow_noise_score=20.0)
    changed = replace(search, rounds=(replace(done, trials=(done.trials[0], rival)),))
    (step,) = build_axis_result(changed, STRICT, STRICT).steps
    assert step.confidence == pytest.approx(confidence, abs=0.01)
    assert step.runners_up[0].effect == "narrowband"


def test_effect_that_is_added_too_does_not_reduce_the_confidence():
    search = search_effect("line and outliers")
    added = search.hypothesis.added
    rounds = list(search.rounds)
    at = next(k for k, one in enumerate(rounds) if one.trials[0].name == "sinusoidal")
    other = next(effect for effect in added if effect.name == "outliers")
    selected = rounds[at].trials[0]
    for effect, confidence in ((other, 1.0), (None, 0.5)):
        rival = Trial("outliers", effect, selected.score)
        rounds[at] = replace(rounds[at], trials=(selected, rival))
        steps = build_axis_result(replace(search, rounds=tuple(rounds)), STRICT, STRICT).steps
        (line,) = (one for one in steps if one.effect == "sinusoidal")
        assert line.confidence == pytest.approx(confidence, abs=0.01)


def test_rejected_candidate_for_an_added_oscillation_does_not_reduce_the_confidence():
    search = search_effect("line and outliers")
    rounds = list(search.rounds)
    at = next(k for k, one in enumerate(rounds) if one.trials[0].name == "outliers")
    selected = rounds[at].trials[0]
    for frequency_hz, confidence in ((17.5, 1.0), (25.0, 0.5)):
        rival = Trial("narrowband", Narrowband(sigma=1e-4, frequency=frequency_hz, bandwidth=0.1), selected.score)
        rounds[at] = replace(rounds[at], trials=(selected, rival))
        steps = build_axis_result(replace(search, rounds=tuple(rounds)), STRICT, STRICT).steps
        (outliers,) = (one for one in steps if one.effect == "outliers")
        assert outliers.confidence == pytest.approx(confidence, abs=0.01)


def test_resonance_beside_a_remaining_difference_is_not_certain():
    result = describe_effect("steep resonance")
    assert result.verdict == "partly_explained"
    (resonance,) = (step for step in result.steps if step.effect == "narrowband")
    assert resonance.confidence <= 0.5
    assert "only approximately" in resonance.because
    (line,) = describe_effect("line").steps
    assert "only approximately" not in line.because


def test_names_beside_a_larger_remaining_difference_are_not_certain():
    result = describe_effect("band with sharp edges")
    assert result.verdict == "partly_explained"
    added = [step for step in result.steps if step.kind == "added"]
    assert added
    assert all(step.confidence <= 0.5 and "the name is uncertain" in step.because for step in added)


def test_one_size_and_a_common_factor_of_white_noise_are_equally_likely():
    y = 1.1 * white(n, np.random.default_rng(5))
    search = search_missing_effects(axis(y), MODEL[:1], STRICT, np.random.default_rng(0))
    (step,) = build_axis_result(search, STRICT, STRICT).steps
    assert (step.kind, step.runners_up[0].effect) == ("retuned", "scale_factor")
    assert 0.4 < step.confidence < 0.7


def test_verdict_follows_from_steps_and_remaining_gaps():
    assert build_axis_result(search_effect("nothing"), STRICT, STRICT).verdict == "agrees"
    assert build_axis_result(search_effect("nothing"), STRICT, ALWAYS).verdict == "unexplained"
    assert build_axis_result(search_effect("line"), STRICT, STRICT).verdict == "explained"
    left = build_axis_result(search_effect("line"), STRICT, ALWAYS)
    assert left.verdict == "partly_explained"
    assert {score.diagnostic for score in left.left_over} == {
        diagnostic for diagnostic, one in search_effect("line").final.findings.items() if one.gain
    }
    assert build_axis_result(search_effect("line"), STRICT, UNREACHED).left_over == ()


def test_gaps_before_a_step_are_those_of_the_old_model_and_after_it_those_of_the_new_one():
    other = dict.fromkeys(DIAGNOSTICS, NullDistribution(8.0, 18.0))
    (step,) = build_axis_result(search_effect("line"), STRICT, other).steps
    assert step.before.threshold == pytest.approx(30.0**0.5)
    assert step.after.threshold == pytest.approx(36.0**0.5)
    assert step.after.null95 == pytest.approx(4.0)


def test_unreduced_gap_is_still_reported():
    """A search with a step whose final gap equals its first gap counts as partly explained."""
    one = search_effect("line")
    again = replace(one, final=one.rounds[0].before)
    assert build_axis_result(again, STRICT, STRICT).verdict == "partly_explained"
