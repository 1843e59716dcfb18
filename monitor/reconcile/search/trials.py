"""Trials of candidate effects, each added alone and fitted together with all other effects.

- **Trials of values and single samples** come first, because their evidence is either certain or absent.
- **Deterministic effects** come before noise effects. Otherwise a noise effect would absorb a drift, and later fits
  would not correct this. A deterministic effect must exceed its penalty even if a slow noise that could replace the
  effect is present before and after. This noise is a random walk, a correlated noise or a power law.
- **Noise effects** are ordered by their score. The score is the gain in ln L, less the penalty of the effect and the
  penalty for changed sizes of known noise effects.
- **Unnamed alternatives** are a power law with any exponent among the noise effects, and a curved drift among the
  deterministic effects. If an unnamed alternative is the best, no known effect is right.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np
from scipy.special import chdtrc

from drivers.sample import Floats
from monitor.noise.effect import Effect, Leak
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
from monitor.reconcile.diagnostics.diagnostics import STEP_MARGIN_FRACTION, least_constant_tiles
from monitor.reconcile.likelihood.axis import Axis, Effects
from monitor.reconcile.likelihood.hypothesis import (
    RESIZE_PENALTY_NATS,
    Hypothesis,
    golden_section,
    noise_indices,
)
from monitor.reconcile.likelihood.whitening import WhitenedAxis
from monitor.reconcile.preparation.value_statistics import Interval
from monitor.reconcile.result import ParameterInterval
from monitor.reconcile.search.candidates import (
    DETERMINISTIC_CANDIDATES,
    NOISE_CANDIDATES,
    PENALTY_NATS,
    propose_correlated_noise,
    start_size,
)

UNNAMED: Final = "power_law"
"""Name of a trial that corresponds to no known effect."""
RETUNE: Final = "retuned"
"""Name of a trial without a new effect, in which known effects get other sizes."""
EXPONENTS: Final = (0.5, 1.5, 2.5, 3.0)
"""Exponents of the power laws that are tried."""
MIN_RESIZE_GAIN_NATS: Final = 1.0
"""Smallest gain in nats of other sizes."""
SCALE_FACTOR_MARGIN_NATS: Final = 3.0
"""Gain in nats by which separately fitted sizes may be better than one common factor, which has fewer parameters."""
SCALE_SEARCH_ITERATIONS: Final = 16
"""Number of iterations of the search for the best common factor."""
FREQUENCY_BANDS: Final = 8
"""Number of frequency bands in which a leak must have the same coefficient."""
MIN_LEAK_PROBABILITY: Final = 1e-5
"""Smallest probability of the observed differences of a leak coefficient between frequency bands. A smaller probability
indicates that vibration acts on both axes.
"""
QUADRATIC_PENALTY_NATS: Final = 2.5
"""Penalty in nats for a second parameter."""
MIN_STUDENT_GAIN_NATS: Final = 2.0
"""Smallest gain in nats of outliers over Student's t."""
MAX_OUTLIER_Z: Final = 4.0
"""Largest z of clustering and of misfit of outliers. Samples with a larger z are not outliers."""
RIVAL_MARGIN_NATS: Final = 1.0
"""Gain in nats by which a step of the noise may be worse than the alternatives, which have more parameters."""
MAX_BAND_FRACTION: Final = 0.25
"""Largest width of a frequency band, as a fraction of the sample rate. This is half of the observed frequency range."""
NOISE_PRIORITY_NATS: Final = 5.0
"""Difference in nats from which noise effects are tried before deterministic effects."""
UNNAMED_MARGIN_NATS: Final = 2.0
"""Gain in nats by which an unnamed alternative must be better so that no effect is named."""


@dataclass(frozen=True, slots=True)
class Trial:
    """Candidate that was tried."""

    name: str
    effect: Effect | None  # None: no known effect, or no new effect
    value: float  # gain less penalty, nats; for a deterministic effect, together with the best slow noise
    alone: float = 0.0  # gain less penalty of a deterministic effect without such noise, nats
    bounds: Mapping[str, ParameterInterval] = field(default_factory=dict)  # parameters that no spectrum determines
    events: int = 0  # number of events that were detected


