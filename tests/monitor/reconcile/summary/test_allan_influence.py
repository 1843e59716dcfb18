"""Tests of the influence of a change on the Allan deviation against formulas."""

import numpy as np
import pytest

from monitor.noise.effects import AngleRandomWalk, BandwidthLimit, Outliers, Sinusoidal
from monitor.reconcile.likelihood.hypothesis_fit import Hypothesis
from monitor.reconcile.search.backward_elimination import changed_sizes
from monitor.reconcile.summary.allan_influence import compute_allan_influences_of_changes
from tests.monitor.reconcile.axes import RATE_HZ, N, axis, time_s, white

n = 30_000
MODEL = (AngleRandomWalk(N=N),)


def influences(y, *added, fixed=frozenset({0})):
    hypothesis = Hypothesis(MODEL, axis(y, MODEL).fit((*MODEL, *added), fixed))
    changed = (*changed_sizes(hypothesis), *range(len(MODEL), len(hypothesis.effects)))
    return compute_allan_influences_of_changes(hypothesis, changed)


def test_line_is_largest_where_its_allan_variance_stands_out_most():
    f, a = 2.3, 4e-4
    y = white(n, np.random.default_rng(1)) + a * np.sin(2 * np.pi * f * time_s(n))
    found = influences(y, Sinusoidal(amplitude=a, frequency=f))[1]
    tau = 2.0 ** np.arange(12) / RATE_HZ
    x = np.pi * f * tau
    ratio = np.sqrt(1.0 + a**2 * np.sin(x) ** 4 / x**2 * tau / N**2)
    assert found.tau_s == pytest.approx(tau[np.argmax(ratio)])
    assert found.ratio == pytest.approx(ratio.max(), rel=0.03)


def test_changed_size_multiplies_the_deviation():
    found = influences(1.3 * white(n, np.random.default_rng(1)), fixed=frozenset())
    assert list(found) == [0]
    assert found[0].ratio == pytest.approx(1.3, rel=0.01)


def test_outliers_add_white_noise_and_a_filter_removes_noise():
    y = white(n, np.random.default_rng(1))
    outliers = Outliers(fraction=1e-2, scale=1e-2)
    found = influences(y, outliers)[1]
    assert found.ratio == pytest.approx(np.sqrt(1.0 + 1e-2 * 1e-4 / (N**2 * RATE_HZ)), rel=0.01)
    assert influences(y, BandwidthLimit(cutoff=10.0, order=1))[1].ratio < 0.8


def test_change_without_influence_has_the_ratio_one():
    found = influences(white(n, np.random.default_rng(1)), Sinusoidal(amplitude=1e-9, frequency=17.3))
    assert found[1].ratio == pytest.approx(1.0, abs=0.01)
