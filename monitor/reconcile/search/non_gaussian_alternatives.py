"""Effects that no second moment can tell apart: which of two was it?

Correlated noise or a random telegraph; a random walk, Poisson steps, or a few single steps. The search finds the first
of each pair, whose likelihood is Gaussian; here the other is given its own likelihood, on the axis with everything else
as it was found, and takes the place if it is better by WORTH.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

from monitor.noise.effects import (
    AngleRandomWalk,
    BiasInstability,
    BiasStep,
    ExponentiallyCorrelated,
    PoissonSteps,
    RandomTelegraph,
    RateRandomWalk,
)
from monitor.reconcile.likelihood.effect_terms import size
from monitor.reconcile.likelihood.hidden_state import Rest
from monitor.reconcile.likelihood.hypothesis import Hypothesis
from monitor.reconcile.likelihood.poisson_steps import steps_or_walk
from monitor.reconcile.likelihood.random_telegraph import telegraph_or_correlated
from monitor.reconcile.likelihood.single_steps import steps_or_once
from monitor.reconcile.preparation.axis import Axis, Effects
from monitor.reconcile.preparation.cosine_bins import series
from monitor.reconcile.result import Bounds

WORTH: Final = 3.0
"""Nats: of 4000 simulated records two told a telegraph from correlated noise wrongly beyond that."""
CAUTION: Final = 1.0
"""Nats that Poisson steps must be worth beyond: a random walk is their limit, and never does better."""
FEW: Final = 2
MORE: Final = 3.0
"""Nats by which each single step beyond FEW is less likely to be one by itself: a name costs that more than a time."""
SINGLE: Final = 5
"""Single steps that are fitted beside Poisson steps, at least."""


@dataclass(frozen=True, slots=True)
class Twin:
    """The other of two effects."""

    found: Effects  # beyond the model, the twin last, in the place of what was found
    gain: float  # nats over that
    bounds: Mapping[str, Bounds]  # its parameters
    events: int  # switches or jumps that were seen
    whole: float = 0.0  # ln L with Poisson steps: that of the walk which is their limit, and what they gain over it
    rival: "Twin | None" = None  # what it would have been otherwise


def telegraph(axis: Axis, state: Hypothesis, at: int) -> Twin | None:
    """A telegraph instead of the correlated noise at an index; None where that cannot be asked."""
    noise = state.effects[at]
    assert isinstance(noise, ExponentiallyCorrelated)
    rest = _rest(state.effects, without=at)
    if not rest.white > 0.0:
        return None
    contest = telegraph_or_correlated(
        series(axis.residual(state.likely)), 1.0 / axis.rate_hz, rest, noise.sigma, noise.correlation_time
    )
    amplitude, dwell = (float(contest.first[name].value) for name in ("amplitude", "dwell_time"))
    effect = RandomTelegraph(amplitude=amplitude, dwell_time=dwell)
    found = (*state.effects[state.given : at], *state.effects[at + 1 :], effect)
    return Twin(found, contest.gain, contest.first, contest.events)


def poisson(axis: Axis, state: Hypothesis) -> Twin | None:
    """Poisson steps instead of single steps, or of a stronger random walk; None where there are neither."""
    steps = [effect for effect in state.found if isinstance(effect, BiasStep)]
    walks = [at for at, effect in enumerate(state.effects) if isinstance(effect, RateRandomWalk)]
    stronger = any(at >= state.given or at in state.likely.noises for at in walks)
    if not steps and not stronger:
        return None
    # the random walk of the model stays as it was; in question are the steps, or what the walk grew by
    bare = tuple(effect for effect in state.found if not isinstance(effect, (BiasStep, RateRandomWalk)))
    sizes = tuple(
        model if at in walks else now for at, (model, now) in enumerate(zip(state.model, state.effects, strict=False))
    )
    held = frozenset(at for at in range(state.given) if at in state.likely.held or at in walks)
    without = axis.fit((*sizes, *bare), held)
    known = max((size(sizes[at]) for at in walks if at < state.given), default=0.0)
    walk = axis.fit((*sizes, *bare, RateRandomWalk(K=max(known, 1e-12))), held)
    excess = size(walk.effects[-1])
    rest = _rest(without.effects)
    if not (excess > 0.0 and rest.white > 0.0):
        return None
    left, tau0_s = series(axis.residual(without)), 1.0 / axis.rate_hz
    contest = steps_or_walk(left, tau0_s, rest, excess)
    gain, whole = contest.gain, walk.log_likelihood + contest.gain
    if steps:
        contest = steps_or_once(left, tau0_s, rest, excess, most=max(len(steps), SINGLE))
        single = sum(name.startswith("time") for name in contest.second)
        gain = contest.gain + MORE * max(single - FEW, 0)
    rate, height = (float(contest.first[name].value) for name in ("rate", "height"))
    found = (*bare, PoissonSteps(rate=rate, height=height))
    return Twin(found, gain - CAUTION, contest.first, contest.events, whole=whole)


def _rest(effects: Effects, without: int | None = None) -> Rest:
    """The noise of an axis, but for one effect, as the contests take it."""
    white = walk = flicker = 0.0
    correlated: list[tuple[float, float]] = []
    for at, effect in enumerate(effects):
        if at == without:
            continue
        match effect:
            case AngleRandomWalk():
                white += effect.N**2
            case RateRandomWalk():
                walk += effect.K**2
            case PoissonSteps():
                walk += effect.rate * effect.height**2
            case BiasInstability():
                flicker += effect.B**2
            case ExponentiallyCorrelated():
                correlated.append((effect.sigma, effect.correlation_time))
            case RandomTelegraph():
                correlated.append((0.5 * effect.amplitude, 0.5 * effect.dwell_time))
    return Rest(white, walk, flicker, tuple(correlated))
