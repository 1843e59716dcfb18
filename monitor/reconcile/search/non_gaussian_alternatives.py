"""Non-Gaussian alternatives that have the same spectrum as a Gaussian effect.

A random telegraph can replace correlated noise. Poisson steps can replace a random walk or single steps. A wandering
line can replace a resonance. The Gaussian effect is replaced if the full log-likelihood of the alternative is larger by
``MIN_ALTERNATIVE_GAIN_NATS``. No effect describes a line whose amplitude varies and whose phase is constant. If such a
line is more likely than a resonance, the resonance is rejected.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Final

from drivers.data_types import Floats
from monitor.noise.effects import (
    AngleRandomWalk,
    BiasInstability,
    BiasStep,
    ExponentiallyCorrelated,
    Narrowband,
    PoissonSteps,
    RandomTelegraph,
    RateRandomWalk,
)
from monitor.reconcile.effect_properties import PENALTY_NATS
from monitor.reconcile.likelihood.axis_fit import AxisFit, Effects
from monitor.reconcile.likelihood.effect_roles import effect_size
from monitor.reconcile.likelihood.event_process_likelihood import BackgroundNoise
from monitor.reconcile.likelihood.hypothesis_fit import RESIZE_PENALTY_NATS, Hypothesis
from monitor.reconcile.likelihood.poisson_steps_vs_random_walk import compare_poisson_with_random_walk
from monitor.reconcile.likelihood.poisson_steps_vs_single_steps import compare_poisson_with_single_steps
from monitor.reconcile.likelihood.telegraph_vs_correlated_noise import compare_telegraph_with_correlated_noise
from monitor.reconcile.likelihood.wandering_line_vs_resonance import (
    WanderingLineComparison,
    compare_wandering_line_with_resonance,
)
from monitor.reconcile.preparation.cosine_bins import inverse_cosine_transform
from monitor.reconcile.result import ParameterInterval
from monitor.reconcile.search.candidate_effects import fit_correlated_noise, initial_effect_size
from monitor.reconcile.search.trials import Trial

MIN_ALTERNATIVE_GAIN_NATS: Final = 3.0
"""Log-likelihood gain that an alternative must exceed, in nats.

