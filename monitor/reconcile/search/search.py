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
from monitor.reconcile.diagnostics.diagnostics import LENSES, Sight, sight
from monitor.reconcile.diagnostics.figures import views
from monitor.reconcile.diagnostics.gap import Findings, Null, look
from monitor.reconcile.likelihood.effect_terms import COURSE, NATURAL, NOISE, ONCE, size
from monitor.reconcile.likelihood.hypothesis import Hypothesis, believed, settled
from monitor.reconcile.preparation.axis import Axis, Effects
from monitor.reconcile.preparation.cosine_bins import bins
from monitor.reconcile.preparation.prepare import again
from monitor.reconcile.result import View
from monitor.reconcile.search.candidates import PRICE, correlated, peaks
from monitor.reconcile.search.cross_validation import CrossValidation, proof
from monitor.reconcile.search.non_gaussian_alternatives import (
    MIN_ALTERNATIVE_GAIN_NATS,
    NonGaussianAlternative,
    poisson,
    telegraph,
)
from monitor.reconcile.search.trials import UNNAMED, Trial, replacements_for_resizing, tried
from monitor.reconcile.search.withdrawal import SMOOTH_SPECTRA, upheld

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

    views: tuple[View, ...]  # before the round
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
    views: tuple[View, ...]  # at the end
    seen: Findings  # at the end
    before: tuple[tuple[View, ...], Findings] | None  # state before effects were withdrawn; None if none were
    rivals: tuple[Trial, ...]  # trials of a last round that selected nothing


def search(axis: Axis, model: Effects, null: Mapping[str, Null], rng: np.random.Generator) -> Search:
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
    state = start = believed(axis, model)
    rounds: list[Round] = []
    rivals: tuple[Trial, ...] = ()
    while True:
        view = sight(axis, state.likely)
        seen = look(view)
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
            state = settled(axis, jumps.found, model)
            rounds.append(Round(views(view), seen, _trials_of_alternative(jumps, 0.0), state, SHARED_SPECTRUM))
            continue
        finer = bins(axis.n, axis.rate_hz, peaks(view))
        if finer.count.size > axis.bins.count.size + 8:
            axis = axis.rebinned(finer)
            state = Hypothesis(model, axis.fit(state.effects, state.likely.held))
            start = start if rounds else state
            view = sight(axis, state.likely)
        asked: list[Trial] = []
        taken = None
        for trials in [better] if better else tried(axis, state, view):
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
    kept = tuple(effect for effect in upheld(state, _gains_by_type(rounds), seen, null) if not _has_zero_size(effect))
    before = None
    while kept != state.found:
        before = before or (views(view), seen)
        state = settled(axis, kept, model)
        view = sight(axis, state.likely)
        seen = look(view)
        kept = tuple(effect for effect in state.found if not _has_zero_size(effect))
    return Search(start, tuple(rounds), axis, state, views(view), seen, before, rivals)


def _select_trial(
    axis: Axis,
    state: Hypothesis,
    trials: list[Trial],
    view: Sight,
    seen: Findings,
    null: Mapping[str, Null],
    rng: np.random.Generator,
) -> tuple[Axis, Round] | None:
    """Return the best trial of one kind that passes cross-validation, or None."""
    strongest = max(seen, key=lambda name: seen[name].gain - null[name].threshold)
    for at, trial in enumerate(trials[:MAX_VALIDATION_ATTEMPTS]):
        if trial.value <= 0.0 or trial.name == UNNAMED:
            return None
        lens = NATURAL.get(trial.name, strongest)
        found = state.found if trial.effect is None else (*state.found, trial.effect)
        mended = again(axis, (*state.model, *found), rng) if type(trial.effect) in REPAIRED_EFFECTS else axis
        after = pruned(mended, settled(mended, found, state.model))
        if trial.effect is not None and _has_zero_size(after.found[-1]):
            continue
        if trial.name in ONCE and LENSES[lens](sight(mended, after.likely)).gain >= seen[lens].gain:
            continue
        added = None if trial.effect is None else after.found[-1]
        told = trials[at:]
        beside = sight(mended, after.likely)
        if _is_gaussian_and_stationary(beside, null):
            after, told = resolve_distribution(mended, after, told, beside)
        proven = proof(mended, state, after, added, lens, null[lens], rng)
        if proven.kept:
            return mended, Round(views(view), seen, tuple(told), after, proven)
    return None