def trial_groups(state: Hypothesis, seen: WhitenedAxis) -> Iterator[list[Trial]]:
    """Yield the trials of one kind after the other, each kind with the best trial first.

    Parameters
    ----------
    state : Hypothesis
        Fitted effects.
    seen : WhitenedAxis
        Axis whitened by ``state``.
    """
    yield _value_trials(seen)
    yield _sample_trials(state, seen)
    deterministic, noises = _deterministic_trials(state, seen), _noise_trials(state, seen)
    # A noise effect that explains far more comes first, because the residuals of a wrong spectrum look like steps and
    # slopes.
    if deterministic and deterministic[0].alone > noises[0].value - NOISE_PRIORITY_NATS:
        yield deterministic
        yield noises
    else:
        yield noises
        yield deterministic


def replacements_for_resizing(state: Hypothesis, seen: WhitenedAxis) -> list[Trial]:
    """Return effects that explain the data better than changed sizes of known noise effects.

    Parameters
    ----------
    state : Hypothesis
        Fitted effects.
    seen : WhitenedAxis
        Axis whitened by ``state``.
    """
    found = [one for one in _deterministic_trials(state, seen) if one.alone > 0.0 and one.value > 0.0]
    noises = [_noise_trial(state, effect) for effect in propose_correlated_noise(seen)]
    return _best_first(found + [one for one in noises if one.value > 0.0])


def _best_first(trials: Sequence[Trial]) -> list[Trial]:
    """Return trials in the order of their values."""
    return sorted(trials, key=lambda one: -one.value)


def _value_trials(seen: WhitenedAxis) -> list[Trial]:
    """Return the trials of quantization, clipping and repeats."""
    shown = seen.axis.shown
    found: list[Trial] = []
    if shown.levels and Resolution not in seen.types:
        grid = shown.levels
        resolution = Resolution(step=grid.step.value)
        found.append(_penalised_trial(resolution, grid.gain, {"step": _scaled_bounds(grid.step)}, grid.levels))
    if shown.clipped and shown.clipped.symmetric and Saturation not in seen.types:
        ends = shown.clipped
        saturation = Saturation(limit=ends.limit.value)
        found.append(_penalised_trial(saturation, ends.gain, {"limit": _scaled_bounds(ends.limit)}, ends.count))
    if shown.repeats and RandomSampleHold not in seen.types:
        twice = shown.repeats
        hold = RandomSampleHold(fraction=min(twice.fraction.value, 0.999))
        bounds = {"fraction": _scaled_bounds(twice.fraction)}
        found.append(_penalised_trial(hold, twice.gain, bounds, round(twice.count)))
    return _best_first(found)


def _sample_trials(state: Hypothesis, seen: WhitenedAxis) -> list[Trial]:
    """Return the trials of outliers and of a step of the noise."""
    return _best_first(_outlier_trial(state, seen) + _noise_step_trial(seen))


def _outlier_trial(state: Hypothesis, seen: WhitenedAxis) -> list[Trial]:
    """Return the trial of outliers, or nothing if another cause of heavy tails is as likely."""
    far = seen.outliers
    if far is None or Outliers in seen.types or far.over_student <= MIN_STUDENT_GAIN_NATS:
        return []
    if max(far.clustering_z, far.misfit_z) >= MAX_OUTLIER_Z:
        return []
    unit = _whitened_unit(state)
    effect = Outliers(fraction=min(far.fraction.value, 1.0), scale=unit * far.scale.value)
    bounds = {"fraction": _scaled_bounds(far.fraction), "scale": _scaled_bounds(far.scale, unit)}
    return [_penalised_trial(effect, far.gain, bounds, far.count)]


def _noise_step_trial(seen: WhitenedAxis) -> list[Trial]:
    """Return the trial of a step of the noise, or nothing if another variation of the variance explains more."""
    history, length_s = seen.variance_history, seen.axis.length_s
    step = history.step
    margin_s = STEP_MARGIN_FRACTION * length_s
    if AngleRandomWalk not in seen.types or not margin_s < step.time.value < (1.0 - STEP_MARGIN_FRACTION) * length_s:
        return []
    rivals = (history.trend, history.periodic, history.wander)
    if step.gain <= max(rivals) - RIVAL_MARGIN_NATS or step.gain <= _band_burst_gain(seen) - RIVAL_MARGIN_NATS:
        return []
    bounds = {"time": _scaled_bounds(step.time), "ratio": _scaled_bounds(step.ratio)}
    return [_penalised_trial(NoiseStep(time=step.time.value, ratio=step.ratio.value), step.gain, bounds)]


