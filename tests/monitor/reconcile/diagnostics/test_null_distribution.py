"""Tests of the thresholds with gains that are drawn from the expected distribution and from other distributions."""

import numpy as np
import pytest
from scipy.stats import expon

from monitor.noise.effects import AngleRandomWalk, PoissonSteps, RateRandomWalk, Resolution, Saturation
from monitor.reconcile.diagnostics.null_distribution import (
    FALSE_ALARM_PROBABILITY,
    NULL_GAIN_QUANTILE_PARAMETERS,
    SIMULATED_RECORDINGS,
    NullDistribution,
    all_simulations_have_improbable_gain,
    compute_diagnostic_gaps,
    estimate_null_distributions,
    is_significance_clear,
    run_diagnostics,
)
from monitor.reconcile.diagnostics.whiteness_tests import DIAGNOSTICS, WhitenessDeparture
from monitor.reconcile.likelihood.effect_roles import is_stationary_gaussian
from monitor.reconcile.result import Location
from tests.monitor.reconcile.axes import WALK, WHITE, axis, make_temperature, walk, white, whiten

PLACES = 500.0


def upper_quartile(diagnostic):
    law = NULL_GAIN_QUANTILE_PARAMETERS[diagnostic]
    return law.offset + law.slope * np.log(PLACES)


def draw_findings(count, rng, shift=0.0):
    """Draw gains of which a quarter exceed the upper quartile, with an exponentially distributed excess."""
    found = []
    for _ in range(count):
        excess = rng.exponential(size=len(DIAGNOSTICS)) - np.log(4.0) + shift
        gains = {
            diagnostic: upper_quartile(diagnostic) + NULL_GAIN_QUANTILE_PARAMETERS[diagnostic].scale * e
            for diagnostic, e in zip(DIAGNOSTICS, excess, strict=True)
        }
        found.append({diagnostic: WhitenessDeparture(float(g), Location(), PLACES) for diagnostic, g in gains.items()})
    return found


def test_quantiles_are_those_of_an_exponential_distribution():
    null = estimate_null_distributions(
        {name: draw_findings(1, np.random.default_rng(0)) for name in ("gx", "gy", "gz")}
    )
    for diagnostic in DIAGNOSTICS:
        start, scale = upper_quartile(diagnostic), NULL_GAIN_QUANTILE_PARAMETERS[diagnostic].scale
        assert null["gx"][diagnostic].null95 == pytest.approx(start + scale * (expon.isf(0.05) - np.log(4.0)))
        # once in 100 recordings, of all diagnostics and axes together
        chance = expon.isf(0.01 / (len(DIAGNOSTICS) * 3)) - np.log(4.0)
        assert null["gx"][diagnostic].threshold == pytest.approx(start + scale * chance)


def test_true_model_rarely_exceeds_a_threshold():
    """Draw gains of three axes from the expected distribution, with as many simulations as the gains require."""
    names, accused, recordings, simulations = ("gx", "gy", "gz"), 0, 3000, 0
    for seed in range(recordings):
        rng = np.random.default_rng([seed, 1])
        found = {}
        for name in names:
            found[name] = draw_findings(1, rng)
            while all_simulations_have_improbable_gain(found[name]) and len(found[name]) < SIMULATED_RECORDINGS:
                found[name] += draw_findings(1, rng)
            simulations += len(found[name])
        null = estimate_null_distributions(found)
        tested = {name: draw_findings(1, rng)[0] for name in names}
        accused += any(
            tested[name][diagnostic].gain > null[name][diagnostic].threshold
            for name in names
            for diagnostic in DIAGNOSTICS
        )
    assert 0.3 * FALSE_ALARM_PROBABILITY < accused / recordings < 2.0 * FALSE_ALARM_PROBABILITY
    assert simulations < 1.1 * recordings * len(names)


def test_more_axes_raise_the_threshold():
    few = draw_findings(1, np.random.default_rng(3))
    one = estimate_null_distributions({"gx": few})["gx"]
    six = estimate_null_distributions(dict.fromkeys(("gx", "gy", "gz", "ax", "ay", "az"), few))["gx"]
    for diagnostic in DIAGNOSTICS:
        assert six[diagnostic].null95 == one[diagnostic].null95
        assert six[diagnostic].threshold - one[diagnostic].threshold == pytest.approx(
            NULL_GAIN_QUANTILE_PARAMETERS[diagnostic].scale * np.log(6.0)
        )


def test_axis_with_unusual_gains_has_its_own_threshold():
    rng = np.random.default_rng(4)
    odd = draw_findings(SIMULATED_RECORDINGS, rng, shift=200.0)
    assert all(all_simulations_have_improbable_gain(odd[:count]) for count in range(1, SIMULATED_RECORDINGS))
    found = estimate_null_distributions({"gx": draw_findings(1, rng), "gz": odd})
    for diagnostic in DIAGNOSTICS:
        smallest, largest = (pick(one[diagnostic].gain for one in odd) for pick in (min, max))
        assert found["gz"][diagnostic].threshold > max(largest, found["gz"][diagnostic].null95)
        assert found["gz"][diagnostic].null95 > smallest
        assert found["gx"][diagnostic].threshold < upper_quartile(diagnostic) + 20.0