def resolve_distribution(
    axis: Axis, state: Hypothesis, trials: list[Trial], view: Sight
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
        alternative = telegraph(axis, state, last)
    elif isinstance(trials[0].effect, BiasStep):
        alternative = compare_jump_processes(axis, state, view)
    if alternative is None:
        return state, trials
    named = _trials_of_alternative(alternative, trials[0].value)
    if alternative.gain <= MIN_ALTERNATIVE_GAIN_NATS:
        return state, [trials[0], *named, *trials[1:]]
    return settled(axis, alternative.found, state.model), [*named, *trials]


def compare_jump_processes(axis: Axis, state: Hypothesis, view: Sight) -> NonGaussianAlternative | None:
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
    steps = poisson(axis, state)
    if steps is None or steps.gain <= MIN_ALTERNATIVE_GAIN_NATS:
        return steps
    # Use the original random walk of the model. An increased random walk would leave nothing for a telegraph.
    walks = frozenset(at for at, effect in enumerate(state.model) if type(effect) in WALK_EFFECTS)
    held = state.likely.held | walks
    known = [state.model[at] if at in walks else state.effects[at] for at in range(state.given)]
    bare = (*known, *(one for one in state.found if type(one) not in WALK_EFFECTS))
    for noise in correlated(axis, Hypothesis(state.model, axis.fit(bare, held)), view):
        other = Hypothesis(state.model, axis.fit((*bare, noise), held))
        if _has_zero_size(other.found[-1]):
            continue
        switching = telegraph(axis, other, len(other.effects) - 1)
        if switching is None or switching.events < MIN_SWITCHES:
            continue
        over = other.likely.log_likelihood + switching.gain - steps.whole
        over -= PRICE["random_telegraph"] - PRICE["poisson_steps"]
        if over > 0.0:
            return replace(switching, gain=steps.gain + over, rival=steps)
    return steps


def _is_gaussian_and_stationary(view: Sight, null: Mapping[str, Null]) -> bool:
    """Return True if the samples are Gaussian and stationary.

    Otherwise, effects that differ only in their distribution cannot be distinguished.
    """
    return all(LENSES[lens](view).gain <= null[lens].threshold for lens in DISTRIBUTION_DIAGNOSTICS)


def pruned(axis: Axis, state: Hypothesis) -> Hypothesis:
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
        less = settled(axis, state.found[:at] + state.found[at + 1 :], state.model)
        if state.score - less.score < 0.5 * PRICE.get(effect.name, 0.0) and type(effect) in NOISE | COURSE:
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
            lenses = (NATURAL[kind.name],) if own else tuple(one.seen)
            found[kind] = max(found.get(kind, 0.0), *(one.seen[lens].gain for lens in lenses))
    return found


def _has_zero_size(effect: Effect) -> bool:
    """Return True if the fit gave a noise effect the size zero."""
    return type(effect) in NOISE and size(effect) == 0.0


def _trials_of_alternative(alternative: NonGaussianAlternative, value: float) -> tuple[Trial, ...]:
    """Return the trials of an alternative to an effect with the given value in nats, and of its own rival."""
    effect = alternative.found[-1]
    one = Trial(effect.name, effect, value + alternative.gain, bounds=alternative.bounds, events=alternative.events)
    return (one,) if alternative.rival is None else (one, *_trials_of_alternative(alternative.rival, value))
