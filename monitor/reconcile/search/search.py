"""Search for missing effects on one axis, by forward selection.

In each round the axis is whitened by the current model, and all diagnostics are run. If no diagnostic passes its
threshold, the search ends. Otherwise the candidates of ``trials`` are tried, one kind after the other. The first
candidate that exceeds its penalty and passes cross-validation is added. Effects from earlier rounds that no longer
contribute are dropped. When spectrum and level agree, effects with the same spectrum are distinguished by their
distribution. At the end, effects that fail a consistency check are withdrawn.
"""

from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from monitor.noise.effect import Effect, Leak
from monitor.noise.effects import BiasStep, Outliers, RandomSampleHold, Saturation
from monitor.reconcile.diagnostics.diagnostics import DIAGNOSTICS
from monitor.reconcile.diagnostics.null_distribution import AxisNull, Findings, run_diagnostics
from monitor.reconcile.diagnostics.plot_data import plot_data
from monitor.reconcile.likelihood.axis import Axis, Effects
from monitor.reconcile.likelihood.effect_terms import (
    NATURAL_DIAGNOSTIC,
    NOISE_SIZE_PARAMETERS,
    ONE_TIME_EFFECTS,
    SIZE_PARAMETERS,
    size,
)
from monitor.reconcile.likelihood.hypothesis import Hypothesis, fit_with_fewest_changes, fit_with_fixed_noise
from monitor.reconcile.likelihood.whitening import WhitenedAxis, whiten_axis
from monitor.reconcile.preparation.cosine_bins import frequency_bins
from monitor.reconcile.result import PlotData
from monitor.reconcile.search.axis_repair import repair_axis_again
from monitor.reconcile.search.candidates import PENALTY_NATS, find_spectral_peaks
from monitor.reconcile.search.cross_validation import CrossValidation, cross_validate, not_validated
from monitor.reconcile.search.non_gaussian_alternatives import (
    MIN_ALTERNATIVE_GAIN_NATS,
    choose_distribution,
    compare_jump_processes,
)
from monitor.reconcile.search.trials import UNNAMED, Trial, alternatives_to_resizing, trial_groups
from monitor.reconcile.search.withdrawal import SMOOTH_SPECTRA, keep_supported_effects

MAX_ROUNDS: Final = 8
"""Largest number of rounds."""
MAX_VALIDATION_ATTEMPTS: Final = 3
"""Number of candidates of one kind that may fail cross-validation before the next kind is tried."""
MIN_FINER_BINS: Final = 8
"""Number of additional bins from which finer bins are worth a new fit."""
REPAIRED_EFFECTS: Final = frozenset({Saturation, RandomSampleHold, Outliers})
"""Effects after which the samples are repaired again."""
DISTRIBUTION_DIAGNOSTICS: Final = ("tails", "variance")
"""Diagnostics that test whether samples are Gaussian and stationary."""


@dataclass(frozen=True, slots=True)
class SearchRound:
    """Result of one round of the search."""

    plots: tuple[PlotData, ...]  # before the round
    findings: Findings  # before the round
    trials: tuple[Trial, ...]  # the first was selected; the others follow, best first
    hypothesis: Hypothesis  # after the round
    validation: CrossValidation


@dataclass(frozen=True, slots=True)
class AxisSearchResult:
    """Result of all rounds on one axis."""

    rounds: tuple[SearchRound, ...]
    hypothesis: Hypothesis
    plots: tuple[PlotData, ...]  # at the end
    findings: Findings  # at the end
    before: tuple[tuple[PlotData, ...], Findings] | None  # hypothesis before effects were withdrawn; None if none were


@dataclass(frozen=True, slots=True)
class _DiagnosedHypothesis:
    """Fitted effects of an axis, and what the diagnostics find in the axis whitened by these effects."""

    hypothesis: Hypothesis
    whitened: WhitenedAxis
    findings: Findings