def test_improbable_gain_is_discarded_if_the_next_simulation_is_probable():
    rng = np.random.default_rng(5)
    odd, usual = draw_findings(1, rng, shift=50.0)[0], draw_findings(1, rng)[0]
    assert all_simulations_have_improbable_gain([odd])
    assert not all_simulations_have_improbable_gain([odd, usual])
    assert estimate_null_distributions({"gz": [odd, usual]}) == estimate_null_distributions({"gz": [usual]})


def test_simulations_continue_while_the_significance_of_a_finding_is_unclear():
    simulated = draw_findings(1, np.random.default_rng(6))
    threshold = estimate_null_distributions({"gz": simulated})["gz"]["psd"].threshold
    odd = [{**simulated[0], "psd": WhitenessDeparture(3.0 * threshold, Location(), PLACES)}]

    def is_clear(gain, simulations):
        recorded = {**simulated[0], "psd": WhitenessDeparture(gain, Location(), PLACES)}
        return is_significance_clear(recorded, simulations, 1)

    assert is_clear(0.99 * threshold, simulated)
    assert not is_clear(1.5 * threshold, simulated)
    assert is_clear(2.1 * threshold, simulated)
    assert is_clear(2.1 * threshold, odd)  # below a simulated gain
    assert not is_clear(4.0 * threshold, odd)
    assert estimate_null_distributions({"gz": odd})["gz"]["psd"].threshold > 2.1 * threshold
    mixed = [*simulated, *odd]  # one of the two does not raise the threshold, so more simulations are needed
    assert estimate_null_distributions({"gz": mixed})["gz"]["psd"].threshold == threshold
    assert not is_clear(2.1 * threshold, mixed)


def test_diagnostic_without_gains_has_a_threshold():
    nothing = [{diagnostic: WhitenessDeparture(0.0, Location()) for diagnostic in DIAGNOSTICS}] * SIMULATED_RECORDINGS
    for one in estimate_null_distributions({"gz": nothing})["gz"].values():
        assert 0.0 < one.null95 < one.threshold < np.inf


def test_non_gaussian_effects_need_all_simulations():
    assert is_stationary_gaussian((AngleRandomWalk(N=1e-4), RateRandomWalk(K=1e-6), Resolution(step=1e-6)))
    assert not is_stationary_gaussian((AngleRandomWalk(N=1e-4), PoissonSteps(rate=0.01, height=1e-4)))
    assert not is_stationary_gaussian((AngleRandomWalk(N=1e-4), Saturation(limit=1.0)))


@pytest.mark.parametrize("n", [6000, pytest.param(140_000, marks=pytest.mark.long)])
@pytest.mark.parametrize("model", [(WHITE,), (WHITE, WALK), (WHITE, RateRandomWalk(K=1e-3))], ids=["N", "NK", "K"])
def test_gains_of_true_models_follow_the_expected_distribution(model, n):
    """Of 40 recordings, 1 to 22 exceed the upper quartile, except with a probability of 2e-5 for each diagnostic."""
    above, beyond = dict.fromkeys(DIAGNOSTICS, 0), 0
    runs = 40
    for seed in range(runs):
        rng = np.random.default_rng([n, seed])
        y = white(n, rng) + sum(walk(n, rng, one.K) for one in model if isinstance(one, RateRandomWalk))
        for diagnostic, found in run_diagnostics(whiten(axis(y, (), make_temperature(n)), model)).items():
            above[diagnostic] += found.gain > NULL_GAIN_QUANTILE_PARAMETERS[diagnostic].quantile(found.places, 0.25)
            beyond += found.gain > NULL_GAIN_QUANTILE_PARAMETERS[diagnostic].quantile(
                found.places, FALSE_ALARM_PROBABILITY / 60.0
            )
    assert beyond <= 1
    for diagnostic, count in above.items():
        assert count <= 22, diagnostic
        assert count >= 1 or diagnostic in ("values", "other_axes"), (
            diagnostic
        )  # one axis of continuous values has neither


def test_gap_is_in_standard_deviations():
    seen = {
        diagnostic: WhitenessDeparture(0.5 * k**2, Location(tau=(1.0, 2.0))) for k, diagnostic in enumerate(DIAGNOSTICS)
    }
    found = compute_diagnostic_gaps(seen, dict.fromkeys(DIAGNOSTICS, NullDistribution(2.0, 8.0)))
    assert [score.diagnostic for score in found] == list(DIAGNOSTICS)
    assert [score.gap for score in found] == pytest.approx(np.arange(len(DIAGNOSTICS)))
    assert {(score.null95, score.threshold) for score in found} == {(2.0, 4.0)}
    assert [score.is_significant for score in found] == [k > 4 for k in range(len(DIAGNOSTICS))]
    assert found[0].where.tau == (1.0, 2.0)
