"""Trials of candidate effects, in which an effect is added to a hypothesis and the fit is repeated.

The **score** of a trial is the gain in log-likelihood less the penalties. ``generate_trial_groups`` yields the trials
in this order:

1. Quantization, clipping and repeated samples.
2. Outliers and a step of the noise.
3. Deterministic effects, with the gain over the best slow noise. Slow noise can resemble a deterministic effect.
4. Noise effects and a common factor for all noise effects of the model.

A power law competes with the noise effects, and a curved drift competes with the deterministic effects. If the power
law or the curved drift has the largest score, no effect is added.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np
from scipy.special import chdtrc

from monitor.noise.effect import AxisLeak, Effect
from monitor.noise.effects import (
    AngleRandomWalk,
    ExponentiallyCorrelated,
    NoiseStep,
    Outliers,
    RandomSampleHold,
    RateRamp,
    RateRandomWalk,
    Resolution,
    Saturation,
    ScaleFactor,
)
from monitor.reconcile.diagnostics.diagnostics import STEP_MARGIN_FRACTION
from monitor.reconcile.likelihood.axis_fit import Effects
from monitor.reconcile.likelihood.hypothesis import (
    Hypothesis,
    find_maximum_by_golden_section,
    noise_effect_indices,
)
from monitor.reconcile.likelihood.whitening import WhitenedAxis
from monitor.reconcile.preparation.value_artifacts import ValueWithInterval
from monitor.reconcile.result import ParameterInterval
from monitor.reconcile.search.candidates import (
    DETERMINISTIC_CANDIDATES,
    NOISE_CANDIDATES,
    PENALTY_NATS,
    initial_effect_size,
    propose_correlated_noise,
)

UNNAMED: Final = "power_law"
"""Name of a trial without a known effect."""
RETUNE: Final = "retuned"
"""Name of a trial that only changes sizes of the noise model."""
EXPONENTS: Final = (0.5, 1.5, 2.5, 3.0)
MIN_RESIZE_GAIN_NATS: Final = 1.0
SCALE_FACTOR_MARGIN_NATS: Final = 3.0
"""Largest advantage of separate sizes over a common factor, in nats."""
SCALE_SEARCH_ITERATIONS: Final = 16
FREQUENCY_BANDS: Final = 8
"""Number of frequency bands in the test for a constant leak coefficient."""
MIN_LEAK_PROBABILITY: Final = 1e-5
"""Smallest probability of the scatter of a leak coefficient between frequency bands.
"""
QUADRATIC_PENALTY_NATS: Final = 2.5
MIN_STUDENT_GAIN_NATS: Final = 2.0
"""Smallest log-likelihood gain of outliers over Student's t, in nats."""
MAX_OUTLIER_Z: Final = 4.0
"""Largest z value of outlier clusters and of the misfit."""
ALTERNATIVE_MARGIN_NATS: Final = 1.0
"""Largest advantage of another variance change over a step of the noise, in nats."""
MAX_BAND_FRACTION: Final = 0.25
"""Largest width of a narrow frequency band, as a fraction of the sample rate."""
NOISE_PRIORITY_NATS: Final = 5.0
"""Score advantage, in nats, with which noise effects are tried before deterministic effects."""
UNNAMED_MARGIN_NATS: Final = 2.0
"""Score advantage, in nats, with which a power law or a curved drift is preferred."""


@dataclass(frozen=True, slots=True)
class Trial:
    """Candidate effect with the score of the fit."""

    name: str  # name of the effect, ``UNNAMED`` or ``RETUNE``
    effect: Effect | None  # None if no effect is added
    score: float  # log-likelihood gain less penalties, nats; for a deterministic effect, the gain over slow noise
    score_without_slow_noise: float = 0.0  # of a deterministic effect, nats
    intervals: Mapping[str, ParameterInterval] = field(
        default_factory=dict
    )  # parameters that the fit does not determine
    event_count: int = 0  # number of events that were detected


def generate_trial_groups(hypothesis: Hypothesis, whitened: WhitenedAxis) -> Iterator[list[Trial]]:
    """Yield groups of trials, each in descending order of the score.

    Parameters
    ----------
    hypothesis : Hypothesis
        Fitted effects.
    whitened : WhitenedAxis
        Axis whitened by ``hypothesis``.
    """
    yield _value_trials(whitened)
    yield _best_first(_outlier_trial(hypothesis, whitened) + _noise_step_trial(whitened))
    deterministic, noises = _deterministic_trials(hypothesis, whitened), _noise_trials(hypothesis, whitened)
    # with a wrong spectrum, the residuals contain apparent steps and slopes; a much better noise effect is tried first
    if deterministic and deterministic[0].score_without_slow_noise > noises[0].score - NOISE_PRIORITY_NATS:
        yield deterministic
        yield noises
    else:
        yield noises
        yield deterministic


