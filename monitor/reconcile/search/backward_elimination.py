"""Backward elimination: the smallest set of names that explains as much as the complete result of the search.

After the search on all axes, the following simpler explanations are tried on each axis. A simpler explanation is
accepted if the penalised likelihood does not decrease.

1. An added effect is left out, and the remaining sizes are fitted again.
2. Two neighbouring lines or resonances are replaced by one resonance.
3. The old size, or zero, is tried in place of each changed size of the noise model.
4. Changed sizes are replaced by one common factor, for one axis or for the three axes of a triad.

If an effect also occurs on another axis, its location is known, and a smaller gain is sufficient. A simplification is
undone if a diagnostic becomes significant.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from itertools import pairwise
from typing import Any, Final

import numpy as np

from monitor.common.distributions import HALF_CHI2_95
from monitor.noise.effect import Effect
from monitor.noise.effects import (
    BandwidthLimit,
    CommonVibration,
    Narrowband,
    PoissonSteps,
    RandomTelegraph,
    ScaleFactor,
    Sinusoidal,
)
from monitor.reconcile.diagnostics.null_distribution import AxisNull
from monitor.reconcile.effect_properties import EFFECT_PROPERTIES, PENALTY_NATS, SIZE_PARAMETERS
from monitor.reconcile.likelihood.effect_roles import effect_size, has_same_size
from monitor.reconcile.likelihood.hypothesis_fit import (
    RESIZE_PENALTY_NATS,
    Hypothesis,
    compared_size_indices,
    compute_size_interval,
    find_maximum_by_golden_section,
)
from monitor.reconcile.recording_checks.checks import TRIADS
from monitor.reconcile.search.candidate_effects import fit_resonance
from monitor.reconcile.search.cross_validation import accept_without_validation
from monitor.reconcile.search.search import AxisSearchResult, SearchRound, diagnose_hypothesis
from monitor.reconcile.search.trials import SCALE_FACTOR_MARGIN_NATS, SCALE_SEARCH_ITERATIONS, Trial

PEAKS: Final = (Sinusoidal, Narrowband)
MAX_PEAK_RATIO: Final = 1.5
"""Largest ratio of the frequencies of two peaks that one resonance may replace."""
KEPT_EFFECTS: Final = (PoissonSteps, RandomTelegraph, CommonVibration)
"""Effects whose evidence is not contained in the likelihood of the spectrum of one axis."""
MapFunction = Callable[[Callable[[Any], Any], Iterable[Any]], Iterable[Any]]
"""Function with the signature of ``map``, such as the ``map`` method of a thread pool."""


def eliminate_unneeded_effects(
    found: Mapping[str, AxisSearchResult],
    null: Mapping[str, AxisNull],
    fitted_first: bool,
    map_function: MapFunction = map,
) -> dict[str, AxisSearchResult]:
    """Replace the result of the search by a simpler explanation where the data permit.

    Parameters
    ----------
    found : mapping of str to AxisSearchResult
        Result of the search on each axis.
    null : mapping of str to AxisNull
        Null distributions of each axis.
    fitted_first : bool
        True if the model was fitted to the same recording. The old sizes then cannot serve as a reference for a common
        factor.
    map_function : callable, optional
        Function with the signature of ``map`` that distributes the work on axes.
    """
    added = {name: one.hypothesis.added for name, one in found.items()}

    def simplify_named_axis(name: str) -> AxisSearchResult:
        others = [effect for other, effects in added.items() if other != name for effect in effects]
        simplify = partial(_simplify_axis, found[name], others, null[name])
        return found[name].hypothesis.axis.evaluate_candidate("simpler explanation", simplify, found[name])

    simpler = dict(zip(found, map_function(simplify_named_axis, found), strict=True))
    if fitted_first:
        return simpler
    for names in (*((name,) for name in simpler), *TRIADS):
        if set(names) <= set(simpler):
            searches = {name: simpler[name] for name in names}
            axis, replace_sizes = searches[names[0]].hypothesis.axis, partial(_with_common_factor, searches, null)
            simpler |= axis.evaluate_candidate(ScaleFactor.name, replace_sizes, searches)
    return simpler


def _simplify_axis(search: AxisSearchResult, others: Sequence[Effect], null: AxisNull) -> AxisSearchResult:
    if not search.rounds:
        return search
    search = _accept_if_diagnostics_agree(search, _without_unneeded_effects(search.hypothesis, others), null)
    merged = _with_merged_peaks(search.hypothesis)
    search = _accept_if_diagnostics_agree(search, merged, null, "the resonance replaces effects that were validated")
    return _accept_if_diagnostics_agree(search, revert_insignificant_size_changes(search.hypothesis), null)


def _accept_if_diagnostics_agree(
    search: AxisSearchResult, simpler: Hypothesis, null: AxisNull, replacement_reason: str = ""
) -> AxisSearchResult:
    """Return the result with a simpler hypothesis, unless a diagnostic becomes significant.

    If ``replacement_reason`` is given, the last added effect replaces other effects and is recorded as a round of the
    search.
    """
    if simpler is search.hypothesis:
        return search
    final = diagnose_hypothesis(simpler)
    for diagnostic, one in final.findings.items():
        if one.gain > null[diagnostic].threshold >= search.final.findings[diagnostic].gain:
            return search
    rounds = search.rounds
    if replacement_reason:
        effect = simpler.added[-1]
        score = max((trial.score for one in rounds for trial in one.trials[:1]), default=0.0)
        trial = Trial(effect.name, effect, score)
        reason = accept_without_validation(replacement_reason)
        rounds = (*rounds, SearchRound(search.final, (trial,), simpler, reason, replaces_effects=True))
    return replace(search, rounds=rounds, hypothesis=simpler, final=final)


def _without_unneeded_effects(hypothesis: Hypothesis, others: Sequence[Effect]) -> Hypothesis:
    """Leave out the added effect with the largest deficit, until the gain of each effect exceeds its penalty."""
    while True:
        best: tuple[float, Hypothesis] | None = None
        for at, effect in enumerate(hypothesis.added):
            removable = effect.name in SIZE_PARAMETERS or isinstance(effect, (BandwidthLimit, ScaleFactor))
            if not removable or isinstance(effect, KEPT_EFFECTS):
                continue
            less = hypothesis.refit_with_other_added_effects(hypothesis.added[:at] + hypothesis.added[at + 1 :])
            if isinstance(effect, ScaleFactor) and len(changed_sizes(less)) > len(changed_sizes(hypothesis)):
                continue  # a factor is simpler than changed sizes
            shared = any(share_frequency_or_time(effect, other) for other in others)
            penalty = RESIZE_PENALTY_NATS if shared else PENALTY_NATS[effect.name]
            surplus = hypothesis.penalised_log_likelihood - less.penalised_log_likelihood - penalty
            if surplus < (best[0] if best else 0.0):
                best = surplus, less
        if best is None:
            return hypothesis
        hypothesis = best[1]


def share_frequency_or_time(a: Effect, b: Effect) -> bool:
    """Return True if two effects on different axes have nearly the same frequency or time.

    A line and a resonance at the same frequency have the same cause.

    Parameters
    ----------
    a, b : Effect
        Effects on different axes.

    Examples
    --------
    >>> line, peak = Sinusoidal(amplitude=1.0, frequency=17.3), Narrowband(sigma=2.0, frequency=17.32, bandwidth=0.1)
    >>> share_frequency_or_time(line, peak), share_frequency_or_time(line, Sinusoidal(amplitude=1.0, frequency=19.0))
    (True, False)
    """
    if type(a) is not type(b) and not (isinstance(a, PEAKS) and isinstance(b, PEAKS)):
        return False
    row = EFFECT_PROPERTIES[a.name]
    first, second = getattr(a, row.identity, None), getattr(b, row.identity, None)
    if not isinstance(first, float) or not isinstance(second, float):
        return False
    return abs(first - second) <= row.tolerance * max(abs(first), abs(second))


def _with_merged_peaks(hypothesis: Hypothesis) -> Hypothesis:
    """Replace neighbouring lines and resonances by one resonance, while the penalised likelihood increases."""
    while True:
        peaks = sorted((one for one in hypothesis.added if isinstance(one, PEAKS)), key=lambda one: one.frequency)
        better = None
        for low, high in pairwise(peaks):
            if high.frequency > MAX_PEAK_RATIO * low.frequency:
                continue
            merged = _merge_peaks(hypothesis, low, high)
            allowed_loss = PENALTY_NATS[low.name] + PENALTY_NATS[high.name] - PENALTY_NATS["narrowband"]
            if merged.penalised_log_likelihood >= hypothesis.penalised_log_likelihood - allowed_loss:
                better = merged
                break
        if better is None:
            return hypothesis
        hypothesis = better


def _merge_peaks(hypothesis: Hypothesis, low: Sinusoidal | Narrowband, high: Sinusoidal | Narrowband) -> Hypothesis:
    axis = hypothesis.axis
    rest = tuple(effect for effect in hypothesis.added if effect is not low and effect is not high)
    other_effects = (*hypothesis.effects[: hypothesis.model_effect_count], *rest)
    middle = 0.5 * (low.frequency + high.frequency)
    width = max(high.frequency - low.frequency, *(getattr(one, "bandwidth", 0.0) for one in (low, high)))
    merged: Effect = Narrowband(sigma=axis.cosine_transform_rms, frequency=middle, bandwidth=width)
    merged = fit_resonance(axis, other_effects, merged)
    return hypothesis.refit_with_other_added_effects((*rest, merged))


def revert_insignificant_size_changes(hypothesis: Hypothesis) -> Hypothesis:
    """Return a hypothesis in which each changed size of the noise model differs significantly from the old size.

    The interval of a changed size excludes the old size, and the gain of the change exceeds
    ``RESIZE_PENALTY_NATS``. A size that is compatible with zero becomes zero.
    """
    while True:
        losses = {at: _with_size(hypothesis, at, hypothesis.model[at]) for at in changed_sizes(hypothesis)}
        unneeded = {at: less for at, less in losses.items() if not _differs_significantly(hypothesis, at, less)}
        if not unneeded:
            break
        hypothesis = max(unneeded.values(), key=lambda one: one.fit.log_likelihood)
    for at in changed_sizes(hypothesis):
        if effect_size(hypothesis.effects[at]) != 0.0:
            absent = _with_size(hypothesis, at, _with_zero_size(hypothesis.model[at]))
            if hypothesis.fit.log_likelihood - absent.fit.log_likelihood < HALF_CHI2_95:
                hypothesis = absent
    return hypothesis


def _with_zero_size(effect: Effect) -> Effect:
    names = [name for name in EFFECT_PROPERTIES[effect.name].sizes if getattr(effect, name) is not None]
    zero: Effect = replace(effect, **dict.fromkeys(names, 0.0))  # type: ignore[type-var]
    return zero


def changed_sizes(hypothesis: Hypothesis) -> list[int]:
    """Return the indices of the effects of the model whose size was changed."""
    return [
        at
        for at in sorted(compared_size_indices(hypothesis.axis, hypothesis.model))
        if not has_same_size(hypothesis.effects[at], hypothesis.model[at])
    ]


def _with_size(hypothesis: Hypothesis, index: int, effect: Effect) -> Hypothesis:
    """Fit the hypothesis with a fixed size of one effect."""
    effects = (*hypothesis.effects[:index], effect, *hypothesis.effects[index + 1 :])
    return Hypothesis(hypothesis.model, hypothesis.axis.fit(effects, hypothesis.fit.fixed_sizes | {index}))


def _differs_significantly(hypothesis: Hypothesis, index: int, with_old_size: Hypothesis) -> bool:
    if hypothesis.fit.log_likelihood - with_old_size.fit.log_likelihood < RESIZE_PENALTY_NATS:
        return False
    interval = compute_size_interval(hypothesis.fit, index)
    if interval.lo is None or interval.hi is None or len(EFFECT_PROPERTIES[hypothesis.effects[index].name].sizes) > 1:
        return True
    return not interval.lo <= effect_size(hypothesis.model[index]) <= interval.hi


def _with_common_factor(
    searches: Mapping[str, AxisSearchResult], null: Mapping[str, AxisNull]
) -> dict[str, AxisSearchResult]:
    """Replace the changed sizes of one or more axes by one factor, if the factor fits nearly as well."""
    before = [one.hypothesis for one in searches.values()]
    names = [max(_factor_count(one), len(changed_sizes(one))) for one in before]
    if min(names) < 1 or sum(names) < 2 or any(_has_absent_term(one) for one in before):
        return dict(searches)

    def scale_noise_of_hypotheses(log_factor: float) -> list[Hypothesis]:
        return [_with_factor(one, float(np.exp(log_factor))) for one in before]

    def total(log_factor: float) -> float:
        return sum(one.fit.log_likelihood for one in scale_noise_of_hypotheses(log_factor))

    start = max(np.linspace(-3.0, 3.0, 13).tolist(), key=total)
    best = find_maximum_by_golden_section(total, start - 0.5, start + 0.5, SCALE_SEARCH_ITERATIONS)
    loss = sum(one.fit.log_likelihood for one in before) - total(best)
    if loss > SCALE_FACTOR_MARGIN_NATS * (sum(names) - 1):
        return dict(searches)
    accepted = {
        name: _accept_if_diagnostics_agree(
            search, simpler, null[name], "the factor replaces sizes that concern the whole recording"
        )
        for (name, search), simpler in zip(searches.items(), scale_noise_of_hypotheses(best), strict=True)
    }
    return accepted if all(accepted[name] is not one for name, one in searches.items()) else dict(searches)


def _factor_count(hypothesis: Hypothesis) -> int:
    return sum(isinstance(effect, ScaleFactor) for effect in hypothesis.added)


def _has_absent_term(hypothesis: Hypothesis) -> bool:
    return any(effect_size(hypothesis.effects[at]) == 0.0 for at in changed_sizes(hypothesis))


def _with_factor(hypothesis: Hypothesis, factor: float) -> Hypothesis:
    """Fit the hypothesis with the old sizes of the noise model times a common factor."""
    added = tuple(effect for effect in hypothesis.added if not isinstance(effect, ScaleFactor))
    effects = (*hypothesis.model, *added, ScaleFactor(factor=factor))
    fixed_sizes = compared_size_indices(hypothesis.axis, hypothesis.model)
    return Hypothesis(hypothesis.model, hypothesis.axis.fit(effects, fixed_sizes))
