"""Comparison of one scale factor on all axes with a wrong sample rate.

A wrong sample rate multiplies the white noise of all axes by the same factor. Without lines and resonances, only the
slow noise distinguishes the two causes.
"""

from collections.abc import Mapping
from dataclasses import replace
from math import exp, fsum, log

from drivers.data_types import AXES
from monitor.noise.effects import SampleRateError, ScaleFactor
from monitor.reconcile.likelihood.hypothesis_fit import RESIZE_PENALTY_NATS, Hypothesis, compared_size_indices
from monitor.reconcile.search.sample_rate_from_spectrum import convert_effect_to_stated_time
from monitor.reconcile.search.search import AxisSearchResult
from monitor.reconcile.search.trials import Trial


def add_sample_rate_as_alternative(found: Mapping[str, AxisSearchResult]) -> dict[str, AxisSearchResult]:
    """Add a wrong sample rate to the trials of the scale factors, if all six axes have a scale factor.

    Parameters
    ----------
    found : mapping of str to AxisSearchResult
        Result of the search on each axis.
    """
    factors = [
        effect.factor
        for search in found.values()
        for effect in search.hypothesis.added
        if isinstance(effect, ScaleFactor)
    ]
    if len(factors) < len(AXES):
        return dict(found)
    sizes_saved = len({f"{factor:.9f}" for factor in factors}) - 1
    ratio = exp(2.0 * fsum(map(log, factors)) / len(factors))
    advantage = fsum(_gain_of_sample_rate(search.hypothesis, ratio) for search in found.values())
    # the noise level alone decides for neither cause
    advantage = min(advantage + RESIZE_PENALTY_NATS * sizes_saved, 0.0)
    return {name: _with_alternative(search, advantage) for name, search in found.items()}


def _gain_of_sample_rate(hypothesis: Hypothesis, ratio: float) -> float:
    """Return the log-likelihood gain if a wrong sample rate replaces the scale factor of an axis."""
    converted = tuple(convert_effect_to_stated_time(effect, ratio) for effect in hypothesis.model)
    added = tuple(effect for effect in hypothesis.added if not isinstance(effect, ScaleFactor))
    fit = hypothesis.axis.fit((*converted, *added), compared_size_indices(hypothesis.axis, converted))
    return fit.log_likelihood - hypothesis.fit.log_likelihood


def _with_alternative(search: AxisSearchResult, advantage: float) -> AxisSearchResult:
    """Add the alternative to the round of the scale factor. ``advantage`` is the gain summed over all axes, in nats."""
    rounds = []
    for one in search.rounds:
        chosen = one.trials[0]
        if isinstance(chosen.effect, ScaleFactor):
            other = Trial(SampleRateError.name, None, chosen.score + advantage, is_rival_only=True)
            one = replace(one, trials=(*one.trials, other))
        rounds.append(one)
    return replace(search, rounds=tuple(rounds))