In 2 of 4000 simulated recordings, a wrong alternative exceeded this gain.
"""
MIN_LINE_GAIN_NATS: Final = MIN_ALTERNATIVE_GAIN_NATS + PENALTY_NATS["wandering_line"] - PENALTY_NATS["narrowband"]
"""Log-likelihood gain over a resonance that a wandering line must exceed, in nats."""
POISSON_PENALTY_NATS: Final = 1.0
"""Penalty for Poisson steps, in nats. A random walk is a limit of Poisson steps and never fits better."""
MAX_FREE_STEPS: Final = 2
"""Number of single steps without an additional penalty."""
STEP_PENALTY_NATS: Final = 3.0
"""Penalty for each further single step, in nats."""
MIN_FITTED_STEPS: Final = 5
"""Smallest number of single steps that the comparison with Poisson steps may fit."""
MIN_SWITCHES: Final = 10
"""Smallest number of switches at which a telegraph may replace Poisson steps. A few jumps can alternate by chance."""
WALK_EFFECTS: Final = (BiasStep, RateRandomWalk)
"""Effects that Poisson steps or a telegraph can replace."""


@dataclass(frozen=True, slots=True)
class NonGaussianAlternative:
    """Non-Gaussian alternative that has the same spectrum as an added effect."""

    added: Effects  # added effects; the alternative is the last one and replaces the original effect
    gain: float  # log-likelihood gain over the original effect, nats
    intervals: Mapping[str, ParameterInterval]  # parameters of the alternative
    event_count: int  # number of switches or jumps
    poisson_log_likelihood: float = (
        0.0  # log-likelihood with Poisson steps: that of a random walk plus their gain over it
    )
    runner_up: "NonGaussianAlternative | None" = None  # alternative that fits second best

    def as_trials(self, replaced: Trial) -> tuple[Trial, ...]:
        """Convert the alternative and the runner-up to trials.

        ``replaced`` is the trial of the replaced effect.
        """
        effect = self.added[-1]
        trial = Trial(
            effect.name,
            effect,
            replaced.score + self.gain,
            slow_noise_score=replaced.slow_noise_score,
            intervals=self.intervals,
            event_count=self.event_count,
            gain_over_same_spectrum=max(self.gain, 0.0),
        )
        return (trial, *(self.runner_up.as_trials(replaced) if self.runner_up else ()))


def replace_by_likelier_alternative(hypothesis: Hypothesis, trials: list[Trial]) -> tuple[Hypothesis, list[Trial]]:
    """Replace a new effect by a more likely alternative with the same spectrum.

    Parameters
    ----------
    hypothesis : Hypothesis
        Fitted effects, with the new effect at the end.
    trials : list of Trial
        All trials, with the selected trial at the start.

    Returns
    -------
    hypothesis : Hypothesis
        Fitted effects with the selected alternative.
    trials : list of Trial
        All trials, including the alternatives.
    """
    alternative, new = None, trials[0].effect
    if isinstance(new, ExponentiallyCorrelated) and isinstance(hypothesis.effects[-1], ExponentiallyCorrelated):
        alternative = fit_telegraph_alternative(hypothesis, len(hypothesis.effects) - 1)
    elif isinstance(new, BiasStep):
        alternative = choose_poisson_steps_or_telegraph(hypothesis)
    if alternative is None:
        return hypothesis, trials
    added = alternative.as_trials(trials[0])
    if alternative.gain <= MIN_ALTERNATIVE_GAIN_NATS:
        return hypothesis, [trials[0], *added, *trials[1:]]
    return hypothesis.refit_with_other_added_effects(alternative.added), [*added, *trials]


def compare_resonance_with_lines(hypothesis: Hypothesis) -> WanderingLineComparison | None:
    """Compare a new resonance with a wandering line and with a line of varying amplitude.

    Return None if the last added effect is not a resonance, or if the recording is too short.
    """
    if not hypothesis.added or not isinstance(hypothesis.added[-1], Narrowband):
        return None
    return compare_wandering_line_with_resonance(
        _residual_series(hypothesis.fit), hypothesis.axis.rate_hz, hypothesis.added[-1]
    )


def wandering_line_trial(compared: WanderingLineComparison, replaced: Trial) -> Trial:
    """Return the trial of a wandering line that competes with the trial of a resonance."""
    score = replaced.score + compared.gain + PENALTY_NATS["narrowband"] - PENALTY_NATS["wandering_line"]
    line = compared.line
    return Trial(line.name, line, score, slow_noise_score=replaced.slow_noise_score, intervals=compared.parameters)


def choose_poisson_steps_or_telegraph(hypothesis: Hypothesis) -> NonGaussianAlternative | None:
    """Return Poisson steps or a slow random telegraph, whichever is more likely, or None if neither applies."""
    steps = fit_poisson_alternative(hypothesis)
    if steps is None or steps.gain <= MIN_ALTERNATIVE_GAIN_NATS:
        return steps
    # a random walk with the fitted size would contain the power of a telegraph
    bare, fixed_sizes = _with_original_walks(hypothesis)
    for noise in fit_correlated_noise(hypothesis.axis, hypothesis.axis.fit(bare, fixed_sizes).effects):
        other = Hypothesis(hypothesis.model, hypothesis.axis.fit((*bare, noise), fixed_sizes))
        if effect_size(other.added[-1]) == 0.0:
            continue
        telegraph = fit_telegraph_alternative(other, len(other.effects) - 1)
        if telegraph is None or telegraph.event_count < MIN_SWITCHES:
            continue
        excess = other.fit.log_likelihood + telegraph.gain - steps.poisson_log_likelihood
        excess -= PENALTY_NATS["random_telegraph"] - PENALTY_NATS["poisson_steps"]
        if excess > 0.0:
            return replace(telegraph, gain=steps.gain + excess, runner_up=steps)
    return steps


def _with_original_walks(hypothesis: Hypothesis) -> tuple[Effects, frozenset[int]]:
    """Return the effects without added random walks and steps, and the indices of fixed noise effects.

    Random walks of the noise model have the original size.
    """
    walks = frozenset(at for at, effect in enumerate(hypothesis.model) if isinstance(effect, WALK_EFFECTS))
    known = [
        hypothesis.model[at] if at in walks else hypothesis.effects[at] for at in range(hypothesis.model_effect_count)
    ]
    fixed_sizes = frozenset(
        at for at in range(hypothesis.model_effect_count) if at in hypothesis.fit.fixed_sizes or at in walks
    )
    return (*known, *(one for one in hypothesis.added if not isinstance(one, WALK_EFFECTS))), fixed_sizes


def fit_telegraph_alternative(hypothesis: Hypothesis, index: int) -> NonGaussianAlternative | None:
    """Fit a random telegraph as an alternative to correlated noise.

    Parameters
    ----------
    hypothesis : Hypothesis
        Fitted effects.
    index : int
        Index of the correlated noise.

    Returns
    -------
    NonGaussianAlternative or None
        The alternative, or None if the axis has no white noise.
    """
    noise = hypothesis.effects[index]
    assert isinstance(noise, ExponentiallyCorrelated)
    background = build_background_noise((*hypothesis.effects[:index], *hypothesis.effects[index + 1 :]))
    if not background.white > 0.0:
        return None
    series, tau0_s = _residual_series(hypothesis.fit), 1.0 / hypothesis.axis.rate_hz
    compared = compare_telegraph_with_correlated_noise(series, tau0_s, background, noise.sigma, noise.correlation_time)
    amplitude, dwell = (float(compared.parameters[name].value) for name in ("amplitude", "dwell_time"))
    effect = RandomTelegraph(amplitude=amplitude, dwell_time=dwell)
    added = (*hypothesis.effects[hypothesis.model_effect_count : index], *hypothesis.effects[index + 1 :], effect)
    return NonGaussianAlternative(added, compared.gain, compared.parameters, compared.events)


def fit_poisson_alternative(hypothesis: Hypothesis) -> NonGaussianAlternative | None:
    """Fit Poisson steps as an alternative to single steps or an increased random walk.

    Return None if the hypothesis contains neither single steps nor an increased random walk.
    """
    steps = sum(isinstance(effect, BiasStep) for effect in hypothesis.added)
    walks = [at for at, effect in enumerate(hypothesis.effects) if isinstance(effect, RateRandomWalk)]
    if not steps and not any(at >= hypothesis.model_effect_count or at in hypothesis.fit.fitted_noise for at in walks):
        return None
    effects, fixed_sizes = _with_original_walks(hypothesis)
    without = hypothesis.axis.fit(effects, fixed_sizes)
    known = max((effect_size(effects[at]) for at in walks if at < hypothesis.model_effect_count), default=0.0)
    walk = hypothesis.axis.fit((*effects, RateRandomWalk(K=max(known, 1e-12))), fixed_sizes)
    excess = effect_size(walk.effects[-1])
    background = build_background_noise(without.effects)
    if not (excess > 0.0 and background.white > 0.0):
        return None
    series, tau0_s = _residual_series(without), 1.0 / hypothesis.axis.rate_hz
    compared = compare_poisson_with_random_walk(series, tau0_s, background, excess)
    gain, whole = compared.gain, walk.log_likelihood + compared.gain
    if steps:
        compared = compare_poisson_with_single_steps(
            series, tau0_s, background, excess, max_single_steps=max(steps, MIN_FITTED_STEPS)
        )
        gain = compared.gain + STEP_PENALTY_NATS * max(compared.single_steps - MAX_FREE_STEPS, 0)
    rate, height = (float(compared.parameters[name].value) for name in ("rate", "height"))
    added = (*effects[hypothesis.model_effect_count :], PoissonSteps(rate=rate, height=height))
    return NonGaussianAlternative(
        added, gain - POISSON_PENALTY_NATS, compared.parameters, compared.events, poisson_log_likelihood=whole
    )


def compare_poisson_with_added_noise(hypothesis: Hypothesis) -> NonGaussianAlternative | None:
    """Compare Poisson steps with added correlated noise, or with an increased bias instability.

    The hypothesis with Poisson steps has the original bias instability and random walk, and neither correlated noise
    nor single steps. Return None if the hypothesis contains neither correlated noise nor a resized bias instability.
    """
    replaced = [effect for effect in hypothesis.added if isinstance(effect, (ExponentiallyCorrelated, *WALK_EFFECTS))]
    resized = [at for at in hypothesis.fit.fitted_noise if at < hypothesis.model_effect_count]
    slow = {at for at in resized if isinstance(hypothesis.effects[at], (BiasInstability, RateRandomWalk))}
    if not any(isinstance(effect, ExponentiallyCorrelated) for effect in replaced) and not any(
        isinstance(hypothesis.effects[at], BiasInstability) for at in slow
    ):
        return None
    known = [
        hypothesis.model[at] if at in slow else hypothesis.effects[at] for at in range(hypothesis.model_effect_count)
    ]
    others = [effect for effect in hypothesis.added if effect not in replaced]
    walk = RateRandomWalk(K=initial_effect_size(hypothesis.axis))
    fit = hypothesis.axis.fit((*known, *others, walk), hypothesis.fit.fixed_sizes | slow)
    jumps = fit_poisson_alternative(Hypothesis(hypothesis.model, fit))
    if jumps is None:
        return None
    score = jumps.poisson_log_likelihood - PENALTY_NATS["poisson_steps"]
    score -= RESIZE_PENALTY_NATS * (len(resized) - len(slow))
    present = hypothesis.penalised_log_likelihood - sum(PENALTY_NATS[effect.name] for effect in replaced)
    return replace(jumps, gain=score - present)


def _residual_series(fit: AxisFit) -> Floats:
    return inverse_cosine_transform(fit.cosine_transform_without_deterministic_effects())


def build_background_noise(effects: Effects) -> BackgroundNoise:
    """Convert noise effects to a ``BackgroundNoise``."""
    white = walk = flicker = 0.0
    correlated: list[tuple[float, float]] = []
    for effect in effects:
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
