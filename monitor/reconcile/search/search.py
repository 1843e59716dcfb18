"""Search for missing effects on one axis, by forward selection.

In each round, the axis is whitened with the current hypothesis and all diagnostics are run. The search ends if no
difference is significant. Otherwise, the best candidate effect that passes cross-validation is added. Added effects
that no longer contribute are dropped. After the last round, effects that the diagnostics contradict are withdrawn.
"""

from dataclasses import dataclass, replace
from functools import partial
from typing import Final

import numpy as np

from monitor.noise.effect import AxisLeak, Effect, Source
from monitor.noise.effects import (
    BiasCurve,
    BiasStep,
    ExponentiallyCorrelated,
    Narrowband,
    Outliers,
    PulseTrain,
    RandomSampleHold,
    RateRandomWalk,
    Saturation,
    WanderingLine,
    WanderingVariance,
)
from monitor.reconcile.diagnostics.null_distribution import AxisNull, Findings, run_diagnostics
from monitor.reconcile.diagnostics.plot_data import build_plot_data
from monitor.reconcile.diagnostics.whiteness_tests import DIAGNOSTICS
from monitor.reconcile.effect_properties import MOST_DIRECT_DIAGNOSTIC, ONE_TIME_EFFECTS, PENALTY_NATS, SIZE_PARAMETERS
from monitor.reconcile.likelihood.axis_fit import Axis, Effects
from monitor.reconcile.likelihood.effect_roles import effect_size, is_noise_effect
from monitor.reconcile.likelihood.hypothesis_fit import (
    Hypothesis,
    fit_with_fewest_changes,
    fit_with_model_sizes,
    refit_correlation_times,
    with_fitted_mean_variance,
)
from monitor.reconcile.likelihood.whitening import WhitenedAxis, whiten_axis
from monitor.reconcile.preparation.cosine_bins import build_frequency_bins
from monitor.reconcile.result import DiagnosticPlotData
from monitor.reconcile.search.candidate_effects import find_broad_spectral_peaks
from monitor.reconcile.search.cross_validation import CrossValidationResult, accept_without_validation, cross_validate
from monitor.reconcile.search.non_gaussian_alternatives import (
    MIN_ALTERNATIVE_GAIN_NATS,
    MIN_LINE_GAIN_NATS,
    choose_poisson_steps_or_telegraph,
    compare_poisson_with_added_noise,
    compare_resonance_with_lines,
    replace_by_likelier_alternative,
    wandering_line_trial,
)
from monitor.reconcile.search.sample_repair import repair_axis_again
from monitor.reconcile.search.trials import Trial, generate_trial_groups, try_alternatives_to_slow_noise
from monitor.reconcile.search.withdrawal_of_contradicted_effects import (
    SMOOTH_SPECTRA,
    difference_remains_near_line,
    keep_uncontradicted_effects,
)

MAX_ROUNDS: Final = 8
MAX_VALIDATION_ATTEMPTS: Final = 3
"""Largest number of candidates of one group for which cross-validation is attempted."""
MIN_FINER_BINS: Final = 8
"""Smallest number of additional bins for a new fit."""
REPAIRED_EFFECTS: Final = frozenset({Saturation, RandomSampleHold, Outliers, WanderingLine})
"""Effects that require a new repair of the samples."""
DISTRIBUTION_DIAGNOSTICS: Final = ("tails", "variance")
"""Diagnostics of non-Gaussian or non-stationary samples."""


@dataclass(frozen=True, slots=True)
class HypothesisDiagnostics:
    """Findings and plots of an axis for one hypothesis."""

    findings: Findings
    plots: tuple[DiagnosticPlotData, ...]


def diagnose_hypothesis(hypothesis: Hypothesis) -> HypothesisDiagnostics:
    """Run the diagnostics on the residuals of a hypothesis, and build the plots."""
    return _diagnose(hypothesis).findings_and_plots()


@dataclass(frozen=True, slots=True)
class SearchRound:
    """Search round that added an effect or changed sizes of the noise model."""

    before: HypothesisDiagnostics
    trials: tuple[Trial, ...]  # the selected trial, then the other trials in descending order of the score
    hypothesis: Hypothesis  # after the round
    validation: CrossValidationResult
    replaces_effects: bool = False  # True if the effect of the round replaces effects of earlier rounds


