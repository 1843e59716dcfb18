"""Search for missing effects on one axis, by forward selection.

In each round, the axis is whitened by the current hypothesis and all diagnostics are run. The search ends if no
difference is significant. Otherwise, the best candidate effect that passes cross-validation is added. Added effects
that no longer contribute are dropped. After the last round, effects that the diagnostics contradict are withdrawn.
"""

from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from monitor.noise.effect import AxisLeak, Effect
from monitor.noise.effects import BiasStep, Outliers, RandomSampleHold, Saturation
from monitor.reconcile.diagnostics.diagnostics import DIAGNOSTICS
from monitor.reconcile.diagnostics.null_distribution import AxisNull, Findings, run_diagnostics
from monitor.reconcile.diagnostics.plot_data import build_plot_data
from monitor.reconcile.likelihood.axis_fit import Axis, Effects
from monitor.reconcile.likelihood.effect_roles import (
    MOST_DIRECT_DIAGNOSTIC,
    NOISE_SIZE_PARAMETERS,
    ONE_TIME_EFFECTS,
    SIZE_PARAMETERS,
    effect_size,
)
from monitor.reconcile.likelihood.hypothesis import Hypothesis, fit_with_fewest_changes, fit_with_fixed_noise
from monitor.reconcile.likelihood.whitening import WhitenedAxis, whiten_axis
from monitor.reconcile.preparation.cosine_bins import build_frequency_bins
from monitor.reconcile.result import PlotData
from monitor.reconcile.search.axis_repair import repair_axis_again
from monitor.reconcile.search.candidates import PENALTY_NATS, find_spectral_peaks
from monitor.reconcile.search.cross_validation import CrossValidationResult, accept_without_validation, cross_validate
from monitor.reconcile.search.non_gaussian_alternatives import (
    MIN_ALTERNATIVE_GAIN_NATS,
    choose_distribution,
    compare_jump_processes,
)
from monitor.reconcile.search.trials import UNNAMED, Trial, generate_trial_groups, try_alternatives_to_resizing
from monitor.reconcile.search.withdrawal import SMOOTH_SPECTRA, keep_supported_effects

MAX_ROUNDS: Final = 8
MAX_VALIDATION_ATTEMPTS: Final = 3
"""Largest number of candidates of one group for which cross-validation is attempted."""
MIN_FINER_BINS: Final = 8
"""Smallest number of additional bins for a new fit."""
REPAIRED_EFFECTS: Final = frozenset({Saturation, RandomSampleHold, Outliers})
"""Effects that require a new repair of the samples."""
DISTRIBUTION_DIAGNOSTICS: Final = ("tails", "variance")
"""Diagnostics of non-Gaussian or non-stationary samples."""


@dataclass(frozen=True, slots=True)
class AxisDiagnostics:
    """Findings and plots of an axis for one hypothesis."""

    findings: Findings
    plots: tuple[PlotData, ...]


@dataclass(frozen=True, slots=True)
class SearchRound:
    """Search round that added an effect or changed sizes of the noise model."""

    before: AxisDiagnostics
    trials: tuple[Trial, ...]  # the selected trial, then the other trials in descending order of the score
    hypothesis: Hypothesis  # after the round
    validation: CrossValidationResult


@dataclass(frozen=True, slots=True)
class AxisSearchResult:
    """Rounds and final hypothesis of the search on one axis."""

    rounds: tuple[SearchRound, ...]
    hypothesis: Hypothesis
    final: AxisDiagnostics
    before_withdrawal: AxisDiagnostics | None  # None if no effect was withdrawn


@dataclass(frozen=True, slots=True)
class _DiagnosedHypothesis:
    hypothesis: Hypothesis
    whitened: WhitenedAxis
    findings: Findings

    def findings_and_plots(self) -> AxisDiagnostics:
        """Return the findings and the plots."""
        return AxisDiagnostics(self.findings, build_plot_data(self.whitened))


def search_missing_effects(axis: Axis, model: Effects, null: AxisNull, rng: np.random.Generator) -> AxisSearchResult:
    """Search for the effects that a noise model lacks on one axis.

    Parameters
    ----------
    axis : Axis
        Axis to search, repaired with the effects of the noise model.
    model : tuple of Effect
        Effects of the axis in the model under test.
    null : AxisNull
        Null distribution of each diagnostic.
    rng : numpy.random.Generator
        Generator for the samples that replace outliers, repeats and clipped samples.
    """
    current = _diagnose(fit_with_fixed_noise(axis, model))
    rounds: list[SearchRound] = []
    while len(rounds) < MAX_ROUNDS:
        current, done = _next_round(current, bool(rounds), null, rng)
        if done is None:
            break
        rounds.append(done)
        current = _diagnose(done.hypothesis)
    kept = keep_supported_effects(current.hypothesis.added, _gains_by_type(rounds), current.findings, null)
    kept, before_withdrawal = _without_zero_sizes(kept), None
    while kept != current.hypothesis.added:
        before_withdrawal = before_withdrawal or current.findings_and_plots()
        current = _diagnose(current.hypothesis.refit_with_added_effects(kept))
        kept = _without_zero_sizes(current.hypothesis.added)
    return AxisSearchResult(tuple(rounds), current.hypothesis, current.findings_and_plots(), before_withdrawal)


def _diagnose(hypothesis: Hypothesis) -> _DiagnosedHypothesis:
    whitened = whiten_axis(hypothesis.fit)
    return _DiagnosedHypothesis(hypothesis, whitened, run_diagnostics(whitened))


