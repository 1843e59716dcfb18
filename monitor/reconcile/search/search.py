"""The search on one axis: look, try what may be missing, keep the best, look again.

One round: the axis is made white by the model and looked at; if nothing passes its threshold, the round was the last.
Else the candidates of ``trials`` are asked, one kind after the other, until one of them is worth its price and holds
on data that did not choose it. What was found earlier and is worth nothing any more is dropped. When spectrum and
level are closed, twins are told apart; at the end names that do not stand are withdrawn.
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
from monitor.reconcile.search.cross_validation import Proof, proof
from monitor.reconcile.search.non_gaussian_alternatives import WORTH, Twin, poisson, telegraph
from monitor.reconcile.search.trials import NAMELESS, Trial, instead, tried
from monitor.reconcile.search.withdrawal import SMOOTH, upheld

ROUNDS: Final = 8
CHANCES: Final = 3
"""Candidates of one kind that may fail on unseen data before the next kind is asked."""
MENDED: Final = frozenset({Saturation, SampleHold, Outliers})
"""Effects after which the samples are put right."""
DISTRIBUTION: Final = ("tails", "variance")
"""Lenses that tell whether samples are Gaussian and steady."""
SWITCHES: Final = 10
"""Of a telegraph that is told from Poisson steps: fewer may well alternate by chance."""
WALKS: Final = frozenset({BiasStep, RateRandomWalk})
"""Effects that jumps are told from."""
SHARED: Final = Proof(float("nan"), float("nan"), True, "its spectrum is that of what it stands for, and was held out")
"""Of a twin that is told by its distribution."""


@dataclass(frozen=True, slots=True)
class Round:
    """What one round found."""

    views: tuple[View, ...]  # before
    seen: Findings  # before
    trials: tuple[Trial, ...]  # the first was taken; the others best first
    state: Hypothesis  # after
    proof: Proof


@dataclass(frozen=True, slots=True)
class Search:
    """All rounds on one axis."""

    start: Hypothesis  # the model as it stands
    rounds: tuple[Round, ...]
    axis: Axis  # mended, with bins as fine as its peaks
    state: Hypothesis
    views: tuple[View, ...]  # at the end
    seen: Findings
    before: tuple[tuple[View, ...], Findings] | None  # before names were withdrawn, if any were
    rivals: tuple[Trial, ...]  # of a round that took nothing


def search(axis: Axis, model: Effects, null: Mapping[str, Null], rng: np.random.Generator) -> Search:
    """Explain one axis.

    Args:
        axis: prepared by the model
        model: effects of the axis in the model under test
        null: of each lens
        rng: for what fills the place of samples that are found to be wrong
    """
    state = start = believed(axis, model)
    rounds: list[Round] = []
    rivals: tuple[Trial, ...] = ()
    while True:
        view = sight(axis, state.likely)
        seen = look(view)
        closed = not any(one.gain > null[lens].threshold for lens, one in seen.items())
        if len(rounds) == ROUNDS:
            break
        better = instead(axis, state, view) if closed and state.freed else []
        if closed and not better:
            jumps = jumping(axis, state, view) if rounds and _well_formed(view, null) else None
            if jumps is None or jumps.gain <= WORTH:
                break
            state = settled(axis, jumps.found, model)
            rounds.append(Round(views(view), seen, _names(jumps, 0.0), state, SHARED))
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
            taken = _taken(axis, state, trials, view, seen, null, rng)
            if taken is not None or (trials and trials[0].name == NAMELESS):
                break
        if taken is None:
            rivals = tuple(sorted(asked, key=lambda one: -one.value))
            break
        axis, done = taken
        state = done.state
        rounds.append(done)
    kept = tuple(effect for effect in upheld(state, _closing(rounds), seen, null) if not _nothing(effect))
    before = None
    while kept != state.found:
        before = before or (views(view), seen)
        state = settled(axis, kept, model)
        view = sight(axis, state.likely)
        seen = look(view)
        kept = tuple(effect for effect in state.found if not _nothing(effect))
    return Search(start, tuple(rounds), axis, state, views(view), seen, before, rivals)


def _taken(
    axis: Axis,
    state: Hypothesis,
    trials: list[Trial],
    view: Sight,
    seen: Findings,
    null: Mapping[str, Null],
    rng: np.random.Generator,
) -> tuple[Axis, Round] | None:
    """The best trial of one kind that holds on data that did not choose it."""
    strongest = max(seen, key=lambda name: seen[name].gain - null[name].threshold)
    for at, trial in enumerate(trials[:CHANCES]):
        if trial.value <= 0.0 or trial.name == NAMELESS:
            return None
        lens = NATURAL.get(trial.name, strongest)
        found = state.found if trial.effect is None else (*state.found, trial.effect)
        mended = again(axis, (*state.model, *found), rng) if type(trial.effect) in MENDED else axis
        after = pruned(mended, settled(mended, found, state.model))
        if trial.effect is not None and _nothing(after.found[-1]):
            continue
        if trial.name in ONCE and LENSES[lens](sight(mended, after.likely)).gain >= seen[lens].gain:
            continue
        added = None if trial.effect is None else after.found[-1]
        told = trials[at:]
        beside = sight(mended, after.likely)
        if _well_formed(beside, null):
            after, told = told_apart(mended, after, told, beside)
        proven = proof(mended, state, after, added, lens, null[lens], rng)
        if proven.kept:
            return mended, Round(views(view), seen, tuple(told), after, proven)
    return None


def told_apart(axis: Axis, state: Hypothesis, trials: list[Trial], view: Sight) -> tuple[Hypothesis, list[Trial]]:
    """The state with what was just found under its right name, where second moments do not tell."""
    last, twin = len(state.effects) - 1, None
    if isinstance(trials[0].effect, ExponentiallyCorrelated) and isinstance(
        state.effects[last], ExponentiallyCorrelated
    ):
        twin = telegraph(axis, state, last)
    elif isinstance(trials[0].effect, BiasStep):
        twin = jumping(axis, state, view)
    if twin is None:
        return state, trials
    named = _names(twin, trials[0].value)
    if twin.gain <= WORTH:
        return state, [trials[0], *named, *trials[1:]]
    return settled(axis, twin.found, state.model), [*named, *trials]


def jumping(axis: Axis, state: Hypothesis, view: Sight) -> Twin | None:
    """Poisson steps instead of a walk or of single steps, or a slow telegraph where that explains the same better."""
    steps = poisson(axis, state)
    if steps is None or steps.gain <= WORTH:
        return steps
    # the walk of the model as it was: with what it grew by, a telegraph would have nothing left to explain
    walks = frozenset(at for at, effect in enumerate(state.model) if type(effect) in WALKS)
    held = state.likely.held | walks
    known = [state.model[at] if at in walks else state.effects[at] for at in range(state.given)]
    bare = (*known, *(one for one in state.found if type(one) not in WALKS))
    for noise in correlated(axis, Hypothesis(state.model, axis.fit(bare, held)), view):
        other = Hypothesis(state.model, axis.fit((*bare, noise), held))
        if _nothing(other.found[-1]):
            continue
        switching = telegraph(axis, other, len(other.effects) - 1)
        if switching is None or switching.events < SWITCHES:
            continue
        over = other.likely.log_likelihood + switching.gain - steps.whole
        over -= PRICE["random_telegraph"] - PRICE["poisson_steps"]
        if over > 0.0:
            return replace(switching, gain=steps.gain + over, rival=steps)
    return steps


def _well_formed(view: Sight, null: Mapping[str, Null]) -> bool:
    """Whether samples are Gaussian and steady: among others, names that rest on a distribution mean nothing."""
    return all(LENSES[lens](view).gain <= null[lens].threshold for lens in DISTRIBUTION)


def pruned(axis: Axis, state: Hypothesis) -> Hypothesis:
    """Without what was found before and is worth nothing any more."""
    for at in range(len(state.found) - 2, -1, -1):
        effect = state.found[at]
        less = settled(axis, state.found[:at] + state.found[at + 1 :], state.model)
        if state.score - less.score < 0.5 * PRICE.get(effect.name, 0.0) and type(effect) in NOISE | COURSE:
            state = less
    return state


def _closing(rounds: list[Round]) -> dict[type[Effect], float]:
    """Kind of effect -> the largest gain of a lens when one of its kind was taken: what it was to close.

    Of leaks, steps and smooth spectra, that of the lens which shows them.
    """
    found: dict[type[Effect], float] = {}
    for one in rounds:
        if one.state.found:
            kind = type(one.state.found[-1])
            own = issubclass(kind, (Leak, BiasStep, *SMOOTH))
            lenses = (NATURAL[kind.name],) if own else tuple(one.seen)
            found[kind] = max(found.get(kind, 0.0), *(one.seen[lens].gain for lens in lenses))
    return found


def _nothing(effect: Effect) -> bool:
    """Whether the fit left a noise without any size."""
    return type(effect) in NOISE and size(effect) == 0.0


def _names(twin: Twin, value: float) -> tuple[Trial, ...]:
    """A twin of what is worth ``value``, and the twin's own rival."""
    effect = twin.found[-1]
    one = Trial(effect.name, effect, value + twin.gain, bounds=twin.bounds, events=twin.events)
    return (one,) if twin.rival is None else (one, *_names(twin.rival, value))