def _band_burst_gain(seen: WhitenedAxis) -> float:
    """Return the gain in nats of the least constant place of the spectrogram if it is a band, otherwise 0.

    A change within a band is no step of the white noise.
    """
    found = least_constant_tiles(seen)
    return found.gain if np.ptp(found.frequency) < MAX_BAND_FRACTION * seen.axis.rate_hz else 0.0


def _whitened_unit(state: Hypothesis) -> float:
    """Return the standard deviation of the axis per unit of the whitened fast series, from the upper half of the
    bins.
    """
    half = state.axis.bins.count.size // 2
    count, variance = state.axis.bins.count[half:], state.fit.fitted.residual[half:]
    return float(np.sqrt(variance.sum() / count.sum()))


def _penalised_trial(effect: Effect, gain: float, bounds: Mapping[str, ParameterInterval], events: int = 0) -> Trial:
    """Return a trial whose value is the gain less the penalty of the effect."""
    return Trial(effect.name, effect, gain - PENALTY_NATS[effect.name], bounds=bounds, events=events)


def _scaled_bounds(found: Interval, unit: float = 1.0) -> ParameterInterval:
    """Return an interval in another unit."""
    return ParameterInterval(unit * found.value, unit * found.lo, unit * found.hi)


def _noise_trial(state: Hypothesis, effect: Effect) -> Trial:
    """Return the trial of one noise effect."""
    score = state.refit((*state.found, effect)).score
    return Trial(effect.name, effect, score - state.score - PENALTY_NATS[effect.name])


def _noise_trials(state: Hypothesis, seen: WhitenedAxis) -> list[Trial]:
    """Return the trials of noise effects by their score, including an unnamed power law."""
    resized = state.refit(state.found)
    found = [Trial(RETUNE, None, resized.score - state.score - MIN_RESIZE_GAIN_NATS)]
    found += [_noise_trial(state, effect) for propose in NOISE_CANDIDATES for effect in propose(seen)]
    found = _best_first([*found, _scale_factor_trial(state, resized)])
    value = max(_power_law_score(state, exponent) for exponent in EXPONENTS) - state.score - PENALTY_NATS[UNNAMED]
    if value > max(found[0].value, 0.0) + UNNAMED_MARGIN_NATS and found[0].name in POWER_LAW_RIVALS:
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
"""Effects that compete with a power law."""


def _deterministic_trials(state: Hypothesis, seen: WhitenedAxis) -> list[Trial]:
    """Return the trials of effects that follow time, temperature or another axis."""
    free = state.axis.fit(state.effects).log_likelihood
    proposed = [effect for propose in DETERMINISTIC_CANDIDATES for effect in propose(seen)]
    kept = [
        effect
        for effect in proposed
        if state.axis.fit((*state.effects, effect)).log_likelihood - free > 0.3 * PENALTY_NATS[effect.name]
        and (not isinstance(effect, Leak) or _has_flat_coefficient(seen, effect))
    ]
    if not kept:
        return []
    slow_noises = _slow_noise_scores(state)
    without = max(state.refit(state.found).score, *(score(state.effects) for score in slow_noises))
    trials = []
    for effect in kept:
        alone = state.refit((*state.found, effect)).score
        gain = max(alone, *(score((*state.effects, effect)) for score in slow_noises)) - without
        penalty = PENALTY_NATS[effect.name] + _quadratic_penalty(effect)
        trials.append(Trial(effect.name, effect, gain - penalty, alone - state.score - penalty))
    trials = _best_first(trials)
    curved = _curved_drift_score(state) - without
    if curved > max(0.0, trials[0].value) + UNNAMED_MARGIN_NATS:
        return [Trial(UNNAMED, None, curved, curved + without - state.score), *trials]
    return trials


