"""Effects that no second moment can tell apart: which of two was it?

Correlated noise or a random telegraph; a random walk, Poisson steps, or a few single steps. The search finds the first
of each pair, whose likelihood is Gaussian; here the other is given its own likelihood, on the axis with everything else
as it was found, and takes the place if it is better by WORTH.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Final

from monitor.noise.effect import Effect
from monitor.noise.effects import (
    AngleRandomWalk,
    BiasInstability,
    BiasStep,
    ExponentiallyCorrelated,
    PoissonSteps,
    RandomTelegraph,
    RateRandomWalk,
)
from monitor.reconcile.axis import Axis, Effects
from monitor.reconcile.bins import series
from monitor.reconcile.hidden import Rest
from monitor.reconcile.hypothesis import RETUNED, Hypothesis, settled
from monitor.reconcile.reconciliation import Bounds
from monitor.reconcile.steps import steps_or_walk
from monitor.reconcile.telegraph import telegraph_or_correlated

WORTH: Final = 2.0
"""Nats."""
PRICE_OF_STEPS: Final = 14.5
PRICE_OF_POISSON: Final = 10.0
SEVERAL: Final = 2
"""Single steps from which on Poisson steps are asked for."""


@dataclass(frozen=True, slots=True)
class Twin:
    """The other of two effects."""

    effects: Effects  # of the axis, the twin last, in the place of what was found
    gain: float  # nats over that
    bounds: Mapping[str, Bounds]  # its parameters
    events: int  # switches or jumps that were seen


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
    kept = (*state.effects[:at], *state.effects[at + 1 :], effect)
    return Twin(kept, contest.gain, contest.first, contest.events)


def poisson(axis: Axis, state: Hypothesis, model: Effects) -> Twin | None:
    """Poisson steps instead of single steps or of a stronger random walk; None where there are neither.

    Args:
        model: the effects of the model under test, with their own sizes
    """
    steps = [at for at in range(state.given, len(state.effects)) if isinstance(state.effects[at], BiasStep)]
    walks = [at for at, effect in enumerate(state.effects) if isinstance(effect, RateRandomWalk)]
    stronger = [at for at in walks if at >= state.given or at in state.likely.noises]
    if len(steps) < SEVERAL and not stronger:
        return None
    # the random walk that the model had stays, the steps or what the walk grew by are in question
    plain: list[Effect] = [effect for at, effect in enumerate(state.effects) if at not in steps]
    known = 0.0
    for at in walks:
        if at < state.given:
            known = float(model[at].K)  # type: ignore[attr-defined]
    bare = [e for at, e in enumerate(plain) if not (isinstance(e, RateRandomWalk) and at >= state.given)]
    without = settled(axis, bare, state.given)
    loose = axis.fit((*bare, RateRandomWalk(K=max(known, 1e-12))), frozenset(_held(without)))
    excess = float(loose.effects[-1].K)  # type: ignore[attr-defined]
    rest = replace(_rest(tuple(bare)), walk=known**2)
    if not (excess > 0.0 and rest.white > 0.0):
        return None
    contest = steps_or_walk(series(axis.residual(without.likely)), 1.0 / axis.rate_hz, rest, excess)
    held = axis.fit(bare, frozenset(_held(without)))
    gain = loose.log_likelihood - held.log_likelihood + contest.gain - PRICE_OF_POISSON
    rival = state.score - (held.log_likelihood - RETUNED * (len(without.likely.noises))) - PRICE_OF_STEPS * len(steps)
    rate, height = (float(contest.first[name].value) for name in ("rate", "height"))
    back = tuple(model[at] if at in walks and at < state.given else effect for at, effect in enumerate(bare))
    kept = (*back, PoissonSteps(rate=rate, height=height))
    return Twin(kept, gain - rival, contest.first, contest.events)


def _held(state: Hypothesis) -> list[int]:
    """All given noises, at the sizes they have."""
    return [at for at in range(state.given) if at in state.likely.held]


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
