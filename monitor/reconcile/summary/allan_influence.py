"""Influence of each change of the model on the Allan deviation of an axis.

The Allan deviation of the extended model is compared with the Allan deviation of the model without the change. All
other sizes stay the same. Cross products of deterministic effects are neglected.
"""

from collections.abc import Iterable
from math import exp
from typing import Final

import numpy as np

from drivers.data_types import Floats, Ints
from monitor.estimation.allan.batch import cluster_sizes, overlapping_avar_axis
from monitor.noise.effect import Effect, Source
from monitor.noise.spectrum import allan_variance_of_density
from monitor.reconcile.effect_table import SIZE_PARAMETERS
from monitor.reconcile.likelihood.axis_fit import Effects
from monitor.reconcile.likelihood.hypothesis_fit import Hypothesis, noise_effect_indices
from monitor.reconcile.preparation.cosine_bins import inverse_cosine_transform
from monitor.reconcile.result import AllanInfluence
from monitor.reconcile.search.backward_elimination import changed_sizes

MAX_LOG_RATIO: Final = 10.0
"""Largest absolute logarithm of a ratio. The ratio is infinite if the model without the change has no noise."""


def compute_allan_influences_of_changes(hypothesis: Hypothesis, changed: Iterable[int]) -> dict[int, AllanInfluence]:
    """Compute the influence of each changed effect on the Allan deviation.

    Parameters
    ----------
    hypothesis : Hypothesis
        Hypothesis with all changes.
    changed : iterable of int
        Indices of the changed effects.

    Returns
    -------
    dict of int to AllanInfluence
        Influence of each effect, by its index. A changed size is compared with the old size. For a moved line or an
        added effect, the reference is the model without this line or effect.
    """
    resized = changed_sizes(hypothesis)
    axis, effects = hypothesis.axis, hypothesis.effects
    factors = cluster_sizes(axis.n, axis.rate_hz)
    deterministic = _deterministic_avars(hypothesis, factors)
    total = _noise_avar(hypothesis, effects, factors) + sum(deterministic.values())
    found: dict[int, AllanInfluence] = {}
    for at in changed:
        if at in deterministic:
            without = total - deterministic[at]
        else:
            old = (hypothesis.model[at],) if at in resized else ()
            rest = (*effects[:at], *old, *effects[at + 1 :])
            without = _noise_avar(hypothesis, rest, factors) + sum(deterministic.values())
        with np.errstate(divide="ignore", invalid="ignore"):
            log_ratio = np.nan_to_num(0.5 * np.log(total / np.maximum(without, 0.0)), posinf=MAX_LOG_RATIO)
        largest = int(np.argmax(np.abs(log_ratio)))
        ratio = exp(float(np.clip(log_ratio[largest], -MAX_LOG_RATIO, MAX_LOG_RATIO)))
        found[at] = AllanInfluence(ratio, float(factors[largest] / axis.rate_hz))
    return found


def _noise_avar(hypothesis: Hypothesis, effects: Effects, factors: Ints) -> Floats:
    """Return the Allan variance of all noise effects with the given sizes, shape (m,)."""
    axis = hypothesis.axis
    tau0_s = 1.0 / axis.rate_hz
    variance = axis.fit(effects, noise_effect_indices(effects)).whittle.variance
    x, y = np.log(axis.bins.f_hz), np.log(variance * tau0_s)
    others = [one for one in effects if isinstance(one, Source) and one.name not in SIZE_PARAMETERS]

    def density(f_hz: Floats) -> Floats:
        added = sum(np.nan_to_num(one.two_sided_psd(f_hz, tau0_s)) for one in others)
        return np.asarray(np.exp(np.interp(np.log(f_hz), x, y)) + added)

    return allan_variance_of_density(density, np.asarray(factors * tau0_s, np.float64), tau0_s, ())


def _deterministic_avars(hypothesis: Hypothesis, factors: Ints) -> dict[int, Floats]:
    """Return the Allan variance of each deterministic effect, by the index of the effect."""
    axis, fit = hypothesis.axis, hypothesis.fit
    found: dict[int, Floats] = {}
    for at, place in fit.regressor_slices:
        effect: Effect = hypothesis.effects[at]
        columns = axis.regressor_cosine_transforms(effect)
        series = sum(beta * column for beta, column in zip(fit.whittle.beta[place].tolist(), columns, strict=True))
        found[at] = np.asarray(overlapping_avar_axis(inverse_cosine_transform(np.asarray(series)), factors)[0])
    return found