@dataclass(frozen=True, slots=True)
class AxisSearchResult:
    """Rounds and final hypothesis of the search on one axis."""

    rounds: tuple[SearchRound, ...]
    hypothesis: Hypothesis
    final: HypothesisDiagnostics
    before_withdrawal: HypothesisDiagnostics | None  # None if no effect was withdrawn


@dataclass(frozen=True, slots=True)
class _DiagnosedHypothesis:
    hypothesis: Hypothesis
    whitened: WhitenedAxis
    findings: Findings

    def findings_and_plots(self) -> HypothesisDiagnostics:
        """Return the findings and the plots."""
        return HypothesisDiagnostics(self.findings, build_plot_data(self.whitened))


_CompletedRound = tuple[SearchRound, _DiagnosedHypothesis]
"""Search round and the diagnosed hypothesis after the round."""


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
    current = _diagnose(fit_with_model_sizes(axis, model))
    rounds: list[SearchRound] = []
    while len(rounds) < MAX_ROUNDS:
        current, completed = _next_round(current, bool(rounds), null, rng)
        if completed is None:
            break
        done, current = completed
        rounds.append(done)
    kept = keep_uncontradicted_effects(
        current.hypothesis.added, _gains_by_type(rounds), current.findings, null, axis.rate_hz
    )
    kept, before_withdrawal = _without_zero_sizes(kept), None
    while kept != current.hypothesis.added:
        withdraw = partial(_with_other_added_effects, current.hypothesis, kept)
        simpler = current.hypothesis.axis.evaluate_candidate("withdrawal", withdraw, None)
        if simpler is None:
            break
        before_withdrawal = before_withdrawal or current.findings_and_plots()
        current = simpler
        kept = _without_zero_sizes(current.hypothesis.added)
    for one in rounds:
        if one.hypothesis.axis is not current.hypothesis.axis:
            one.hypothesis.axis.clear_cached_sums()
    return AxisSearchResult(tuple(rounds), current.hypothesis, current.findings_and_plots(), before_withdrawal)


def _diagnose(hypothesis: Hypothesis, whitened: WhitenedAxis | None = None) -> _DiagnosedHypothesis:
    whitened = whitened or whiten_axis(hypothesis.fit)
    return _DiagnosedHypothesis(hypothesis, whitened, run_diagnostics(whitened))


def _with_other_added_effects(hypothesis: Hypothesis, added: Effects) -> _DiagnosedHypothesis:
    return _diagnose(hypothesis.refit_with_other_added_effects(added))


def _next_round(
    current: _DiagnosedHypothesis, later: bool, null: AxisNull, rng: np.random.Generator
) -> tuple[_DiagnosedHypothesis, _CompletedRound | None]:
    """Run one search round. Return the hypothesis before the round, and the completed round, which is None at the end
    of the search.
    """
    hypothesis, whitened = current.hypothesis, current.whitened
    agrees = not any(one.gain > null[diagnostic].threshold for diagnostic, one in current.findings.items())
    better = (
        try_alternatives_to_slow_noise(hypothesis, whitened) if agrees and _has_fitted_slow_noise(hypothesis) else []
    )
    conspicuous = any(
        one.gain > null[diagnostic].min_gain_to_test_effects for diagnostic, one in current.findings.items()
    )
    completed = None
    if better or conspicuous:
        current, completed = _try_groups(current, better, agrees, null, rng)
    if completed is None and agrees and later and _is_gaussian_and_stationary(whitened, null):
        completed = hypothesis.axis.evaluate_candidate("jump process", partial(_replace_slow_noise, current), None)
    return current, completed


def _has_fitted_slow_noise(hypothesis: Hypothesis) -> bool:
    """Return True if a noise effect of the model was resized, or if correlated noise or a random walk was added."""
    slow = (ExponentiallyCorrelated, RateRandomWalk)
    return hypothesis.resized_model_effect_count > 0 or any(isinstance(effect, slow) for effect in hypothesis.added)


def _try_groups(
    current: _DiagnosedHypothesis, better: list[Trial], agrees: bool, null: AxisNull, rng: np.random.Generator
) -> tuple[_DiagnosedHypothesis, _CompletedRound | None]:
    """Select the first acceptable trial. If all diagnostics agree, skip groups whose best trial only changes sizes."""
    current = _with_finer_bins(current)
    for trials in [better] if better else generate_trial_groups(current.hypothesis, current.whitened):
        if agrees and trials and trials[0].effect is None:
            continue
        completed = _select_trial(current, trials, null, rng)
        if completed is not None:
            return current, completed
    return current, None


