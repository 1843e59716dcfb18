"""Thresholds from simulated gains beside the quantiles of the law that the gains were drawn from."""

import numpy as np
import pytest
from scipy.stats import expon

from monitor.reconcile.diagnostics.diagnostics import DIAGNOSTICS, Finding
from monitor.reconcile.diagnostics.null_distribution import (
    FALSE_ALARM_PROBABILITY,
    NullDistribution,
    _tail_quantiles,
    compute_diagnostic_gaps,
    estimate_null_distributions,
)
from monitor.reconcile.result import Location

START = 5.0  # nats: gains are START and an exponential of mean one, as the largest of many χ²/2


def simulated(count, rng, shift=0.0):
    gains = START + shift + rng.exponential(size=(count, len(DIAGNOSTICS)))
    return [{lens: Finding(float(g), Location()) for lens, g in zip(DIAGNOSTICS, row, strict=True)} for row in gains]


def thresholds(runs, names, seeds):
    found = []
    for seed in range(seeds):
        rng = np.random.default_rng(seed)
        each = estimate_null_distributions({name: simulated(runs, rng) for name in names})
        found += [(one.null95, one.threshold) for of_axis in each.values() for one in of_axis.values()]
    return np.array(found)


def test_levels_are_those_of_an_exponential():
    names = ("gx", "gy", "gz", "ax", "ay", "az")
    null95, threshold = np.median(thresholds(6, names, 20), axis=0)
    assert null95 == pytest.approx(START + expon.isf(0.05), abs=0.4)
    # once in 100 recordings, of all lenses and axes together
    assert threshold == pytest.approx(START + expon.isf(0.01 / (len(DIAGNOSTICS) * 6)), rel=0.15)


def test_a_true_model_is_rarely_accused():
    """Recordings of three axes beside nulls of six recordings each, all gains drawn from one law."""
    names, accused, recordings = ("gx", "gy", "gz"), 0, 0
    for seed in range(60):
        rng = np.random.default_rng([seed, 1])
        null = estimate_null_distributions({name: simulated(6, rng) for name in names})
        limits = np.array([[null[name][lens].threshold for lens in DIAGNOSTICS] for name in names])
        gains = START + rng.exponential(size=(100, 3, len(DIAGNOSTICS)))
        accused += np.count_nonzero((gains > limits).any(axis=(1, 2)))
        recordings += 100
    assert accused / recordings < 2.0 * FALSE_ALARM_PROBABILITY
    assert accused > 0


def test_more_axes_ask_for_more():
    rng = np.random.default_rng(3)
    few = simulated(6, rng)
    for lens in DIAGNOSTICS:
        gains = np.array([findings[lens].gain for findings in few])
        one, six = _tail_quantiles(gains, 1), _tail_quantiles(gains, 6)
        assert six.threshold > one.threshold > one.null95
        # log 6 nats of an exponential distribution with a mean of 1 to 1.3
        assert np.log(6.0) - 1e-9 < six.threshold - one.threshold < 1.3 * np.log(6.0) + 1e-9


def test_an_axis_of_its_own_kind_has_its_own_threshold():
    rng = np.random.default_rng(4)
    found = estimate_null_distributions(
        {"gx": simulated(6, rng), "gy": simulated(6, rng), "gz": simulated(6, rng, shift=200.0)}
    )
    for lens in DIAGNOSTICS:
        assert found["gz"][lens].threshold > 200.0 + START
        assert found["gz"][lens].null95 > 200.0 + START - 1.0


def test_a_lens_that_never_sees_anything_has_a_threshold():
    nothing = [{lens: Finding(0.0, Location()) for lens in DIAGNOSTICS}] * 6
    for one in estimate_null_distributions({"gz": nothing})["gz"].values():
        assert 0.0 < one.null95 < one.threshold < np.inf


def test_a_gap_is_in_standard_deviations():
    seen = {lens: Finding(0.5 * k**2, Location(tau=(1.0, 2.0))) for k, lens in enumerate(DIAGNOSTICS)}
    found = compute_diagnostic_gaps(seen, dict.fromkeys(DIAGNOSTICS, NullDistribution(2.0, 8.0)))
    assert [score.lens for score in found] == list(DIAGNOSTICS)
    assert [score.gap for score in found] == pytest.approx(np.arange(len(DIAGNOSTICS)))
    assert {(score.null95, score.threshold) for score in found} == {(2.0, 4.0)}
    assert [score.is_significant for score in found] == [k > 4 for k in range(len(DIAGNOSTICS))]
    assert found[0].where.tau == (1.0, 2.0)