def try_alternatives_to_resizing(hypothesis: Hypothesis, whitened: WhitenedAxis) -> list[Trial]:
    """Return the trials of effects that explain the data better than new sizes of the noise model.

    Parameters
    ----------
    hypothesis : Hypothesis
        Fitted effects.
    whitened : WhitenedAxis
        Axis whitened by ``hypothesis``.
    """
    trials = [one for one in _deterministic_trials(hypothesis, whitened) if one.score_without_slow_noise > 0.0]
    trials += [_noise_trial(hypothesis, effect) for effect in propose_correlated_noise(whitened)]
    return _best_first([one for one in trials if one.score > 0.0])


def _best_first(trials: Sequence[Trial]) -> list[Trial]:
    return sorted(trials, key=lambda one: -one.score)


def _value_trials(whitened: WhitenedAxis) -> list[Trial]:
    statistics = whitened.axis.value_artifacts
    found: list[Trial] = []
    if statistics.quantization and Resolution not in whitened.effect_types:
        grid = statistics.quantization
        resolution = Resolution(step=grid.step.value)
        found.append(_penalised_trial(resolution, grid.gain, {"step": _scaled_bounds(grid.step)}, grid.levels))
    if statistics.clipping and statistics.clipping.symmetric and Saturation not in whitened.effect_types:
        ends = statistics.clipping
        saturation = Saturation(limit=ends.limit.value)
        found.append(_penalised_trial(saturation, ends.gain, {"limit": _scaled_bounds(ends.limit)}, ends.count))
    if statistics.repeats and RandomSampleHold not in whitened.effect_types:
        twice = statistics.repeats
        hold = RandomSampleHold(fraction=min(twice.fraction.value, 0.999))
        intervals = {"fraction": _scaled_bounds(twice.fraction)}
        found.append(_penalised_trial(hold, twice.gain, intervals, round(twice.count)))
    return _best_first(found)


def _outlier_trial(hypothesis: Hypothesis, whitened: WhitenedAxis) -> list[Trial]:
    """Try outliers, unless another cause of heavy tails is as likely."""
    far = whitened.outlier_fit
    if far is None or Outliers in whitened.effect_types or far.gain_over_student <= MIN_STUDENT_GAIN_NATS:
        return []
    if max(far.clustering_z, far.misfit_z) >= MAX_OUTLIER_Z:
        return []
    unit = _whitened_unit(hypothesis)
    effect = Outliers(fraction=min(far.fraction.value, 1.0), scale=unit * far.scale.value)
    intervals = {"fraction": _scaled_bounds(far.fraction), "scale": _scaled_bounds(far.scale, unit)}
    return [_penalised_trial(effect, far.gain, intervals, far.count)]


def _noise_step_trial(whitened: WhitenedAxis) -> list[Trial]:
    """Try a step of the noise, unless another change of the variance is as likely."""
    changes, length_s = whitened.variance_changes, whitened.axis.length_s
    step = changes.step
    inside = STEP_MARGIN_FRACTION * length_s < step.time.value < (1.0 - STEP_MARGIN_FRACTION) * length_s
    if AngleRandomWalk not in whitened.effect_types or not inside:
        return []
    if step.gain <= max(changes.largest_alternative_gain, _band_gain(whitened)) - ALTERNATIVE_MARGIN_NATS:
        return []
    intervals = {"time": _scaled_bounds(step.time), "ratio": _scaled_bounds(step.ratio)}
    return [_penalised_trial(NoiseStep(time=step.time.value, ratio=step.ratio.value), step.gain, intervals)]


def _band_gain(whitened: WhitenedAxis) -> float:
    """Return the gain of a power change within a narrow frequency band, or 0 for a wide band.

    A step of white noise changes the power at all frequencies.
    """
    found = whitened.spectrogram_change
    return found.gain if np.ptp(found.frequency) < MAX_BAND_FRACTION * whitened.axis.rate_hz else 0.0