def _replace_slow_noise(current: _DiagnosedHypothesis) -> _CompletedRound | None:
    """Replace slow noise or single steps by a more likely jump process, or return None."""
    compared = (
        choose_poisson_steps_or_telegraph(current.hypothesis),
        compare_poisson_with_added_noise(current.hypothesis),
    )
    jumps = max((one for one in compared if one is not None), key=lambda one: one.gain, default=None)
    if jumps is None or jumps.gain <= MIN_ALTERNATIVE_GAIN_NATS:
        return None
    validation = accept_without_validation("the replaced effect has the same spectrum and was validated")
    hypothesis = current.hypothesis.refit_with_other_added_effects(jumps.added)
    trials = jumps.as_trials(Trial("", None, 0.0))
    return SearchRound(current.findings_and_plots(), trials, hypothesis, validation), _diagnose(hypothesis)


def _with_finer_bins(current: _DiagnosedHypothesis) -> _DiagnosedHypothesis:
    """Return the hypothesis fitted with finer bins around narrow peaks, and the same findings."""
    axis, hypothesis = current.hypothesis.axis, current.hypothesis
    finer = build_frequency_bins(axis.n, axis.rate_hz, find_broad_spectral_peaks(current.whitened))
    if finer.count.size <= axis.bins.count.size + MIN_FINER_BINS:
        return current
    hypothesis = Hypothesis(
        hypothesis.model, replace(axis, bins=finer).fit(hypothesis.effects, hypothesis.fit.fixed_sizes)
    )
    axis.clear_cached_sums()
    return _DiagnosedHypothesis(hypothesis, whiten_axis(hypothesis.fit), current.findings)


def _select_trial(
    current: _DiagnosedHypothesis, trials: list[Trial], null: AxisNull, rng: np.random.Generator
) -> _CompletedRound | None:
    """Return the round that adds the first trial effect that passes all tests, or None."""
    axis = current.hypothesis.axis
    for at, trial in enumerate(trials[:MAX_VALIDATION_ATTEMPTS]):
        if trial.score <= 0.0 or trial.is_rival_only:
            return None
        done = axis.evaluate_candidate(trial.name, partial(_accept_trial, current, trials, at, null, rng), None)
        if done is not None:
            return done
    return None


def _accept_trial(
    current: _DiagnosedHypothesis, trials: list[Trial], at: int, null: AxisNull, rng: np.random.Generator
) -> _CompletedRound | None:
    """Return the round that adds the effect of one trial, or None if the effect does not pass all tests."""
    trial, findings = trials[at], current.findings
    strongest = max(findings, key=lambda name: findings[name].gain - null[name].threshold)
    diagnostic = MOST_DIRECT_DIAGNOSTIC.get(trial.name, strongest)
    after = _add_effect(current.hypothesis, trial, rng)
    added = None if trial.effect is None or trial.moved is not None else after.added[-1]
    if added is not None and _has_zero_size(added):
        return None
    whitened = whiten_axis(after.fit)
    if trial.name in ONE_TIME_EFFECTS and DIAGNOSTICS[diagnostic](whitened).gain >= findings[diagnostic].gain:
        return None
    tried = [trial, *trials[:at], *trials[at + 1 :]]  # a rejected trial still reduces the confidence
    lines = None
    if isinstance(added, Narrowband):
        compare = partial(compare_resonance_with_lines, after)
        lines = after.axis.evaluate_candidate(WanderingLine.name, compare, None)
    if lines is not None and (lines.is_modulated or (lines.is_sweep and lines.gain > MIN_LINE_GAIN_NATS)):
        return None
    if lines is not None:
        line = wandering_line_trial(lines, trial)
        tried = [trial, line, *tried[1:]]
        if lines.gain > MIN_LINE_GAIN_NATS:
            tried[:2] = line, trial
            after, added = _add_effect(current.hypothesis, line, rng), lines.line
            whitened = whiten_axis(after.fit)
            if difference_remains_near_line(lines.line, findings, whitened, null):
                return None
    if _is_gaussian_and_stationary(whitened, null):
        replace_effect = partial(replace_by_likelier_alternative, after, tried)
        after, tried = after.axis.evaluate_candidate("non-Gaussian alternative", replace_effect, (after, tried))
        whitened = whitened if after.fit is whitened.fit else whiten_axis(after.fit)
    for effect in after.added:
        effect.check_rate(after.axis.rate_hz)
    validation = cross_validate(current.hypothesis, after, added, diagnostic, null[diagnostic])
    if not validation.kept:
        return None
    done = SearchRound(current.findings_and_plots(), tuple(tried), after, validation)
    return done, _diagnose(after, whitened)


