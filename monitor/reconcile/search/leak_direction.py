"""Direction of a leak between two axes.

If an axis contains a share of another axis, the samples of both axes are correlated, and the search may find a leak in
either direction. Each direction changes the spectrum of another axis, so the log-likelihoods of both directions differ.
The following model describes the axes a and b:

    a = d·b + noise of a,    b = e·a + noise of b.

The joint log-likelihood is the sum of the log-likelihoods of both axes and of n ln |1 − d·e|, where n is the number of
coefficients of an axis. The last term shifts the most likely value of d if e is not zero.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial
from math import inf, log

from monitor.noise.effect import AxisLeak
from monitor.noise.effects import CrossAxis
from monitor.reconcile.diagnostics.null_distribution import AxisNull
from monitor.reconcile.effect_properties import PENALTY_NATS
from monitor.reconcile.likelihood.hypothesis_fit import Hypothesis, fit_with_fewest_changes
from monitor.reconcile.search.search import AxisSearchResult
from monitor.reconcile.search.trials import Trial


@dataclass(frozen=True, slots=True)
class _Leak:
    source: str
    coefficient: float
    model_coefficient: float  # in the model under test, or 0 for an added leak
    standard_error: float  # of the coefficient
    gain: float  # penalised log-likelihood gain over the model under test, nats


def find_leaks_in_wrong_direction(
    found: Mapping[str, AxisSearchResult], null: Mapping[str, AxisNull]
) -> dict[str, frozenset[str]]:
    """Return the sources of each axis for which a leak in the opposite direction is more likely.

    Parameters
    ----------
    found : mapping of str to AxisSearchResult
        Result of the search on each axis.
    null : mapping of str to AxisNull
        Null distributions of each axis.
    """
    wrong: dict[str, frozenset[str]] = {}
    for axis, search in found.items():
        for leak in _find_changed_leaks(search.hypothesis):
            if leak.source not in found:
                continue
            finding = found[leak.source].final.findings["other_axes"]
            if finding.where.source == axis and finding.gain > null[leak.source]["other_axes"].threshold:
                wrong[leak.source] = wrong.get(leak.source, frozenset()) | {axis}
            opposite = _find_leak_from(axis, found[leak.source].hypothesis)
            if opposite is not None and _advantage(search.hypothesis, leak, opposite) < 0.0:
                wrong[axis] = wrong.get(axis, frozenset()) | {leak.source}
    return wrong


def add_opposite_leaks_as_alternatives(
    found: Mapping[str, AxisSearchResult], first_found: Mapping[str, AxisSearchResult]
) -> dict[str, AxisSearchResult]:
    """Add the leak in the opposite direction to the trials of each leak.

    Parameters
    ----------
    found : mapping of str to AxisSearchResult
        Result of the search on each axis.
    first_found : mapping of str to AxisSearchResult
        Result of the search before leaks in the wrong direction were excluded.
    """
    return {name: _with_alternatives(name, search, first_found) for name, search in found.items()}


def _with_alternatives(
    name: str, search: AxisSearchResult, first_found: Mapping[str, AxisSearchResult]
) -> AxisSearchResult:
    rounds = list(search.rounds)
    for leak in _find_changed_leaks(search.hypothesis):
        other = first_found[leak.source].hypothesis if leak.source in first_found else None
        opposite = None if other is None else _find_leak_from(name, other)
        if opposite is None and other is not None:
            opposite = other.axis.evaluate_candidate(
                CrossAxis.name, partial(_fit_added_leak_from, name, other), opposite
            )
        at = next((at for at, one in enumerate(rounds) if _has_fitted_leak(one.hypothesis, leak.source)), None)
        if opposite is None or at is None:
            continue
        score = rounds[at].trials[0].score - _advantage(search.hypothesis, leak, opposite)
        rival = Trial(f"leak from {name} to {leak.source}", None, score, is_rival_only=True)
        rounds[at] = replace(rounds[at], trials=(*rounds[at].trials, rival))
    return replace(search, rounds=tuple(rounds))


def _find_changed_leaks(hypothesis: Hypothesis) -> list[_Leak]:
    """Return the leaks that were added to the model or whose coefficient was changed."""
    leaks = [
        _describe_leak(hypothesis, at, effect)
        for at, effect in enumerate(hypothesis.effects)
        if isinstance(effect, AxisLeak)
    ]
    return [leak for leak in leaks if leak.coefficient != leak.model_coefficient]


def _find_leak_from(source: str, hypothesis: Hypothesis) -> _Leak | None:
    """Return the leak from an axis, or None if the hypothesis contains none."""
    for at, effect in enumerate(hypothesis.effects):
        if isinstance(effect, AxisLeak) and effect.source == source:
            return _describe_leak(hypothesis, at, effect)
    return None


def _describe_leak(hypothesis: Hypothesis, at: int, effect: AxisLeak) -> _Leak:
    """Compute the gain of a leak over the model under test. The gain of an unchanged leak is zero."""
    if at >= hypothesis.model_effect_count:
        place = at - hypothesis.model_effect_count
        less = hypothesis.refit_with_other_added_effects(hypothesis.added[:place] + hypothesis.added[place + 1 :])
        gain = hypothesis.penalised_log_likelihood - less.penalised_log_likelihood - PENALTY_NATS[effect.name]
        return _Leak(effect.source, effect.coefficient, 0.0, hypothesis.fit.size_standard_error(at), gain)
    known = hypothesis.model[at]
    assert isinstance(known, AxisLeak)
    gain = 0.0
    if effect.coefficient != known.coefficient:  # the other sizes may change back
        axis = replace(hypothesis.axis, sources_of_unchanged_leaks=frozenset({effect.source}))
        less = fit_with_fewest_changes(axis, hypothesis.added, hypothesis.model)
        gain = hypothesis.penalised_log_likelihood - less.penalised_log_likelihood
    return _Leak(effect.source, effect.coefficient, known.coefficient, hypothesis.fit.size_standard_error(at), gain)


def _has_fitted_leak(hypothesis: Hypothesis, source: str) -> bool:
    """Return True if a hypothesis contains a leak from an axis whose coefficient is fitted."""
    return any(
        isinstance(effect, AxisLeak) and effect.source == source and at not in hypothesis.fit.fixed_sizes
        for at, effect in enumerate(hypothesis.effects)
    )


def _fit_added_leak_from(source: str, hypothesis: Hypothesis) -> _Leak | None:
    """Add a leak from an axis to a hypothesis. Return None if the axis cannot leak."""
    axis = hypothesis.axis
    if source not in axis.leak_sources or source[0] != axis.name[0]:
        return None
    leaking = hypothesis.refit_with_other_added_effects((*hypothesis.added, CrossAxis(source=source, coefficient=1.0)))
    effect = leaking.added[-1]
    assert isinstance(effect, AxisLeak)
    gain = leaking.penalised_log_likelihood - hypothesis.penalised_log_likelihood - PENALTY_NATS[effect.name]
    error = leaking.fit.size_standard_error(len(leaking.effects) - 1)
    return _Leak(source, effect.coefficient, 0.0, error, gain)


def _advantage(hypothesis: Hypothesis, leak: _Leak, opposite: _Leak) -> float:
    """Return the difference between the joint log-likelihoods of a leak and of the opposite leak, in nats."""
    n = hypothesis.axis.coefficients.size
    return _joint_gain(leak, opposite.model_coefficient, n) - _joint_gain(opposite, leak.model_coefficient, n)


def _joint_gain(leak: _Leak, opposite_coefficient: float, n: int) -> float:
    """Return the gain of a leak if the model contains a leak in the opposite direction, in nats.

    The gain is the maximum of g − (d − d₁)²/(2s²) + n ln |1 − d·e| over d, to first order in e. Here, d₁ is the fitted
    coefficient with the standard error s, and e is the coefficient of the opposite leak.
    """
    shift = -n * opposite_coefficient * leak.standard_error**2
    determinant = abs(1.0 - (leak.coefficient + shift) * opposite_coefficient)
    loss = 0.5 * (n * opposite_coefficient * leak.standard_error) ** 2
    return leak.gain - loss + n * log(determinant) if determinant > 0.0 else -inf