def _whitened_unit(hypothesis: Hypothesis) -> float:
    """Return the factor that converts the whitened series to the unit of the axis."""
    half = hypothesis.axis.bins.count.size // 2
    count, variance = hypothesis.axis.bins.count[half:], hypothesis.fit.whittle.residual[half:]
    return float(np.sqrt(variance.sum() / count.sum()))


def _penalised_trial(
    effect: Effect, gain: float, intervals: Mapping[str, ParameterInterval], event_count: int = 0
) -> Trial:
    return Trial(effect.name, effect, gain - PENALTY_NATS[effect.name], intervals=intervals, event_count=event_count)


def _scaled_bounds(found: ValueWithInterval, unit: float = 1.0) -> ParameterInterval:
    return ParameterInterval(unit * found.value, unit * found.lo, unit * found.hi)


def _noise_trial(hypothesis: Hypothesis, effect: Effect) -> Trial:
    score = hypothesis.refit_with_added_effects((*hypothesis.added, effect)).penalised_log_likelihood
    return Trial(effect.name, effect, score - hypothesis.penalised_log_likelihood - PENALTY_NATS[effect.name])


def _noise_trials(hypothesis: Hypothesis, whitened: WhitenedAxis) -> list[Trial]:
    """Try noise effects, new sizes of the noise model, a common factor, and a power law."""
    resized = hypothesis.refit_with_added_effects(hypothesis.added)
    found = [
        Trial(
            RETUNE, None, resized.penalised_log_likelihood - hypothesis.penalised_log_likelihood - MIN_RESIZE_GAIN_NATS
        )
    ]
    found += [_noise_trial(hypothesis, effect) for propose in NOISE_CANDIDATES for effect in propose(whitened)]
    found = _best_first([*found, _scale_factor_trial(hypothesis, resized)])
    value = (
        max(_score_with_power_law(hypothesis, hypothesis.effects, one) for one in EXPONENTS)
        - hypothesis.penalised_log_likelihood
    )
    if value > max(found[0].score, 0.0) + UNNAMED_MARGIN_NATS and found[0].name in POWER_LAW_RIVALS:
        return [Trial(UNNAMED, None, value), *found]
    return found


POWER_LAW_RIVALS: Final = frozenset(
    {
        "quantization_noise",
        "angle_random_walk",
        "bias_instability",
        "rate_random_walk",
        "exponentially_correlated",
        "scale_factor",
    }
)
"""Names of the effects that compete with a power law."""


def _deterministic_trials(hypothesis: Hypothesis, whitened: WhitenedAxis) -> list[Trial]:
    """Try effects that depend on time, temperature or another axis, and a curved drift."""
    free = hypothesis.axis.fit(hypothesis.effects).log_likelihood
    proposed = [effect for propose in DETERMINISTIC_CANDIDATES for effect in propose(whitened)]
    kept = [
        effect
        for effect in proposed
        if hypothesis.axis.fit((*hypothesis.effects, effect)).log_likelihood - free > 0.3 * PENALTY_NATS[effect.name]
        and (not isinstance(effect, AxisLeak) or _has_flat_coefficient(whitened, effect))
    ]
    if not kept:
        return []
    slow_noises = _slow_noise_scores(hypothesis)
    resized = hypothesis.refit_with_added_effects(hypothesis.added)
    without = max(resized.penalised_log_likelihood, *(score(hypothesis.effects) for score in slow_noises))
    trials = []
    for effect in kept:
        alone = hypothesis.refit_with_added_effects((*hypothesis.added, effect)).penalised_log_likelihood
        gain = max(alone, *(score((*hypothesis.effects, effect)) for score in slow_noises)) - without
        quadratic = getattr(effect, "quadratic", None) is not None
        penalty = PENALTY_NATS[effect.name] + (QUADRATIC_PENALTY_NATS if quadratic else 0.0)
        trials.append(Trial(effect.name, effect, gain - penalty, alone - hypothesis.penalised_log_likelihood - penalty))
    trials = _best_first(trials)
    curved = _curved_drift_score(hypothesis) - without
    if curved > max(0.0, trials[0].score) + UNNAMED_MARGIN_NATS:
        return [Trial(UNNAMED, None, curved, curved + without - hypothesis.penalised_log_likelihood), *trials]
    return trials


