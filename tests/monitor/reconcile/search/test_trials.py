"""Tests of trials of candidate effects: outliers whose magnitudes differ from those of two Gaussians."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from monitor.noise.effects import Outliers
from monitor.reconcile.likelihood.hypothesis_fit import fit_with_model_sizes
from monitor.reconcile.likelihood.whitening import whiten_axis
from monitor.reconcile.search.trials import _outlier_trial
from tests.monitor.reconcile.axes import WHITE, axis, white

n = 36_000


@pytest.mark.parametrize(("misfit_share", "named"), [(0.22, True), (0.4, False)])
def test_distant_outliers_are_named_if_the_misfit_is_much_smaller_than_their_gain(misfit_share, named):
    rng = np.random.default_rng(2)
    outliers = 5.0 * (rng.random(n) < 5e-3) * white(n, rng)
    hypothesis = fit_with_model_sizes(axis(white(n, rng) + outliers, (WHITE,)), (WHITE,))
    fit = whiten_axis(hypothesis.fit).outlier_fit
    found = replace(fit, misfit_z=(2.0 * misfit_share * fit.gain) ** 0.5, clustering_z=0.0)
    trials = _outlier_trial(SimpleNamespace(outlier_fit=found, effect_types=frozenset(), fit=hypothesis.fit))
    assert [trial.name for trial in trials] == [Outliers.name] * named
    assert all(trial.misfit_nats == pytest.approx(misfit_share * fit.gain) for trial in trials)