def _next_round(
    current: _DiagnosedHypothesis, later: bool, null: AxisNull, rng: np.random.Generator
) -> tuple[_DiagnosedHypothesis, SearchRound | None]:
    """Run one search round. Return the hypothesis before the round, and the round, which is None at the end of the
    search.
    """
    hypothesis, whitened = current.hypothesis, current.whitened
    agrees = not any(one.gain > null[lens].threshold for lens, one in current.findings.items())
    better = try_alternatives_to_resizing(hypothesis, whitened) if agrees and hypothesis.refitted_size_count else []
    if agrees and not better:
        return current, _replace_random_walk(current) if later and _is_gaussian_and_stationary(whitened, null) else None
    current = _with_finer_bins(current)
    for trials in [better] if better else generate_trial_groups(current.hypothesis, current.whitened):
        done = _select_trial(current, trials, null, rng)
        if done is not None:
            return current, done
        if trials and trials[0].name == UNNAMED:
            break
    return current, None


def _replace_random_walk(current: _DiagnosedHypothesis) -> SearchRound | None:
    """Replace a random walk or single steps by a more likely jump process, or return None."""
    jumps = compare_jump_processes(current.hypothesis)
    if jumps is None or jumps.gain <= MIN_ALTERNATIVE_GAIN_NATS:
        return None
    validation = accept_without_validation("the replaced effect has the same spectrum and was validated")
    hypothesis = current.hypothesis.refit_with_added_effects(jumps.added)
    return SearchRound(current.findings_and_plots(), jumps.as_trials(0.0), hypothesis, validation)


def _with_finer_bins(current: _DiagnosedHypothesis) -> _DiagnosedHypothesis:
    """Return the hypothesis fitted with finer bins around narrow peaks, and the same findings."""
    axis, hypothesis = current.hypothesis.axis, current.hypothesis
    finer = build_frequency_bins(axis.n, axis.rate_hz, find_spectral_peaks(current.whitened))
    if finer.count.size <= axis.bins.count.size + MIN_FINER_BINS:
        return current
    hypothesis = Hypothesis(
        hypothesis.model, replace(axis, bins=finer).fit(hypothesis.effects, hypothesis.fit.fixed_noise)
    )
    return _DiagnosedHypothesis(hypothesis, whiten_axis(hypothesis.fit), current.findings)


def _select_trial(
    current: _DiagnosedHypothesis, trials: list[Trial], null: AxisNull, rng: np.random.Generator
) -> SearchRound | None:
    """Return the round that adds the first trial effect that passes all tests, or None."""
    findings = current.findings
    strongest = max(findings, key=lambda name: findings[name].gain - null[name].threshold)
    for at, trial in enumerate(trials[:MAX_VALIDATION_ATTEMPTS]):
        if trial.score <= 0.0 or trial.name == UNNAMED:
            return None
        lens = MOST_DIRECT_DIAGNOSTIC.get(trial.name, strongest)
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
            return SearchRound(current.findings_and_plots(), tuple(tried), after, validation)
    return None


def _add_effect(hypothesis: Hypothesis, trial: Trial, rng: np.random.Generator) -> Hypothesis:
    """Add the effect of a trial to the hypothesis. If the effect alters samples, the axis is repaired again first."""
    added = hypothesis.added if trial.effect is None else (*hypothesis.added, trial.effect)
    axis = hypothesis.axis
    if type(trial.effect) in REPAIRED_EFFECTS:
        axis = repair_axis_again(axis, (*hypothesis.model, *added), rng)
    return drop_unneeded_effects(fit_with_fewest_changes(axis, added, hypothesis.model))


def _is_gaussian_and_stationary(whitened: WhitenedAxis, null: AxisNull) -> bool:
    """Return True if the diagnostics find neither outliers nor variance changes."""
    return all(DIAGNOSTICS[lens](whitened).gain <= null[lens].threshold for lens in DISTRIBUTION_DIAGNOSTICS)


def drop_unneeded_effects(hypothesis: Hypothesis) -> Hypothesis:
    """Drop added effects that no longer contribute. The last added effect is always kept."""
    for at in range(len(hypothesis.added) - 2, -1, -1):
        effect = hypothesis.added[at]
        if type(effect) not in SIZE_PARAMETERS:
            continue
        less = hypothesis.refit_with_added_effects(hypothesis.added[:at] + hypothesis.added[at + 1 :])
        if hypothesis.penalised_log_likelihood - less.penalised_log_likelihood < 0.5 * PENALTY_NATS.get(
            effect.name, 0.0
        ):
            hypothesis = less
    return hypothesis


def _gains_by_type(rounds: list[SearchRound]) -> dict[type[Effect], float]:
    """Return, for each type of added effect, the largest gain of a diagnostic before the effect was added.

    For leaks, steps and smooth spectra, only the most sensitive diagnostic is used.
    """
    found: dict[type[Effect], float] = {}
    for one in rounds:
        if one.hypothesis.added:
            kind = type(one.hypothesis.added[-1])
            most_direct_only = issubclass(kind, (AxisLeak, BiasStep, *SMOOTH_SPECTRA))
            lenses = (MOST_DIRECT_DIAGNOSTIC[kind.name],) if most_direct_only else tuple(one.before.findings)
            found[kind] = max(found.get(kind, 0.0), *(one.before.findings[lens].gain for lens in lenses))
    return found


def _without_zero_sizes(effects: Effects) -> Effects:
    return tuple(effect for effect in effects if not _has_zero_size(effect))


def _has_zero_size(effect: Effect) -> bool:
    return type(effect) in NOISE_SIZE_PARAMETERS and effect_size(effect) == 0.0
