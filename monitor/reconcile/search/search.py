"""Search for missing effects on one axis, by forward selection.

In each round the axis is whitened by the current model and examined. If no diagnostic passes its threshold, the search
ends. Otherwise the candidates of ``trials`` are tried, one kind after the other. The first one that exceeds its penalty
and passes cross-validation is added. Effects from earlier rounds that no longer contribute are dropped. When spectrum
and level agree, effects with the same spectrum are distinguished by their distribution. At the end, effects that fail a
consistency check are withdrawn.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from monitor.noise.effect import Effect, Leak
from monitor.noise.effects import BiasStep, ExponentiallyCorrelated, Outliers, RateRandomWalk, SampleHold, Saturation
from monitor.reconcile.diagnostics.diagnostics import DIAGNOSTICS, WhitenedAxis, whiten_axis
from monitor.reconcile.diagnostics.figures import plot_data
from monitor.reconcile.diagnostics.gap import Findings, NullDistribution, run_diagnostics
from monitor.reconcile.likelihood.effect_terms import (
    DETERMINISTIC_SIZE_PARAMETERS,
    NATURAL_DIAGNOSTIC,
    NOISE_SIZE_PARAMETERS,
    ONE_TIME_EFFECTS,
    size,
)
from monitor.reconcile.likelihood.hypothesis import Hypothesis, fit_with_fewest_changes, fit_with_given_sizes
from monitor.reconcile.preparation.axis import Axis, Effects
from monitor.reconcile.preparation.cosine_bins import frequency_bins
from monitor.reconcile.preparation.prepare import repair_again
from monitor.reconcile.result import PlotData
from monitor.reconcile.search.candidates import PENALTY_NATS, find_spectral_peaks, propose_correlated_noise
from monitor.reconcile.search.cross_validation import CrossValidation, cross_validate
from monitor.reconcile.search.non_gaussian_alternatives import (
    MIN_ALTERNATIVE_GAIN_NATS,
    NonGaussianAlternative,
    fit_poisson_alternative,
    fit_telegraph_alternative,
)
from monitor.reconcile.search.trials import UNNAMED, Trial, replacements_for_resizing, trial_groups
from monitor.reconcile.search.withdrawal import SMOOTH_SPECTRA, supported_effects

MAX_ROUNDS: Final = 8
"""Largest number of rounds."""
MAX_VALIDATION_ATTEMPTS: Final = 3
"""Number of candidates of one kind that may fail cross-validation before the next kind is tried."""
REPAIRED_EFFECTS: Final = frozenset({Saturation, SampleHold, Outliers})
"""Effects after which the samples are repaired again."""
DISTRIBUTION_DIAGNOSTICS: Final = ("tails", "variance")
"""Diagnostics that test whether samples are Gaussian and stationary."""
MIN_SWITCHES: Final = 10
"""Smallest number of switches of a telegraph that is preferred to Poisson steps. Fewer jumps may alternate in sign by
chance.
"""
WALK_EFFECTS: Final = frozenset({BiasStep, RateRandomWalk})
"""Effects that jump processes are compared with."""
SHARED_SPECTRUM: Final = CrossValidation(
    float("nan"), float("nan"), True, "its spectrum is that of what it stands for, and was held out"
)
"""Cross-validation result of an alternative that differs only in its distribution."""


@dataclass(frozen=True, slots=True)
class Round:
    """Result of one round of the search."""

    views: tuple[PlotData, ...]  # before the round
    seen: Findings  # before the round
    trials: tuple[Trial, ...]  # the first was selected; the others follow, best first
    state: Hypothesis  # after the round
    proof: CrossValidation


@dataclass(frozen=True, slots=True)
class Search:
    """Result of all rounds on one axis."""

    start: Hypothesis  # the unchanged model
    rounds: tuple[Round, ...]
    axis: Axis  # repaired, with bins as fine as its peaks require
    state: Hypothesis
    views: tuple[PlotData, ...]  # at the end
    seen: Findings  # at the end
    before: tuple[tuple[PlotData, ...], Findings] | None  # state before effects were withdrawn; None if none were
    rivals: tuple[Trial, ...]  # trials of a last round that selected nothing


def search_axis(axis: Axis, model: Effects, null: Mapping[str, NullDistribution], rng: np.random.Generator) -> Search:
    """Search for the effects that explain one axis.

    Parameters
    ----------
    axis : Axis
        Axis, prepared with the model.
    model : tuple of Effect
        Effects of the axis in the model under test.
    null : mapping of str to Null
        Null distribution of each diagnostic.
    rng : numpy.random.Generator
        Generator for the replacement of samples that are found to be wrong.
    """
    state = start = fit_with_given_sizes(axis, model)
    rounds: list[Round] = []
    rivals: tuple[Trial, ...] = ()
    while True:
        view = whiten_axis(axis, state.likely)
        seen = run_diagnostics(view)
        closed = not any(one.gain > null[lens].threshold for lens, one in seen.items())
        if len(rounds) == MAX_ROUNDS:
            break
        better = replacements_for_resizing(axis, state, view) if closed and state.freed else []
        if closed and not better:
            jumps = (
                compare_jump_processes(axis, state, view)
                if rounds and _is_gaussian_and_stationary(view, null)
                else None
            )
            if jumps is None or jumps.gain <= MIN_ALTERNATIVE_GAIN_NATS:
                break
            state = fit_with_fewest_changes(axis, jumps.found, model)
            rounds.append(Round(plot_data(view), seen, _trials_of_alternative(jumps, 0.0), state, SHARED_SPECTRUM))
            continue
        finer = frequency_bins(axis.n, axis.rate_hz, find_spectral_peaks(view))
        if finer.count.size > axis.bins.count.size + 8:
            axis = axis.rebinned(finer)
            state = Hypothesis(model, axis.fit(state.effects, state.likely.held))
            start = start if rounds else state
            view = whiten_axis(axis, state.likely)
        asked: list[Trial] = []
        taken = None
        for trials in [better] if better else trial_groups(axis, state, view):
            asked += trials
            taken = _select_trial(axis, state, trials, view, seen, null, rng)
            if taken is not None or (trials and trials[0].name == UNNAMED):
                break
        if taken is None:
            rivals = tuple(sorted(asked, key=lambda one: -one.value))
            break
        axis, done = taken
        state = done.state
        rounds.append(done)
    kept = tuple(
        effect for effect in supported_effects(state, _gains_by_type(rounds), seen, null) if not _has_zero_size(effect)
    )
    before = None
    while kept != state.found:
        before = before or (plot_data(view), seen)
        state = fit_with_fewest_changes(axis, kept, model)
        view = whiten_axis(axis, state.likely)
        seen = run_diagnostics(view)
        kept = tuple(effect for effect in state.found if not _has_zero_size(effect))
    return Search(start, tuple(rounds), axis, state, plot_data(view), seen, before, rivals)


def _select_trial(
    axis: Axis,
    state: Hypothesis,
    trials: list[Trial],
    view: WhitenedAxis,
    seen: Findings,
    null: Mapping[str, NullDistribution],
    rng: np.random.Generator,
) -> tuple[Axis, Round] | None:
    """Return the best trial of one kind that passes cross-validation, or None."""
    strongest = max(seen, key=lambda name: seen[name].gain - null[name].threshold)
    for at, trial in enumerate(trials[:MAX_VALIDATION_ATTEMPTS]):
        if trial.value <= 0.0 or trial.name == UNNAMED:
            return None
        lens = NATURAL_DIAGNOSTIC.get(trial.name, strongest)
        found = state.found if trial.effect is None else (*state.found, trial.effect)
        mended = repair_again(axis, (*state.model, *found), rng) if type(trial.effect) in REPAIRED_EFFECTS else axis
        after = drop_unneeded_effects(mended, fit_with_fewest_changes(mended, found, state.model))
        if trial.effect is not None and _has_zero_size(after.found[-1]):
            continue
        if (
            trial.name in ONE_TIME_EFFECTS
            and DIAGNOSTICS[lens](whiten_axis(mended, after.likely)).gain >= seen[lens].gain
        ):
            continue
        added = None if trial.effect is None else after.found[-1]
        told = trials[at:]
        beside = whiten_axis(mended, after.likely)
        if _is_gaussian_and_stationary(beside, null):
            after, told = resolve_distribution(mended, after, told, beside)
        proven = cross_validate(mended, state, after, added, lens, null[lens], rng)
        if proven.kept:
            return mended, Round(plot_data(view), seen, tuple(told), after, proven)
    return None


def resolve_distribution(
    axis: Axis, state: Hypothesis, trials: list[Trial], view: WhitenedAxis
) -> tuple[Hypothesis, list[Trial]]:
    """Replace a new effect by one with the same spectrum if its distribution fits better.

    Parameters
    ----------
    axis : Axis
        Axis to fit.
    state : Hypothesis
        Fitted effects, of which the last one is new.
    trials : list of Trial
        Trials of which the first one was selected.
    view : Sight
        Axis whitened by ``state``.

    Returns
    -------
    state : Hypothesis
        Fitted effects with the selected alternative.
    trials : list of Trial
        Trials with the alternatives included.
    """
    last, alternative = len(state.effects) - 1, None
    if isinstance(trials[0].effect, ExponentiallyCorrelated) and isinstance(
        state.effects[last], ExponentiallyCorrelated
    ):
        alternative = fit_telegraph_alternative(axis, state, last)
    elif isinstance(trials[0].effect, BiasStep):
        alternative = compare_jump_processes(axis, state, view)
    if alternative is None:
        return state, trials
    named = _trials_of_alternative(alternative, trials[0].value)
    if alternative.gain <= MIN_ALTERNATIVE_GAIN_NATS:
        return state, [trials[0], *named, *trials[1:]]
    return fit_with_fewest_changes(axis, alternative.found, state.model), [*named, *trials]


def compare_jump_processes(axis: Axis, state: Hypothesis, view: WhitenedAxis) -> NonGaussianAlternative | None:
    """Return Poisson steps as alternative to a random walk or single steps, or a slow telegraph if it fits better.

    Parameters
    ----------
    axis : Axis
        Axis to fit.
    state : Hypothesis
        Fitted effects.
    view : Sight
        Axis whitened by ``state``.

    Returns
    -------
    NonGaussianAlternative or None
        The alternative, or None if the axis has no random walk and no steps that it could replace.
    """
    steps = fit_poisson_alternative(axis, state)
    if steps is None or steps.gain <= MIN_ALTERNATIVE_GAIN_NATS:
        return steps
    # Use the original random walk of the model. An increased random walk would leave nothing for a telegraph.
    walks = frozenset(at for at, effect in enumerate(state.model) if type(effect) in WALK_EFFECTS)
    held = state.likely.held | walks
    known = [state.model[at] if at in walks else state.effects[at] for at in range(state.given)]
    bare = (*known, *(one for one in state.found if type(one) not in WALK_EFFECTS))
    for noise in propose_correlated_noise(axis, Hypothesis(state.model, axis.fit(bare, held)), view):
        other = Hypothesis(state.model, axis.fit((*bare, noise), held))
        if _has_zero_size(other.found[-1]):
            continue
        switching = fit_telegraph_alternative(axis, other, len(other.effects) - 1)
        if switching is None or switching.events < MIN_SWITCHES:
            continue
        over = other.likely.log_likelihood + switching.gain - steps.whole
        over -= PENALTY_NATS["random_telegraph"] - PENALTY_NATS["poisson_steps"]
        if over > 0.0:
            return replace(switching, gain=steps.gain + over, rival=steps)
    return steps


def _is_gaussian_and_stationary(view: WhitenedAxis, null: Mapping[str, NullDistribution]) -> bool:
    """Return True if the samples are Gaussian and stationary.

    Otherwise, effects that differ only in their distribution cannot be distinguished.
    """
    return all(DIAGNOSTICS[lens](view).gain <= null[lens].threshold for lens in DISTRIBUTION_DIAGNOSTICS)


def drop_unneeded_effects(axis: Axis, state: Hypothesis) -> Hypothesis:
    """Return the hypothesis without effects from earlier rounds that no longer contribute.

    Parameters
    ----------
    axis : Axis
        Axis to fit.
    state : Hypothesis
        Fitted effects. The last one is never dropped.
    """
    for at in range(len(state.found) - 2, -1, -1):
        effect = state.found[at]
        less = fit_with_fewest_changes(axis, state.found[:at] + state.found[at + 1 :], state.model)
        if (
            state.score - less.score < 0.5 * PENALTY_NATS.get(effect.name, 0.0)
            and type(effect) in NOISE_SIZE_PARAMETERS | DETERMINISTIC_SIZE_PARAMETERS
        ):
            state = less
    return state


def _gains_by_type(rounds: list[Round]) -> dict[type[Effect], float]:
    """Return, for each type of effect, the largest gain of a diagnostic when an effect of this type was selected.

    For leaks, steps and smooth spectra, only their natural diagnostic counts.
    """
    found: dict[type[Effect], float] = {}
    for one in rounds:
        if one.state.found:
            kind = type(one.state.found[-1])
            own = issubclass(kind, (Leak, BiasStep, *SMOOTH_SPECTRA))
            lenses = (NATURAL_DIAGNOSTIC[kind.name],) if own else tuple(one.seen)
            found[kind] = max(found.get(kind, 0.0), *(one.seen[lens].gain for lens in lenses))
    return found


def _has_zero_size(effect: Effect) -> bool:
    """Return True if the fit gave a noise effect the size zero."""
    return type(effect) in NOISE_SIZE_PARAMETERS and size(effect) == 0.0


def _trials_of_alternative(alternative: NonGaussianAlternative, value: float) -> tuple[Trial, ...]:
    """Return the trials of an alternative to an effect with the given value in nats, and of its own rival."""
    effect = alternative.found[-1]
    one = Trial(effect.name, effect, value + alternative.gain, bounds=alternative.bounds, events=alternative.events)
    return (one,) if alternative.rival is None else (one, *_trials_of_alternative(alternative.rival, value))