def _add_effect(hypothesis: Hypothesis, trial: Trial, rng: np.random.Generator) -> Hypothesis:
    """Add the effect of a trial to the hypothesis, or move an effect of the model to another frequency.

    If the effect alters samples, the axis is repaired again first.
    """
    if trial.moved is not None and trial.effect is not None:
        model = (*hypothesis.model[: trial.moved], trial.effect, *hypothesis.model[trial.moved + 1 :])
        return drop_unneeded_effects(fit_with_fewest_changes(hypothesis.axis, hypothesis.added, model))
    added = hypothesis.added if trial.effect is None else (*hypothesis.added, trial.effect)
    axis = hypothesis.axis
    if type(trial.effect) in REPAIRED_EFFECTS:
        axis = repair_axis_again(axis, (*hypothesis.model, *added), rng)
    model = hypothesis.model
    if isinstance(trial.effect, WanderingVariance):  # the mean variance of the recording depends on chance
        model = with_fitted_mean_variance(axis, (*model, trial.effect))[: len(model)]
    added = refit_correlation_times(axis, added, model)
    found = drop_unneeded_effects(fit_with_fewest_changes(axis, added, model))
    if np.isfinite(axis.raw).all():
        return found
    axis = repair_axis_again(axis, found.effects, rng)  # the missing samples depend on the spectrum
    return drop_unneeded_effects(fit_with_fewest_changes(axis, found.added, found.model))


def _is_gaussian_and_stationary(whitened: WhitenedAxis, null: AxisNull) -> bool:
    """Return True if the diagnostics find neither outliers nor variance changes."""
    return all(
        DIAGNOSTICS[diagnostic](whitened).gain <= null[diagnostic].threshold for diagnostic in DISTRIBUTION_DIAGNOSTICS
    )


def drop_unneeded_effects(hypothesis: Hypothesis) -> Hypothesis:
    """Drop added effects that no longer contribute. The last added effect is always kept."""
    for at in range(len(hypothesis.added) - 2, -1, -1):
        effect = hypothesis.added[at]
        if effect.name not in SIZE_PARAMETERS:
            continue
        less = hypothesis.refit_with_other_added_effects(hypothesis.added[:at] + hypothesis.added[at + 1 :])
        if hypothesis.penalised_log_likelihood - less.penalised_log_likelihood < 0.5 * PENALTY_NATS.get(
            effect.name, 0.0
        ):
            hypothesis = less
    return hypothesis


def _gains_by_type(rounds: list[SearchRound]) -> dict[type[Effect], float]:
    """Return, for each type of added effect, the largest gain of a diagnostic before the effect was added.

    For leaks, steps, curves, pulses and smooth spectra, only the most sensitive diagnostic is used.
    """
    found: dict[type[Effect], float] = {}
    for one in rounds:
        if one.hypothesis.added:
            kind = type(one.hypothesis.added[-1])
            most_direct_only = issubclass(kind, (AxisLeak, BiasStep, BiasCurve, PulseTrain, *SMOOTH_SPECTRA))
            diagnostics = (MOST_DIRECT_DIAGNOSTIC[kind.name],) if most_direct_only else tuple(one.before.findings)
            found[kind] = max(
                found.get(kind, 0.0), *(one.before.findings[diagnostic].gain for diagnostic in diagnostics)
            )
    return found


def _without_zero_sizes(effects: Effects) -> Effects:
    return tuple(effect for effect in effects if not _has_zero_size(effect))


def _has_zero_size(effect: Effect) -> bool:
    return isinstance(effect, Source) and is_noise_effect(effect) and effect_size(effect) == 0.0