def _has_flat_coefficient(seen: WhitenedAxis, leak: Leak) -> bool:
    """Return True if one coefficient describes a leak at all frequencies.

    If vibration acts on both axes, the coefficient depends on the frequency. The coefficients in ``FREQUENCY_BANDS``
    bands of equal width have the variance 1/(Σ X²/v). Their scatter about the mean is tested with χ².
    """
    column = seen.axis.others[leak.source] * seen.weight
    edges = np.linspace(0, column.size, FREQUENCY_BANDS + 1).astype(np.int64)[:-1]
    square = np.maximum(np.add.reduceat(column**2, edges), 1e-300)
    product = np.add.reduceat(column * seen.whitened, edges)
    scatter = float((square * (product / square - product.sum() / square.sum()) ** 2).sum())
    return bool(chdtrc(FREQUENCY_BANDS - 1, scatter) > MIN_LEAK_PROBABILITY)


def _curved_drift_score(state: Hypothesis) -> float:
    """Return the score of a curved drift without a name, less its penalty."""
    bent = state.axis.fit((*state.effects, RateRamp(R=start_size(state.axis))), state.fit.held, curved=True)
    return bent.log_likelihood - RESIZE_PENALTY_NATS * state.freed - PENALTY_NATS["rate_ramp"] - QUADRATIC_PENALTY_NATS


def _quadratic_penalty(effect: Effect) -> float:
    """Return the penalty for a second parameter of an effect."""
    return QUADRATIC_PENALTY_NATS if getattr(effect, "quadratic", None) is not None else 0.0


def _slow_noise_scores(state: Hypothesis) -> list[Callable[[Effects], float]]:
    """Return functions that score effects together with each slow noise that could replace a deterministic effect.

    The sizes of the model's noise effects are not changed.
    """
    axis, small = state.axis, start_size(state.axis)
    held, cost = state.fit.held, RESIZE_PENALTY_NATS * state.freed

    def with_noise(noise: Effect) -> Callable[[Effects], float]:
        return lambda effects: axis.fit((*effects, noise), held).log_likelihood - cost - PENALTY_NATS[noise.name]

    def with_power_law(exponent: float) -> Callable[[Effects], float]:
        row = _power_law(axis, exponent)
        return lambda effects: axis.fit(effects, held, row).log_likelihood - cost - PENALTY_NATS[UNNAMED]

    times_s = np.geomspace(10.0 / axis.rate_hz, 0.1 * axis.length_s, 8)
    noises: list[Effect] = [ExponentiallyCorrelated(sigma=small, correlation_time=float(t)) for t in times_s]
    if not any(isinstance(effect, RateRandomWalk) for effect in state.effects):
        noises.append(RateRandomWalk(K=small))
    return [*(with_noise(one) for one in noises), *(with_power_law(exponent) for exponent in EXPONENTS)]


def _power_law_score(state: Hypothesis, exponent: float) -> float:
    """Return the score with an additional power law."""
    fit = state.axis.fit(state.effects, state.fit.held, _power_law(state.axis, exponent))
    return fit.log_likelihood - RESIZE_PENALTY_NATS * state.freed


def _power_law(axis: Axis, exponent: float) -> Floats:
    """Return the variance basis, shape (1, m), of a power law."""
    return np.asarray((axis.bins.f_hz / axis.bins.f_hz[0]) ** -exponent)[None, :]


def _scale_factor_trial(state: Hypothesis, resized: Hypothesis) -> Trial:
    """Return the trial of one common factor for all noise effects of the model.

    A single wrong size is no evidence for a common factor. In this case, only the wrong size is changed. If two or more
    sizes are wrong and one factor explains them as well, the factor is preferred.
    """
    effects, held = (*state.model, *state.found), noise_indices(state.model)

    def value(x: float) -> float:
        return state.axis.fit((*effects, ScaleFactor(factor=float(np.exp(x)))), held).log_likelihood

    start = float(max(np.linspace(-3.0, 3.0, 13), key=value))
    x = golden_section(value, start - 0.5, start + 0.5, SCALE_SEARCH_ITERATIONS)
    gain = value(x) - state.score - PENALTY_NATS["scale_factor"]
    if resized.freed > 1 and value(x) > resized.fit.log_likelihood - SCALE_FACTOR_MARGIN_NATS:
        gain = max(gain, resized.score - state.score)
    return Trial("scale_factor", ScaleFactor(factor=float(np.exp(x))), gain)