def search_axis(axis: Axis, model: Effects, null: AxisNull, rng: np.random.Generator) -> AxisSearchResult:
    """Search for the effects that explain one axis.

    Parameters
    ----------
    axis : Axis
        Axis, prepared with the model.
    model : tuple of Effect
        Effects of the axis in the model under test.
    null : AxisNull
        Null distribution of each diagnostic.
    rng : numpy.random.Generator
        Generator for the replacement of samples that are found to be wrong.
    """
    current = _examine(fit_with_fixed_noise(axis, model))
    rounds: list[SearchRound] = []
    while len(rounds) < MAX_ROUNDS:
        current, done = _next_round(current, bool(rounds), null, rng)
        if done is None:
            break
        rounds.append(done)
        current = _examine(done.hypothesis)
    kept = keep_supported_effects(current.hypothesis.added, _gains_by_type(rounds), current.findings, null)
    kept, before = _without_zero_sizes(kept), None
    while kept != current.hypothesis.added:
        before = before or (plot_data(current.whitened), current.findings)
        current = _examine(current.hypothesis.refit_with_added_effects(kept))
        kept = _without_zero_sizes(current.hypothesis.added)
    return AxisSearchResult(tuple(rounds), current.hypothesis, plot_data(current.whitened), current.findings, before)


def _examine(hypothesis: Hypothesis) -> _DiagnosedHypothesis:
    """Whiten an axis by the fitted effects and run all diagnostics."""
    whitened = whiten_axis(hypothesis.fit)
    return _DiagnosedHypothesis(hypothesis, whitened, run_diagnostics(whitened))


def _next_round(
    current: _DiagnosedHypothesis, later: bool, null: AxisNull, rng: np.random.Generator
) -> tuple[_DiagnosedHypothesis, SearchRound | None]:
    """Return the examination, with finer bins if necessary, and the next round, or None if the search ends.

    ``later`` is True if there were rounds before.
    """
    hypothesis, whitened = current.hypothesis, current.whitened
    agrees = not any(one.gain > null[lens].threshold for lens, one in current.findings.items())
    better = alternatives_to_resizing(hypothesis, whitened) if agrees and hypothesis.refitted_size_count else []
    if agrees and not better:
        return current, _replace_random_walk(current) if later and _is_gaussian_and_stationary(whitened, null) else None
    current = _with_finer_bins(current)
    for trials in [better] if better else trial_groups(current.hypothesis, current.whitened):
        done = _select_trial(current, trials, null, rng)
        if done is not None:
            return current, done
        if trials and trials[0].name == UNNAMED:
            break
    return current, None


def _replace_random_walk(current: _DiagnosedHypothesis) -> SearchRound | None:
    """Return the round that replaces a random walk or single steps by a jump process, or None if that fits worse."""
    jumps = compare_jump_processes(current.hypothesis)
    if jumps is None or jumps.gain <= MIN_ALTERNATIVE_GAIN_NATS:
        return None
    validation = not_validated("the replaced effect has the same spectrum and was validated")
    hypothesis = current.hypothesis.refit_with_added_effects(jumps.added)
    return SearchRound(plot_data(current.whitened), current.findings, jumps.as_trials(0.0), hypothesis, validation)


def _with_finer_bins(current: _DiagnosedHypothesis) -> _DiagnosedHypothesis:
    """Return the examination with finer bins around narrow peaks, if there are any. The findings stay the same."""
    axis, hypothesis = current.hypothesis.axis, current.hypothesis
    finer = frequency_bins(axis.n, axis.rate_hz, find_spectral_peaks(current.whitened))
    if finer.count.size <= axis.bins.count.size + MIN_FINER_BINS:
        return current
    hypothesis = Hypothesis(
        hypothesis.model, replace(axis, bins=finer).fit(hypothesis.effects, hypothesis.fit.fixed_noise)
    )
    return _DiagnosedHypothesis(hypothesis, whiten_axis(hypothesis.fit), current.findings)


