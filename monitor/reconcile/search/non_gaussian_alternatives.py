"""Alternatives to Gaussian effects that have the same spectrum but another distribution.

The pairs are correlated noise and random telegraph, random walk and Poisson steps, and single steps and Poisson steps.
The search first finds the effect with a Gaussian likelihood. Here the alternative gets its own likelihood on the same
axis, with all other effects unchanged. It replaces the effect if it is better by ``MIN_ALTERNATIVE_GAIN_NATS``.
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
from monitor.reconcile.likelihood.hidden_state import BackgroundNoise
from monitor.reconcile.likelihood.hypothesis import Hypothesis
from monitor.reconcile.likelihood.poisson_steps import compare_steps_with_random_walk
from monitor.reconcile.likelihood.random_telegraph import compare_telegraph_with_correlated
from monitor.reconcile.likelihood.single_steps import compare_steps_with_single_steps
from monitor.reconcile.preparation.axis import Axis, Effects
from monitor.reconcile.preparation.cosine_bins import inverse_cosine_transform
from monitor.reconcile.result import ParameterInterval

MIN_ALTERNATIVE_GAIN_NATS: Final = 3.0
"""Gain in nats that an alternative must reach. In 2 of 4000 simulated recordings, telegraph and correlated noise were
confused in spite of a larger gain.
"""
POISSON_PENALTY_NATS: Final = 1.0
"""Additional gain in nats that Poisson steps must reach. A random walk is their limit and never fits better."""
MAX_FREE_STEPS: Final = 2
"""Number of single steps without an additional penalty."""
STEP_PENALTY_NATS: Final = 3.0
"""Penalty in nats for each further single step. A new effect costs more than a new step time."""
MIN_FITTED_STEPS: Final = 5
"""Smallest limit for the number of single steps that are compared with Poisson steps."""


@dataclass(frozen=True, slots=True)
class NonGaussianAlternative:
    """Alternative effect with the same spectrum as an effect that was found, but another distribution."""

    found: Effects  # effects beyond the model; the alternative comes last and replaces the original effect
    gain: float  # log-likelihood gain over the original effect, nats
    bounds: Mapping[str, ParameterInterval]  # parameters of the alternative
    events: int  # number of switches or jumps
    whole: float = 0.0  # log-likelihood with Poisson steps: that of a random walk plus their gain over it
    rival: "NonGaussianAlternative | None" = None  # the alternative that this one was preferred to


def fit_telegraph_alternative(axis: Axis, state: Hypothesis, at: int) -> NonGaussianAlternative | None:
    """Return a random telegraph as alternative to correlated noise.

    Parameters
    ----------
    axis : Axis
        Axis to fit.
    state : Hypothesis
        Fitted effects.
    at : int
        Index of the correlated noise.

    Returns
    -------
    NonGaussianAlternative or None
        The alternative, or None if the axis has no white noise.
    """
    noise = state.effects[at]
    assert isinstance(noise, ExponentiallyCorrelated)
    rest = _background_noise(state.effects, without=at)
    if not rest.white > 0.0:
        return None
    contest = compare_telegraph_with_correlated(
        inverse_cosine_transform(axis.residual(state.likely)),
        1.0 / axis.rate_hz,
        rest,
        noise.sigma,
        noise.correlation_time,
    )
    amplitude, dwell = (float(contest.first[name].value) for name in ("amplitude", "dwell_time"))
    effect = RandomTelegraph(amplitude=amplitude, dwell_time=dwell)
    found = (*state.effects[state.given : at], *state.effects[at + 1 :], effect)
    return NonGaussianAlternative(found, contest.gain, contest.first, contest.events)


def fit_poisson_alternative(axis: Axis, state: Hypothesis) -> NonGaussianAlternative | None:
    """Return Poisson steps as alternative to single steps or to an increased random walk.

    Parameters
    ----------
    axis : Axis
        Axis to fit.
    state : Hypothesis
        Fitted effects.

    Returns
    -------
    NonGaussianAlternative or None
        The alternative, or None if the axis has neither single steps nor an increased random walk.
    """
    steps = [effect for effect in state.found if isinstance(effect, BiasStep)]
    walks = [at for at, effect in enumerate(state.effects) if isinstance(effect, RateRandomWalk)]
    stronger = any(at >= state.given or at in state.likely.noises for at in walks)
    if not steps and not stronger:
        return None
    # The random walk of the model keeps its original size. The steps, or the increase of the random walk, are tested.
    bare = tuple(effect for effect in state.found if not isinstance(effect, (BiasStep, RateRandomWalk)))
    sizes = tuple(
        model if at in walks else now for at, (model, now) in enumerate(zip(state.model, state.effects, strict=False))
    )
    held = frozenset(at for at in range(state.given) if at in state.likely.held or at in walks)
    without = axis.fit((*sizes, *bare), held)
    known = max((size(sizes[at]) for at in walks if at < state.given), default=0.0)
    walk = axis.fit((*sizes, *bare, RateRandomWalk(K=max(known, 1e-12))), held)
    excess = size(walk.effects[-1])
    rest = _background_noise(without.effects)
    if not (excess > 0.0 and rest.white > 0.0):
        return None
    left, tau0_s = inverse_cosine_transform(axis.residual(without)), 1.0 / axis.rate_hz
    contest = compare_steps_with_random_walk(left, tau0_s, rest, excess)
    gain, whole = contest.gain, walk.log_likelihood + contest.gain
    if steps:
        contest = compare_steps_with_single_steps(left, tau0_s, rest, excess, most=max(len(steps), MIN_FITTED_STEPS))
        single = sum(name.startswith("time") for name in contest.second)
        gain = contest.gain + STEP_PENALTY_NATS * max(single - MAX_FREE_STEPS, 0)
    rate, height = (float(contest.first[name].value) for name in ("rate", "height"))
    found = (*bare, PoissonSteps(rate=rate, height=height))
    return NonGaussianAlternative(found, gain - POISSON_PENALTY_NATS, contest.first, contest.events, whole=whole)


def _background_noise(effects: Effects, without: int | None = None) -> BackgroundNoise:
    """Return the noise of an axis, without one effect, in the form that the likelihood ratios use."""
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
    return BackgroundNoise(white, walk, flicker, tuple(correlated))