def _has_flat_coefficient(whitened: WhitenedAxis, leak: AxisLeak) -> bool:
    """Return True if one coefficient describes a leak at all frequencies.

    If vibration acts on both axes, the coefficient depends on the frequency. A χ² test compares the coefficients of
    several frequency bands. With the source transform X and the noise variance v, the variance of a coefficient is
    1/Σ(X²/v).
    """
    column = whitened.axis.leak_sources[leak.source] * whitened.weights
    edges = np.linspace(0, column.size, FREQUENCY_BANDS + 1).astype(np.int64)[:-1]
    square = np.maximum(np.add.reduceat(column**2, edges), 1e-300)
    product = np.add.reduceat(column * whitened.coefficients, edges)
    scatter = float((square * (product / square - product.sum() / square.sum()) ** 2).sum())
    return bool(chdtrc(FREQUENCY_BANDS - 1, scatter) > MIN_LEAK_PROBABILITY)


def _curved_drift_score(hypothesis: Hypothesis) -> float:
    """Return the penalised log-likelihood of the hypothesis with an additional quadratic drift."""
    effects = (*hypothesis.effects, RateRamp(R=initial_effect_size(hypothesis.axis)))
    fit = hypothesis.axis.fit(effects, hypothesis.fit.fixed_noise, curvature=True)
    return fit.log_likelihood - hypothesis.resize_penalty - PENALTY_NATS["rate_ramp"] - QUADRATIC_PENALTY_NATS


def _slow_noise_scores(hypothesis: Hypothesis) -> list[Callable[[Effects], float]]:
    """Return functions that compute the score of given effects with an additional slow noise."""
    axis, small = hypothesis.axis, initial_effect_size(hypothesis.axis)
    fixed_noise, cost = hypothesis.fit.fixed_noise, hypothesis.resize_penalty

    def make_noise_score(noise: Effect) -> Callable[[Effects], float]:
        return lambda effects: axis.fit((*effects, noise), fixed_noise).log_likelihood - cost - PENALTY_NATS[noise.name]

    def make_power_law_score(exponent: float) -> Callable[[Effects], float]:
        return lambda effects: _score_with_power_law(hypothesis, effects, exponent)

    times_s = np.geomspace(10.0 / axis.rate_hz, 0.1 * axis.length_s, 8)
    noises: list[Effect] = [ExponentiallyCorrelated(sigma=small, correlation_time=float(t)) for t in times_s]
    if not any(isinstance(effect, RateRandomWalk) for effect in hypothesis.effects):
        noises.append(RateRandomWalk(K=small))
    return [*(make_noise_score(one) for one in noises), *(make_power_law_score(exponent) for exponent in EXPONENTS)]


def _score_with_power_law(hypothesis: Hypothesis, effects: Effects, exponent: float) -> float:
    f_hz = hypothesis.axis.bins.f_hz
    basis = np.asarray((f_hz / f_hz[0]) ** -exponent)[None, :]
    fit = hypothesis.axis.fit(effects, hypothesis.fit.fixed_noise, basis)
    return fit.log_likelihood - hypothesis.resize_penalty - PENALTY_NATS[UNNAMED]


def _scale_factor_trial(hypothesis: Hypothesis, resized: Hypothesis) -> Trial:
    """Try a common factor for all noise effects of the model.

    If several sizes changed and the factor fits nearly as well, the factor has at least the score of separate sizes.
    """
    effects, fixed_noise = (*hypothesis.model, *hypothesis.added), noise_effect_indices(hypothesis.model)

    def log_likelihood_with_factor(log_factor: float) -> float:
        return hypothesis.axis.fit(
            (*effects, ScaleFactor(factor=float(np.exp(log_factor)))), fixed_noise
        ).log_likelihood

    start = float(max(np.linspace(-3.0, 3.0, 13), key=log_likelihood_with_factor))
    x = find_maximum_by_golden_section(log_likelihood_with_factor, start - 0.5, start + 0.5, SCALE_SEARCH_ITERATIONS)
    gain = log_likelihood_with_factor(x) - hypothesis.penalised_log_likelihood - PENALTY_NATS["scale_factor"]
    if (
        resized.refitted_size_count > 1
        and log_likelihood_with_factor(x) > resized.fit.log_likelihood - SCALE_FACTOR_MARGIN_NATS
    ):
        gain = max(gain, resized.penalised_log_likelihood - hypothesis.penalised_log_likelihood)
    return Trial("scale_factor", ScaleFactor(factor=float(np.exp(x))), gain)