def _select_trial(
    current: _DiagnosedHypothesis, trials: list[Trial], null: AxisNull, rng: np.random.Generator
) -> SearchRound | None:
    """Return the round with the best trial of one kind that passes cross-validation, or None."""
    findings = current.findings
    strongest = max(findings, key=lambda name: findings[name].gain - null[name].threshold)
    for at, trial in enumerate(trials[:MAX_VALIDATION_ATTEMPTS]):
        if trial.score <= 0.0 or trial.name == UNNAMED:
            return None
        lens = NATURAL_DIAGNOSTIC.get(trial.name, strongest)
        after = _add_effect(current.hypothesis, trial, rng)
        added = None if trial.effect is None else after.added[-1]
        if added is not None and _has_zero_size(added):
            continue
        whitened = whiten_axis(after.fit)
        if trial.name in ONE_TIME_EFFECTS and DIAGNOSTICS[lens](whitened).gain >= findings[lens].gain:
            continue
        tried = trials[at:]
        if _is_gaussian_and_stationary(whitened, null):
            after, tried = choose_distribution(after, tried)
        validation = cross_validate(current.hypothesis, after, added, lens, null[lens], rng)
        if validation.kept:
            return SearchRound(plot_data(current.whitened), findings, tuple(tried), after, validation)
    return None


def _add_effect(hypothesis: Hypothesis, trial: Trial, rng: np.random.Generator) -> Hypothesis:
    """Return the hypothesis with the effect of a trial, fitted to samples that are repaired for this effect."""
    found = hypothesis.added if trial.effect is None else (*hypothesis.added, trial.effect)
    axis = hypothesis.axis
    if type(trial.effect) in REPAIRED_EFFECTS:
        axis = repair_axis_again(axis, (*hypothesis.model, *found), rng)
    return drop_unneeded_effects(fit_with_fewest_changes(axis, found, hypothesis.model))


def _is_gaussian_and_stationary(whitened: WhitenedAxis, null: AxisNull) -> bool:
    """Return True if the samples are Gaussian and stationary.

    Otherwise, effects that differ only in their distribution cannot be distinguished.
    """
    return all(DIAGNOSTICS[lens](whitened).gain <= null[lens].threshold for lens in DISTRIBUTION_DIAGNOSTICS)


def drop_unneeded_effects(hypothesis: Hypothesis) -> Hypothesis:
    """Return the hypothesis without effects that no longer contribute. The last effect is never dropped."""
    for at in range(len(hypothesis.added) - 2, -1, -1):
        effect = hypothesis.added[at]
        if type(effect) not in SIZE_PARAMETERS:
            continue
        less = hypothesis.refit_with_added_effects(hypothesis.added[:at] + hypothesis.added[at + 1 :])
        if hypothesis.score - less.score < 0.5 * PENALTY_NATS.get(effect.name, 0.0):
            hypothesis = less
    return hypothesis


def _gains_by_type(rounds: list[SearchRound]) -> dict[type[Effect], float]:
    """Return, for each type of effect, the largest gain of a diagnostic when an effect of this type was selected.

    For leaks, steps and smooth spectra, only their natural diagnostic counts.
    """
    found: dict[type[Effect], float] = {}
    for one in rounds:
        if one.hypothesis.added:
            kind = type(one.hypothesis.added[-1])
            natural_only = issubclass(kind, (Leak, BiasStep, *SMOOTH_SPECTRA))
            lenses = (NATURAL_DIAGNOSTIC[kind.name],) if natural_only else tuple(one.findings)
            found[kind] = max(found.get(kind, 0.0), *(one.findings[lens].gain for lens in lenses))
    return found


def _without_zero_sizes(effects: Effects) -> Effects:
    """Return the effects without noise effects that the fit gave the size zero."""
    return tuple(effect for effect in effects if not _has_zero_size(effect))


def _has_zero_size(effect: Effect) -> bool:
    """Return True if the fit gave a noise effect the size zero."""
    return type(effect) in NOISE_SIZE_PARAMETERS and size(effect) == 0.0
