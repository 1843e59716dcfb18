"""Trials of candidate effects. Each candidate is added alone, everything is fitted again, and the best trial comes
first.

- **Values and single samples** come first, because their evidence is either certain or absent.
- **Deterministic effects** come before noise effects. Otherwise a noise effect would absorb a drift, and later fits
  would not correct this. A deterministic effect must exceed its penalty even if a slow noise that could replace it is
  present before and after. This noise is a random walk, a correlated noise or a power law.
- **Noise effects** are ordered by their score. The score is the gain in ln L, less the penalty of the effect and the
  penalty for changed sizes of known noise effects.
- **Unnamed alternatives** are a power law with any exponent among the noise effects, and a curved drift among the
  deterministic effects. If one of them is the best, no known effect is right.
"""

from collections.abc import Callable, Iterator, Mapping
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
    RateRamp,
    RateRandomWalk,
    Resolution,
    SampleHold,
    Saturation,
    ScaleFactor,
)
from monitor.reconcile.diagnostics.diagnostics import STEP_MARGIN_FRACTION, WhitenedAxis, least_constant_tiles
from monitor.reconcile.likelihood.effect_terms import NOISE_SIZE_PARAMETERS
from monitor.reconcile.likelihood.hypothesis import GOLDEN, RESIZE_PENALTY_NATS, Hypothesis, fit_with_fewest_changes
from monitor.reconcile.preparation.axis import Axis, Effects
from monitor.reconcile.preparation.value_statistics import Interval
from monitor.reconcile.result import ParameterInterval
from monitor.reconcile.search.candidates import (
    DETERMINISTIC_CANDIDATES,
    NOISE_CANDIDATES,
    PENALTY_NATS,
    propose_correlated_noise,
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
FREQUENCY_BANDS: Final = 8
"""Number of frequency bands in which a leak must have the same coefficient."""
MIN_LEAK_PROBABILITY: Final = 1e-5
"""Smallest probability of coefficients that differ as much between bands. Below it, something shakes both axes."""
QUADRATIC_PENALTY_NATS: Final = 2.5
"""Penalty in nats for a second parameter."""
MIN_STUDENT_GAIN_NATS: Final = 2.0
"""Smallest gain in nats of outliers over Student's t."""
MAX_OUTLIER_Z: Final = 4.0
"""Largest z of clustering and of misfit of outliers. Above it, the samples are not outliers."""
RIVAL_MARGIN_NATS: Final = 1.0
"""Gain in nats by which a step of the noise may be worse than its alternatives, which have more parameters."""
MAX_BAND_FRACTION: Final = 0.25
"""Width below which a frequency range counts as a band, as a fraction of the sample rate. It is half of the observed
range.
"""
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
    bounds: Mapping[str, ParameterInterval] = field(
        default_factory=dict
    )  # parameters that the spectrum does not determine
    events: int = 0  # number of events that were detected


def trial_groups(axis: Axis, state: Hypothesis, seen: WhitenedAxis) -> Iterator[list[Trial]]:
    """Yield the trials of one kind after the other, each kind with the best trial first.

    Parameters
    ----------
    axis : Axis
        Axis to fit.
    state : Hypothesis
        Fitted effects.
    seen : Sight
        Axis whitened by ``state``.
    """
    yield _value_trials(axis, state, seen)
    yield _sample_trials(axis, state, seen)
    courses, noises = _deterministic_trials(axis, state, seen), _noise_trials(axis, state, seen)
    # A noise effect that explains far more comes first, because the residuals of a wrong spectrum look like steps and
    # slopes.
    if courses and courses[0].alone > noises[0].value - NOISE_PRIORITY_NATS:
        yield courses
        yield noises
    else:
        yield noises
        yield courses


def replacements_for_resizing(axis: Axis, state: Hypothesis, view: WhitenedAxis) -> list[Trial]:
    """Return effects that explain the data better than changed sizes of known noise effects.

    Parameters
    ----------
    axis : Axis
        Axis to fit.
    state : Hypothesis
        Fitted effects.
    view : Sight
        Axis whitened by ``state``.
    """
    found = [one for one in _deterministic_trials(axis, state, view) if one.alone > 0.0 and one.value > 0.0]
    for effect in propose_correlated_noise(axis, state, view):
        value = (
            fit_with_fewest_changes(axis, (*state.found, effect), state.model).score
            - state.score
            - PENALTY_NATS[effect.name]
        )
        if value > 0.0:
            found.append(Trial(effect.name, effect, value))
    return sorted(found, key=lambda one: -one.value)


def _value_trials(axis: Axis, state: Hypothesis, seen: WhitenedAxis) -> list[Trial]:
    """Return the trials of quantization, clipping and repeats."""
    have, shown = {type(effect) for effect in state.effects}, axis.shown
    found: list[Trial] = []
    if shown.levels and Resolution not in have:
        grid = shown.levels
        found.append(
            _penalised_trial(
                Resolution(step=grid.step.value), grid.gain, {"step": _scaled_bounds(grid.step)}, grid.levels
            )
        )
    if shown.clipped and shown.clipped.symmetric and Saturation not in have:
        ends = shown.clipped
        found.append(
            _penalised_trial(
                Saturation(limit=ends.limit.value), ends.gain, {"limit": _scaled_bounds(ends.limit)}, ends.count
            )
        )
    if shown.repeats and SampleHold not in have:
        twice = shown.repeats
        hold = SampleHold(fraction=min(twice.fraction.value, 0.999))
        found.append(
            _penalised_trial(hold, twice.gain, {"fraction": _scaled_bounds(twice.fraction)}, round(twice.count))
        )
    return sorted(found, key=lambda one: -one.value)


def _sample_trials(axis: Axis, state: Hypothesis, seen: WhitenedAxis) -> list[Trial]:
    """Return the trials of outliers and of a step of the noise."""
    found: list[Trial] = []
    far, course = seen.outliers, seen.course
    have = {type(effect) for effect in state.effects}
    if (
        far is not None
        and Outliers not in have
        and far.over_student > MIN_STUDENT_GAIN_NATS
        and max(far.clustering_z, far.misfit_z) < MAX_OUTLIER_Z
    ):
        # convert the sizes of the whitened series to the unit of the axis
        unit = _whitened_unit(axis, state)
        effect = Outliers(fraction=min(far.fraction.value, 1.0), scale=unit * far.scale.value)
        bounds = {"fraction": _scaled_bounds(far.fraction), "scale": _scaled_bounds(far.scale, unit)}
        found.append(_penalised_trial(effect, far.gain, bounds, far.count))
    rival = max(course.trend, course.periodic.gain, course.wander)
    length_s = axis.n / axis.rate_hz
    inside = STEP_MARGIN_FRACTION * length_s < course.step.time.value < (1.0 - STEP_MARGIN_FRACTION) * length_s
    if (
        inside
        and course.step.gain > rival - RIVAL_MARGIN_NATS
        and any(isinstance(effect, AngleRandomWalk) for effect in state.effects)
        and course.step.gain > _band_burst_gain(seen) - RIVAL_MARGIN_NATS
    ):
        step = NoiseStep(time=course.step.time.value, ratio=course.step.ratio.value)
        bounds = {"time": _scaled_bounds(course.step.time), "ratio": _scaled_bounds(course.step.ratio)}
        found.append(_penalised_trial(step, course.step.gain, bounds))
    return sorted(found, key=lambda one: -one.value)


def _band_burst_gain(seen: WhitenedAxis) -> float:
    """Return the gain in nats of the least constant place of the spectrogram if it is a band, otherwise 0.

    A change within a band is no step of the white noise.
    """
    found = least_constant_tiles(seen)
    return found.gain if np.ptp(found.frequency) < MAX_BAND_FRACTION * seen.axis.rate_hz else 0.0


def _whitened_unit(axis: Axis, state: Hypothesis) -> float:
    """Return the standard deviation of the axis per unit of the whitened fast series, from the upper half of the
    bins.
    """
    half = axis.bins.count.size // 2
    count, variance = axis.bins.count[half:], state.likely.fitted.residual[half:]
    return float(np.sqrt(variance.sum() / count.sum()))


def _penalised_trial(effect: Effect, gain: float, bounds: Mapping[str, ParameterInterval], events: int = 0) -> Trial:
    """Return a trial whose value is the gain less the penalty of the effect."""
    return Trial(effect.name, effect, gain - PENALTY_NATS[effect.name], bounds=bounds, events=events)


def _scaled_bounds(found: Interval, unit: float = 1.0) -> ParameterInterval:
    """Return an interval in another unit."""
    return ParameterInterval(unit * found.value, unit * found.lo, unit * found.hi)


def _noise_trials(axis: Axis, state: Hypothesis, seen: WhitenedAxis) -> list[Trial]:
    """Return the trials of noise effects by their score, including an unnamed one."""
    resized = fit_with_fewest_changes(axis, state.found, state.model)
    found = [Trial(RETUNE, None, resized.score - state.score - MIN_RESIZE_GAIN_NATS)]
    for family in NOISE_CANDIDATES:
        for effect in family(axis, state, seen):
            value = (
                fit_with_fewest_changes(axis, (*state.found, effect), state.model).score
                - state.score
                - PENALTY_NATS[effect.name]
            )
            found.append(Trial(effect.name, effect, value))
    found.append(_scale_factor_trial(axis, state, resized))
    found.sort(key=lambda one: -one.value)
    value = max(_power_law_score(axis, state, exponent) for exponent in EXPONENTS) - state.score - PENALTY_NATS[UNNAMED]
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


def _deterministic_trials(axis: Axis, state: Hypothesis, seen: WhitenedAxis) -> list[Trial]:
    """Return the trials of effects that follow time, temperature or another axis."""
    free = axis.fit(state.effects).log_likelihood
    kept: list[Effect] = []
    for family in DETERMINISTIC_CANDIDATES:
        for effect in family(axis, state, seen):
            gain = axis.fit((*state.effects, effect)).log_likelihood - free
            if gain > 0.3 * PENALTY_NATS[effect.name] and (
                not isinstance(effect, Leak) or _has_flat_coefficient(seen, effect)
            ):
                kept.append(effect)
    if not kept:
        return []
    beside = _slow_noise_scores(axis, state)
    without = max(
        fit_with_fewest_changes(axis, state.found, state.model).score, *(one(state.effects) for one in beside)
    )
    trials = []
    for effect in kept:
        with_it = (*state.effects, effect)
        alone = fit_with_fewest_changes(axis, (*state.found, effect), state.model).score
        gain = max(alone, *(one(with_it) for one in beside)) - without
        price = PENALTY_NATS[effect.name] + _quadratic_penalty(effect)
        trials.append(Trial(effect.name, effect, gain - price, alone - state.score - price))
    trials.sort(key=lambda one: -one.value)
    curved = _curved_drift_score(axis, state) - without
    if curved > max(0.0, trials[0].value) + UNNAMED_MARGIN_NATS:
        return [Trial(UNNAMED, None, curved, curved + without - state.score), *trials]
    return trials


def _has_flat_coefficient(seen: WhitenedAxis, leak: Leak) -> bool:
    """Return True if one coefficient describes a leak at all frequencies.

    If something shakes both axes, the coefficient depends on the frequency. The coefficients in ``FREQUENCY_BANDS``
    bands of equal width have the variance 1/(Σ X²/v). Their scatter about the mean is tested with χ².
    """
    column = seen.axis.others[leak.source] * seen.weight
    edges = np.linspace(0, column.size, FREQUENCY_BANDS + 1).astype(np.int64)[:-1]
    length = np.maximum(np.add.reduceat(column**2, edges), 1e-300)
    product = np.add.reduceat(column * seen.whitened, edges)
    spread = float((length * (product / length - product.sum() / length.sum()) ** 2).sum())
    return bool(chdtrc(FREQUENCY_BANDS - 1, spread) > MIN_LEAK_PROBABILITY)


def _curved_drift_score(axis: Axis, state: Hypothesis) -> float:
    """Return the score of a curved drift without a name, less its penalty."""
    ramp = RateRamp(R=1e-3 * float(np.sqrt(np.mean(axis.coefficients**2))))
    bent = axis.fit((*state.effects, ramp), state.likely.held, curved=True)
    return bent.log_likelihood - RESIZE_PENALTY_NATS * state.freed - PENALTY_NATS["rate_ramp"] - QUADRATIC_PENALTY_NATS


def _quadratic_penalty(effect: Effect) -> float:
    """Return the penalty for a second parameter of an effect."""
    return QUADRATIC_PENALTY_NATS if getattr(effect, "quadratic", None) is not None else 0.0


def _slow_noise_scores(axis: Axis, state: Hypothesis) -> list[Callable[[Effects], float]]:
    """Return functions that score effects together with each slow noise that could replace a deterministic effect.

    The sizes of the model's noise effects are not changed.
    """
    small = 1e-3 * float(np.sqrt(np.mean(axis.coefficients**2)))
    held, cost, length_s = state.likely.held, RESIZE_PENALTY_NATS * state.freed, axis.n / axis.rate_hz

    def beside(one: Effect) -> Callable[[Effects], float]:
        return lambda effects: axis.fit((*effects, one), held).log_likelihood - cost - PENALTY_NATS[one.name]

    def beside_law(exponent: float) -> Callable[[Effects], float]:
        row = _power_law(axis, exponent)
        return lambda effects: axis.fit(effects, held, row).log_likelihood - cost - PENALTY_NATS[UNNAMED]

    times_s = np.geomspace(10.0 / axis.rate_hz, 0.1 * length_s, 8)
    stand_ins: list[Effect] = [ExponentiallyCorrelated(sigma=small, correlation_time=float(t)) for t in times_s]
    if not any(isinstance(effect, RateRandomWalk) for effect in state.effects):
        stand_ins.append(RateRandomWalk(K=small))
    return [*(beside(one) for one in stand_ins), *(beside_law(exponent) for exponent in EXPONENTS)]


def _power_law_score(axis: Axis, state: Hypothesis, exponent: float) -> float:
    """Return the score with an additional power law."""
    return (
        axis.fit(state.effects, state.likely.held, _power_law(axis, exponent)).log_likelihood
        - RESIZE_PENALTY_NATS * state.freed
    )


def _power_law(axis: Axis, exponent: float) -> Floats:
    """Return the variance basis, shape (1, m), of a power law."""
    return np.asarray((axis.bins.f_hz / axis.bins.f_hz[0]) ** -exponent)[None, :]


def _scale_factor_trial(axis: Axis, state: Hypothesis, resized: Hypothesis) -> Trial:
    """Return the trial of one common factor for all noise effects of the model.

    If one size is wrong, this says nothing about the others, and only this size is changed. If two or more sizes are
    wrong and one factor explains them as well, the factor is preferred.
    """
    effects = (*state.model, *state.found)
    held = frozenset(at for at, effect in enumerate(state.model) if type(effect) in NOISE_SIZE_PARAMETERS)

    def value(x: float) -> float:
        return axis.fit((*effects, ScaleFactor(factor=float(np.exp(x)))), held).log_likelihood

    x = float(max(np.linspace(-3.0, 3.0, 13), key=value))
    lo, hi = x - 0.5, x + 0.5
    for _ in range(16):
        a, b = hi - GOLDEN * (hi - lo), lo + GOLDEN * (hi - lo)
        lo, hi = (lo, b) if value(a) > value(b) else (a, hi)
    x = 0.5 * (lo + hi)
    worth = value(x) - state.score - PENALTY_NATS["scale_factor"]
    if resized.freed > 1 and value(x) > resized.likely.log_likelihood - SCALE_FACTOR_MARGIN_NATS:
        worth = max(worth, resized.score - state.score)
    return Trial("scale_factor", ScaleFactor(factor=float(np.exp(x))), worth)
